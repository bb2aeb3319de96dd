"""A dry run in words, the answer first, and as one JSON object."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from undulog.capture.common.console import Column, table

from ..gate.limits import safety_example
from ..gate.outcome import some_names
from .dry_run import DryRun, Verdict
from .dry_run_gait import Demand, JointDemand

_NOTHING = "-"
_TOO_NARROW = "; the terminal is too narrow for all of it, --json has it"


def _number(value: float, form: str) -> str:
    return _NOTHING if math.isnan(value) else format(value, f"z{form}")


def _degrees(value: float, form: str = ".1f") -> str:
    return _number(math.degrees(value), form)


def _share(name: str) -> Callable[[JointDemand], str]:
    def cell(joint: JointDemand) -> str:
        (found,) = (demand for demand in joint.demands if demand.name == name)
        return _number(100.0 * found.share, ".0f")

    return cell


_COLUMNS: tuple[tuple[Column, Callable[[JointDemand], str]], ...] = (
    (Column("joint", left=True), lambda joint: joint.name),
    (Column("from °", spare=4), lambda joint: _degrees(joint.least)),
    (Column("to °", spare=4), lambda joint: _degrees(joint.greatest)),
    (Column("%"), _share("range")),
    (Column("°/s", spare=5), lambda joint: _degrees(joint.rate, ".0f")),
    (Column("%"), _share("rate")),
    (Column("°/s²", spare=1), lambda joint: _degrees(joint.acceleration, ".0f")),
    (Column("error °", spare=5), lambda joint: _degrees(joint.tracking_error)),
    (Column("%"), _share("tracking error")),
    (Column("N m", spare=5), lambda joint: _number(joint.torque_peak, ".3f")),
    (Column("%"), _share("torque")),
    (Column("rms", spare=2), lambda joint: _number(joint.torque_rms, ".3f")),
    (Column("A", spare=5), lambda joint: _number(joint.current_peak, ".2f")),
    (Column("%"), _share("current")),
    (Column("net J", spare=3), lambda joint: _number(joint.energy_net_j, ".3f")),
    (Column("abs J", spare=2), lambda joint: _number(joint.energy_abs_j, ".3f")),
    (Column("el. J", spare=3), lambda joint: _number(joint.energy_el_j, ".3f")),
    (Column("clamped", spare=3), lambda joint: _number(joint.clamped or math.nan, ".0%")),
)


def joint_table(joints: Sequence[JointDemand], width: int) -> Iterator[str]:
    """The table.

    Args:
        joints: What is asked of each.
        width: Characters in a line; columns that may go, go where they don't fit.

    Yields:
        What the percentages are of, the heads, a line for each joint.
    """
    rows = [[(cell(joint), "") for _, cell in _COLUMNS] for joint in joints]
    lines, left_out = table([column for column, _ in _COLUMNS], rows, width)
    yield (
        "% of the limit: half the range, [safety]'s rate, tracking error and current, the servo's "
        f"stall torque{_TOO_NARROW if left_out else ''}"
    )
    yield from (line.plain for line in lines)


_NAMED = 3
_REMARKS = 6
_SHOWN_AS = {  # of a demand: unit and how many of it are one of SI's
    "range": ("°", math.degrees(1.0)),
    "rate": ("°/s", math.degrees(1.0)),
    "tracking error": ("°", math.degrees(1.0)),
    "current": ("A", 1.0),
    "torque": ("N m", 1.0),
}


def summary_lines(run: DryRun, width: int) -> Iterator[str]:
    """Lines for a terminal.

    Args:
        width: Characters in a line of the table.

    Yields:
        The answer, what it would take, the joints.
    """
    yield from _answer(run)
    yield from _remarks(run)
    where = f"{run.driven.kind} in the twin of {run.scenario.robot.name} in {run.scenario.name}"
    yield f"{where}, {run.duration_s:g} s; nothing was sent, and no bus opened"
    yield _approach(run)
    seconds = max(run.duration_s, 1e-9)
    net, absolute, electrical = run.energy_j
    yield (
        f"energy: mechanical {net:.3g} J net and {absolute:.3g} J absolute, electrical "
        f"{electrical:.3g} J; mean power {net / seconds:.3g} W and {electrical / seconds:.3g} W"
    )
    if run.path is not None:
        yield f"session of the twin: {run.path}"
    yield ""
    yield from joint_table(run.joints, width)


def _answer(run: DryRun) -> Iterator[str]:
    robot, near = run.scenario.robot.name, _nearest(run)
    what = f"{run.driven.name} on {robot}"
    match run.verdict:
        case Verdict.RUNS:
            yield f"{what} would run as it is; {near}"
        case Verdict.CLAMPED:
            yield f"{what} would run, clamped: {_clamps(run)}; {near}"
        case Verdict.STOPS:
            when = f"at {run.duration_s:.2f} s" if run.started else "on the way to the first pose"
            why = run.fault.text if run.fault is not None else ""
            yield f"{what} would stop {when}: {why}"
        case Verdict.UNFINISHED:
            yield (
                f"{what}: not known, the dry run was stopped at {run.duration_s:g} s of "
                f"{run.scenario.duration_s:g} s; {near}"
            )
        case Verdict.REFUSED:
            lacks = f"{robot} lacks the limits {', '.join(run.missing)}"
            yield f"{what} would not start: {lacks}; {near}"
            yield "Its description needs this, with values of its own; --robot names the file:"
            yield from (f"  {line}" for line in safety_example(run.missing).splitlines())


def _nearest(run: DryRun) -> str:
    """What comes closest to its limit."""
    found = run.closest
    if found is None:
        return "it has no limits to come close to"
    joint, demand = found
    unit, scale = _SHOWN_AS[demand.name]
    return (
        f"closest to a limit: {joint}, {demand.name} {scale * demand.value:.3g} of "
        f"{scale * demand.limit:.3g} {unit} ({demand.share:.0%})"
    )


def _clamps(run: DryRun) -> str:
    named = [
        f"{joint.name} {joint.clamped:.0%} of the time" for joint in run.joints if joint.clamped
    ]
    cut = f"cut to the joint limits: {', '.join(run.cut)}" if run.cut else ""
    return "; ".join(part for part in (some_names(named, _NAMED), cut) if part)


def _remarks(run: DryRun) -> Iterator[str]:
    """What the gate would change, and why."""
    found = [remark.text for remark in run.remarks if remark.level == "warn"]
    yield from (f"  {text}" for text in found[:_REMARKS])
    if len(found) > _REMARKS:
        yield f"  and {len(found) - _REMARKS} more of this kind; --json has all"


def _approach(run: DryRun) -> str:
    if np.isnan(run.first_pose).any():
        return "first pose: not known"
    farthest = max(range(len(run.joints)), key=lambda i: abs(run.first_pose[i]))
    angle = math.degrees(run.first_pose[farthest])
    if run.approach_s == 0.0:
        return "first pose: straight joints"
    how_long = f"a ramp of {run.approach_s:.2f} s from straight joints"
    if math.isnan(run.approach_s):
        how_long = "no ramp_rate gives the speed of the way there"
    return f"first pose: {run.joints[farthest].name} farthest, at {angle:.1f}°; {how_long}"


def reported(run: DryRun) -> dict[str, Any]:
    """The dry run as plain JSON values.

    Returns:
        SI units; what isn't known, or has no limit, is None.
    """
    found = run.closest
    net, absolute, electrical = run.energy_j
    seconds = max(run.duration_s, 1e-9)
    return {
        "armed": False,
        "driven": run.driven.name,
        "kind": run.driven.kind,
        "robot": run.scenario.robot.name,
        "world": run.scenario.name,
        "verdict": str(run.verdict),
        "would_run": run.verdict.fit,
        "duration_s": run.duration_s,
        "planned_duration_s": run.scenario.duration_s,
        "stop": _stop(run),
        "missing_limits": list(run.missing),
        "closest": None if found is None else {"joint": found[0], **_demand(found[1])},
        "first_pose": list(run.first_pose),
        "approach_s": _known(run.approach_s),
        "energy_net_j": net,
        "energy_abs_j": absolute,
        "energy_el_j": electrical,
        "power_net_w": net / seconds,
        "power_el_w": electrical / seconds,
        "cut": list(run.cut),
        "remarks": [{"level": one.level, "text": one.text} for one in run.remarks],
        "joints": [_joint(joint) for joint in run.joints],
        "path": None if run.path is None else str(run.path),
    }


def _stop(run: DryRun) -> dict[str, Any] | None:
    fault = run.fault
    if fault is None:
        return None
    time_s = run.duration_s if run.started else None
    return {"time_s": time_s, "why": fault.text, **fault.to_dict()}


def _joint(joint: JointDemand) -> dict[str, Any]:
    values = {name: _known(value) for name, value in vars(joint).items()}
    shares = {demand.name.replace(" ", "_"): _known(demand.share) for demand in joint.demands}
    return {**values, "margin": joint.margin, "share": shares}


def _demand(demand: Demand) -> dict[str, Any]:
    return {
        "quantity": demand.name,
        "value": demand.value,
        "limit": demand.limit,
        "share": demand.share,
    }


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
