"""How the joints of a session follow their commands, and what that decides."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.fault import Judgement
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, cycle_s
from undulog.capture.judgement.session import motions_of, times_made

from ...common.answer import NotFollowing
from ...signals.columns import QUANTITIES, Columns
from ...signals.windows import Stretch

_COMPARABLE = {"lost_samples"}
"""A joint with these faults alone still takes part in the comparison."""


@dataclass(frozen=True)
class Following:
    """How the joints follow their commands.

    Attributes:
        judgement: Of the joints, times from the session's start.
        offsets: Mean of the position less that of the command, cycle by cycle [rad], by joint.
        commanded: Joints with commands, which may hold still.
        in_frames: Whether times were made from a frame rate, so that no joint is judged.
    """

    judgement: Judgement
    offsets: Mapping[str, FloatArray]
    commanded: frozenset[str]
    in_frames: bool


def following(session: SessionView, columns: Columns, window: Stretch) -> Following:
    """Judge how the joints follow their commands in a window."""
    motions = motions_of(
        session,
        {quantity: columns.of(quantity) for quantity in QUANTITIES},
        columns.names,
        (window.start_ns, window.stop_ns),
    )
    in_frames = times_made(session)
    judgement = Judgement() if in_frames else judge(motions)
    offsets = {m.name: _offsets(m) for m in motions if m.position.t_s.size > 1}
    return Following(judgement, offsets, frozenset(m.name for m in motions), in_frames)


def _offsets(motion: RecordedJoint) -> FloatArray:
    """Return the offset of each whole cycle [rad]."""
    t_s, command = motion.position.t_s, motion.command.at(motion.position.t_s)
    width = cycle_s(command, motion.position.period_s)
    count = int((t_s[-1] - t_s[0]) / width)
    if count < 1:
        return np.zeros(0)
    starts: FloatArray = t_s[0] + width * np.arange(count + 1, dtype=np.float64)
    edges = np.searchsorted(t_s, starts)
    error = np.concatenate([[0.0], np.cumsum(motion.position.values - command)])
    samples = np.diff(edges)
    return (np.diff(error[edges]) / np.maximum(samples, 1))[samples > 0]


def not_following(follows: Following) -> tuple[NotFollowing, ...]:
    """Return the joints that don't follow, in chain order."""
    return tuple(
        NotFollowing(
            fault.joint, fault.kinds, fault.since_s, fault.until_s, fault.share, fault.evidence
        )
        for fault in follows.judgement.faults
    )


def stopped(faulty: Iterable[NotFollowing]) -> frozenset[str]:
    """Return the joints that are not compared.

    Args:
        faulty: Joints that do not follow.

    Returns:
        Their names, without those of which samples are missing only.
    """
    return frozenset(fault.joint for fault in faulty if set(fault.kinds) - _COMPARABLE)
