"""The detection of joints that do not follow, by itself and on arrays: no bag, no answer."""

from __future__ import annotations

import numpy as np

from undulog.capture.following.find import joints_not_following
from undulog.capture.following.motion import JointMotion, Samples

from .outputs import Named, Statement
from .robot import Log


def detected(log: Log) -> Statement:
    """Find the joints that do not follow in what was logged.

    Args:
        log: The log.

    Returns:
        A statement without a sentence of its own: the names of the joints found.
    """
    robot = log.robot
    sent = robot.sent()

    def samples(columns: np.ndarray | None, j: int) -> Samples | None:
        if columns is None:
            return None
        kept = np.isfinite(columns[:, j])
        return Samples(robot.t_s[kept, j], columns[kept, j])

    motions: list[JointMotion] = []
    for j, name in enumerate(robot.names):
        position = samples(log.position, j)
        assert position is not None
        motions.append(
            JointMotion(
                name,
                Samples(robot.sent_s, sent[:, j]),
                position,
                velocity=samples(log.velocity, j),
                effort=samples(log.effort, j),
                reference=samples(log.second, j),
            )
        )
    found = {
        one.joint: Named(frozenset(one.kinds), one.since_s) for one in joints_not_following(motions)
    }
    return Statement(" ".join(found), found)
