"""Modules that a test names, marked on the body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import IntArray

from ...content.entities import NAMED
from ...samples.timeline import Clock
from .markers import above_joints
from .motion import Motion

MARKS = "/world/snake/named"


def log_marks(
    rec: rr.RecordingStream,
    clock: Clock,
    motion: Motion,
    names: Sequence[str],
    chosen: IntArray,
) -> None:
    """Mark joints with a point and their name.

    Args:
        rec: The recording.
        clock: Its timelines.
        motion: What moved.
        names: The joints; those that the robot doesn't have are left out.
        chosen: Which of its drawing times, shape (n,).
    """
    robot = motion.robot
    known = tuple(name for name in names if name in robot.joint_names)
    if not known:
        return
    look = rr.Points3D.from_fields(colors=NAMED, radii=rr.Radius.ui_points(5.0), show_labels=True)
    rec.log(MARKS, look, static=True)
    for part, times in clock.rows(motion.t_ns[chosen]):
        point = above_joints(robot, known, *motion.links(chosen[part])).astype(np.float32)
        drawn = np.isfinite(point).all(axis=-1)
        labels = [known[i] for i in np.nonzero(drawn)[1].tolist()]
        dots = rr.Points3D.columns(positions=point[drawn], labels=labels)
        rec.send_columns(MARKS, times, dots.partition(np.count_nonzero(drawn, axis=1)))
