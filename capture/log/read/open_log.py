"""An open log: the file, and the reader of each kind of topic."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ...common.errors import DataError, RobotFileError, UndulogError
from ...common.remote import as_path
from ..columns.blocks import Window
from ..columns.columns import Messages
from ..columns.layouts import Group, names_of
from ..columns.topics import Topics
from ..file.log_file import LogFile
from ..messages.definitions import newer_contract
from ..messages.frames import FrameArray, join_batches
from .field_arrays import FieldArrays, group_arrays, joined
from .joint_states import JointReader
from .joint_topics import JointTopicFinder, JointTopics, check_joints
from .sample_times import JointSignals, StampClock

if TYPE_CHECKING:
    import pandas as pd

    from ...robot.model import Robot
    from ...robot.run import TwinRun

DESCRIPTION = "robot.toml"
"""Attachment that describes the robot."""


class OpenLog:
    """A log that is open for reading, shared by a session and all views of it.

    Attributes:
        path: The file, or the folder of a split session.
        warnings: Missing or doubtful parts, one sentence each; grows while columns are read.
    """

    def __init__(
        self,
        path: Path,
        column_folder: Path | None,
        threads: int,
        robot: str | Path | None = None,
        on_copied: Callable[[float], None] = lambda _: None,
    ) -> None:
        """Open a log; see :meth:`.Session.open`."""
        self.path = path = as_path(path)
        described = None
        if robot is not None:
            from ...robot.description import load_robot

            described = load_robot(robot)
        self.file = LogFile(path, column_folder, on_copied)
        self.warnings = list(self.file.warnings)
        if (newer := newer_contract(self.file.metadata.get("undulog", {}))) is not None:
            self.warnings.append(newer)
        self.topics = Topics(self.file, self._warn, threads=threads)
        self._clock = StampClock(self.topics, self._warn)
        self.joints = JointReader(path, self.topics, self._clock, self._warn, lambda: self._chain)
        self.robot_given = None if described is None else self._given(str(robot), described)

    @cached_property
    def robot(self) -> Robot | None:
        """The robot whose description is attached, or was given for a log without one; or None.

        Its bus map isn't held against its databases; see :attr:`checked_robot`.
        """
        return self._described(in_full=False)

    @cached_property
    def checked_robot(self) -> Robot | None:
        """The same, None where the bus map or its databases have faults, too."""
        return self._described(in_full=True)

    def _described(self, *, in_full: bool) -> Robot | None:
        if self.robot_given is not None:
            return self.robot_given[1]
        if DESCRIPTION not in self.file.attachments:
            return None
        from ...robot.description import robot_in_session

        attached = {name: item.data for name, item in self.file.attachments.items()}
        try:
            return robot_in_session(attached, self.path, in_full=in_full)
        except RobotFileError as error:
            self._warn(f"the attached robot description can't be used: {error}")
            return None

    def _given(self, name: str, robot: Robot) -> tuple[str, Robot] | None:
        """Return a robot given for the log, as it was named, if the log has none of its own."""
        if DESCRIPTION in self.file.attachments:
            self._warn(f"the log has a description of its robot; the one given, {name}, isn't used")
            return None
        try:
            check_joints(self.path, self.topics, robot.joint_names, name)
        except UndulogError:
            self.file.close()
            raise
        return name, robot

    @cached_property
    def run(self) -> TwinRun | None:
        """Servos, contact and physics rate of a twin's run; None for other sessions."""
        from ...robot.run import RUN_RECORD, run_from_record, run_from_scenario

        facts = self.file.metadata.get(RUN_RECORD)
        if facts is not None:
            try:
                return run_from_record(facts)
            except ValueError as error:
                self._warn(f"the metadata record {RUN_RECORD} can't be used: {error}")
        scenario = self.file.attachments.get("scenario.toml")
        names = () if self.robot is None else self.robot.joint_names
        return None if scenario is None else run_from_scenario(scenario.data, names)

    def joint_topics(self, command: str, response: str) -> JointTopics:
        """Find commands and responses; see :meth:`.SessionView.joint_topics`."""
        return JointTopicFinder(self.path, self.topics, self._chain).find(command, response)

    def joint_orders(self, topic: str, window_ns: Window) -> list[tuple[str, ...]]:
        """See :meth:`.SessionView.joint_orders`."""
        messages = self.topics.read({topic: ()}, window_ns)[topic]
        orders = dict.fromkeys(names_of(group.layout) for group in messages.groups)
        return [*orders, *([()] if messages.unread else [])]

    def tables(
        self, topics: Mapping[str, Sequence[str] | None], window_ns: Window
    ) -> dict[str, pd.DataFrame]:
        """Read tables in one pass, for a window of log times; see :meth:`.SessionView.table`."""
        return self._as_tables(topics, self.topics.read(topics, window_ns))

    def arrays(
        self, topics: Mapping[str, Sequence[str] | None], window_ns: Window
    ) -> dict[str, FieldArrays]:
        """Read fields in one pass, for a window of log times; see :meth:`.SessionView.arrays`."""
        messages = self.topics.read(topics, window_ns)
        read: dict[str, FieldArrays] = {}
        for topic in topics:
            shift_ns = self._clock.shift_ns(topic)
            groups = self._groups(topic, messages.pop(topic))
            read[topic] = joined([group_arrays(group, shift_ns) for group in groups])
        return read

    def columns(
        self,
        joints: Mapping[str, Sequence[str]],
        tables: Mapping[str, Sequence[str] | None],
    ) -> tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]:
        """Read all of the log in one pass; see :meth:`.SessionView.columns`."""
        requests: dict[str, Sequence[str] | None] = dict(self.joints.requests(joints))
        if twice := sorted(requests.keys() & tables.keys()):
            raise DataError(f"{', '.join(twice)}: ask for signals or for a table, not for both")
        messages = self.topics.read(requests | dict(tables), (None, None))
        read = self._as_tables(tables, messages)
        return self.joints.signals(joints, messages, (None, None)), read

    def frames(
        self, topic: str, window_ns: Window, dtype: np.dtype[np.void], label: str
    ) -> FrameArray:
        """Read frames of one kind; see :meth:`.SessionView.frames`."""
        batches: list[tuple[IntArray, IntArray, FrameArray]] = []
        messages = self.topics.read({topic: ["data"]}, window_ns)[topic]
        for group in self._groups(topic, messages):
            data = group.values("data")
            if data.shape[1] % dtype.itemsize or label not in group.layout.strings.values():
                kind = f"frames of {dtype.itemsize} bytes"
                raise DataError(f"{self.path}: {topic} does not hold {kind}, {label}")
            batches.append((group.times(), group.order(), data.view(dtype)))
        return join_batches(batches, dtype)

    @property
    def _chain(self) -> Sequence[str]:
        return self.robot.joint_names if self.robot is not None else ()

    def _warn(self, sentence: str) -> None:
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def _groups(self, topic: str, messages: Messages) -> list[Group]:
        if messages.unread:
            why = messages.unread[0].why
            self._warn(f"{topic}: {len(messages.unread)} messages can't be read: {why}")
        return messages.groups

    def _as_tables(
        self, topics: Mapping[str, Sequence[str] | None], messages: dict[str, Messages]
    ) -> dict[str, pd.DataFrame]:
        """Return tables of some messages, which are removed from ``messages`` one by one."""
        return {topic: self._table(topic, messages.pop(topic)) for topic in topics}

    def _table(self, topic: str, messages: Messages) -> pd.DataFrame:
        import pandas as pd  # a third of a second, which only tables need

        groups = self._groups(topic, messages)
        shift_ns = self._clock.shift_ns(topic)
        frames = [_frame(group, shift_ns) for group in groups]
        if not frames:
            return pd.DataFrame(index=pd.Index([], dtype="int64", name="t_ns"))
        table = pd.concat(frames) if len(frames) > 1 else frames[0]
        if table.index.is_monotonic_increasing:
            return table
        return table.sort_index(kind="stable")


