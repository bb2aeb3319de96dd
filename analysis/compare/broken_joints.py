"""Joints that do not follow in one of two groups of sessions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from undulog.capture.common.console import plain

from ..common.answer import NotFollowing, StandOut
from ..parts.comparison.examine import OFFSET_RAD
from ..parts.comparison.words import deviation_in_words, fault_in_words
from ..results.comparison import BrokenJoint
from .side import ComparedSession

_Entry = TypeVar("_Entry", NotFollowing, StandOut)


def broken_joints(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession]
) -> tuple[BrokenJoint, ...]:
    """Find the joints that do not follow, or stand off their command, on one side only.

    Returns:
        The joints in the order of the answers, those that do not follow first.
    """
    joints: list[BrokenJoint] = []
    for side, sessions, other in (("B", b, a), ("A", a, b)):
        answers = [session.analysis.answer for session in sessions]
        elsewhere = {
            fault.joint for session in other for fault in session.analysis.answer.not_following
        }
        for fault in _first([fault for answer in answers for fault in answer.not_following]):
            if fault.joint not in elsewhere:
                text = f"in {side} {fault_in_words(fault)}"
                joints.append(BrokenJoint(fault.joint, side, fault.kinds, text))
        names = {joint.name for joint in joints}
        stand_out = [deviation for answer in answers for deviation in answer.stand_out]
        for deviation in _first(
            [deviation for deviation in stand_out if deviation.quantity == "offset"]
        ):
            if deviation.joint not in names | elsewhere and _moved(
                deviation.joint, sessions, other
            ):
                text = f"in {side} {plain(deviation.joint)} has {deviation_in_words(deviation)}"
                joints.append(BrokenJoint(deviation.joint, side, (), text))
    return tuple(sorted(joints, key=lambda joint: not joint.kinds))


def _moved(
    joint: str, sessions: Sequence[ComparedSession], other: Sequence[ComparedSession]
) -> bool:
    """Return whether a joint's mean differs between the sides, too: both may share a zero."""
    sides = [
        [session.offsets[joint] for session in side if joint in session.offsets]
        for side in (sessions, other)
    ]
    if not all(sides):
        return True
    here, there = (float(np.median(side)) for side in sides)
    return abs(here - there) > OFFSET_RAD


def _first(several: Sequence[_Entry]) -> list[_Entry]:
    """Return the first entry of each joint."""
    entries: dict[str, _Entry] = {}
    for entry in several:
        entries.setdefault(entry.joint, entry)
    return list(entries.values())
