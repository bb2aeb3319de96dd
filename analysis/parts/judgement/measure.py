"""A session's answer: its joints' faults, the comparison of the rest, and the words for both."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.fault import Judgement
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, cycle_s
from undulog.capture.judgement.session import motions_of, times_made
from undulog.capture.robot.model import Robot

from ...response.fitting import GaitFit
from ...results.analysis import JointResult
from ...results.answer import Artefact, NotFollowing, overlapping
from ...signals.columns import QUANTITIES, Columns, by_plane
from ...signals.windows import Stretch
from ..comparison.examine import Chain, Findings, examine
from ..comparison.pooled import over_gaits

_COMPARABLE = {"lost_samples"}
"""A joint with these faults alone still takes part in the comparison."""

_STANDING = frozenset({("position", "frozen"), ("position", "clipped"), ("effort", "stalled")})
"""Artefacts of a joint that stands; whether it had to move decides."""

_REPEATED = _STANDING | {("position", "stale")}
"""Artefacts that frames of made times show of what is sampled more slowly."""


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


def unrefuted(artefacts: Iterable[Artefact], follows: Following) -> tuple[Artefact, ...]:
    """Leave out values that seem to stand where the joint follows its command all the same.

    A joint that was not asked to move may stand, too; of one that doesn't follow for a while, what
    stands at other times is left out.

    Args:
        follows: How the joints follow.

    Returns:
        The others, in their order.
    """
    judgement = follows.judgement
    standing = _REPEATED if follows.in_frames else _STANDING
    decided = bool(judgement.judged or judgement.unexposed or follows.in_frames)
    faults = {fault.joint: fault.spans_s for fault in judgement.faults}
    left: list[Artefact] = []
    for artefact in artefacts:
        if (artefact.quantity, artefact.flag) not in standing:
            left.append(artefact)
        elif artefact.joint in faults:
            spans = [
                span for span in artefact.spans_s if overlapping(faults[artefact.joint], *span)
            ]
            left += [replace(artefact, spans_s=tuple(spans))] if spans else []
        elif not (decided and artefact.joint in follows.commanded):
            left.append(artefact)
    return tuple(left)


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


def compare_joints(
    robot: Robot | None,
    gaits: Sequence[GaitFit],
    joints: Iterable[JointResult],
    *,
    faulty: Iterable[NotFollowing],
    commanded: tuple[str, ...],
    offsets: Mapping[str, FloatArray],
) -> Findings:
    """Compare the sound joints with each other.

    Args:
        robot: The robot, or None; then all joints are one chain.
        gaits: The fitted gaits, one for each window in which it is constant.
        faulty: Joints that do not follow.
        offsets: Of each joint, cycle by cycle [rad].

    Returns:
        The findings, of several gaits over all of them; none without a gait.
    """
    out = stopped(faulty)
    results = list(joints)
    sound = {j.name for j in results if j.lag_rad.value is not None and j.name not in out}
    old = {j.name for j in results if j.name in sound and "stale" in j.flags}
    if old != sound:  # where all samples are late by a hold, that makes no difference
        sound -= old
    loaded = _loaded(results, commanded)
    chains = [
        _chains(robot, gait, sound, commanded=commanded, offsets=offsets, loaded=loaded)
        for gait in gaits
    ]
    return examine(chains[0] if len(chains) == 1 else over_gaits(chains))


def _chains(
    robot: Robot | None,
    gait: GaitFit,
    sound: Container[str],
    *,
    commanded: tuple[str, ...],
    offsets: Mapping[str, FloatArray],
    loaded: frozenset[str],
) -> list[Chain]:
    """Return the joints of one gait that are compared, by plane and group."""
    chains: list[Chain] = []
    for index, group in enumerate(gait.groups):
        if group.response is None:
            continue
        # A joint that is commanded but in no group has its place in the chain all the same.
        members = [name for name in commanded if gait.group_of(name) in (index, None)]
        for plane, names in by_plane(robot, members).items():
            inside = [name for name in names if name in sound and name in group.answered]
            response = group.response.select([group.answered.index(name) for name in inside])
            means = {name: offsets[name] for name in inside if name in offsets}
            chains.append(
                Chain(plane, index, tuple(names), tuple(inside), response, means, loaded=loaded)
            )
    return chains


def _loaded(joints: Iterable[JointResult], commanded: tuple[str, ...]) -> frozenset[str]:
    """Commanded joints at a limit beside another that is, head to tail."""
    flags = {joint.name: joint.flags for joint in joints}
    limited = ["saturated" in flags.get(name, ()) for name in commanded]
    return frozenset(
        name
        for k, name in enumerate(commanded)
        if limited[k] and any(limited[j] for j in (k - 1, k + 1) if 0 <= j < len(limited))
    )
