"""Reads JointState topics of any make: fields, clocks and sampling times put right."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import DataError, MissingChannelError
from .columns import Messages
from .joint_rows import JointRows, merge_rows, own_times, rows_of
from .rosmsg import MessageType
from .signals import JointSignals
from .stamp_clock import StampClock
from .topics import Topics, Window

JOINT_STATE = "sensor_msgs/msg/JointState"
UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
"""Field of a JointState to its unit, where the channel doesn't say otherwise."""

_NS = 1_000_000_000
_MEASURED = (
    "/joint_states",
    "/joint_velocity",
    "/joint_effort",
    "/joint_current",
    "/joint_voltage",
    "/joint_temperature",
)
OFFSET_TOPICS = dict.fromkeys(_MEASURED, "/joint_sample_offset") | {
    "/joint_commands": "/joint_command_offset"
}
"""Topic to the topic with its joints' times relative to the stamp: a bus goes joint by joint."""

_SLACK_NS = 5 * _NS
"""How far a sampling time may lie from its log time before a window could miss it."""

_STAMP = ("header.stamp.sec", "header.stamp.nanosec")


class JointReader:
    """Joint signals of one session."""

    def __init__(
        self, path: Path, topics: Topics, clock: StampClock, warn: Callable[[str], None]
    ) -> None:
        """Keep what reading needs.

        Args:
            path: The file, for messages.
            topics: Its topics.
            clock: Of its header stamps.
            warn: Takes one sentence for each irregularity.
        """
        self._path = path
        self._topics = topics
        self._clock = clock
        self._warn = warn
        self._offsets: dict[str, JointSignals] = {}

    def read(
        self, wanted: Mapping[str, Sequence[str]], window_ns: Window, chain: Sequence[str]
    ) -> dict[tuple[str, str], JointSignals]:
        """Read fields of JointState topics in one pass over the file.

        Args:
            wanted: Topic to fields: ``position``, ``velocity``, ``effort``.
            window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
            chain: Joint names head to tail; joints not in it come after it.

        Returns:
            (topic, field) to signals.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If a topic is not of JointStates, or there is no such field.
        """
        self._check(wanted)
        start, stop = window_ns
        wide = (
            None if start is None else start - _SLACK_NS,
            None if stop is None else stop + _SLACK_NS,
        )
        found = self._topics.read({topic: [*_STAMP, *wanted[topic]] for topic in wanted}, wide)
        return {
            (topic, field): self._signals(topic, field, found[topic], window_ns, chain)
            for topic in wanted
            for field in wanted[topic]
        }

    def _check(self, wanted: Mapping[str, Sequence[str]]) -> None:
        channels = self._topics.channels
        for topic, fields in wanted.items():
            if topic not in channels:
                raise MissingChannelError(self._path, topic, sorted(channels))
            if channels[topic].type_name != JOINT_STATE:
                kind = channels[topic].type_name
                raise DataError(f"{self._path}: {topic} is {kind}, not {JOINT_STATE}")
            if not _is_joint_state(self._topics.message_type(topic)):
                raise DataError(f"{self._path}: {topic}: its schema is not that of {JOINT_STATE}")
            for field in fields:
                if field not in UNITS:
                    raise DataError(f"a JointState has no {field!r}; it has {', '.join(UNITS)}")

    def _signals(
        self, topic: str, field: str, found: Messages, window_ns: Window, chain: Sequence[str]
    ) -> JointSignals:
        rows = [rows_of(group, field) for group in found.groups]
        rows.extend(self._general_rows(topic, field, found))
        if rows and not any(row.values.size for row in rows):
            raise MissingChannelError(self._path, f"{field} in {topic}", self._filled(topic))
        rows = [self._on_log_clock(row, topic) for row in rows]
        names, times, values = merge_rows(rows, topic, field, self._warn)
        times = self._at_own_times(topic, names, times)
        cut = [_cut(t, v, window_ns) for t, v in zip(times, values, strict=True)]
        unit = UNITS[field]
        if field == "position":
            unit = self._topics.channels[topic].metadata.get("unit", unit)
        signals = JointSignals(
            topic, field, unit, names, tuple(t for t, _ in cut), tuple(v for _, v in cut)
        )
        known = [name for name in chain if name in names]
        return signals.select(known + [name for name in names if name not in chain])

    def _general_rows(self, topic: str, field: str, found: Messages) -> list[JointRows]:
        """Rows of messages without a layout, through the general decoder."""
        if not found.unread:
            return []
        decode = self._topics.decoder(topic)
        rows: list[JointRows] = []
        lost = 0
        for item in found.unread:
            try:
                message = decode(item.data)
            except DataError:
                lost += 1
                continue
            stamp = message.header.stamp
            stamp_ns = int(stamp.sec) * _NS + int(stamp.nanosec)
            values = np.array([getattr(message, field)], dtype=np.float64)
            times = np.array([stamp_ns]), np.array([item.log_ns])
            rows.append(JointRows(tuple(message.name), *times, values))
        if lost:
            self._warn(f"{topic}: {lost} messages can't be read: {found.unread[0].why}")
        return rows

    def _filled(self, topic: str) -> list[str]:
        """The fields that the topic does carry."""
        found = self._topics.read({topic: list(UNITS)}, (None, None))[topic]
        return [name for name in UNITS if any(name in group.columns for group in found.groups)]

    def _on_log_clock(self, row: JointRows, topic: str) -> JointRows:
        if len(row.stamp_ns) and not row.stamp_ns.any():
            self._warn(f"{topic}: header stamps are zero; log times are used instead")
            return JointRows(row.names, row.log_ns, row.log_ns, row.values)
        shift_ns = self._clock.shift_ns(topic)
        return JointRows(row.names, row.stamp_ns + shift_ns, row.log_ns, row.values)

    def _at_own_times(
        self, topic: str, names: Sequence[str], times: Sequence[IntArray]
    ) -> list[IntArray]:
        offset_topic = OFFSET_TOPICS.get(topic)
        if offset_topic not in self._topics.channels or offset_topic is None:
            return list(times)
        if offset_topic not in self._offsets:
            key = (offset_topic, "position")
            self._offsets[offset_topic] = self.read({key[0]: [key[1]]}, (None, None), ())[key]
        offsets = self._offsets[offset_topic]
        if all(not values.any() for values in offsets.values):
            return list(times)  # sampled together: keep the shared array
        own: list[IntArray] = []
        for name, t_ns in zip(names, times, strict=True):
            if name in offsets.names:
                signal = offsets.signal(name)
                own.append(own_times(t_ns, signal.t_ns, signal.values))
            else:
                self._warn(f"{offset_topic} has no {name}: its message stamps are used")
                own.append(t_ns)
        return own


def _is_joint_state(found: MessageType) -> bool:
    """Whether a type has all that a JointState has, whatever else it has."""
    fields = {field.name: field for field in found.fields}
    arrays = [fields.get(name) for name in UNITS]
    header = fields["header"].nested if "header" in fields else None
    stamp = [field.nested for field in header.fields if field.name == "stamp"] if header else []
    time = stamp[0] if stamp else None
    parts = [part.name for part in time.fields] if time is not None else []
    return (
        "sec" in parts
        and "nanosec" in parts
        and all(field is not None and field.is_array and field.base for field in arrays)
        and "name" in fields
        and fields["name"].base == "string"
    )


def _cut(t_ns: IntArray, values: FloatArray, window_ns: Window) -> tuple[IntArray, FloatArray]:
    """The samples in the half-open window [start, stop); views."""
    start, stop = window_ns
    first = 0 if start is None else int(np.searchsorted(t_ns, start, side="left"))
    last = len(t_ns) if stop is None else int(np.searchsorted(t_ns, stop, side="left"))
    if (first, last) == (0, len(t_ns)):
        return t_ns, values
    return t_ns[first:last], values[first:last]
