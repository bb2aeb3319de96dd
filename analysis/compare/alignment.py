"""Which joints and gaits of two groups of sessions are compared with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import ComplexArray
from undulog.capture.common.errors import DataError

from ..session.runs import GaitRun, command_difference, other_frequency
from .side import ComparedSession
from .tracking import commands_differ


@dataclass(frozen=True)
class Alignment:
    """Common joints and gait of the sessions of both sides.

    Attributes:
        names: Joints that can be compared, head to tail.
        left_out: Joints that can't, and why.
        gaits_differ: How the gaits differ, or None.
        commands_differ: How the commands of joints differ that are no gait, or None.
    """

    names: tuple[str, ...]
    left_out: dict[str, str]
    gaits_differ: str | None
    commands_differ: str | None = None


def align(a: Sequence[GaitRun], b: Sequence[GaitRun], *, any_gait: bool = False) -> Alignment:
    """Find the joints that can be compared.

    Args:
        a: Runs of one side, at least one.
        b: Runs of the other, at least one.
        any_gait: Compare the responses although the gaits differ.

    Raises:
        DataError: If a session has no gait, no joint is in all of them, or the gaits differ and
            that is not allowed.
    """
    runs = [*a, *b]
    for run in runs:
        if not run.names:
            raise DataError(
                f"{run.label} has no gait, so there is no gait phase to align it by, and others "
                "have one: compare sessions with a gait, or sessions without"
            )
    for side, side_runs in (("A", a), ("B", b)):
        refuse_copies([(run.label, run.ratio) for run in side_runs], side)
    joints = list(dict.fromkeys(name for run in runs for name in run.names))
    answered = [
        {name for name, ratio in zip(run.names, run.ratio, strict=True) if np.isfinite(ratio)}
        for run in runs
    ]
    names = tuple(name for name in joints if all(name in run_joints for run_joints in answered))
    if not names:
        raise DataError(
            f"no joint has gain and lag in all sessions: {a[0].label} drives "
            f"{_some(a[0].names)}, {b[0].label} {_some(b[0].names)}"
        )
    left_out = {
        name: "no gain and lag in "
        + ", ".join(
            r.label for r, run_joints in zip(runs, answered, strict=True) if name not in run_joints
        )
        for name in joints
        if name not in names
    }
    faults = [fault for run in runs[1:] if (fault := gait_fault(run, runs[0], names)) is not None]
    if faults and not any_gait:
        raise DataError(
            f"the gaits differ, so joints would answer differently anyway: {faults[0]}; record the "
            "same gait, or compare nevertheless with --any-gait"
        )
    return Alignment(names, left_out, faults[0] if faults else None)


def align_commanded(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession], *, any_gait: bool = False
) -> Alignment:
    """Find the joints of sessions with commands that can be compared, of gaits or of any motion.

    Args:
        a: Sessions of one side, at least one.
        b: Sessions of the other, at least one.
        any_gait: Compare the responses although the gaits differ.

    Raises:
        DataError: If no joint can be compared, only some sessions have a gait, or the gaits differ
            and that is not allowed.
    """
    sides = [[session.analysis.tracking for session in side] for side in (a, b)]
    with_delay = [
        {place for quantity, place in session.estimates if quantity == "delay"}
        for session in (*a, *b)
    ]
    tracked = [
        joint.joint for joint in sides[0][0] if all(joint.joint in names for names in with_delay)
    ]
    if tracked and not any(session.run.names for session in (*a, *b)):
        for side, sessions in (("A", a), ("B", b)):
            refuse_copies(
                [(session.run.label, _numbers(session, tracked)) for session in sessions], side
            )
        aligned = Alignment((), {}, None)
    else:
        aligned = align(
            [session.run for session in a], [session.run for session in b], any_gait=any_gait
        )
    some = {name for names in with_delay for name in names} - {*tracked, *aligned.names}
    left_out = dict.fromkeys(sorted(some), "no gain, lag and offset in all sessions")
    return replace(
        aligned,
        names=(*aligned.names, *(name for name in tracked if name not in aligned.names)),
        left_out={**left_out, **aligned.left_out},
        commands_differ=commands_differ(sides[0], sides[1], tracked),
    )


def _numbers(session: ComparedSession, names: Sequence[str]) -> ComplexArray:
    """Return what a copy of a session has, too."""
    keys = [(quantity, name) for quantity in ("gain", "delay", "offset") for name in names]
    return np.array([session.estimates[key][0] for key in keys], np.complex128)


def gait_fault(run: GaitRun, model: GaitRun, names: Sequence[str]) -> str | None:
    """Return the difference of a run's gait from the model's.

    Args:
        model: The run that it is held against.
        names: Joints to look at, driven in both.

    Returns:
        The reason, or None within 0.5 % of the frequency and 1 % of every command's amplitude.
    """
    if (different := other_frequency(run, model)) is not None:
        return f"{run.label} has {different[0]} Hz, {model.label} {different[1]} Hz"
    command, other = (
        np.array([gait.command[gait.names.index(name)] for name in names]) for gait in (run, model)
    )
    groups, others = (
        [gait.group[gait.names.index(name)] for name in names] for gait in (run, model)
    )
    if groups != others:
        return f"{run.label} has other joints than {model.label} at one frequency"
    members = [np.flatnonzero(np.array(groups) == group) for group in set(groups)]
    if (off := command_difference(command, other, members)) is None:
        return None
    worst, percent, degrees = off
    return (
        f"at {names[worst]} the command of {run.label} is {percent} % in amplitude and {degrees} "
        f"degrees in phase off that of {model.label}"
    )


def refuse_copies(runs: Sequence[tuple[str, ComplexArray]], side: str) -> None:
    """Raise an error for copies: two copies of one run would show no scatter.

    Args:
        runs: Label and numbers of each.
    """
    seen: dict[bytes, str] = {}
    for label, values in runs:
        numbers = values.tobytes()
        if numbers in seen:
            raise DataError(
                f"{label} is a copy of the numbers of {seen[numbers]} on side {side}: a copy "
                "is not a run of its own"
            )
        seen[numbers] = label


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
