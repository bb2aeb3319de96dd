"""Messages of a recording that goes on, as the samples that are drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import DataError, RobotFileError
from undulog.capture.log.columns.layouts import LayoutSorter, Matrix, names_of, stamps_of, values_of
from undulog.capture.log.columns.topics import decoder_of
from undulog.capture.log.messages.cdr import Layout, layout_of
from undulog.capture.log.messages.definitions import MessageType, parse_message_type
from undulog.capture.log.read.joint_messages import JointRows, merge_rows
from undulog.capture.log.read.joint_states import OFFSET_TOPICS
from undulog.capture.log.read.sample_times import clock_shift_ns, moved
from undulog.capture.log.write.mcap_sink import Description
from undulog.capture.recorder.live_wire import LiveMessage
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Robot

from ..draw.lines import MODE
from ..draw.motion import POSE, HeadPath, tracked_head
from ..samples.tracks import JOINT_STATE, OFFSETS, Columns, Track, ordered, without_filler

PATIENCE_NS = 250_000_000
"""How long a quantity without new samples delays those computed from it [ns]."""

_OFFSETS_KEPT = 1024
"""A recorder writes those of a slice of frames ahead of the samples that they time."""

_ODOMETRY = "nav_msgs/msg/Odometry"
_RANGE = "sensor_msgs/msg/Range"
_STRING = "std_msgs/msg/String"
_LOG = "rcl_interfaces/msg/Log"


Samples = tuple[IntArray, FloatArray]
"""Times [ns], and a value at each."""


@dataclass
class SampleBatch:
    """New samples.

    Attributes:
        head: Of the head's pose, or None.
        ranges: Topic to sampling times [ns], shape (n,), and distances [m], shape (n,).
        modes: Times of gait modes [ns], and their names.
        events: When something happened [ns], and its message.
        messages: How many messages it was made of.
    """

    columns: Columns = field(default_factory=Columns)
    head: HeadPath | None = None
    ranges: dict[str, Samples] = field(default_factory=dict[str, Samples])
    modes: list[tuple[int, str]] = field(default_factory=list[tuple[int, str]])
    events: list[tuple[int, Any]] = field(default_factory=list[tuple[int, Any]])
    messages: int = 0


@dataclass(frozen=True)
class _Group:
    """Messages of one layout, a row each."""

    layout: Layout
    t_ns: IntArray
    log_ns: IntArray
    matrix: Matrix

    def values(self, path: str) -> NDArray[Any]:
        return values_of(self.layout, path, self.matrix)


@dataclass
class _Topic:
    """A channel and what is known of its messages."""

    channel: Channel
    schema: Schema
    kind: MessageType
    sorter: LayoutSorter
    decode: Callable[[bytes], Any] | None = None


class LiveLog:
    """What is known of a recording so far, and how to read its messages."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self.facts: Mapping[str, str] = {}
        self.unread = 0
        """Messages that could not be read, or came before their channel was known."""
        self.notes: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, _Topic] = {}
        self._files: dict[str, str] = {}
        self._robot: Robot | None = None
        # Topic and joint to stamps and sample time minus stamp [s].
        self._offsets: dict[str, dict[str, Samples]] = {}
        self._robot_is_read = True
        self._shift_ns: int | None = None

    @property
    def robot(self) -> Robot | None:
        """The robot, or None while none is described."""
        if not self._robot_is_read:
            self._robot_is_read = True
            self._read_robot()
        return self._robot

    @property
    def units(self) -> dict[str, str]:
        """Topic to its unit; ``rad`` where its channel has none."""
        channels = [topic.channel for topic in self._topics.values()]
        return {channel.topic: channel.metadata.get("unit", "rad") for channel in channels}

    def define(self, record: Description | object) -> None:
        """Take what explains messages; the same again changes nothing.

        Args:
            record: A schema, a channel, the facts of the session, or an attached file.

        Raises:
            DataError: If a schema can't be read.
        """
        match record:
            case Schema():
                self._schemas[record.id] = record
            case Channel():
                self._define_channel(record)
            case Metadata():
                self.facts = record.metadata
            case Attachment():
                text = record.data.decode("utf-8", "replace")
                if self._files.get(record.name) != text:
                    self._files[record.name] = text
                    self._robot_is_read = False
            case _:
                pass

    def decode(self, messages: Iterable[LiveMessage]) -> SampleBatch:
        """Read messages.

        Args:
            messages: In the order of their sequence numbers.
        """
        by_channel: dict[int, list[LiveMessage]] = {}
        batch = SampleBatch()
        for message in messages:
            by_channel.setdefault(message.channel_id, []).append(message)
            batch.messages += 1
        topics: list[tuple[_Topic, list[LiveMessage]]] = []
        for channel_id, group in by_channel.items():
            topic = self._topics.get(channel_id)
            if topic is None:
                self.unread += len(group)
            else:
                topics.append((topic, group))
        topics.sort(key=lambda pair: pair[0].channel.topic not in OFFSETS)  # these shift the times
        for topic, group in topics:
            self._read(topic, group, batch)
        return batch

    # -- definitions -----------------------------------------------------------------------

    def _define_channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        topic = self._topics.get(channel.id)
        if schema is None or (topic is not None and topic.channel == channel):
            return
        kind = parse_message_type(schema.name, schema.data.decode("utf-8", "replace"))
        self._topics[channel.id] = _Topic(channel, schema, kind, _sorter(kind))

    def _read_robot(self) -> None:
        """Read the robot from the files that have come so far."""
        if "robot.toml" not in self._files:
            return
        try:
            text = self._files["robot.toml"]
            self._robot = parse_robot(text, source="robot.toml", databases=self._files)
        except RobotFileError as error:
            self._robot = None
            self.notes[:] = [f"the robot description can't be used: {error}"]
        else:
            self.notes.clear()

    # -- messages --------------------------------------------------------------------------

    def _read(self, topic: _Topic, messages: Sequence[LiveMessage], batch: SampleBatch) -> None:
        name, type_name = topic.channel.topic, topic.schema.name
        if type_name == JOINT_STATE:
            self._read_joints(topic, messages, batch)
        elif type_name == _ODOMETRY and name == "/odom":
            if samples := self._samples(topic, messages, POSE):
                batch.head = tracked_head(*samples)
        elif type_name == _RANGE:
            if samples := self._samples(topic, messages, ["range"]):
                batch.ranges[name] = ordered(samples[0], samples[1][:, 0])
        elif type_name == _STRING and name == MODE:
            batch.modes += [(t, str(m.data)) for t, m in self._general(topic, messages)]
        elif type_name == _LOG:
            batch.events += self._general(topic, messages)

    def _samples(
        self, topic: _Topic, messages: Sequence[LiveMessage], fields: Sequence[str]
    ) -> Samples | None:
        """Some numbers of each message, shape (n, number of fields); None where none is read."""
        groups = self._groups(topic, messages)
        if not groups:
            return None
        rows = [
            np.concatenate([group.values(field_name) for field_name in fields], axis=1)
            for group in groups
        ]
        t_ns = np.concatenate([group.t_ns for group in groups])
        return t_ns, np.concatenate(rows).astype(np.float64)

    def _read_joints(
        self, topic: _Topic, messages: Sequence[LiveMessage], batch: SampleBatch
    ) -> None:
        name = topic.channel.topic
        fields = ("position", "velocity", "effort") if name == "/joint_states" else ("position",)
        groups = self._groups(topic, messages)
        if name in OFFSETS:
            self._keep_offsets(name, [_joint_rows(group, "position") for group in groups])
            return
        shifted: dict[tuple[str, int], IntArray] = {}  # the fields of a message share their times
        for field_name in fields:
            rows = [_joint_rows(group, field_name) for group in groups]
            tracks = self._tracks(
                name, field_name, [row for row in rows if row.values.size], shifted
            )
            if tracks:
                batch.columns[name, field_name] = tracks

    def _tracks(
        self,
        topic: str,
        field_name: str,
        rows: Sequence[JointRows],
        shifted: dict[tuple[str, int], IntArray],
    ) -> tuple[Track, ...]:
        names, times, values = merge_rows(rows, topic, field_name, _ignore)
        offsets = self._offsets.get(OFFSET_TOPICS.get(topic, ""), {})
        tracks: dict[str, Track] = {}
        for name, t_ns, column in zip(names, times, values, strict=True):
            if name in offsets:
                key = name, t_ns.size
                if key not in shifted:
                    shifted[key] = moved(t_ns, *offsets[name])
                t_ns = shifted[key]  # noqa: PLW2901
            track = without_filler(Track(name, *ordered(t_ns, column)))
            if np.isfinite(track.values).any():
                tracks[name] = track
        chain = self.robot.joint_names if self.robot is not None else ()
        inside = [tracks[name] for name in chain if name in tracks]
        return (*inside, *(track for name, track in tracks.items() if name not in chain))

    def _keep_offsets(self, topic: str, rows: Sequence[JointRows]) -> None:
        """Keep the last sample times relative to the stamp; none where all are zero."""
        kept = self._offsets.setdefault(topic, {})
        names, times, values = merge_rows(rows, topic, "position", _ignore)
        if not kept and not any(column.any() for column in values):
            return  # sampled together
        for name, t_ns, column in zip(names, times, values, strict=True):
            old_t, old = kept.get(name, (t_ns[:0], column[:0]))
            joined = ordered(np.concatenate([old_t, t_ns]), np.concatenate([old, column]))
            kept[name] = joined[0][-_OFFSETS_KEPT:], joined[1][-_OFFSETS_KEPT:]

    def _on_log_clock(self, stamp_ns: IntArray | None, log_ns: IntArray) -> IntArray:
        """Stamps on the log's clock; see :mod:`.capture.log.read.sample_times`."""
        if stamp_ns is None or not stamp_ns.any():
            return log_ns
        if self._shift_ns is None:
            self._shift_ns = clock_shift_ns(int(stamp_ns[0]), int(log_ns[0]))
        return stamp_ns + self._shift_ns

    def _groups(self, topic: _Topic, messages: Sequence[LiveMessage]) -> list[_Group]:
        """The messages by layout."""
        groups: list[_Group] = []
        by_length: dict[int, list[LiveMessage]] = {}
        for message in messages:
            by_length.setdefault(len(message.payload), []).append(message)
        for length, rest in by_length.items():
            data = np.frombuffer(b"".join(message.payload for message in rest), dtype=np.uint8)
            matrix = data.reshape(len(rest), length)
            log_ns = np.array([message.log_time_ns for message in rest], dtype=np.int64)
            for rows, layout, *_ in topic.sorter.sort(matrix):
                if isinstance(layout, DataError):
                    self.unread += 1
                else:
                    payloads, logged_ns = matrix[rows], log_ns[rows]
                    t_ns = self._on_log_clock(stamps_of(layout, payloads), logged_ns)
                    groups.append(_Group(layout, t_ns, logged_ns, payloads))
        if topic.sorter.is_full:
            topic.sorter = _sorter(topic.kind)
        return groups

    def _general(self, topic: _Topic, messages: Sequence[LiveMessage]) -> list[tuple[int, Any]]:
        """Log times and messages of any shape."""
        decoded: list[tuple[int, Any]] = []
        try:
            decode = topic.decode = topic.decode or decoder_of(topic.schema, topic.channel.topic)
            decoded.extend((message.log_time_ns, decode(message.payload)) for message in messages)
        except DataError:
            self.unread += len(messages) - len(decoded)
        return decoded


def _joint_rows(group: _Group, field_name: str) -> JointRows:
    values = group.values(field_name).astype(np.float64)
    return JointRows(names_of(group.layout), group.t_ns, group.log_ns, values)


def _sorter(kind: MessageType) -> LayoutSorter:
    return LayoutSorter(partial(layout_of, kind), in_all=True)


def _ignore(_sentence: str) -> None:
    """Ignore irregularities of a log: the recorder and ``log check`` report them."""
