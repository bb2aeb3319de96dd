"""Reads JointState topics of any make as one series per joint.

Foreign logs have all joints in one message, or one joint per message, or a set that changes; each
joint gets its own samples at its own sampling times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...common.arrays import NS, FloatArray, IntArray
from ...common.errors import DataError, MissingChannelError
from ..columns.blocks import Window
from ..columns.columns import Messages
from ..columns.layouts import Group, names_of
from ..columns.topics import Topics
from ..messages.definitions import JOINT_STATE, MessageType
from .sample_times import JointSignals, Series, StampClock, cut, own_times

_EARLY_OR_LATE = 0.1
"""A joint that is missing for more than this part of the topic's span causes a warning."""


@dataclass(frozen=True)
class JointRows:
    """Messages that carry the same joints.

    Attributes:
        names: The joints, k of them.
        stamp_ns: header.stamp [ns], shape (n,).
        log_ns: Log time [Unix ns], shape (n,).
        values: Shape (n, k), or (n, 0) if these messages leave the field empty.
    """

    names: tuple[str, ...]
    stamp_ns: IntArray
    log_ns: IntArray
    values: FloatArray


def rows_of(group: Group, field: str) -> JointRows:
    """Return the rows of JointState messages of one layout, in log order."""
    log_ns = group.times()
    stamp_ns = group.stamps() if group.is_stamped else np.zeros_like(log_ns)
    values = group.values(field).astype(np.float64, copy=False)
    if (np.diff(log_ns) < 0).any():  # a file need not be in log order, a reader must be
        logged = np.argsort(log_ns, kind="stable")
        stamp_ns, log_ns, values = stamp_ns[logged], log_ns[logged], values[logged]
    return JointRows(names_of(group.layout), stamp_ns, log_ns, values)


def merge_rows(
    rows: Sequence[JointRows], topic: str, field: str, warn: Callable[[str], None]
) -> tuple[tuple[str, ...], list[IntArray], list[FloatArray]]:
    """Merge messages of all layouts to one series per joint.

    Args:
        rows: The messages, by layout.
        warn: Called with one sentence for each irregularity.

    Returns:
        Joint names in order of first appearance, times [Unix ns] and values, one array per joint;
        joints sampled together share one array of times.
    """
    filled = [row for row in rows if row.names and row.values.shape[1] == len(row.names)]
    for row in rows:
        if row.names and row.values.shape[1] not in {0, len(row.names)}:
            warn(
                f"{topic}: {len(row.stamp_ns)} messages have {len(row.names)} names but "
                f"{row.values.shape[1]} values of {field}; they are left out"
            )
    if len(filled) == 1:
        row = filled[0]
        t_ns, order = _in_time(row.stamp_ns, f"{topic}", warn)
        values = row.values if order is None else row.values[order]
        if values.strides[0] != values.itemsize:  # a joint's samples side by side
            values = np.asfortranarray(values)
        return row.names, [t_ns] * len(row.names), [values[:, j] for j in range(len(row.names))]
    parts: dict[str, list[tuple[JointRows, int]]] = {}
    for row in filled:
        for j, name in enumerate(row.names):
            parts.setdefault(name, []).append((row, j))
    times: list[IntArray] = []
    columns: list[FloatArray] = []
    for name, pieces in parts.items():
        log_ns = np.concatenate([row.log_ns for row, _ in pieces])
        logged = np.argsort(log_ns, kind="stable")
        stamps = np.concatenate([row.stamp_ns for row, _ in pieces])[logged]
        values = np.concatenate([row.values[:, j] for row, j in pieces])[logged]
        t_ns, order = _in_time(stamps, f"{topic}, {name}", warn)
        times.append(t_ns)
        columns.append(values if order is None else values[order])
    _warn_changed_set(tuple(parts), times, topic, warn)
    return tuple(parts), times, columns


def _in_time(
    t_ns: IntArray, where: str, warn: Callable[[str], None]
) -> tuple[IntArray, IntArray | None]:
    """Sort times; return also the order if they were unsorted. Duplicates cause a warning."""
    steps = np.diff(t_ns)
    backward, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    order: IntArray | None = None
    if backward:
        warn(f"{where}: {backward} samples go back in time; sorted by their stamps")
        order = np.argsort(t_ns, kind="stable")
        t_ns = t_ns[order]
        repeated = int((np.diff(t_ns) == 0).sum())
    if repeated:
        warn(f"{where}: {repeated} samples repeat the stamp before them; all are kept")
    return t_ns, order


