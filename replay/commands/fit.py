"""Command ``sim fit``."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import echo, emit_json, progress, refuse_existing
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_stop
from undulog.capture.common.process import interruptible


def fit(
    file: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    on: str = "twin",
    scenario: Path | None = None,
    only: Annotated[list[str] | None, Parameter(name="--only")] = None,
    module: str | None = None,
    modules: bool = False,
    delay: bool = False,
    spread: float = 0.5,
    within: float = 0.05,
    settle: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    kernels: Literal["numpy", "numba", "auto"] = "auto",
    force: bool = False,
    json: bool = False,
) -> int:
    """Fit the twin's servo and friction to a session, so that it answers as the robot did.

    The session's commands are given to the twin again and again, its parameters changed until its
    joint angles match the recorded ones. Each parameter comes with a 95 % interval, and those that
    the session does not determine are named, with what would determine them. The written robot
    description has the fitted servo; the ground's friction belongs to a scenario: `--scenario`.

    Example: `undulog sim fit run.mcap --on twin:flat --modules -o fitted.toml`

    Args:
        file: The session, `.mcap`: commands and joint states, of a robot or of the twin.
        on: `twin:SCENARIO` to start from, or `twin`, the world that it was recorded in.
        output: The robot description to write, `.toml`.
        scenario: The scenario to write, with the fitted ground and module, `.toml`.
        only: A parameter to fit, e.g. `stall_torque`; may be given several times. All by default:
            stall torque, proportional gain, Coulomb and viscous friction, gear stiffness and
            damping, and the ground's friction. The others stay as they are.
        module: Fit this joint's own stall torque, too, e.g. `joint05`.
        modules: Try every module, and name the one that differs.
        delay: Fit a dead time, too; the twin has none, so it is reported and not written.
        spread: Relative standard deviation of the parameters, as known before the session.
        within: A parameter counts as determined if its interval is within this share of it.
        settle: The first seconds to leave out, instead of the session's own.
        topics: Where commands and responses are; commands are never found by type.
        kernels: What computes the forces: `numba` is faster; `auto` takes it where it is installed.
        force: Replace the outputs if they are there.
        json: Print one JSON object instead of text.
    """
    _check(output, scenario, spread, within, one=module is not None and modules)
    scheme, colon, world = on.partition(":")
    if scheme != "twin" or bool(colon) != bool(world):
        raise UsageError(f"--on {on}: expected twin or twin:SCENARIO")
    for path in (output, scenario):
        if path is not None:
            refuse_existing(path, force=force)
    from undulog.sim.scenario.scenario import Kernels

    from ..calibrate.fit import Wanted, calibrate
    from ..calibrate.report import reported, summary_lines, write_calibration

    compiled = kernels == "numba" or (kernels == "auto" and find_spec("numba") is not None)
    wanted = Wanted(tuple(only or ()), module, modules, delay, spread, within, settle)
    with interruptible() as stop, progress(f"fit to {file.name}", 1.0) as bar:
        calibration = calibrate(
            file,
            world or None,
            wanted,
            topics=topics.names,
            kernels=Kernels.NUMBA if compiled else Kernels.NUMPY,
            on_tick=lambda: check_stop(output, stop),
            on_iteration=lambda k, rms, speed: bar.update(
                1.0 - 0.7**k, f"iteration {k}: {rms:.3g} rad, {speed:.1f} x real time"
            ),
        )
        check_stop(output, stop)
        write_calibration(calibration, output, scenario)
    if json:
        paths = {"robot": str(output), "scenario": None if scenario is None else str(scenario)}
        emit_json({**reported(calibration), "written": paths})
        return 0
    echo(*summary_lines(calibration))
    echo(f"{output}: the robot with the fitted servo")
    if scenario is not None:
        echo(f"{scenario}: the scenario with the fitted ground, on that robot")
    elif calibration.scenario.world.ground is not None:
        echo("The ground's friction belongs to a scenario: --scenario FILE writes one.")
    return 0


def _check(output: Path, scenario: Path | None, spread: float, within: float, *, one: bool) -> None:
    for path in (output, scenario):
        if path is not None and path.suffix.lower() != ".toml":
            raise UsageError(f"{path}: descriptions are TOML; end its name in .toml")
    if scenario is not None and scenario.resolve() == output.resolve():
        raise UsageError(f"--scenario {scenario}: that is the robot's file; name another one")
    if not 0 < spread <= 2:
        raise UsageError(f"--spread {spread:g}: give a share between 0 and 2")
    if not 0 < within < 1:
        raise UsageError(f"--within {within:g}: give a share between 0 and 1")
    if one:
        raise UsageError("--module and --modules: give one of them")
