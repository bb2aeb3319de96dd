"""The session reader: any log to the contract, and any ROS 2 bag with JointStates, as columns.

Opening reads the summary only. Columns are read when asked for, over a time window if given;
whatever could not be read is said in ``warnings``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self, cast

import numpy as np
import pandas as pd
from mcap.exceptions import McapError
from mcap.records import Schema

from .arrays import FloatArray, IntArray
from .cdr import layout_of
from .columns import Group, Unread, message_blocks, message_bytes, read_groups
from .errors import DataError, LogError, MissingChannelError, RobotFileError
from .frames import FRAME_DTYPE, FrameArray, empty_frames, frames_from_bytes
from .joint_reading import JointRows, merge_rows, own_times, rows_of
from .robot import Robot
from .robot_file import parse_robot
from .rosmsg import MessageType, parse_message_type
from .signals import JointSignals
from .storage import LogFile

JOINT_STATE = "sensor_msgs/msg/JointState"
SAMPLE_OFFSET_TOPIC = "/joint_sample_offset"

_NS = 1_000_000_000
_POLLED = {"/joint_states", "/joint_current", "/joint_voltage", "/joint_temperature"}
"""Topics whose samples are taken joint by joint in the polling cycle."""

_SLACK_NS = 5 * _NS
"""How far a sampling time may lie from its log time before a window could miss it."""

_FAR_NS = 3600 * _NS
"""Stamps further than this from the log time are on another clock (simulated time)."""

_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}


@dataclass(frozen=True)
class Channel:
    """One topic of a session.

    Attributes:
        topic: E.g. ``/joint_states``.
        type_name: E.g. ``sensor_msgs/msg/JointState``.
        count: Number of messages.
        metadata: Of the channel, e.g. ``unit``.
    """

    topic: str
    type_name: str
    count: int
    metadata: Mapping[str, str]


class Session:
    """A recorded session, opened for reading."""

    def __init__(self, path: Path | str) -> None:
        """Open a session.

        Args:
            path: The MCAP file.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
        """
        self.path = Path(path)
        self._file = LogFile(self.path)
        self._warnings = list(self._file.warnings)
        self._types: dict[str, MessageType] = {}
        self._stamp_shift_ns = 0
        self._offsets: JointSignals | None = None
        self._offsets_read = False
        ids: dict[str, list[int]] = {}
        for channel in self._file.channels.values():
            ids.setdefault(channel.topic, []).append(channel.id)
        self._ids = ids
        self.channels: Mapping[str, Channel] = MappingProxyType(
            {topic: self._channel(topic, ids[topic]) for topic in ids}
        )
        self.robot: Robot | None = self._read_robot()

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Open a session; the same as calling the class.

        Args:
            path: The MCAP file.

        Returns:
            The session, usable in a ``with`` block.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
        """
        return cls(path)

    def close(self) -> None:
        """Release the file."""
        self._file.close()

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

    # -- facts -----------------------------------------------------------------------------

    @property
    def warnings(self) -> list[str]:
        """What is missing or doubtful, one sentence each; grows while columns are read."""
        return list(self._warnings)

    @property
    def start_ns(self) -> int:
        """Log time of the first message [Unix ns]; 0 where there is none."""
        return min((block.start_ns for block in self._filled()), default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last message [Unix ns]; 0 where there is none."""
        return max((block.end_ns for block in self._filled()), default=0)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / _NS

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
        if field not in _UNITS:
            raise DataError(f"a JointState has no {field!r}; it has {', '.join(_UNITS)}")
        rows = self._joint_rows(topic, field, start_ns, stop_ns)
        if sum(len(row.stamp_ns) for row in rows) and not any(row.values.size for row in rows):
            raise MissingChannelError(self.path, f"{field} in {topic}", self._fields(topic))
        rows = [self._on_log_clock(row, topic) for row in rows]
        names, times, values = merge_rows(rows, topic, field, self._warn)
        times = self._at_own_times(topic, names, times)
        cut = [_cut(t, v, start_ns, stop_ns) for t, v in zip(times, values, strict=True)]
        unit = _UNITS[field]
        if field == "position":
            unit = self.channels[topic].metadata.get("unit", unit)
        signals = JointSignals(
            topic, field, unit, names, tuple(t for t, _ in cut), tuple(v for _, v in cut)
        )
        return signals.select(self._chain_order(names))

    def table(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> pd.DataFrame:
        """All numbers and strings of a topic, one row a message.

        Args:
            topic: Any topic whose type has a ``ros2msg`` schema.
            start_ns: First log time wanted [Unix ns]; None for the session's start.
            stop_ns: One past the last log time wanted [Unix ns]; None for the end.

        Returns:
            Index ``t_ns``: header.stamp [Unix ns], or the log time where the type has none.
            Columns by field path, e.g. ``pose.pose.position.x`` or ``position[3]``, units as the
            message type has them.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If its type can't be read.
        """
        groups, unread = self._groups(topic, None, (start_ns, stop_ns))
        if unread:
            self._warn(f"{topic}: {len(unread)} messages can't be read: {unread[0].why}")
        frames = [_frame(group) for group in groups]
        if not frames:
            return pd.DataFrame(index=pd.Index([], dtype="int64", name="t_ns"))
        table = pd.concat(frames) if len(frames) > 1 else frames[0]
        return table.sort_index(kind="stable")

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
        decode = self._general_decoder(topic)
        for data, offsets in message_blocks(
            self._file, self._channel_ids(topic), (None, None), self._warn
        ):
            for offset in offsets.tolist():
                log_ns, message = message_bytes(data, offset)
                yield log_ns, decode(message)

    def frames(self, topic: str) -> FrameArray:
        """All raw CAN frames of a bus, in the order they were logged.

        Args:
            topic: E.g. ``/can/can0``.

        Returns:
            Records of :data:`capture.frames.FRAME_DTYPE`, shape (n,).

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If the topic holds something else.
        """
        groups, unread = self._groups(topic, ["data"], (None, None))
        if unread:
            self._warn(f"{topic}: {len(unread)} messages can't be read: {unread[0].why}")
        batches: list[tuple[int, FrameArray]] = []
        for group in groups:
            data = group.values("data")
            if data.shape[1] % FRAME_DTYPE.itemsize or not group.layout.strings:
                raise DataError(f"{self.path}: {topic} does not hold frames of 32 bytes")
            for log_ns, row in zip(group.times().tolist(), data, strict=True):
                batches.append((log_ns, frames_from_bytes(row.tobytes())))
        batches.sort(key=lambda batch: batch[0])
        return np.concatenate([empty_frames(0), *(frames for _, frames in batches)])

    # -- inside ----------------------------------------------------------------------------

    def _warn(self, sentence: str) -> None:
        if sentence not in self._warnings:
            self._warnings.append(sentence)

    def _filled(self) -> list[Any]:
        return [block for block in self._file.blocks if block.end_ns]

    def _channel(self, topic: str, ids: Sequence[int]) -> Channel:
        channels = [self._file.channels[channel_id] for channel_id in ids]
        schemas = [self._file.schemas.get(channel.schema_id) for channel in channels]
        names = {schema.name for schema in schemas if schema is not None}
        if len(names) > 1:
            self._warn(f"{topic} has several types: {', '.join(sorted(names))}; the first is read")
            self._ids[topic] = [
                channel.id
                for channel, schema in zip(channels, schemas, strict=True)
                if schema is not None and schema.name == cast("Schema", schemas[0]).name
            ]
        count = sum(self._file.counts.get(channel_id, 0) for channel_id in self._ids[topic])
        name = schemas[0].name if schemas[0] is not None else ""
        return Channel(topic, name, count, MappingProxyType(dict(channels[0].metadata)))

    def _read_robot(self) -> Robot | None:
        stored = self.attachments
        if "robot.toml" not in stored:
            return None
        databases = {
            name: data.decode("utf-8", "replace")
            for name, data in stored.items()
            if name.endswith(".dbc")
        }
        try:
            text = stored["robot.toml"].decode()
            return parse_robot(text, source=f"{self.path}:robot.toml", databases=databases)
        except (RobotFileError, UnicodeDecodeError) as error:
            self._warn(f"the attached robot description can't be used: {error}")
            return None

    def _channel_ids(self, topic: str) -> list[int]:
        if topic not in self._ids:
            raise MissingChannelError(self.path, topic, sorted(self._ids))
        return self._ids[topic]

    def _type(self, topic: str) -> MessageType:
        if topic not in self._types:
            schema = self._schema(topic)
            text = schema.data.decode("utf-8", "replace")
            self._types[topic] = parse_message_type(schema.name, text)
        return self._types[topic]

    def _schema(self, topic: str) -> Schema:
        channel = self._file.channels[self._channel_ids(topic)[0]]
        schema = self._file.schemas.get(channel.schema_id)
        if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
            found = f"{channel.message_encoding or 'no encoding'} with " + (
                f"a {schema.encoding or 'nameless'} schema" if schema is not None else "no schema"
            )
            raise DataError(f"{self.path}: {topic} is {found}; only ROS 2 messages (cdr) are read")
        return schema

    def _groups(
        self, topic: str, paths: Sequence[str] | None, window_ns: tuple[int | None, int | None]
    ) -> tuple[list[Group], list[Unread]]:
        return read_groups(
            self._file,
            self._channel_ids(topic),
            self._type(topic),
            paths=paths,
            window_ns=window_ns,
            warn=self._warn,
        )

    def _general_decoder(self, topic: str) -> Any:
        from mcap_ros2.decoder import DecoderFactory, McapROS2DecodeError

        schema = self._schema(topic)
        try:
            decoder = DecoderFactory().decoder_for("cdr", schema)
        except (McapROS2DecodeError, ValueError) as error:
            raise DataError(f"{self.path}: {topic}: its schema can't be used: {error}") from error

        def decode(message: bytes) -> Any:
            try:
                return cast("Any", decoder)(message)
            except (McapError, struct.error, ValueError, IndexError, ArithmeticError) as error:
                raise DataError(f"{self.path}: {topic}: a message is damaged: {error}") from error

        return decode

    def _joint_rows(
        self, topic: str, field: str, start_ns: int | None, stop_ns: int | None
    ) -> list[JointRows]:
        self._channel_ids(topic)
        if self.channels[topic].type_name != JOINT_STATE:
            kind = self.channels[topic].type_name
            raise DataError(f"{self.path}: {topic} is {kind}, not {JOINT_STATE}")
        self._find_stamp_shift(topic)
        wide = (
            None if start_ns is None else start_ns - _SLACK_NS,
            None if stop_ns is None else stop_ns + _SLACK_NS,
        )
        groups, unread = self._groups(topic, [*_STAMP, field], wide)
        rows = [rows_of(group, field) for group in groups]
        if unread:
            rows.extend(self._general_rows(topic, field, unread))
        return rows

    def _general_rows(self, topic: str, field: str, unread: Sequence[Unread]) -> list[JointRows]:
        """Rows of messages without a layout, through the general decoder."""
        decode = self._general_decoder(topic)
        rows: list[JointRows] = []
        lost = 0
        for item in unread:
            try:
                message = decode(item.data)
            except DataError:
                lost += 1
                continue
            stamp = message.header.stamp
            stamp_ns = int(stamp.sec) * _NS + int(stamp.nanosec)
            values = np.array([getattr(message, field)], dtype=np.float64)
            rows.append(
                JointRows(
                    tuple(message.name), np.array([stamp_ns]), np.array([item.log_ns]), values
                )
            )
        if lost:
            self._warn(f"{topic}: {lost} messages can't be read: {unread[0].why}")
        return rows

    def _fields(self, topic: str) -> list[str]:
        groups, _ = self._groups(topic, list(_UNITS), (None, None))
        return [field for field in _UNITS if any(field in group.columns for group in groups)]

    def _find_stamp_shift(self, topic: str) -> None:
        """Note how far the topic's clock is from the log's, if it is another clock."""
        if self._stamp_shift_ns:
            return
        for data, offsets in message_blocks(
            self._file, self._channel_ids(topic), (None, None), self._warn
        ):
            log_ns, message = message_bytes(data, int(offsets[0]))
            try:
                layout = layout_of(self._type(topic), message)
            except DataError:
                return
            sec, nanosec = (
                int(np.frombuffer(message, leaf.dtype, 1, leaf.offset)[0])
                for leaf in (layout.leaves[path] for path in _STAMP)
            )
            stamp_ns = sec * _NS + nanosec
            if stamp_ns and abs(log_ns - stamp_ns) > _FAR_NS:
                # Whole seconds, so that all topics of the session get the same shift.
                self._stamp_shift_ns = round((log_ns - stamp_ns) / _NS) * _NS
                self._warn(
                    f"header stamps lie {-self._stamp_shift_ns / _NS:.0f} s from the log times "
                    "(another clock, such as simulated time); they are shifted by that"
                )
            return

    def _on_log_clock(self, row: JointRows, topic: str) -> JointRows:
        if len(row.stamp_ns) and not row.stamp_ns.any():
            self._warn(f"{topic}: header stamps are zero; log times are used instead")
            return JointRows(row.names, row.log_ns, row.log_ns, row.values)
        if self._stamp_shift_ns:
            stamps = row.stamp_ns + self._stamp_shift_ns
            return JointRows(row.names, stamps, row.log_ns, row.values)
        return row

    def _at_own_times(
        self, topic: str, names: Sequence[str], times: Sequence[IntArray]
    ) -> list[IntArray]:
        if topic not in _POLLED or SAMPLE_OFFSET_TOPIC not in self._ids:
            return list(times)
        if not self._offsets_read:
            self._offsets_read = True
            self._offsets = self.joints(SAMPLE_OFFSET_TOPIC)
        offsets = self._offsets
        if offsets is None:
            return list(times)
        if all(not values.any() for values in offsets.values):
            return list(times)  # sampled together: keep the shared array
        own: list[IntArray] = []
        for name, t_ns in zip(names, times, strict=True):
            if name in offsets.names:
                signal = offsets.signal(name)
                own.append(own_times(t_ns, signal.t_ns, signal.values))
            else:
                self._warn(f"{SAMPLE_OFFSET_TOPIC} has no {name}: its message stamps are used")
                own.append(t_ns)
        return own

    def _chain_order(self, names: Sequence[str]) -> list[str]:
        chain = self.robot.joint_names if self.robot is not None else ()
        known = [name for name in chain if name in names]
        return known + [name for name in names if name not in chain]


def _cut(
    t_ns: IntArray, values: FloatArray, start_ns: int | None, stop_ns: int | None
) -> tuple[IntArray, FloatArray]:
    """The samples in the half-open window [start, stop); views."""
    first = 0 if start_ns is None else int(np.searchsorted(t_ns, start_ns, side="left"))
    last = len(t_ns) if stop_ns is None else int(np.searchsorted(t_ns, stop_ns, side="left"))
    if (first, last) == (0, len(t_ns)):
        return t_ns, values
    return t_ns[first:last], values[first:last]


def _frame(group: Group) -> pd.DataFrame:
    """One layout group as a table."""
    count = sum(map(len, group.log_ns))
    columns: dict[str, Any] = {}
    for path, text in group.layout.strings.items():
        columns[path] = np.full(count, text, dtype=object)
    for path, leaf in group.layout.leaves.items():
        values = group.values(path)
        if leaf.is_array:
            columns |= {f"{path}[{k}]": values[:, k] for k in range(leaf.count)}
        else:
            columns[path] = values[:, 0]
    t_ns = group.times()
    for prefix in ("header.", ""):
        if f"{prefix}stamp.sec" in columns:
            seconds = columns.pop(f"{prefix}stamp.sec").astype(np.int64)
            t_ns = seconds * _NS + columns.pop(f"{prefix}stamp.nanosec").astype(np.int64)
            break
    return pd.DataFrame(columns, index=pd.Index(t_ns, name="t_ns"))


__all__ = ["JOINT_STATE", "SAMPLE_OFFSET_TOPIC", "Channel", "LogError", "Session"]
