"""Reads topics of joints, JointStates and others, as one series per joint.

Foreign logs have all joints in one message, or one joint per message, or a set that changes; each
joint gets its own samples at its own sampling times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...common.arrays import NS, IntArray
from ...common.errors import DataError, MissingChannelError
from ..columns.blocks import Window
from ..columns.columns import Messages
from ..columns.names import distinct_names, one_name_sentences
from ..columns.topics import Channel, Topics
from ..messages.definitions import FLOAT_ARRAYS, JOINT_STATE, TRAJECTORY
from .joint_messages import (
    INTERFACE_UNITS,
    UNITS,
    JointRows,
    JointSource,
    JointTrajectory,
    carried,
    check_source,
    joint_source,
    leaf_paths,
    merge_rows,
    points_in_force,
    rows_of,
    sampled,
    trajectories,
)
from .sample_times import JointSeries, JointSignals, StampClock, cut, own_times

SLACK_NS = 5 * NS
"""Largest difference between sampling time and log time for which a window is complete."""

NEAR_NS = NS // 4
"""The same for logs of undulog, if the samples read cover the window."""

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
"""Topic to the topic of its joints' sampling times relative to the stamp."""


def widened(window_ns: Window, slack_ns: int) -> Window:
    """Return a window of log times for one of sampling times.

    Args:
        window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
        slack_ns: Largest difference of log times [ns].
    """
    start, stop = window_ns
    return None if start is None else start - slack_ns, None if stop is None else stop + slack_ns


def covers(by_topic: Mapping[str, Messages], window_ns: Window) -> bool:
    """Whether messages surely extend beyond a window at both ends and are in order.

    Args:
        window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
    """
    start, stop = window_ns
    for messages in by_topic.values():
        if len(messages.groups) != 1 or messages.unread:
            return False
        stamps = messages.groups[0].stamps()
        if not (start is None or stamps[0] < start) or not (stop is None or stamps[-1] >= stop):
            return False
        if (stamps[1:] < stamps[:-1]).any():
            return False
    return True


