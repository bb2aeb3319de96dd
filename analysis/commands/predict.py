"""Command ``predict``: from kicks of an open loop to the closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.commands.sessions import CONTRACT, JointTopicOptions
from undulog.capture.common.console import emit_json
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.common.files import check_output

from .analyse import chosen, experiment_of, show

if TYPE_CHECKING:
    from ..results.coupling import Coupling, LocalCoupling


def predict(
    *files: Path,
    eps: float,
    age: float = 0.0,
    kick: Annotated[list[str] | None, Parameter(name="--kick")] = None,
    until: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Predict from kicks how oscillators that feel their servos synchronise through the body.

    Generators phi' = omega + eps (2 q/A cos phi - b), each with its own servo's angle q, have no
    other coupling than the body. The matrices P and R that kicks of the open loop gave
    (`undulog plan phase-kicks`) give how their phases relax or grow, with nothing fitted: rates and
    patterns with 95 % intervals, and what is left of a kick.

    Example: `undulog predict kicks.json --eps 0.3 --kick joint05=0.2 -o predicted.json`

    Args:
        files: The runs of a kick experiment (MCAP), or its result, one `.json` file.
        eps: Rate of the feedback [1/s].
        age: How old a servo's angle is on average when it is used [s].
        kick: `JOINT=RAD`, turn its oscillator and follow all phases; may be given several times.
        until: How long to follow them [s].
        start: Start of what is analysed of each session, from its start [s]; chosen if not given.
        stop: Its end [s].
        topics: Where commands and responses are.
        output: Write the JSON to this file too, a name that ends in .json.
        force: Replace the output file if it exists.
        json: Print the result as one JSON object.
    """
    if not files:
        raise UsageError("predict needs kicks, e.g. undulog predict kicks.json --eps 0.3")
    turned = _kicks(kick or ())
    options = chosen(start, stop, topics)
    if output is not None:
        why = "the prediction is JSON; end its name in .json"
        check_output(output, (".json",), why, force=force)
    from dataclasses import asdict
    from json import dumps

    from undulog.capture.common.files import write_text

    from ..experiment.kicks.prediction import closed_loop
    from ..present.text import render_loop

    first, *others = files
    if any(one.suffix.lower() == ".json" for one in files):
        if others:
            raise UsageError("predict takes one result file, or the sessions of an experiment")
        coupling = coupling_of_result(first)
    else:
        coupling = _local(experiment_of(files, options, "predict").coupling)
    found = closed_loop(coupling, eps, age_s=age, kick=turned, until_s=until)
    if output is not None:
        write_text(output, dumps(asdict(found), indent=2, allow_nan=False) + "\n")
    if json:
        emit_json(asdict(found))
        return
    show(lambda width, color: render_loop(found, width=width, color=color), output)


def _kicks(words: Sequence[str]) -> dict[str, float]:
    """Parse joints and angles of ``JOINT=RAD``."""
    found: dict[str, float] = {}
    for word in words:
        name, equals, angle = word.rpartition("=")
        try:
            found[name] = float(angle)
        except ValueError:
            equals = ""
        if not name or not equals:
            raise UsageError(f"--kick {word}: expected JOINT=RAD, e.g. joint05=0.2")
    return found


def coupling_of_result(file: Path) -> LocalCoupling:
    """Read the coupling of a result of kicks.

    Raises:
        DataError: If the file holds none.
    """
    from ..present.notebook.files import load
    from ..results.coupling import Coupling
    from ..results.experiment import Experiment

    result = load(file)
    coupling = result.coupling if isinstance(result, Experiment) else result
    if not isinstance(coupling, Coupling):
        raise DataError(
            f"{file}: holds no coupling from kicks; give the result of all their sessions"
        )
    return _local(coupling)


def _local(coupling: Coupling) -> LocalCoupling:
    from ..results.coupling import LocalCoupling

    if isinstance(coupling, LocalCoupling):
        return coupling
    if not coupling.identifiable:
        record = f"; record {coupling.record}" if coupling.record else ""
        raise DataError(f"no coupling to predict from: {coupling.why}{record}")
    raise DataError("no coupling to predict from: these are no kicks around one gait")
