"""A session's answer: its joints' faults, the comparison of the rest, and the words for both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.following.fault import Fault
from undulog.capture.following.find import joints_not_following, motions_of, times_made
from undulog.capture.following.motion import BLOCKS, COHERENT, JointMotion, Samples
from undulog.capture.robot.model import Robot

from ..response.fitting import GaitFit
from ..results.analysis import JointResult
from ..results.answer import Artefact, NotFollowing
from ..signals.columns import QUANTITIES, Columns, by_plane
from ..signals.windows import Stretch
from .examine import Chain, Findings, examine

_COMPARABLE = {"lost_samples"}
"""A joint with these faults alone still takes part in the comparison."""

_OF_FLAG: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("position", "wrapped"): ("wrapped_sensor",),
    ("position", "wrong_sign"): ("inverted", "inverted_sensor"),
    ("position", "wrong_unit"): ("scaled_sensor",),
    ("position", "scale_mismatch"): ("scaled_sensor",),
    ("position", "clipped"): ("at_limit", "clipped_sensor"),
    ("position", "frozen"): ("frozen_sensor", "jammed", "dead"),
    ("position", "stale"): ("stale_sensor", "lost_samples"),
    ("effort", "stalled"): ("stalled", "jammed"),
    ("current", "stalled"): ("stalled", "jammed"),
}
"""Artefacts that mean that a joint does not follow, or can't be seen to: kinds that fit."""

_ZERO = frozenset({"slipped", "slipped_sensor", "drifting_sensor"})
"""Kinds of a zero that moved."""

_AGAIN = 3
"""Stalls that a limit causes, too, in each cycle."""

_TOGETHER = 0.5
"""Correlation with the command that shows motion."""

_LASTING = 0.1
"""Share of the window that an artefact holds at least: a joint may press on an obstacle."""

_WHOLE = 0.8
"""Share of the window that old values in all of it are seen in: ends and turns show little."""


@dataclass(frozen=True)
class Following:
    """How the joints follow their commands.

    Attributes:
        faults: Joints that do not, times from the session's start, in chain order.
        offsets: Mean of the position less that of the command, cycle by cycle [rad], by joint.
    """

    faults: tuple[Fault, ...]
    offsets: Mapping[str, FloatArray]
    motions: Mapping[str, JointMotion]


def following(session: SessionView, columns: Columns, window: Stretch) -> Following:
    """Find how the joints follow their commands in a window.

    Returns:
        The joints that do not follow, and the offsets of all.
    """
    motions = motions_of(
        session,
        {quantity: columns.of(quantity) for quantity in QUANTITIES},
        columns.names,
        (window.start_ns, window.stop_ns),
    )
    return Following(
        () if times_made(session) else joints_not_following(motions),
        {each.name: _offsets(each) for each in motions if each.position.t_s.size > 1},
        {each.name: each for each in motions},
    )


def _offsets(motion: JointMotion) -> FloatArray:
    """Return the offset of each whole cycle that is judged [rad]."""
    response = motion.response
    return response.offset[::BLOCKS][response.valid[::BLOCKS]]


def unrefuted(artefacts: Iterable[Artefact], follows: Following) -> tuple[Artefact, ...]:
    """Leave out values that repeat for a moment where the joint follows its command all the same.

    Args:
        follows: How the joints follow in it.

    Returns:
        The others, in their order.
    """
    broken = {fault.joint for fault in follows.faults}
    return tuple(
        one
        for one in artefacts
        if (one.quantity, one.flag) != ("position", "frozen")
        or one.joint in broken
        or not _follows_there(follows.motions.get(one.joint), one.spans_s)
    )


def _follows_there(motion: JointMotion | None, spans_s: Iterable[tuple[float, float]]) -> bool:
    """Return whether a joint is driven and follows in every window that overlaps some spans."""
    if motion is None or not motion.command.range > 0 or motion.position.t_s.size < 2:
        return False
    response = motion.response
    there = np.zeros_like(response.valid)
    for start, stop in spans_s:
        there |= (response.start_s < stop) & (response.stop_s > start)
    there &= response.valid
    return bool(there.any() and (response.explained[there] > COHERENT).all())


