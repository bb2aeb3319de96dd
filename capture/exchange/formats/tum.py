"""The pose of a frame as a TUM trajectory: ``timestamp tx ty tz qx qy qz qw`` a line.

Times are Unix seconds with nine decimals, so exact to the nanosecond; lengths in m. Numbers have
all digits that they need. The pose is that of the message: from an Odometry or a stamped pose in
its ``header.frame_id``, from a transform in its parent frame, which the first line names.

Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...common.arrays import NS, FloatArray, IntArray
from ...common.console import plain, progress
from ...common.errors import DataError, MissingChannelError, some_names
from ...common.files import check_output, check_stop, part_file
from ...common.process import StopRequest
from ..reports import ExportReport
from .format import DirectWriter, Format, not_read

if TYPE_CHECKING:
    from ...log.read.session import Session

SUFFIXES = (".tum", ".txt")
"""Of a trajectory."""

_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_FIELD = {
    _ODOMETRY: "pose.pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
}
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_NUMBERS = tuple(
    [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]
)
_LINES_PER_BLOCK = 10_000


@dataclass(frozen=True)
class PoseTrajectory:
    """Poses of one frame.

    Attributes:
        frame: The frame that moves.
        parents: The frames that it is given in; one, unless the log changes it.
        t_ns: Times [Unix ns], shape (n,).
        poses: Position [m] and quaternion x, y, z, w, shape (n, 7).
    """

    topic: str
    frame: str
    parents: tuple[str, ...]
    t_ns: IntArray
    poses: FloatArray


def export_tum(
    source: Path,
    output: Path,
    *,
    frame: str | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write the poses of a frame as a TUM trajectory, in order of time.

    Args:
        output: A name that ends in .tum or .txt.
        frame: The frame; that of the first Odometry or stamped pose if None.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the name ends in anything else.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no poses.
        DataError: If it has no such frame, or no pose of it is usable.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    from ...log.read.session import Session

    why = f"end the name of a trajectory in {' or '.join(SUFFIXES)}"
    check_output(output, SUFFIXES, why, force=force)
    with Session.open(source) as session:
        trajectory = read_trajectory(session, frame)
        warnings = session.warnings
    norm = np.linalg.norm(trajectory.poses[:, 3:], axis=1)
    usable = np.isfinite(trajectory.poses).all(axis=1) & (norm > 0.5) & (norm < 2.0)
    if not usable.any():
        raise DataError(
            f"{source}: {trajectory.topic} has no pose of {trajectory.frame} with finite numbers"
        )
    if lost := int((~usable).sum()):
        warnings.append(f"{lost} poses left out: not finite, or their quaternion is no rotation")
    if len(trajectory.parents) > 1:
        warnings.append(
            f"the pose is given in several frames: {some_names(trajectory.parents, 10)}"
        )
    order = np.flatnonzero(usable)[np.argsort(trajectory.t_ns[usable], kind="stable")]
    parent = next(iter(trajectory.parents), "")
    with (
        part_file(output) as part,
        progress(f"export {output.name}", len(order)) as bar,
        part.open("w", encoding="utf-8", newline="\n") as stream,
    ):
        names = plain(f"pose of {trajectory.frame} in {parent or 'an unnamed frame'}")
        stream.write(f"# {names}, from {plain(trajectory.topic)}\n")
        stream.write("# timestamp tx ty tz qx qy qz qw\n")
        for start in range(0, len(order), _LINES_PER_BLOCK):
            rows = order[start : start + _LINES_PER_BLOCK]
            stream.writelines(_lines(trajectory.t_ns[rows], trajectory.poses[rows]))
            bar.update(start)
            check_stop(output, stop)
    what = f"{len(order)} poses of {trajectory.frame} in {parent}, from {trajectory.topic}"
    facts = {
        "poses": len(order),
        "frame": trajectory.frame,
        "parent": parent,
        "topic": trajectory.topic,
    }
    return ExportReport(what, facts, warnings)


def _lines(t_ns: IntArray, poses: FloatArray) -> Iterator[str]:
    times: list[int] = t_ns.tolist()
    rows: list[list[float]] = poses.tolist()
    for time, pose in zip(times, rows, strict=True):
        seconds, rest = divmod(time, NS)
        yield f"{seconds}.{rest:09d} {' '.join(map(repr, pose))}\n"


def read_trajectory(session: Session, frame: str | None = None) -> PoseTrajectory:
    """Return the poses of a frame, in the order of the log.

    Args:
        frame: The frame; that of the first Odometry or stamped pose if None.

    Raises:
        MissingChannelError: If the session has no poses.
        DataError: If it has no such frame; names those that it has.
    """
    kinds = {topic: channel.type_name for topic, channel in session.channels.items()}
    posed = [topic for topic, kind in kinds.items() if kind in _POSE_FIELD]
    posed.sort(key=lambda topic: (topic != "/odom", topic))
    moved = [topic for topic, kind in kinds.items() if kind == _TRANSFORMS]
    if not posed and not moved:
        raise MissingChannelError(session.path, "poses", sorted(kinds))
    frames: list[str] = []
    for topic in posed:
        for trajectory in _of_poses(session, topic, kinds[topic]):
            if frame is None or trajectory.frame == frame:
                return trajectory
            frames.append(trajectory.frame)
    trajectory, others = _of_transforms(session, moved, frame)
    if trajectory is None:
        names = some_names(sorted({*frames, *others}), 40)
        asked = "no Odometry, so name one (--frame)" if frame is None else f"no frame {frame!r}"
        raise DataError(f"{session.path}: has {asked}; it has {names}")
    return trajectory


def _of_poses(session: Session, topic: str, kind: str) -> Iterator[PoseTrajectory]:
    """Yield the poses of each frame of a topic; a pose without a name has that of its topic."""
    numbers = [f"{_POSE_FIELD[kind]}.{name}" for name in _NUMBERS]
    names = ["header.frame_id", *(["child_frame_id"] if kind == _ODOMETRY else [])]
    table = session.columns({}, {topic: [*names, *numbers]})[1][topic]
    if table.empty:
        return
    named = table.get("child_frame_id")
    children = np.full(len(table), topic) if named is None else named.astype(str).to_numpy()
    parents = table["header.frame_id"].astype(str).to_numpy()
    poses = table[numbers].to_numpy(dtype=np.float64)
    t_ns = table.index.to_numpy(dtype=np.int64)
    for child in dict.fromkeys(children.tolist()):
        mine = children == child
        references = tuple(dict.fromkeys(parents[mine].tolist()))
        yield PoseTrajectory(topic, str(child), references, t_ns[mine], poses[mine])


def _of_transforms(
    session: Session, topics: Sequence[str], frame: str | None
) -> tuple[PoseTrajectory | None, list[str]]:
    """Return the poses of a frame in its parent, by all topics; and the frames that there are."""
    from ...log.read.sample_times import clock_shift_ns

    names: dict[str, None] = {}
    times: list[int] = []
    poses: list[list[float]] = []
    parents: dict[str, None] = {}
    where = ""
    for topic in topics:
        shift_ns: int | None = None
        for log_ns, message in session.messages(topic):
            for transform in message.transforms:
                names[transform.child_frame_id] = None
                if transform.child_frame_id != frame:
                    continue
                stamp_ns = transform.header.stamp.sec * NS + transform.header.stamp.nanosec
                if shift_ns is None:
                    shift_ns = clock_shift_ns(stamp_ns, log_ns)
                where = where or topic
                times.append(stamp_ns + shift_ns)
                parents[transform.header.frame_id] = None
                t, q = transform.transform.translation, transform.transform.rotation
                poses.append([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
    if frame is None or not times:
        return None, list(names)
    t_ns = np.array(times, dtype=np.int64)
    return PoseTrajectory(where, frame, tuple(parents), t_ns, np.array(poses)), list(names)


FORMAT = Format(
    "tum", "TUM trajectory", SUFFIXES, not_read,
    write=DirectWriter(export_tum, "has poses", ("frame",)),
)  # fmt: skip
