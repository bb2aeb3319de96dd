"""The verb ``sim null``: a model of identical modules, for sessions of one direction."""

from __future__ import annotations

from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from undulog.capture.common.console import emit_json, progress, refuse_existing, say
from undulog.capture.common.errors import UsageError


def null(
    scenario: str,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    spread: float = 0.2,
    kernels: Literal["numpy", "numba", "auto"] = "auto",
    force: bool = False,
    json: bool = False,
) -> None:
    """Model how identical modules answer a scenario's gait, for `undulog analyse --null`.

    The twin runs the scenario with its servos' stall torque, gain and friction and the ground's
    friction changed by 10 %, singly and by pairs, and with each module changed by itself: about a
    hundred runs for 13 driven joints. The scenario's modules must be identical and its gait steady.

    Example: `undulog sim null weak-servo-pi3 -o weak.null.json`

    Args:
        scenario: Name of a shipped scenario (see `undulog sim list`), or a TOML file.
        output: The model to write, `.json`.
        spread: Relative standard deviation of the shared parameters, as known before a session.
        kernels: What computes the forces: `numba` is faster; `auto` takes it where it is installed.
        force: Replace the output if it is there.
        json: Print one JSON object instead of text.
    """
    from undulog.capture.robot.null_model import write_null_model

    from ..null_model.null_model import null_model
    from ..scenario.engines import Kernels
    from ..scenario.scenario_file import load_scenario

    if output.suffix.lower() != ".json":
        raise UsageError(f"{output}: a null model is JSON; end its name in .json")
    if not 0 < spread < 1:
        raise UsageError(f"--spread {spread:g}: give a share between 0 and 1")
    chosen = load_scenario(scenario)
    refuse_existing(output, force=force)
    compiled = kernels == "numba" or (kernels == "auto" and find_spec("numba") is not None)
    with progress(f"null model of {chosen.name}", 1.0) as bar:
        model = null_model(
            chosen,
            made_by=f"undulog {version('undulog')} sim null {chosen.name} ({chosen.session_id})",
            spread=spread,
            kernels=Kernels.NUMBA if compiled else Kernels.NUMPY,
            on_run=lambda done, total: bar.update(done / total, f"run {done} of {total}"),
        )
    write_null_model(output, model)
    if json:
        emit_json(
            {
                "path": str(output),
                "robot": model.robot,
                "frequency_hz": model.frequency_hz,
                "joints": list(model.joints),
                "parameters": {one.name: one.value for one in model.parameters},
                "error": model.error,
            }
        )
        return
    say(
        f"{output}: {len(model.joints)} driven joints of {model.robot} at {model.frequency_hz:g} "
        f"Hz; off the twin by at most {model.error:.2g} in ln gain and lag within its reach"
    )
    for one in model.parameters:
        say(
            f"{one.name.replace('_', ' ')} {one.value:g} {one.unit}, by a factor "
            f"exp(±{one.reach:g})"
        )
