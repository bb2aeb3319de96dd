"""What moved: head pose, joint angles and power at the times at which the body is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.capture.robot.model import Robot

from ..samples.quantities import mechanical_power
from ..samples.tracks import (
    Columns,
    Track,
    decimate,
    hold,
    interpolate,
    mark_gaps,
    ordered,
    resampled,
)

BODY_RATE_HZ = 50.0
SPARSE_RATE_HZ = 25.0
"""Of what moves beside the body: commanded shape, distance sensors, names."""

POSE = [
    *(f"pose.pose.position.{axis}" for axis in "xyz"),
    *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
]
"""Position [m] and orientation of an Odometry."""


@dataclass(frozen=True)
class Motion:
    """The body at its drawing times.

    Attributes:
        robot: The robot, m joints.
        head: Where its head was at the n drawing times.
        angles: Measured joint angles [rad], shape (n, m).
        commands: Commanded joint angles [rad], shape (n, m), or None where none were logged.
        power_w: Mechanical power of the joints [W], shape (n, m), or None where none is known.
    """

    robot: Robot
    head: HeadPath
    angles: FloatArray
    commands: FloatArray | None
    power_w: FloatArray | None

    @property
    def t_ns(self) -> IntArray:
        """Drawing times [ns], shape (n,)."""
        return self.head.t_ns

    def links(
        self, rows: slice | IntArray, angles: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the poses of the links.

        Args:
            rows: Which drawing times, k of them.
            angles: Joint angles to use instead of the measured ones [rad], shape (k, m).

        Returns:
            Link centres [m], shape (k, m + 1, 3), and rotations, shape (k, m + 1, 3, 3); NaN
            from the first link whose pose isn't known to the tail.
        """
        if angles is None:
            centre, rotation = self._links
            return centre[rows], rotation[rows]
        turn = rotation_from_quaternion(self.head.quaternion[rows])
        return link_poses(self.robot, self.head.position[rows], turn, angles)

    @cached_property
    def _links(self) -> tuple[FloatArray, FloatArray]:
        """All links, as they were measured."""
        return self.links(slice(None), self.angles)


@dataclass(frozen=True)
class HeadPath:
    """Where the head was.

    Attributes:
        t_ns: Times [ns], shape (n,).
        position: Centre of the head link [m], shape (n, 3).
        quaternion: Orientation x, y, z, w, shape (n, 4).
        tracked: False where no odometry was logged and the head is held at the origin.
    """

    t_ns: IntArray
    position: FloatArray
    quaternion: FloatArray
    tracked: bool

    @classmethod
    def of(cls, t_ns: IntArray, pose: FloatArray, *, tracked: bool) -> HeadPath:
        """Build a path from columns as in :data:`POSE`, shape (n, 7)."""
        return cls(t_ns, pose[:, :3], pose[:, 3:], tracked)

    @property
    def pose(self) -> FloatArray:
        """Columns as in :data:`POSE`, shape (n, 7)."""
        return np.concatenate([self.position, self.quaternion], axis=1)

    def at(self, rows: slice | IntArray) -> HeadPath:
        """Some of its times."""
        return HeadPath(self.t_ns[rows], self.position[rows], self.quaternion[rows], self.tracked)


def frames_of(
    head: HeadPath, end_ns: int | None, origin_ns: int | None = None
) -> tuple[HeadPath, BoolArray]:
    """Choose when the body is drawn.

    Args:
        head: The head's path, or a part of it.
        end_ns: The session's end [ns]; None where it isn't known.
        origin_ns: First time of the whole path [ns]; None for that of this part.

    Returns:
        The path at most 50 times a second, on its own sampling times, with a row of NaN in each
        gap; and which of these rows, no more than 25 a second, are drawn of what moves beside the
        body, shape (n,).
    """
    chosen = head.at(decimate(head.t_ns, BODY_RATE_HZ, origin_ns))
    t_ns, pose = mark_gaps(chosen.t_ns, chosen.pose, end_ns)
    sparse = np.zeros(t_ns.size, dtype=np.bool_)
    sparse[decimate(t_ns, SPARSE_RATE_HZ, origin_ns)] = True
    # A gap ends whatever is drawn.
    sparse |= np.isnan(pose).any(axis=1)
    return HeadPath.of(t_ns, pose, tracked=head.tracked), sparse


def read_head(
    session: SessionView, robot: Robot, positions: Sequence[Track], warnings: list[str]
) -> HeadPath:
    """Read the head's pose from ``/odom``; without odometry it is held at the origin.

    Args:
        positions: Measured joint angles, whose times serve where there is no odometry.
        warnings: Grows by a sentence where something had to be assumed.

    Returns:
        The path at its own sampling times.
    """
    odometry = session.channels.get("/odom")
    if odometry is None or not odometry.count:
        warnings.append("no /odom in the session: the head is held at the origin")
        return still_head(positions[0].t_ns)
    _, first = next(session.messages("/odom"))
    child, link = str(first.child_frame_id), robot.links[0].name
    if child != link:
        warnings.append(f"/odom is of {child or 'no frame'}; it is taken as the head link {link}")
    logged = session.arrays({"/odom": POSE})["/odom"]
    pose = np.stack([logged.values[name] for name in POSE], axis=1).astype(np.float64)
    return tracked_head(logged.t_ns, pose)


def still_head(t_ns: IntArray) -> HeadPath:
    """Return the path of an untracked head: the origin.

    Args:
        t_ns: Times [ns], shape (n,).
    """
    still = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (t_ns.size, 1))
    return HeadPath.of(t_ns, still, tracked=False)


def tracked_head(t_ns: IntArray, pose: FloatArray) -> HeadPath:
    """Return the head's path from odometry.

    Args:
        t_ns: Sampling times [ns], shape (n,).
        pose: Columns as in :data:`POSE`, shape (n, 7).

    Returns:
        The path in the order of its times; NaN where there is no orientation.
    """
    t_ns, pose = ordered(t_ns, pose)
    norm = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        quaternion = pose[:, 3:] / norm  # NaN where the tracker wrote zeros: no pose
    return HeadPath(t_ns, pose[:, :3], quaternion, tracked=True)


def assemble(robot: Robot, head: HeadPath, columns: Columns) -> Motion:
    """Bring joints and power to the times at which the body is drawn.

    Args:
        robot: The robot, m joints.
        head: Where its head was at these times.
        columns: Angles, commands, efforts and velocities, as far as they were logged.

    Returns:
        What moved; NaN in gaps.
    """
    names, t_ns = robot.joint_names, head.t_ns
    positions, commands = (
        columns.get((topic, "position"), ()) for topic in ("/joint_states", "/joint_commands")
    )
    power = mechanical_power(columns)
    return Motion(
        robot=robot,
        head=head,
        angles=resampled(positions, names, t_ns, interpolate),
        commands=resampled(commands, names, t_ns, hold) if commands else None,
        power_w=resampled(power, names, t_ns, interpolate) if power else None,
    )
