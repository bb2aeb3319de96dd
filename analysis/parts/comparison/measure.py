"""Compare the sound joints of a session, by plane and group, over all its gaits."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ...common.answer import NotFollowing
from ...response.fitting import GaitFit
from ...signals.columns import by_plane
from ..joints.result import JointResult
from ..judgement.measure import stopped
from .examine import Chain, Findings, examine
from .pooled import over_gaits


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