def _warn_changed_set(
    names: Sequence[str], times: Sequence[IntArray], topic: str, warn: Callable[[str], None]
) -> None:
    """Warn of joints that are missing at the start or end of the topic."""
    filled = [t for t in times if len(t)]
    if not filled:
        return
    start, stop = min(int(t[0]) for t in filled), max(int(t[-1]) for t in filled)
    slack = _EARLY_OR_LATE * (stop - start)
    partial = [
        name
        for name, t in zip(names, times, strict=True)
        if not len(t) or t[0] - start > slack or stop - t[-1] > slack
    ]
    if partial:
        warn(
            f"{topic}: the set of joints changes during the session; only part of it has "
            f"{', '.join(partial)}"
        )


SLACK_NS = 5 * NS
"""Largest difference between sampling time and log time for which a window is complete."""

NEAR_NS = NS // 4
"""The same for logs of undulog, if the samples read cover the window."""


def widened(window_ns: Window, slack_ns: int) -> Window:
    """Return a window of log times for one of sampling times.

    Args:
        window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
        slack_ns: Largest difference of log times [ns].
    """
    start, stop = window_ns
    return None if start is None else start - slack_ns, None if stop is None else stop + slack_ns


def covers(found: Mapping[str, Messages], window_ns: Window) -> bool:
    """Whether messages surely extend beyond a window at both ends and are in order.

    Args:
        window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
    """
    start, stop = window_ns
    for messages in found.values():
        if len(messages.groups) != 1 or messages.unread:
            return False
        stamps = messages.groups[0].stamps()
        if not (start is None or stamps[0] < start) or not (stop is None or stamps[-1] >= stop):
            return False
        if (stamps[1:] < stamps[:-1]).any():
            return False
    return True


UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
"""Field of a JointState to its unit, if the channel states no other."""
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


