"""A dry run in words, the answer first, and as one JSON object."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from capture.robot.safety import safety_example

from .dry_run import DryRun, Verdict

if TYPE_CHECKING:
    from .dry_run_tally import Demand, JointDemand

_NAMED = 3
_REMARKS = 6
_NOTHING = "-"
_TITLES = (
    *("joint", "least °", "greatest °", "of limit", "rate °/s", "of max"),
    *("error °", "of max", "peak N m", "of stall", "rms N m", "peak A", "of max"),
    *("net J", "abs J", "el. J", "clamped", "accel. °/s²"),
)
_SPARE = ("rms N m", "abs J", "accel. °/s²")
"""Columns that a narrow terminal goes without."""

_SHOWN_AS = {  # of a demand: unit and how many of it are one of SI's
    "range": ("°", math.degrees(1.0)),
    "rate": ("°/s", math.degrees(1.0)),
    "tracking error": ("°", math.degrees(1.0)),
    "current": ("A", 1.0),
    "torque": ("N m", 1.0),
}


def told(run: DryRun, width: int) -> Iterator[str]:
    """Lines for a terminal.

    Args:
        run: How it went.
        width: Characters in a line of the table.

    Yields:
        The answer, what it would take, the joints.
    """
    yield from _answer(run)
    yield from _remarks(run)
    yield (
        f"{run.kind} in the twin of {run.robot} in {run.world}, {run.duration_s:g} s; nothing was "
        "sent, and no bus opened"
    )
    yield _approach(run)
    seconds = max(run.duration_s, 1e-9)
    net, absolute, electrical = run.energy_j
    yield (
        f"energy: {net:.3g} J mechanical ({absolute:.3g} J without sign), {electrical:.3g} J "
        f"electrical; mean power {net / seconds:.3g} W and {electrical / seconds:.3g} W"
    )
    if run.path is not None:
        yield f"session of the twin: {run.path}"
    yield ""
    yield from _table(run.joints, width)


def _answer(run: DryRun) -> Iterator[str]:
    what, near = f"{run.driven} on {run.robot}", _nearest(run)
    match run.verdict:
        case Verdict.RUNS:
            yield f"{what} would run as it is; {near}"
        case Verdict.CLAMPED:
            yield f"{what} would run, clamped: {_clamps(run)}; {near}"
        case Verdict.STOPS:
            when = f"at {run.duration_s:.2f} s" if run.started else "on the way to the first pose"
            why = run.fault.text if run.fault is not None else ""
            yield f"{what} would stop {when}: {why}; {near}"
        case Verdict.UNFINISHED:
            yield (
                f"{what}: not known, the dry run was stopped at {run.duration_s:g} s of "
                f"{run.planned_s:g} s; {near}"
            )
        case Verdict.REFUSED:
            yield (
                f"{what} would not start: {run.robot} lacks the limits {', '.join(run.missing)}; "
                f"{near}"
            )
            yield "Its description needs, with values of its own:"
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
    more = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
    cut = f"cut to the joint limits: {', '.join(run.cut)}" if run.cut else ""
    return "; ".join(part for part in (", ".join(named[:_NAMED]) + more, cut) if part)


def _remarks(run: DryRun) -> Iterator[str]:
    """What the gate would change, and why."""
    found = [remark.text for remark in run.remarks if remark.level == "warn"]
    yield from (f"  {text}" for text in found[:_REMARKS])
    if len(found) > _REMARKS:
        yield f"  and {len(found) - _REMARKS} more of this kind; --json has all"


def _approach(run: DryRun) -> str:
    farthest = max(range(len(run.joints)), key=lambda i: abs(run.first_pose[i]))
    angle = math.degrees(run.first_pose[farthest])
    if run.approach_s == 0.0:
        return "first pose: straight joints"
    how_long = (
        "no ramp_rate says how fast"
        if math.isnan(run.approach_s)
        else (f"a ramp of {run.approach_s:.2f} s from straight joints")
    )
    return f"first pose: {run.joints[farthest].name} farthest, at {angle:.1f}°; {how_long}"


def _table(joints: Sequence[JointDemand], width: int) -> Iterator[str]:
    from capture.daemon.text_table import Column, table

    columns = [
        Column(title, len(title), left=not k, wide=title in _SPARE)
        for k, title in enumerate(_TITLES)
    ]
    rows = [[(cell, "") for cell in _cells(joint)] for joint in joints]
    yield from (line.plain for line in table(columns, rows, width))


def _cells(joint: JointDemand) -> list[str]:
    share = {demand.name: _share(demand) for demand in joint.demands}
    energies = joint.energy_net_j, joint.energy_abs_j, joint.energy_el_j
    return [
        joint.name,
        *(f"{math.degrees(angle):z.1f}" for angle in (joint.least, joint.greatest)),
        share["range"],
        *(_number(math.degrees(joint.rate), ".0f"), share["rate"]),
        *(_number(math.degrees(joint.tracking_error), ".1f"), share["tracking error"]),
        *(_number(joint.torque_peak, "z.3f"), share["torque"], _number(joint.torque_rms, "z.3f")),
        *(_number(joint.current_peak, ".2f"), share["current"]),
        *(_number(energy, "z.3f") for energy in energies),
        f"{joint.clamped:.0%}" if joint.clamped else _NOTHING,
        _number(math.degrees(joint.acceleration), ".0f"),
    ]


def _share(demand: Demand) -> str:
    return _number(demand.share, ".0%")


def _number(value: float, form: str) -> str:
    return _NOTHING if math.isnan(value) else format(value, form)


def reported(run: DryRun) -> dict[str, Any]:
    """The dry run as plain JSON values.

    Args:
        run: How it went.

    Returns:
        SI units; what isn't known, or has no limit, is None.
    """
    found = run.closest
    net, absolute, electrical = run.energy_j
    seconds = max(run.duration_s, 1e-9)
    return {
        "armed": False,
        "driven": run.driven,
        "kind": run.kind,
        "robot": run.robot,
        "world": run.world,
        "verdict": str(run.verdict),
        "would_run": run.verdict.fit,
        "duration_s": run.duration_s,
        "planned_duration_s": run.planned_s,
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
    return {
        "time_s": run.duration_s if run.started else None,
        "why": fault.text,
        "kind": str(fault.kind),
        "joint": fault.joint or None,
        "value": fault.value,
        "limit": fault.limit,
    }


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