class JointReader:
    """Joint signals of one session."""

    def __init__(
        self,
        path: Path,
        topics: Topics,
        clock: StampClock,
        warn: Callable[[str], None],
        chain: Callable[[], Sequence[str]],
    ) -> None:
        """Set up a reader.

        Args:
            warn: Called with one sentence for each irregularity.
            chain: Returns joint names head to tail; joints not in it come after it.
        """
        self._path, self._topics, self._clock, self._warn = path, topics, clock, warn
        self._chain = chain
        self._offsets: dict[str, JointSeries] = {}
        self._trajectories: dict[str, list[JointTrajectory]] = {}

    def read(
        self, topics: Mapping[str, Sequence[str]], window_ns: Window
    ) -> dict[tuple[str, str], JointSignals]:
        """Read fields of JointState topics in one pass over the file.

        Args:
            topics: Topic to fields: ``position``, ``velocity``, ``effort``.
            window_ns: Half-open window of sampling times [Unix ns]; None for open ends.

        Returns:
            (topic, field) to signals.

        Raises:
            MissingChannelError: If the session has no such topic, or it never carries the field.
            DataError: If a topic is not of JointStates, or there is no such field.
        """
        requests = self.requests(topics)
        messages: dict[str, Messages] | None = None
        if self._topics.is_ours and window_ns != (None, None):
            messages = self._topics.read(requests, widened(window_ns, NEAR_NS))
        if messages is None or not covers(messages, window_ns):
            messages = self._topics.read(requests, widened(window_ns, SLACK_NS))
        return self.signals(topics, messages, window_ns)

    def requests(self, topics: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str] | None]:
        """Return the topics and leaf paths to read for some fields, with the offset topics.

        Trajectories are not among them: the times of their points have no window of log times.

        Args:
            topics: Name of a topic, or of a part of one, to fields: ``position``, ``velocity``,
                ``effort``.

        Returns:
            Topic of the log to leaf paths; None for all.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If a topic has no joints, or there is no such field.
        """
        self._check(topics)
        offsets = {topic for topic in map(self._offset_topic, topics) if topic is not None}
        self._check(dict.fromkeys(offsets, ()))
        paths: dict[str, dict[str, None] | None] = {}
        for name in [*topics, *sorted(offsets)]:
            source, kind = self._source(name)
            if kind == TRAJECTORY:
                continue
            fields = [*topics.get(name, ()), *(["position"] if name in offsets else [])]
            leaves, earlier = leaf_paths(source, kind, fields), paths.get(source.topic, {})
            both = None if leaves is None or earlier is None else earlier | dict.fromkeys(leaves)
            paths[source.topic] = both
        return {topic: None if path is None else list(path) for topic, path in paths.items()}

    def carried(self, name: str) -> dict[str, tuple[str, ...]]:
        """Return the fields that a topic ever has, each with its joints in order of appearance.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If a topic has no joints.
        """
        self._check({name: ()})
        source, kind = self._source(name)
        joints: dict[str, dict[str, None]] = {}
        if kind == TRAJECTORY:
            for read_trajectory in self._read_trajectories(source.topic):
                for field, values in read_trajectory.values.items():
                    if values.size:
                        joints.setdefault(field, {}).update(dict.fromkeys(read_trajectory.names))
        else:
            for group in self._topics.read({source.topic: []}, (None, None))[source.topic].groups:
                for field, names in carried(source, kind, group.layout).items():
                    joints.setdefault(field, {}).update(dict.fromkeys(names))
        return {field: tuple(joints[field]) for field in UNITS if field in joints}

    def logged(
        self, topics: Mapping[str, Sequence[str]], window_ns: Window
    ) -> dict[tuple[str, str], list[JointRows]]:
        """Return messages as they were logged, those of a window of log times.

        Args:
            topics: Topic to fields.
            window_ns: Half-open window of log times [Unix ns]; None for open ends. Trajectories are
                returned whole, whatever the window.

        Returns:
            (topic, field) to rows; the rows of the fields of one topic belong together.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If a topic has no joints, or there is no such field.
        """
        messages = self._topics.read(self.requests(topics), window_ns)
        keys = [(name, field) for name, fields in topics.items() for field in fields]
        rows = {key: self._rows(*key, messages) for key in keys}
        for (name, _), several in rows.items():
            for sentence in one_name_sentences(row.names for row in several):
                self._warn(f"{name}: {sentence}")
        return rows

    def signals(
        self,
        topics: Mapping[str, Sequence[str]],
        messages: Mapping[str, Messages],
        window_ns: Window,
    ) -> dict[tuple[str, str], JointSignals]:
        """Return the signals of messages that were read.

        Args:
            messages: The messages of :meth:`requests`.
            window_ns: Half-open window of sampling times [Unix ns]; None for open ends.

        Returns:
            (topic, field) to signals.

        Raises:
            MissingChannelError: If a topic never carries a field.
        """
        keys = [(topic, field) for topic, fields in topics.items() for field in fields]
        series = {key: self._series(*key, messages, window_ns) for key in keys}
        times = {key: list(channel.t_ns) for key, channel in series.items()}
        for offset_topic in sorted({name for t, _ in keys if (name := self._offset_topic(t))}):
            shifted = [key for key in keys if self._offset_topic(key[0]) == offset_topic]
            stamped = [series[key] for key in shifted]
            offsets = self._offset_series(offset_topic, messages, stamped, window_ns)
            if not any(values.any() for values in offsets.values):
                continue  # sampled together
            if offset_topic in topics:
                offsets = _copied(offsets)
            times |= zip(shifted, own_times(stamped, offsets), strict=True)
            names = set(offsets.names)
            for key in shifted:
                for name in series[key].names:
                    if name not in names:
                        self._warn(f"{offset_topic} has no {name}: its message stamps are used")
        shared = {id(t_ns): t_ns for key in keys for t_ns in times[key]}
        cuts = {key: cut(t_ns, window_ns) for key, t_ns in shared.items()}
        return {key: self._signals(key, series[key], times[key], cuts) for key in keys}

    def _offset_topic(self, topic: str) -> str | None:
        name = OFFSET_TOPICS.get(topic)
        return name if name in self._topics.channels else None

    def _offset_series(
        self,
        topic: str,
        messages: Mapping[str, Messages],
        stamped: Sequence[JointSeries],
        window_ns: Window,
    ) -> JointSeries:
        """Return the offsets of a topic from before the first stamp on; may be overwritten."""
        if topic in self._offsets:
            return _copied(self._offsets[topic])
        offsets = self._series(topic, "position", messages, window_ns)
        first = min((int(t[0]) for series in stamped for t in series.t_ns if len(t)), default=0)
        covered = all(len(t) and int(t[0]) <= first for t in offsets.t_ns)
        if covered or window_ns[0] is None:
            return offsets
        whole = self._topics.read({topic: ["position"]}, (None, None))
        self._offsets[topic] = self._series(topic, "position", whole)  # such topics are small
        return _copied(self._offsets[topic])

    def channel(self, name: str) -> Channel | None:
        """Return a topic, or a part of one, as the channel of JointStates that it is read as.

        None if the log has no such topic.

        Raises:
            DataError: If it has no joints.
        """
        source = joint_source(name, self._topics.channels)
        if source is None:
            return None
        self._check_source(source)
        logged = self._topics.channels[source.topic]
        return replace(logged, topic=name, type_name=JOINT_STATE)

    def _source(self, name: str) -> tuple[JointSource, str]:
        """Return what a name stands for, and the type of the messages."""
        channels = self._topics.channels
        source = joint_source(name, channels)
        if source is None:
            raise MissingChannelError(self._path, name, sorted(channels))
        return source, channels[source.topic].type_name

    def _check_source(self, source: JointSource) -> None:
        try:
            check_source(source, self._topics.message_type(source.topic))
        except DataError as error:
            named = "" if str(self._path) in str(error) else f"{self._path}: "
            raise DataError(f"{named}{error}") from None

    def _check(self, topics: Mapping[str, Sequence[str]]) -> None:
        for name, fields in topics.items():
            self._check_source(self._source(name)[0])
            for field in fields:
                if field not in UNITS:
                    raise DataError(f"a JointState has no {field!r}; it has {', '.join(UNITS)}")

    def _series(
        self,
        name: str,
        field: str,
        messages: Mapping[str, Messages],
        window_ns: Window = (None, None),
    ) -> JointSeries:
        """Return one field of a topic at message stamps on the log's clock."""
        source, kind = self._source(name)
        rows = self._rows(name, field, messages)
        if (rows or kind == TRAJECTORY) and not any(row.values.size for row in rows):
            raise MissingChannelError(
                self._path, f"{field} in {name}", self._filled(source, kind, window_ns)
            )
        return JointSeries(*merge_rows(rows, name, field, self._warn))

    def _rows(self, name: str, field: str, by_topic: Mapping[str, Messages]) -> list[JointRows]:
        """Return one field of a topic, with stamps on the log's clock."""
        source, kind = self._source(name)
        if kind == TRAJECTORY:
            return self._points(source, field)
        messages = by_topic[source.topic]
        try:
            rows = [rows_of(source, kind, group, field) for group in messages.groups]
        except DataError as error:
            raise DataError(f"{self._path}: {error}") from None
        rows.extend(self._general_rows(source, kind, field, messages))
        if kind in FLOAT_ARRAYS:  # whose times are the log's already
            return rows
        return [self._on_log_clock(row, source.topic) for row in rows]

    def _points(self, source: JointSource, field: str) -> list[JointRows]:
        """Return the points of the trajectories of a topic, at their own times."""
        topic = source.topic
        every = self._read_trajectories(topic)
        stamped = any(trajectory.stamp_ns for trajectory in every)
        shift_ns = self._clock.shift_ns(topic) if stamped else 0
        points, replaced = points_in_force(every, field, shift_ns)
        if replaced:
            self._warn(
                f"{topic}: {replaced} points were replaced by a later trajectory before their time"
            )
        return [JointRows(names, t_ns, t_ns, values) for names, t_ns, values in points]

    def _read_trajectories(self, topic: str) -> list[JointTrajectory]:
        if topic not in self._trajectories:
            warn = self._warn
            messages = self._topics.raw(topic)
            self._trajectories[topic] = [
                *trajectories(messages, lambda sentence: warn(f"{topic}: {sentence}"))
            ]
        return self._trajectories[topic]

    def _signals(
        self,
        key: tuple[str, str],
        series: JointSeries,
        times: Sequence[IntArray],
        cuts: Mapping[int, tuple[slice, IntArray]],
    ) -> JointSignals:
        topic, field = key
        names = series.names
        unit = UNITS[field]
        if field == "position":
            source, _ = self._source(topic)
            unit = INTERFACE_UNITS.get(source.part, unit)
            unit = self._topics.channels[source.topic].metadata.get("unit", unit)
        signals = JointSignals(
            topic,
            field,
            unit,
            names,
            tuple(cuts[id(t_ns)][1] for t_ns in times),
            tuple(v[cuts[id(t_ns)][0]] for t_ns, v in zip(times, series.values, strict=True)),
        )
        chain = self._chain()
        there, of_chain = set(names), set(chain)
        ordered = [name for name in chain if name in there]
        order = (*ordered, *(name for name in names if name not in of_chain))
        return signals if order == names else signals.select(order)

    def _general_rows(
        self, source: JointSource, kind: str, field: str, messages: Messages
    ) -> list[JointRows]:
        """Read JointStates without a layout by the general decoder."""
        if not messages.unread:
            return []
        rows: list[JointRows] = []
        lost = 0
        decode = self._topics.decoder(source.topic) if kind == JOINT_STATE else None
        for item in messages.unread:
            if decode is None:
                lost += 1
                continue
            try:
                message = decode(item.data)
            except DataError:
                lost += 1
                continue
            stamp = message.header.stamp
            stamp_ns = int(stamp.sec) * NS + int(stamp.nanosec)
            values = np.array([getattr(message, field)], dtype=np.float64)
            times = np.array([stamp_ns]), np.array([item.log_ns])
            rows.append(JointRows(distinct_names(message.name), *times, values))
        if lost:
            self._warn(f"{source.topic}: {lost} messages can't be read: {messages.unread[0].why}")
        return rows

    def _filled(self, source: JointSource, kind: str, window_ns: Window) -> list[str]:
        """Return the fields that a source has in a window of sampling times."""
        if kind == TRAJECTORY:
            every = self._trajectories[source.topic]
            return [
                name for name in UNITS if any(trajectory.values[name].size for trajectory in every)
            ]
        window_ns = widened(window_ns, SLACK_NS)
        paths = leaf_paths(source, kind, UNITS)
        groups = self._topics.read({source.topic: paths}, window_ns)[source.topic].groups
        return [
            name for name in UNITS if any(sampled(source, kind, g, name)[1].size for g in groups)
        ]

    def _on_log_clock(self, row: JointRows, topic: str) -> JointRows:
        if len(row.stamp_ns) and not row.stamp_ns.any():
            self._warn(f"{topic}: header stamps are zero; log times are used instead")
            return JointRows(row.names, row.log_ns, row.log_ns, row.values)
        shift_ns = self._clock.shift_ns(topic)
        if not shift_ns:
            return row
        return JointRows(row.names, row.stamp_ns + shift_ns, row.log_ns, row.values)


def _copied(series: JointSeries) -> JointSeries:
    return JointSeries(series.names, series.t_ns, [values.copy() for values in series.values])