class JointReader:
    """Joint signals of one session."""

    def __init__(
        self, path: Path, topics: Topics, clock: StampClock, warn: Callable[[str], None]
    ) -> None:
        """Set up a reader; ``warn`` is called with one sentence for each irregularity."""
        self._path, self._topics, self._clock, self._warn = path, topics, clock, warn
        self._offsets: dict[str, Series] = {}

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
        requests = self.requests(wanted)
        found: dict[str, Messages] | None = None
        if self._topics.is_ours and window_ns != (None, None):
            found = self._topics.read(requests, widened(window_ns, NEAR_NS))
        if found is None or not covers(found, window_ns):
            found = self._topics.read(requests, widened(window_ns, SLACK_NS))
        return self.signals(wanted, found, window_ns, chain)

    def requests(self, wanted: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str]]:
        """Return the topics and leaf paths to read for some fields, with the offset topics.

        Args:
            wanted: Topic to fields: ``position``, ``velocity``, ``effort``.

        Raises:
            MissingChannelError: If the session has no such topic.
            DataError: If a topic is not of JointStates, or there is no such field.
        """
        self._check(wanted)
        offsets = {topic for topic in map(self._offset_topic, wanted) if topic is not None}
        self._check(dict.fromkeys(offsets, ()))
        return {
            topic: [*wanted.get(topic, ()), *(["position"] if topic in offsets else [])]
            for topic in dict.fromkeys([*wanted, *sorted(offsets)])
        }

    def signals(
        self,
        wanted: Mapping[str, Sequence[str]],
        found: Mapping[str, Messages],
        window_ns: Window,
        chain: Sequence[str],
    ) -> dict[tuple[str, str], JointSignals]:
        """Return the signals of messages that were read.

        Args:
            found: The messages of :meth:`requests`.
            window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
            chain: Joint names head to tail; joints not in it come after it.

        Returns:
            (topic, field) to signals.

        Raises:
            MissingChannelError: If a topic never carries a field.
        """
        keys = [(topic, field) for topic, fields in wanted.items() for field in fields]
        series = {key: self._series(*key, found[key[0]], window_ns) for key in keys}
        times = {key: list(each.t_ns) for key, each in series.items()}
        for offset_topic in sorted({name for t, _ in keys if (name := self._offset_topic(t))}):
            own = [key for key in keys if self._offset_topic(key[0]) == offset_topic]
            stamped = [series[key] for key in own]
            offsets = self._offset_series(offset_topic, found, stamped, window_ns)
            if not any(values.any() for values in offsets.values):
                continue  # sampled together
            if offset_topic in wanted:
                offsets = _copied(offsets)
            times |= zip(own, own_times(stamped, offsets), strict=True)
            known = set(offsets.names)
            for key in own:
                for name in series[key].names:
                    if name not in known:
                        self._warn(f"{offset_topic} has no {name}: its message stamps are used")
        shared = {id(t_ns): t_ns for key in keys for t_ns in times[key]}
        cuts = {each: cut(t_ns, window_ns) for each, t_ns in shared.items()}
        return {key: self._signals(key, series[key], times[key], cuts, chain) for key in keys}

    def _offset_topic(self, topic: str) -> str | None:
        name = OFFSET_TOPICS.get(topic)
        return name if name in self._topics.channels else None

    def _offset_series(
        self,
        topic: str,
        found: Mapping[str, Messages],
        stamped: Sequence[Series],
        window_ns: Window,
    ) -> Series:
        """Return the offsets of a topic from before the first stamp on; may be overwritten."""
        if topic in self._offsets:
            return _copied(self._offsets[topic])
        offsets = self._series(topic, "position", found[topic], window_ns)
        first = min((int(t[0]) for each in stamped for t in each.t_ns if len(t)), default=0)
        known = all(len(t) and int(t[0]) <= first for t in offsets.t_ns)
        if known or window_ns[0] is None:
            return offsets
        whole = self._topics.read({topic: ["position"]}, (None, None))[topic]
        self._offsets[topic] = self._series(topic, "position", whole)  # such topics are small
        return _copied(self._offsets[topic])

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

    def _series(
        self, topic: str, field: str, found: Messages, window_ns: Window = (None, None)
    ) -> Series:
        """Return one field of a topic at message stamps on the log's clock."""
        rows = [rows_of(group, field) for group in found.groups]
        rows.extend(self._general_rows(topic, field, found))
        if rows and not any(row.values.size for row in rows):
            raise MissingChannelError(
                self._path, f"{field} in {topic}", self._filled(topic, window_ns)
            )
        rows = [self._on_log_clock(row, topic) for row in rows]
        return Series(*merge_rows(rows, topic, field, self._warn))

    def _signals(
        self,
        key: tuple[str, str],
        series: Series,
        times: Sequence[IntArray],
        cuts: Mapping[int, tuple[slice, IntArray]],
        chain: Sequence[str],
    ) -> JointSignals:
        topic, field = key
        names = series.names
        unit = UNITS[field]
        if field == "position":
            unit = self._topics.channels[topic].metadata.get("unit", unit)
        signals = JointSignals(
            topic,
            field,
            unit,
            names,
            tuple(cuts[id(t_ns)][1] for t_ns in times),
            tuple(v[cuts[id(t_ns)][0]] for t_ns, v in zip(times, series.values, strict=True)),
        )
        there, of_chain = set(names), set(chain)
        known = [name for name in chain if name in there]
        order = (*known, *(name for name in names if name not in of_chain))
        return signals if order == names else signals.select(order)

    def _general_rows(self, topic: str, field: str, found: Messages) -> list[JointRows]:
        """Read messages without a layout by the general decoder."""
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
            stamp_ns = int(stamp.sec) * NS + int(stamp.nanosec)
            values = np.array([getattr(message, field)], dtype=np.float64)
            times = np.array([stamp_ns]), np.array([item.log_ns])
            rows.append(JointRows(tuple(message.name), *times, values))
        if lost:
            self._warn(f"{topic}: {lost} messages can't be read: {found.unread[0].why}")
        return rows

    def _filled(self, topic: str, window_ns: Window) -> list[str]:
        """Return the fields that the topic has in a window of sampling times."""
        window_ns = widened(window_ns, SLACK_NS)
        found = self._topics.read({topic: list(UNITS)}, window_ns)[topic]
        return [name for name in UNITS if any(name in group.paths for group in found.groups)]

    def _on_log_clock(self, row: JointRows, topic: str) -> JointRows:
        if len(row.stamp_ns) and not row.stamp_ns.any():
            self._warn(f"{topic}: header stamps are zero; log times are used instead")
            return JointRows(row.names, row.log_ns, row.log_ns, row.values)
        shift_ns = self._clock.shift_ns(topic)
        if not shift_ns:
            return row
        return JointRows(row.names, row.stamp_ns + shift_ns, row.log_ns, row.values)


def _is_joint_state(found: MessageType) -> bool:
    """Whether a type has all fields of a JointState."""
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


def _copied(series: Series) -> Series:
    return Series(series.names, series.t_ns, [values.copy() for values in series.values])
