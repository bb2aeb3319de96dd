"""The session reader: any log to the contract, and any ROS 2 bag with JointStates, as columns.

Opening reads the summary only. Columns are read when asked for, over a time window if given;
whatever could not be read is said in ``warnings``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ...common.errors import DataError, RobotFileError
from ...common.threads import threads_or_default
from ...robot.description import robot_in_session
from ...robot.model import Robot
from ..columns.columns import Messages
from ..columns.groups import Group
from ..columns.topics import Channel, Topics
from ..file.storage import LogFile
from ..messages.frames import (
    FD_FRAME_DTYPE,
    FD_FRAME_LAYOUT,
    FRAME_DTYPE,
    FRAME_LAYOUT,
    FrameArray,
    join_batches,
)
from .joint_reader import JointReader
from .own_times import StampClock
from .signals import JointSignals

_NS = 1_000_000_000


class Session:
    """A recorded session, opened for reading."""

    def __init__(
        self, path: Path | str, *, threads: int | None = None, column_folder: Path | None = None
    ) -> None:
        """Open a session.

        Args:
            path: The MCAP file; of a split session any part, or the folder that holds it.
            threads: How many decompress what is read; None for one a core that this process may
                use, at most four. What is read is the same.
            column_folder: A folder on a disk: large columns lie there, in files without names, and
                :meth:`forget` lets go of their memory (Linux). None for memory.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
            UsageError: If ``threads`` is less than 1.
        """
        threads = threads_or_default(threads)
        self.path = Path(path)
        self._file = LogFile(self.path, column_folder)
        self._warnings = list(self._file.warnings)
        self._warned = set(self._warnings)
        self._topics = Topics(self._file, self._warn, threads=threads)
        self._clock = StampClock(self._topics, self._warn)
        self._joints = JointReader(self.path, self._topics, self._clock, self._warn)

    @classmethod
    def open(
        cls, path: Path | str, *, threads: int | None = None, column_folder: Path | None = None
    ) -> Self:
        """Open a session; the same as calling the class.

        Args:
            path: The MCAP file; of a split session any part, or the folder that holds it.
            threads: How many decompress what is read; None for one a core that this process may
                use, at most four. What is read is the same.
            column_folder: A folder on a disk: large columns lie there, in files without names, and
                :meth:`forget` lets go of their memory (Linux). None for memory.

        Returns:
            The session, usable in a ``with`` block.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
            UsageError: If ``threads`` is less than 1.
        """
        return cls(path, threads=threads, column_folder=column_folder)

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def forget(self) -> None:
        """Let go of the memory of what was read so far.

        For who goes through a long session stretch by stretch: the pages of a mapped file count as
        this process's memory as long as they are. What is read next is the same. Columns that lie
        in files are let go of, too, and keep their values; those in memory stay.
        """
        self._file.forget()

    def __enter__(self) -> Self:
        """Nothing to do: the file is open."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Release the file."""
        self.close()

    @property
    def channels(self) -> Mapping[str, Channel]:
        """Topic to channel."""
        return self._topics.channels

    # -- facts -----------------------------------------------------------------------------

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read, in order: one, or the parts of a split session."""
        return tuple(file.path for file in self._file.files)

    @property
    def warnings(self) -> list[str]:
        """What is missing or doubtful, one sentence each; grows while columns are read."""
        return list(self._warnings)

    @property
    def start_ns(self) -> int:
        """Log time of the first message [Unix ns]; 0 where there is none."""
        return self._file.limits[0]

    @property
    def end_ns(self) -> int:
        """Log time of the last message [Unix ns]; 0 where there is none."""
        return self._file.limits[1]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / _NS

    @property
    def chunk_times_ns(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        """First and last log time of each chunk [Unix ns], as it states them, shape (n,) each."""
        return self._file.spans

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The file's metadata records; ``undulog`` holds session id, epoch and versions."""
        return MappingProxyType(self._file.metadata)

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Attached files, e.g. ``robot.toml``, by name."""
        stored = self._file.attachments
        return MappingProxyType({name: item.data for name, item in stored.items()})

    @property
    def session_id(self) -> str:
        """The session's id, or the file's name for a log that has none."""
        return self._file.metadata.get("undulog", {}).get("session_id") or self.path.stem

    @property
    def settle_s(self) -> float | None:
        """The first part that is not fit for steady-state analysis [s], None if it doesn't say."""
        stated = self._file.metadata.get("undulog", {}).get("settle_s", "")
        try:
            seconds = float(stated)
        except ValueError:
            return None
        return seconds if 0.0 <= seconds < math.inf else None

    @cached_property
    def robot(self) -> Robot | None:
        """The robot whose description is attached, or None."""
        try:
            return robot_in_session(self.attachments, self.path)
        except RobotFileError as error:
            self._warn(f"the attached robot description can't be used: {error}")
            return None

    @property
    def verdict(self) -> str | None:
        """The recorder's final health verdict, or None."""
        return self._file.metadata.get("undulog.health", {}).get("verdict")

    @property
    def library(self) -> str:
        """The library that wrote the file."""
        return self._file.library

    @property
    def profile(self) -> str:
        """The MCAP profile, ``ros2`` for a log to the contract."""
        return self._file.profile

    # -- columns ---------------------------------------------------------------------------

    def joints(
        self,
        topic: str,
        field: str = "position",
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> JointSignals:
        """One quantity of all joints of a JointState topic.

        Args:
            topic: E.g. ``/joint_states``.
            field: ``position``, ``velocity`` or ``effort``.
            start_ns: First sampling time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last sampling time wanted [Unix ns]; None for the end.

        Returns:
            The samples, in the robot's chain order where the session has a robot, at their own
            sampling times: header.stamp plus the logged sample offset.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If the topic is not of JointStates or the field is none of the three.
        """
        return self.joint_columns({topic: [field]}, start_ns=start_ns, stop_ns=stop_ns)[
            topic, field
        ]

    def joint_columns(
        self,
        wanted: Mapping[str, Sequence[str]],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], JointSignals]:
        """Several quantities in one pass over the file.

        Args:
            wanted: Topic to fields, e.g. ``{"/joint_states": ["position", "velocity"]}``.
            start_ns: First sampling time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last sampling time wanted [Unix ns]; None for the end.

        Returns:
            (topic, field) to samples, as :meth:`joints` gives them.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If a topic is not of JointStates or a field is none of the three.
        """
        chain = self.robot.joint_names if self.robot is not None else ()
        return self._joints.read(wanted, (start_ns, stop_ns), chain)

    def table(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> pd.DataFrame:
        """All numbers and strings of a topic, one row a message.

        Args:
            topic: Any topic whose type has a ``ros2msg`` schema.
            start_ns: First log time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last log time wanted [Unix ns]; None for the end.

        Returns:
            Index ``t_ns``: header.stamp [Unix ns] on the log's clock, or the log time where the
            type has none or the stamp is zero.
            Columns by field path, e.g. ``pose.pose.position.x`` or ``position[3]``, units as the
            message type has them.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If its type can't be read.
        """
        found = self._topics.read({topic: None}, (start_ns, stop_ns))[topic]
        return self._table(topic, found)

    def columns(
        self,
        joints: Mapping[str, Sequence[str]],
        tables: Mapping[str, Sequence[str] | None],
    ) -> tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]:
        """Joint signals and tables of the whole session, in one pass over the file.

        Args:
            joints: JointState topic to fields, as for :meth:`joint_columns`.
            tables: Topic to field paths, e.g. ``{"/sonar": ["range"]}``; None for all of a topic.

        Returns:
            (topic, field) to signals as :meth:`joints` gives them, and topic to table as
            :meth:`table` gives it.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If a topic can't be read as asked, or is asked for both ways.
        """
        requests: dict[str, Sequence[str] | None] = dict(self._joints.requests(joints))
        if twice := sorted(requests.keys() & tables.keys()):
            raise DataError(f"{', '.join(twice)}: ask for signals or for a table, not for both")
        found = self._topics.read(requests | dict(tables), (None, None))
        read: dict[str, pd.DataFrame] = {}
        for topic in tables:
            read[topic] = self._table(topic, found.pop(topic))
        chain = self.robot.joint_names if self.robot is not None else ()
        return self._joints.signals(joints, found, (None, None), chain), read

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Decode a topic message by message, for types of any shape (slow).

        Args:
            topic: Any topic with a ``ros2msg`` schema.

        Yields:
            Log time [Unix ns] and the decoded message, fields as attributes.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If a message can't be decoded.
        """
        decode = self._topics.decoder(topic)
        for log_ns, message in self._topics.raw(topic):
            yield log_ns, decode(message)

    def frames(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> FrameArray:
        """Raw CAN frames of a bus, in the order they were logged.

        Args:
            topic: E.g. ``/can/can0``.
            start_ns: First log time of a message of frames wanted [Unix ns]; None for the
                session's start.
            stop_ns: One past the last such log time wanted [Unix ns]; None for the end.

        Returns:
            Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If the topic holds something else.
        """
        return self._frames(topic, (start_ns, stop_ns), FRAME_DTYPE, FRAME_LAYOUT)

    def fd_frames(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> FrameArray:
        """Raw CAN FD frames of a bus, in the order they were logged.

        Args:
            topic: E.g. ``/can_fd/can0``.
            start_ns: First log time of a message of frames wanted [Unix ns]; None for the
                session's start.
            stop_ns: One past the last such log time wanted [Unix ns]; None for the end.

        Returns:
            Records of :data:`.capture.log.messages.frames.FD_FRAME_DTYPE`, shape (n,).

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If the topic holds something else.
        """
        return self._frames(topic, (start_ns, stop_ns), FD_FRAME_DTYPE, FD_FRAME_LAYOUT)

    # -- inside ----------------------------------------------------------------------------

    def _frames(
        self,
        topic: str,
        window_ns: tuple[int | None, int | None],
        dtype: np.dtype[np.void],
        label: str,
    ) -> FrameArray:
        batches: list[tuple[IntArray, IntArray, FrameArray]] = []
        found = self._topics.read({topic: ["data"]}, window_ns)[topic]
        for group in self._groups(topic, found):
            data = group.values("data")
            if data.shape[1] % dtype.itemsize or label not in group.layout.strings.values():
                kind = f"frames of {dtype.itemsize} bytes"
                raise DataError(f"{self.path}: {topic} does not hold {kind}, {label}")
            batches.append((group.times(), group.order(), data.view(dtype)))
        return join_batches(batches, dtype)

    def _warn(self, sentence: str) -> None:
        if sentence not in self._warned:
            self._warned.add(sentence)
            self._warnings.append(sentence)

    def _groups(self, topic: str, found: Messages) -> list[Group]:
        if found.unread:
            why = found.unread[0].why
            self._warn(f"{topic}: {len(found.unread)} messages can't be read: {why}")
        return found.groups

    def _table(self, topic: str, found: Messages) -> pd.DataFrame:
        groups = self._groups(topic, found)
        shift_ns = self._clock.shift_ns(topic)
        frames = [_frame(group, shift_ns) for group in groups]
        if not frames:
            return pd.DataFrame(index=pd.Index([], dtype="int64", name="t_ns"))
        table = pd.concat(frames) if len(frames) > 1 else frames[0]
        if table.index.is_monotonic_increasing:
            return table
        return table.sort_index(kind="stable")


def _frame(group: Group, shift_ns: int) -> pd.DataFrame:
    """One layout group as a table."""
    columns: dict[str, Any] = {}
    for path, text in group.strings.items():
        columns[path] = np.full(len(group), text, dtype=object)
    for path in group.paths:
        values = group.values(path)
        if group.layout.leaves[path].is_array:
            columns |= {f"{path}[{k}]": values[:, k] for k in range(values.shape[1])}
        else:
            columns[path] = values[:, 0]
    t_ns = group.stamps()
    if group.is_stamped and (shift_ns or not t_ns.all()):
        t_ns = np.where(t_ns == 0, group.times(), t_ns + shift_ns)
    return pd.DataFrame(columns, index=pd.Index(t_ns, name="t_ns"), copy=False)
