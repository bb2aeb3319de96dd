"""Command ``sim fit``: a calibration, in words or as one JSON object."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import echo, emit_json, progress, refuse_existing
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_stop
from undulog.capture.common.process import interruptible

if TYPE_CHECKING:
    from ..calibrate.fit import CalibrationResult, FittedParameter
    from ..calibrate.identifiability import Alternative
    from ..calibrate.lack_of_fit import JointMisfit, LackOfFit

_NOT_NOISE = 3.0
"""An autocorrelation time of the residual from which it is called out [samples]."""


def fit(
    *files: Path,
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
    """Fit the twin's servo and friction to sessions, so that it answers as the robot did.

    The sessions' commands are given to the twin again and again, at their own times, its parameters
    changed until its joint angles match the recorded ones. Several sessions of one robot share all
    parameters. Each parameter comes with a 95 % interval, and those that
    the sessions do not determine are named, with what would determine them. The written robot
    description has the fitted servo; the ground's friction belongs to a scenario: `--scenario`.

    Example: `undulog sim fit run.mcap --on twin:flat --modules -o fitted.toml`

    Args:
        files: Sessions, `.mcap`: commands and joint states, of a robot or of the twin.
        on: `twin:SCENARIO` to start from, or `twin`, the world that each was recorded in.
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
        settle: The first seconds of each session to leave out, instead of its own.
        topics: Where commands and responses are; commands are never found by type.
        kernels: What computes the forces: `numba` is faster; `auto` takes it where it is installed.
        force: Replace the outputs if they are there.
        json: Print one JSON object instead of text.
    """
    if not files:
        raise UsageError("give one or several sessions, .mcap")
    _check(output, scenario, spread, within, both=module is not None and modules)
    scheme, colon, world = on.partition(":")
    if scheme != "twin" or bool(colon) != bool(world):
        raise UsageError(f"--on {on}: expected twin or twin:SCENARIO")
    for path in (output, scenario):
        if path is not None:
            refuse_existing(path, force=force)
    from undulog.sim.scenario.scenario import Kernels

    from ..calibrate.fit import Wanted, calibrate
    from ..calibrate.written import write_calibration

    compiled = kernels == "numba" or (kernels == "auto" and find_spec("numba") is not None)
    options = Wanted(tuple(only or ()), module, modules, delay, spread, within, settle)
    names = ", ".join(file.name for file in files)
    with interruptible() as stop, progress(f"fit to {names}", 1.0) as bar:
        calibration = calibrate(
            files,
            world or None,
            options,
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
        emit_json({**_facts(calibration), "written": paths})
        return 0
    echo(*_summary(calibration))
    echo(f"{output}: the robot with the fitted servo")
    if scenario is not None:
        echo(f"{scenario}: the scenario with the fitted ground, on that robot")
    elif calibration.scenario.world.ground is not None:
        echo("The ground's friction belongs to a scenario: --scenario FILE writes one.")
    return 0


def _check(
    output: Path, scenario: Path | None, spread: float, within: float, *, both: bool
) -> None:
    for path in (output, scenario):
        if path is not None and path.suffix.lower() != ".toml":
            raise UsageError(f"{path}: descriptions are TOML; end its name in .toml")
    if scenario is not None and scenario.resolve() == output.resolve():
        raise UsageError(f"--scenario {scenario}: that is the robot's file; name another one")
    if not 0 < spread <= 2:
        raise UsageError(f"--spread {spread:g}: give a share between 0 and 2")
    if not 0 < within < 1:
        raise UsageError(f"--within {within:g}: give a share between 0 and 1")
    if both:
        raise UsageError("--module and --modules: give one of them")


def _summary(calibration: CalibrationResult) -> Iterator[str]:
    """Yield lines for a terminal: the answer first, joints last."""
    before, after = (_rms(misfits) for misfits in (calibration.before, calibration.after))
    if calibration.lack.significant:
        yield from _lack(calibration.lack)
    yield (
        f"{', '.join(calibration.sessions)} in {calibration.world}: "
        f"twin and robot are {before:.3g} rad apart "
        f"(RMS) before, {after:.3g} rad after; {calibration.iterations} iterations, "
        f"{calibration.runs} runs at {calibration.speed:.1f} x real time"
    )
    if not calibration.converged:
        yield "The fit did not come to an end: take its numbers as a step on the way."
    fits = not calibration.lack.significant
    yield "Parameters (95 % interval; before):" if fits else "Parameters (no interval; before):"
    width = max(len(parameter.label) for parameter in calibration.parameters)
    yield from (f"  {_parameter(parameter, width)}" for parameter in calibration.parameters)
    if fits:
        yield from _undetermined(calibration)
    yield from _search(calibration)
    yield from _checked(calibration.lack)
    if calibration.memory > _NOT_NOISE:
        yield (
            f"What is left has a memory of {calibration.memory:.0f} samples: it isn't the noise of "
            "encoders alone."
        )
    yield "Joints (before -> after):"
    for joint, first in calibration.before.items():
        yield f"  {joint}  {_misfit(first, calibration.after[joint])}"


def _facts(calibration: CalibrationResult) -> dict[str, Any]:
    """Return the calibration as plain JSON values, in SI units."""
    search, lack = calibration.search, calibration.lack
    return {
        "session": calibration.sessions[0],
        "sessions": list(calibration.sessions),
        "world": calibration.world,
        "parameters": [
            {key: value for key, value in vars(parameter).items() if key != "label"}
            for parameter in calibration.parameters
        ],
        "undetermined": [
            parameter.label for parameter in calibration.parameters if not parameter.determined
        ],
        "ridges": [vars(ridge) for ridge in calibration.ridges],
        "would_tell": list(calibration.would_tell),
        "search": None
        if search is None
        else {**vars(search), "named": search.named and not lack.significant},
        "misfit": {
            joint: {"before": vars(first), "after": vars(calibration.after[joint])}
            for joint, first in calibration.before.items()
        },
        "fits": not lack.significant,
        "lack_of_fit": {
            "p": lack.p,
            "worst": lack.worst,
            "explanation": None if lack.explanation is None else lack.explanation.label,
            "gait_hz": lack.gaits_hz[0] if lack.gaits_hz else None,
            "joints": {joint: vars(result) for joint, result in lack.joints.items()},
            "alternatives": [
                {
                    "label": alternative.label,
                    "size": alternative.size,
                    "ci95": alternative.ci95,
                    "p": alternative.p,
                }
                for alternative in lack.alternatives
            ],
            "unfitted": None if lack.unfitted is None else vars(lack.unfitted),
        },
        "rms_rad": {"before": _rms(calibration.before), "after": _rms(calibration.after)},
        "half_step_rms_rad": calibration.step.rms,
        "residual_memory_samples": calibration.memory,
        "iterations": calibration.iterations,
        "converged": calibration.converged,
        "runs": calibration.runs,
        "real_time_factor": calibration.speed,
    }


def _lack(lack: LackOfFit) -> Iterator[str]:
    """The first line of a fit that doesn't fit."""
    from ..calibrate.lack_of_fit import LEVEL

    parts: list[str] = []
    if (best := lack.explanation) is not None:
        taken = f"takes {100 * (1 - best.left):.0f} % of what is left"
        parts.append(f"{best.label} would fit better ({_size(best)}; {taken})")
    if off := [j for j, joint in lack.joints.items() if len(lack.joints) * joint.p < LEVEL]:
        periodic = lack.joints[lack.worst].periodic_rad
        size = "" if periodic is None else f" by {periodic:.2g} rad (RMS)"
        how = "is no noise" if periodic is None else "comes back with every cycle"
        others = f" and {len(off) - 1} more" if len(off) > 1 else ""
        parts.append(f"what is left at {lack.worst}{others} {how}{size}")
    if lack.unfitted is not None and lack.unfitted.p < LEVEL:
        parts_of = "sessions" if lack.unfitted.by_session else "the two halves of the session"
        parts.append(
            f"{parts_of} ask for different parameters "
            f"({lack.unfitted.unfitted_rad:.3g} rad off where not fitted, "
            f"{lack.unfitted.fitted_rad:.3g} where fitted)"
        )
    why = "; ".join(parts) or "its joints and halves together leave more than noise"
    yield (
        f"The twin doesn't fit this session ({_p(lack.p)}): {why}. It lacks something that the "
        "robot has: another friction law, play, a weak module (--modules). The values are those "
        "that fit best; they have no intervals, and none is determined."
    )


