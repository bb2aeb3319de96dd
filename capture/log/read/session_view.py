"""A session through an open log: its joints and tables as columns, for a window if given."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ...common.arrays import NS
from ...common.errors import MissingChannelError
from ..columns.blocks import Window
from ..columns.topics import Channel
from ..messages.definitions import MessageType
from ..messages.frames import FD_FRAME_DTYPE, FD_FRAME_LAYOUT, FRAME_DTYPE, FRAME_LAYOUT, FrameArray
from .joint_messages import JointRows
from .joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC, JointTopics
from .open_log import OpenLog, ViewedSession
from .sample_times import JointSignals

if TYPE_CHECKING:
    import pandas as pd

    from .field_arrays import FieldArrays

_Found = TypeVar("_Found")
_NO_NAMES: Mapping[str, str] = MappingProxyType({})


class SessionView(ViewedSession):
    """A session, or a view of it that reads through the same open file; see :meth:`view`.

    Functions that read a session accept either. Only the session itself can be closed.
    """

    def __init__(
        self,
        log: OpenLog,
        *,
        window_ns: Window = (None, None),
        names: Mapping[str, str] = _NO_NAMES,
        on_read: Callable[[], None] = lambda: None,
        limits_ns: tuple[int, int] | None = None,
    ) -> None:
        """Create a view of a log; :meth:`.Session.open` and :meth:`view` call this.

        Args:
            window_ns: Half-open time window [Unix ns]; None for open ends.
            names: Name of a topic in the view to its name in the log, if they differ.
            on_read: Called before each read.
            limits_ns: Start and end that the view states; those of the window if None.
        """
        super().__init__(log)
        self._window_ns, self._names, self._on_read = window_ns, names, on_read
        (first_ns, last_ns), (start_ns, stop_ns) = log.file.limits, window_ns
        start_ns = first_ns if start_ns is None else max(first_ns, start_ns)
        end_ns = last_ns if stop_ns is None else min(last_ns, stop_ns)
        self.start_ns, self.end_ns = limits_ns or (start_ns, end_ns)
        """Log times of the first and the last message, or the limits of the view [Unix ns]."""

    def view(
        self,
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
        rename: Mapping[str, str] = _NO_NAMES,
        on_read: Callable[[], None] | None = None,
    ) -> SessionView:
        """Return a view with a time window, with other topic names, or with a stop check.

        Nothing is read or copied by this. A view of a view narrows it further.

        Args:
            start_ns: First time that is read [Unix ns]; None for the session's start.
            stop_ns: One past the last time that is read [Unix ns]; None for the end.
            rename: Name in the view to the topic. Other topics that have one of these names are
                left out of the view.
            on_read: Called before each read and each message; may raise, e.g. after a request to
                stop.

        Returns:
            The view, usable as long as the session is open. Signals are limited by their sampling
            times; tables, messages and frames by their log times. The numbers of messages in
            :attr:`channels` stay those of the whole session.

        Raises:
            MissingChannelError: If a topic that is to be renamed isn't in the session.
        """
        for topic in rename.values():
            if self.joint_channel(topic) is None:
                raise MissingChannelError(self.path, topic, sorted(self.channels))
        renamed = {name: self._logged(topic) for name, topic in rename.items()}
        return SessionView(
            self._log,
            window_ns=self._within(start_ns, stop_ns),
            names={**self._names, **renamed},
            on_read=on_read or self._on_read,
        )

    def joint_topics(
        self, command: str = COMMAND_TOPIC, response: str = RESPONSE_TOPIC
    ) -> JointTopics:
        """Find the commands and the responses of a log of any make.

        Args:
            command: Topic of the commands; ``TOPIC.PART`` of a controller state, or
                ``TOPIC:JOINT,JOINT`` of an array. If the log has no ``/joint_commands``, this
                default stands for commands that are found by the types of messages.
            response: Topic of the responses, likewise.

        Returns:
            Names as :meth:`joints` takes them.

        Raises:
            MissingChannelError: If a topic that was chosen is not there.
            DataError: If an array was chosen whose joints are unknown.
        """
        if self._names.keys() & {COMMAND_TOPIC, RESPONSE_TOPIC}:
            return JointTopics(command, response)
        return self._log.joint_topics(command, response)

    def joint_channel(self, name: str) -> Channel | None:
        """Return the channel of JointStates that a name of joints is read as; None without one.

        Raises:
            DataError: If the topic has no joints.
        """
        return self.channels.get(name) or self._log.joints.channel(name)

    def joint_fields(self, name: str) -> dict[str, tuple[str, ...]]:
        """Return the fields that a topic ever has, each with its joints in order of appearance.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If it has no joints.
        """
        return self._log.joints.carried(self._logged(name))

    def joint_messages(
        self,
        topics: Mapping[str, Sequence[str]],
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], list[JointRows]]:
        """Return messages of joints as they were logged, in place of a series for each joint.

        Args:
            topics: Topic to fields, as for :meth:`joint_columns`.
            start_ns: First log time wanted [Unix ns]; None for the start.
            stop_ns: One past the last log time wanted [Unix ns]; None for the end. Trajectories
                are returned whole.

        Returns:
            (topic, field) to rows; those of the fields of one topic belong together.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If a topic has no joints or a field is none of the three.
        """
        window_ns = self._within(start_ns, stop_ns)
        return self._of_joints(topics, lambda logged: self._log.joints.logged(logged, window_ns))

    def message_type(self, topic: str) -> MessageType:
        """Return the type of a topic's messages.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If its schema can't be read.
        """
        return self._log.topics.message_type(self._logged(topic))

    def with_joints(
        self, command: str = COMMAND_TOPIC, response: str = RESPONSE_TOPIC
    ) -> SessionView:
        """Return a view that has commands and responses on the topics of the log contract.

        Args:
            command: As for :meth:`joint_topics`.
            response: As for :meth:`joint_topics`.

        Returns:
            The view; the session itself if they are there already.

        Raises:
            MissingChannelError: As :meth:`joint_topics`.
            DataError: As :meth:`joint_topics`.
        """
        chosen = self.joint_topics(command, response)
        sources = {
            COMMAND_TOPIC: chosen.command,
            RESPONSE_TOPIC: chosen.response,
            **chosen.quantities,
        }
        names = {
            topic: name for topic, name in sources.items() if self.joint_channel(name) is not None
        }
        return self.view(rename=names) if chosen.renamed.keys() & names.keys() else self

    def part(self, start_ns: int | None, stop_ns: int | None) -> SessionView:
        """Return a view that reads a window [Unix ns]; its start and end stay those of this one."""
        return SessionView(
            self._log,
            window_ns=self._within(start_ns, stop_ns),
            names=self._names,
            on_read=self._on_read,
            limits_ns=(self.start_ns, self.end_ns),
        )

    def forget(self) -> None:
        """Release memory of the data read so far, e.g. between parts of a long session.

        The pages of a mapped file count as this process's memory until they are released; they are
        read again when needed. Columns in files are released, too, and keep their values; those in
        memory stay.
        """
        self._on_read()
        self._log.file.forget()

    # -- facts -----------------------------------------------------------------------------

    @property
    def channels(self) -> Mapping[str, Channel]:
        """Topic to channel."""
        logged = self._log.topics.channels
        if not self._names:
            return logged
        away = {*self._names, *self._names.values()}
        channels = {
            name: replace(channel, topic=name)
            for name, topic in self._names.items()
            if (channel := logged.get(topic) or self._log.joints.channel(topic)) is not None
        }
        channels |= {topic: channel for topic, channel in logged.items() if topic not in away}
        return MappingProxyType(channels)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / NS

    # -- columns ---------------------------------------------------------------------------

    def joints(
        self,
        topic: str,
        field: str = "position",
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> JointSignals:
        """Return one quantity of all joints of a JointState topic.

        Args:
            topic: E.g. ``/joint_states``.
            field: ``position``, ``velocity`` or ``effort``.
            start_ns: First sampling time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last sampling time wanted [Unix ns]; None for the end.

        Returns:
            The samples, in chain order if the session has a robot, at their own
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
        topics: Mapping[str, Sequence[str]],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], JointSignals]:
        """Return several quantities in one pass over the file.

        Args:
            topics: Topic to fields, e.g. ``{"/joint_states": ["position", "velocity"]}``.
            start_ns: First sampling time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last sampling time wanted [Unix ns]; None for the end.

        Returns:
            (topic, field) to samples, as :meth:`joints` gives them.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If a topic is not of JointStates or a field is none of the three.
        """
        window_ns = self._within(start_ns, stop_ns)
        return self._of_joints(topics, lambda logged: self._log.joints.read(logged, window_ns))

    def joint_orders(self, topic: str) -> list[tuple[str, ...]]:
        """Return the lists of joints that messages of a JointState topic have, as they have them.

        Args:
            topic: E.g. ``/joint_states``.

        Returns:
            Each different list once, in order of first appearance; an empty one for messages that
            can't be read.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If its type can't be read.
        """
        self._on_read()
        return self._log.joint_orders(self._logged(topic), self._within(None, None))

    def table(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> pd.DataFrame:
        """Return all numbers and strings of a topic, one row per message.

        Args:
            topic: Any topic whose type has a ``ros2msg`` schema.
            start_ns: First log time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last log time wanted [Unix ns]; None for the end.

        Returns:
            Index ``t_ns``: header.stamp [Unix ns] on the log's clock, or the log time if the type
            has no stamp or it is zero. Columns by field path, e.g. ``pose.pose.position.x`` or
            ``position[3]``, in the units of the message type.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If its type can't be read.
        """
        return self._tables({topic: None}, (start_ns, stop_ns))[topic]

    def arrays(
        self,
        topics: Mapping[str, Sequence[str] | None],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[str, FieldArrays]:
        """Return fields of some topics, as :meth:`table` does, as plain arrays.

        Args:
            topics: Topic to field paths, e.g. ``{"/sonar": ["range"]}``; None for all of a topic.
            start_ns: First log time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last log time wanted [Unix ns]; None for the end.

        Returns:
            By topic.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If its type can't be read.
        """
        self._on_read()
        logged = {self._logged(topic): paths for topic, paths in topics.items()}
        read = self._log.arrays(logged, self._within(start_ns, stop_ns))
        return {topic: read[self._logged(topic)] for topic in topics}

    def columns(
        self,
        joints: Mapping[str, Sequence[str]],
        tables: Mapping[str, Sequence[str] | None],
    ) -> tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]:
        """Return joint signals and tables of the whole session, in one pass over the file.

        Args:
            joints: JointState topic to fields, as for :meth:`joint_columns`.
            tables: Topic to field paths, e.g. ``{"/sonar": ["range"]}``; None for all of a topic.

        Returns:
            (topic, field) to signals as :meth:`joints` gives them, and topic to table as
            :meth:`table` gives it.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If a topic can't be read, or is requested both ways.
        """
        if self._names or self._window_ns != (None, None):
            # A window of sampling times isn't one of log times: two passes.
            return self.joint_columns(joints) if joints else {}, self._tables(tables, (None, None))
        self._on_read()
        return self._log.columns(joints, tables)

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
        topics, logged = self._log.topics, self._logged(topic)
        decode = topics.decoder(logged)
        for log_ns, message in topics.raw(logged, self._window_ns):
            self._on_read()
            yield log_ns, decode(message)

    def frames(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> FrameArray:
        """Return raw CAN frames of a bus, in the order they were logged.

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
        """Return raw CAN FD frames of a bus, e.g. of ``/can_fd/can0``; see :meth:`frames`.

        Returns:
            Records of :data:`.capture.log.messages.frames.FD_FRAME_DTYPE`, shape (n,).
        """
        return self._frames(topic, (start_ns, stop_ns), FD_FRAME_DTYPE, FD_FRAME_LAYOUT)

    # -- inside ----------------------------------------------------------------------------

    def _of_joints(
        self,
        topics: Mapping[str, Sequence[str]],
        read: Callable[[Mapping[str, Sequence[str]]], Mapping[tuple[str, str], _Found]],
    ) -> dict[tuple[str, str], _Found]:
        """Read fields by the names that the log has, and return them by those of the view."""
        self._on_read()
        logged: dict[str, list[str]] = {}
        for topic, fields in topics.items():
            logged.setdefault(self._logged(topic), []).extend(fields)
        results = read(logged)
        keys = ((topic, field) for topic, fields in topics.items() for field in fields)
        return {(topic, field): results[self._logged(topic), field] for topic, field in keys}

    def _tables(
        self, topics: Mapping[str, Sequence[str] | None], window_ns: Window
    ) -> dict[str, pd.DataFrame]:
        self._on_read()
        logged = {self._logged(topic): paths for topic, paths in topics.items()}
        tables = self._log.tables(logged, self._within(*window_ns))
        return {topic: tables[self._logged(topic)] for topic in topics}

    def _frames(
        self, topic: str, window_ns: Window, dtype: np.dtype[np.void], label: str
    ) -> FrameArray:
        self._on_read()
        return self._log.frames(self._logged(topic), self._within(*window_ns), dtype, label)

    def _logged(self, topic: str) -> str:
        return self._names.get(topic, topic)

    def _within(self, start_ns: int | None, stop_ns: int | None) -> Window:
        """Return the part of a window that is in the view."""
        starts = [bound for bound in (start_ns, self._window_ns[0]) if bound is not None]
        stops = [bound for bound in (stop_ns, self._window_ns[1]) if bound is not None]
        return max(starts, default=None), min(stops, default=None)