def not_following(
    follows: Following, artefacts: Iterable[Artefact], names: tuple[str, ...], duration_s: float
) -> tuple[NotFollowing, ...]:
    """Join faults with the artefacts that falsify a joint's position.

    Args:
        names: All joints, in chain order.
        duration_s: Length of the window [s].

    Returns:
        One entry a joint, in chain order.
    """
    found = {
        each.joint: NotFollowing(
            each.joint, each.kinds, each.since_s, each.until_s, each.share, each.evidence
        )
        for each in follows.faults
    }
    # A flat top changes the scale, too.
    for artefact in sorted(artefacts, key=lambda one: one.flag != "clipped"):
        kinds = _kinds_of(artefact, follows.motions.get(artefact.joint))
        lasted = sum(stop - start for start, stop in artefact.spans_s)
        share = lasted / duration_s if artefact.spans_s and duration_s > 0 else 1.0
        known = found.get(artefact.joint)
        # A flat top moves the mean of the position, which by itself is a zero that moved.
        new = known is None or (artefact.flag == "clipped" and _ZERO.issuperset(known.kinds))
        if kinds and new and (share >= _LASTING or artefact.falsifies("position")):
            spans = () if artefact.flag == "stale" and share > _WHOLE else artefact.spans_s
            since, until = (spans[0][0], spans[-1][1]) if spans else (None, None)
            text = f"{artefact.quantity} {artefact.flag}"
            text += f" ({artefact.note})" if artefact.note else ""
            found[artefact.joint] = NotFollowing(artefact.joint, kinds, since, until, share, text)
    return tuple(found[name] for name in names if name in found)


def stopped(faulty: Iterable[NotFollowing]) -> frozenset[str]:
    """Return the joints that are not compared.

    Args:
        faulty: Joints that do not follow.

    Returns:
        Their names, without those of which samples are missing only.
    """
    return frozenset(each.joint for each in faulty if set(each.kinds) - _COMPARABLE)


def _kinds_of(artefact: Artefact, motion: JointMotion | None) -> tuple[str, ...]:
    """Kinds of fault that fit an artefact; none for most artefacts."""
    kinds = _OF_FLAG.get((artefact.quantity, artefact.flag), ())
    if artefact.flag == "stalled" and len(artefact.spans_s) >= _AGAIN:
        return ("at_limit", *kinds)
    if artefact.flag == "clipped" and motion is not None and motion.reference is not None:
        goes_on = _goes_on(motion.reference, motion.command, artefact.spans_s)
        return ("clipped_sensor",) if goes_on else ("at_limit",)
    return kinds


def _goes_on(second: Samples, command: Samples, spans_s: Iterable[tuple[float, float]]) -> bool:
    """Return whether a second sensor moves with the command where the first one is flat."""
    parts: list[FloatArray] = []
    for span in spans_s:
        i, j = np.searchsorted(second.t_s, span)
        both = np.stack([second.values[i:j], command.at(second.t_s[i:j])])
        if j > i:
            parts.append(both - both.mean(axis=1, keepdims=True))
    joined = np.concatenate(parts, axis=1) if parts else np.zeros((2, 1))
    power = float(np.linalg.norm(joined[0]) * np.linalg.norm(joined[1]))
    return power > 0 and float(joined[0] @ joined[1]) > _TOGETHER * power


def compare_joints(
    robot: Robot | None,
    gait: GaitFit | None,
    joints: Iterable[JointResult],
    *,
    faulty: Iterable[NotFollowing],
    commanded: tuple[str, ...],
    offsets: Mapping[str, FloatArray],
) -> Findings:
    """Compare the sound joints with each other.

    Args:
        robot: The robot, or None; then all joints are one chain.
        gait: The fitted gait, or None.
        faulty: Joints that do not follow.
        offsets: Of each joint, cycle by cycle [rad].

    Returns:
        The findings; none without a gait.
    """
    if gait is None:
        return Findings()
    out = stopped(faulty)
    results = list(joints)
    sound = {j.name for j in results if j.lag_rad.value is not None and j.name not in out}
    old = {j.name for j in results if j.name in sound and "stale" in j.flags}
    if old != sound:  # where all samples are late by a hold, that makes no difference
        sound -= old
    loaded = _loaded(results, commanded)
    chains: list[Chain] = []
    for index, group in enumerate(gait.groups):
        if group.response is None:
            continue
        # A joint that is commanded but in no group has its place in the chain all the same.
        members = [name for name in commanded if gait.group_of(name) in (index, None)]
        for plane, names in by_plane(robot, members).items():
            own = [name for name in names if name in sound and name in group.answered]
            response = group.response.select([group.answered.index(name) for name in own])
            means = {name: offsets[name] for name in own if name in offsets}
            chains.append(
                Chain(plane, index, tuple(names), tuple(own), response, means, loaded=loaded)
            )
    return examine(chains)


def _loaded(joints: Iterable[JointResult], commanded: tuple[str, ...]) -> frozenset[str]:
    """Commanded joints at a limit beside another that is, head to tail."""
    flags = {joint.name: joint.flags for joint in joints}
    limited = ["saturated" in flags.get(name, ()) for name in commanded]
    return frozenset(
        name
        for k, name in enumerate(commanded)
        if limited[k] and any(limited[j] for j in (k - 1, k + 1) if 0 <= j < len(limited))
    )