def _size(other: Alternative) -> str:
    """How much of another law, with its 95 % interval."""
    low, high = other.ci95
    if other.widens:
        return f"weight {other.size:.2f} [{low:.2f}, {high:.2f}], 0 is the twin's law"
    return f"{other.size:.2g} rad [{low:.2g}, {high:.2g}]"


def _checked(lack: LackOfFit) -> Iterator[str]:
    if lack.significant:
        return
    what = "the gait's harmonics" if lack.gaits_hz else "the residual's memory"
    off = ""
    if lack.unfitted is not None:
        size = lack.unfitted.unfitted_rad
        other_part = "each session under the parameters of the others"
        if not lack.unfitted.by_session:
            other_part = "each half under the parameters of the other"
        off = f"; {other_part} is {size:.3g} rad off"
    if open_laws := [
        alternative.label
        for alternative in lack.alternatives
        if alternative.widens and alternative.could_be
    ]:
        yield (
            f"Not determined by this session: {' or '.join(open_laws)} would do as well; "
            "intervals have it in them."
        )
    yield f"Fits: nothing but noise is shown at {what} ({_p(lack.p)}){off}."


def _p(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _rms(misfits: dict[str, JointMisfit]) -> float:
    import numpy as np

    return float(np.sqrt(np.mean([misfit.rms**2 for misfit in misfits.values()])))


def _parameter(fitted: FittedParameter, width: int) -> str:
    from ..calibrate.parameters import DELAY

    scale, unit = (
        (1e3, "ms") if fitted.name == DELAY else (1.0, "" if fitted.unit == "1" else fitted.unit)
    )
    numbers = f"{scale * fitted.value:.4g}"
    if fitted.ci95 is not None:
        low, high = fitted.ci95
        numbers += f" [{scale * low:.4g}, {scale * high:.4g}]"
    before = "" if fitted.name == DELAY else f"; {scale * fitted.start:.4g}"
    open_ = "" if fitted.determined or fitted.ci95 is None else ", undetermined"
    return f"{fitted.label:{width}}  {numbers} {unit}".rstrip() + before + open_


def _undetermined(calibration: CalibrationResult) -> Iterator[str]:
    from ..calibrate.parameters import DELAY

    open_ones = [
        parameter.label for parameter in calibration.parameters if not parameter.determined
    ]
    if not open_ones:
        return
    yield f"Undetermined by this session: {', '.join(open_ones)}."
    for ridge in calibration.ridges:
        parts = (
            f"{label} + {1e3 * factor:.2g} ms" if label == DELAY else f"{label} x {factor:.2f}"
            for label, factor in ridge.factors.items()
        )
        yield f"  answers alike: {', '.join(parts)}"
    yield from (f"  what would determine {line}" for line in calibration.would_tell)


def _search(calibration: CalibrationResult) -> Iterator[str]:
    if (search := calibration.search) is None:
        return
    p = _p(search.p)
    if search.named and calibration.lack.significant:
        yield (
            f"Of {search.tried} modules {search.module} lessens the misfit most; whether it "
            "differs is open, since the twin doesn't fit."
        )
    elif search.named:
        yield f"Of {search.tried} modules {search.module} differs ({p}, family-wise)."
    else:
        yield (
            f"Of {search.tried} modules none is shown to differ; {search.module} would be the "
            f"first ({p}, family-wise)."
        )


def _misfit(first: JointMisfit, last: JointMisfit) -> str:
    text = f"{first.rms:.4f} -> {last.rms:.4f} rad"
    if first.gain is None or last.gain is None or first.late_s is None or last.late_s is None:
        return text
    return (
        f"{text}; gain {100 * first.gain:+.1f} -> {100 * last.gain:+.1f} %; late "
        f"{1e3 * first.late_s:+.1f} -> {1e3 * last.late_s:+.1f} ms"
    )