def _frame(group: Group, shift_ns: int) -> pd.DataFrame:
    """Return one layout group as a table."""
    import pandas as pd

    arrays = group_arrays(group, shift_ns)
    return pd.DataFrame(arrays.values, index=pd.Index(arrays.t_ns, name="t_ns"), copy=False)


class ViewedSession:
    """The facts of a session, which hold for each of its views."""

    def __init__(self, log: OpenLog) -> None:
        """Take the facts of a log."""
        self._log = log

    @property
    def path(self) -> Path:
        """The file, or the folder of a split session."""
        return self._log.path

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read, in order: one, or the parts of a split session."""
        return tuple(file.path for file in self._log.file.files)

    @property
    def is_remote(self) -> bool:
        """Whether it is on a server, so that each read costs time."""
        return any(file.remote is not None for file in self._log.file.files)

    @property
    def size(self) -> int:
        """Size of the files [byte]."""
        return self._log.file.size

    def fingerprint(self) -> str:
        """Return the SHA-256 of the files; of those on a server, their ETags."""
        return self._log.file.fingerprint()

    @property
    def warnings(self) -> list[str]:
        """Missing or doubtful parts, one sentence each; grows while columns are read."""
        return list(self._log.warnings)

    @property
    def chunk_times_ns(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        """First and last log time stated in each chunk [Unix ns], shape (n,) each."""
        return self._log.file.spans

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The file's metadata records; ``undulog`` holds session id, epoch and versions."""
        return MappingProxyType(self._log.file.metadata)

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Attached files, e.g. ``robot.toml``, by name."""
        stored = self._log.file.attachments
        return MappingProxyType({name: item.data for name, item in stored.items()})

    @property
    def session_id(self) -> str:
        """The session's id; one from the content if it has none, the same for every copy."""
        return self._log.file.session_id

    @property
    def settle_s(self) -> float | None:
        """Settling time to leave out of a steady-state analysis [s]; None if not stated."""
        stated = self._log.file.metadata.get("undulog", {}).get("settle_s", "")
        try:
            seconds = float(stated)
        except ValueError:
            return None
        return seconds if 0.0 <= seconds < math.inf else None

    @property
    def robot(self) -> Robot | None:
        """The robot whose description is attached, or None."""
        return self._log.robot

    @property
    def robot_given(self) -> str | None:
        """Name or file of the robot that was given for a log without one; None otherwise."""
        given = self._log.robot_given
        return None if given is None else given[0]

    @property
    def run(self) -> TwinRun | None:
        """Servos, contact and physics rate of a twin's run; None for other sessions."""
        return self._log.run

    @property
    def robot_as_run(self) -> Robot | None:
        """The robot with the servos and masses of a twin's run; else as described."""
        if self.robot is None or self.run is None:
            return self.robot
        return self.robot.with_modules(self.run.servo_of, self.run.mass_factor)

    @property
    def verdict(self) -> str | None:
        """The recorder's final health verdict, or None."""
        return self._log.file.metadata.get("undulog.health", {}).get("verdict")

    @property
    def library(self) -> str:
        """The library that wrote the file."""
        return self._log.file.library

    @property
    def profile(self) -> str:
        """The MCAP profile, ``ros2`` for a log of the log contract."""
        return self._log.file.profile
