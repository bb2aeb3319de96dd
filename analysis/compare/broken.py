"""Joints that are broken on one side of a comparison: the first thing that differs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from undulog.capture.common.console import plain

from ..results.answer import Answer, NotFollowing, StandOut
from ..results.comparison import BrokenJoint
from ..segments.answer import deviation_in_words, fault_in_words
from ..segments.examine import OFFSET_RAD
from .side import Seen


def broken_joints(a: Sequence[Seen], b: Sequence[Seen]) -> tuple[BrokenJoint, ...]:
    """Find the joints that do not follow, or stand off their command, on one side only.

    Args:
        a: Sessions of side A.
        b: Those of side B.

    Returns:
        The joints in the order of the answers, those that do not follow first.
    """
    found: list[BrokenJoint] = []
    for side, own, other in (("B", b, a), ("A", a, b)):
        answers = [one.analysis.answer for one in own]
        elsewhere = {each.joint for one in other for each in one.analysis.answer.not_following}
        for fault in _first([each for answer in answers for each in answer.not_following]):
            if fault.joint not in elsewhere:
                text = f"in {side} {fault_in_words(fault)}"
                found.append(BrokenJoint(fault.joint, side, fault.kinds, text))
        known = {each.name for each in found}
        for each in _first([each for answer in answers for each in _off(answer)]):
            if each.joint not in known | elsewhere and _moved(each.joint, own, other):
                text = f"in {side} {plain(each.joint)} has {deviation_in_words(each)}"
                found.append(BrokenJoint(each.joint, side, (), text))
    return tuple(sorted(found, key=lambda each: not each.kinds))


def _off(answer: Answer) -> list[StandOut]:
    return [each for each in answer.stand_out if each.quantity == "offset"]


def _moved(joint: str, own: Sequence[Seen], other: Sequence[Seen]) -> bool:
    """Whether a joint's mean differs between the sides, too: both may share a zero."""
    here, there = (
        [one.offsets[joint] for one in side if joint in one.offsets] for side in (own, other)
    )
    if not here or not there:
        return True
    return abs(float(np.median(here)) - float(np.median(there))) > OFFSET_RAD


_Entry = TypeVar("_Entry", NotFollowing, StandOut)


def _first(several: Sequence[_Entry]) -> list[_Entry]:
    """The first entry of each joint."""
    found: dict[str, _Entry] = {}
    for each in several:
        found.setdefault(each.joint, each)
    return list(found.values())
