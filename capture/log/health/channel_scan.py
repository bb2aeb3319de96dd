"""Tallies of the messages of one channel, many at a time.

Messages are processed in batches of a few thousand, for speed, and memory holds one batch per
channel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import FloatArray, IntArray
from ...common.errors import DataError
from ..columns.layouts import (
    MOST_JOINT_LISTS,
    MOST_LAYOUTS,
    TIME,
    LayoutSorter,
    Matrix,
    names_of,
    time_ns,
    values_of,
)
from ..mcap.chunk import BODY_AT, FIXED_SIZE, LAST_NS, Buffer, gather
from ..messages import frames as wire
from ..messages.cdr import Layout, layout_of
from ..messages.definitions import MessageType
from ..messages.frames import records_at
from .bus_tally import BusTally
from .freeze import RangeTally
from .rules import LIMIT_RAD
from .tallies import SequenceTally, TimingTally

_STAMP_AT = 4  # a leading Header or Time follows the encapsulation header at once
_BATCH_ROWS = 4096
_BATCH_BYTES = 1 << 21
_FIELDS = ("position", "velocity", "effort")

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

Limits = dict[str, tuple[float, float]]


@dataclass
class NameTallies:
    """Tallies of the messages that carry the same names.

    Attributes:
        names: Joints or values; empty for other types.
        first_log_ns: First log time [Unix ns].
        last_log_ns: Last log time [Unix ns].
        nan_of: Number of NaN and number of values, by field.
        joint_nan: Samples that are NaN in some field, shape (k,).
        at_limit: Angles at the joint's limits, shape (k,).
        ranges: Smallest and largest angles in each second.
    """

    names: tuple[str, ...]
    timing: TimingTally = field(default_factory=TimingTally)
    first_log_ns: int = 2**63 - 1
    last_log_ns: int = 0
    numbers: int = 0
    nan_of: dict[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    rows: int = 0
    joint_nan: IntArray = field(init=False)
    at_limit: IntArray = field(init=False)
    ranges: RangeTally = field(default_factory=RangeTally)

    def __post_init__(self) -> None:
        """Create the counters."""
        self.joint_nan = np.zeros(len(self.names), np.int64)
        self.at_limit = np.zeros(len(self.names), np.int64)

    @property
    def nan(self) -> int:
        """Number of NaN, without axes of a vector that are not measured.

        Such an axis is always NaN while another one is not, see sensor_msgs/MagneticField.
        """
        return sum(
            count
            for path, (count, of) in self.nan_of.items()
            if count < of or not self._is_spare_axis(path)
        )

    def _is_spare_axis(self, path: str) -> bool:
        vector, _, axis = path.rpartition(".")
        every = [self.nan_of.get(f"{vector}.{other}", (0, 0)) for other in "xyz"]
        return axis in ("x", "y", "z") and any(count < of for count, of in every)


class ChannelScan:
    """Tallies of one channel; ``ends`` are the first and last message of diagnostics."""

    def __init__(
        self,
        topic: str,
        kind: MessageType | None,
        *,
        joints: bool,
        limits: Limits | None,
        horizon_s: int | None = None,
    ) -> None:
        """Start empty.

        Args:
            kind: Its message type; None if it can't be read: then only log times are used.
            joints: Whether its messages are JointStates.
            limits: Joint name to limits [rad]; None if its positions are not angles.
            horizon_s: How far stamps may go back in a running recording [s], which bounds memory.
                None for a file.
        """
        self.topic = topic
        self.count = self.unread = 0
        self.sequence = SequenceTally()
        self.series: dict[tuple[str, ...], NameTallies] = {}
        framed = kind is not None and kind.name == "std_msgs/msg/UInt8MultiArray"
        framed = framed and topic.startswith(wire.FRAME_TOPIC_PREFIXES)
        self.bus = BusTally(horizon_s) if framed else None
        self.ends: tuple[bytes, bytes] | None = None
        self._keeps_ends = kind is not None and kind.name == DIAGNOSTICS
        self.kind = kind
        self._joints, self._limits = joints, limits
        self._stamped = kind is not None and _is_stamped(kind)
        self._horizon_s = horizon_s
        self._sorter = None if kind is None else _sorter(kind, joints=joints)
        self._log: list[NDArray[np.uint64]] = []
        self._sequence: list[NDArray[np.uint32]] = []
        self._pending: list[tuple[IntArray, Matrix]] = []  # rows of the batch, their messages
        self._rows = self._bytes = 0

    def add(self, data: Buffer, offsets: IntArray, heads: NDArray[np.void]) -> None:
        """Add the channel's messages of one block.

        Args:
            data: The block's payload.
            offsets: Offsets of their records, in file order, shape (n,).
            heads: The records' heads, of :data:`HEAD`, shape (n,).
        """
        # Few large messages at a time: each is copied.
        pieces = int(min(len(heads), heads["length"].sum() // (2 * _BATCH_BYTES) + 1))
        if pieces > 1:
            for k in range(pieces):
                part = slice(k * len(heads) // pieces, (k + 1) * len(heads) // pieces)
                self._add(data, offsets[part], heads[part])
        else:
            self._add(data, offsets, heads)

    def _add(self, data: Buffer, offsets: IntArray, heads: NDArray[np.void]) -> None:
        self._log.append(heads["log"])
        self._sequence.append(heads["sequence"])
        if self.kind is not None:
            lengths = heads["length"].astype(np.int64) - FIXED_SIZE
            first = int(lengths[0])
            if (lengths == first).all():
                self._take(data, offsets, np.arange(len(offsets)), first)
            else:
                sizes: list[int] = np.unique(lengths).tolist()
                for size in sizes:
                    rows = np.flatnonzero(lengths == size)
                    self._take(data, offsets[rows], rows, size)
        self._rows += len(offsets)
        if self._rows >= _BATCH_ROWS or self._bytes >= _BATCH_BYTES:
            self.flush()

    def _take(self, data: Buffer, offsets: IntArray, rows: IntArray, size: int) -> None:
        """Copy messages of one length; ``rows`` are their positions in the block."""
        if not size:
            matrix = np.empty((len(rows), 0), np.uint8)
        elif len(rows) == 1 and size >= _BATCH_BYTES:  # processed before the payload is released
            matrix = np.frombuffer(data, np.uint8, size, int(offsets[0]) + BODY_AT)[None]
        else:
            records = gather(data, offsets + BODY_AT, np.dtype(f"V{size}"))
            matrix = records.view(np.uint8).reshape(len(rows), -1)
        self._pending.append((self._rows + rows, matrix))
        self._bytes += matrix.size

    def flush(self) -> None:
        """Process the messages collected so far."""
        if not self._rows:
            return
        log_ns = np.minimum(np.concatenate(self._log), LAST_NS).astype(np.int64)
        self.sequence.add(np.concatenate(self._sequence).astype(np.int64))
        self.count += len(log_ns)
        batch = self._pending
        self._log, self._sequence, self._pending = [], [], []
        self._rows = self._bytes = 0
        by_length: dict[int, list[tuple[IntArray, Matrix]]] = {}
        for rows, matrix in batch:
            by_length.setdefault(matrix.shape[1], []).append((rows, matrix))
        whole = [
            parts[0]
            if len(parts) == 1
            else (np.concatenate([r for r, _ in parts]), np.concatenate([m for _, m in parts]))
            for parts in by_length.values()
        ]
        if self._keeps_ends:
            self._keep_ends(whole)
        stamps = log_ns.copy()
        if self._stamped:
            for rows, matrix in whole:
                _stamp(stamps, rows, matrix)
        if self._joints:
            self._add_joints(whole, stamps, log_ns)
            return
        series = self._add_times((), stamps, log_ns)
        if self.kind is not None and self.bus is not None:
            self._add_frames(self.bus, self.kind, whole, len(log_ns))
        else:
            for _, matrix in whole:
                for layout, _, part in self._by_layout(matrix):
                    _count_nan(series, layout, part)

    def _series_of(self, names: tuple[str, ...]) -> NameTallies:
        if names not in self.series:
            self.series[names] = NameTallies(names, ranges=RangeTally(self._horizon_s))
        return self.series[names]

    def _keep_ends(self, whole: list[tuple[IntArray, Matrix]]) -> None:
        """Keep the first and the last message."""
        if not whole:
            return
        first = min(whole, key=lambda part: int(part[0].min()))
        last = max(whole, key=lambda part: int(part[0].max()))
        early = first[1][int(first[0].argmin())].tobytes()
        late = last[1][int(last[0].argmax())].tobytes()
        self.ends = (early if self.ends is None else self.ends[0], late)

    def _add_times(self, names: tuple[str, ...], stamps: IntArray, log_ns: IntArray) -> NameTallies:
        series = self._series_of(names)
        series.timing.add(stamps)
        series.first_log_ns = min(series.first_log_ns, int(log_ns.min()))
        series.last_log_ns = max(series.last_log_ns, int(log_ns.max()))
        return series

    def _add_joints(
        self, whole: list[tuple[IntArray, Matrix]], stamps: IntArray, log_ns: IntArray
    ) -> None:
        places: dict[tuple[str, ...], list[IntArray]] = {}
        for rows, matrix in whole:
            for layout, selection, part in self._by_layout(matrix):
                names, chosen = names_of(layout), rows[selection]
                places.setdefault(names, []).append(chosen)
                series = self._series_of(names)
                _count_nan(series, layout, part)
                self._add_values(series, layout, part, stamps[chosen])
        for names, chosen in places.items():
            ordered = np.sort(np.concatenate(chosen))
            self._add_times(names, stamps[ordered], log_ns[ordered])

    def _add_values(
        self, series: NameTallies, layout: Layout, part: Matrix, stamps: IntArray
    ) -> None:
        fields = [_numbers(layout, name, part) for name in _FIELDS]
        fields = [values for values in fields if values.shape[1] == len(series.names) > 0]
        if not fields:
            return
        series.rows += len(part)
        series.joint_nan += np.any([np.isnan(values) for values in fields], axis=0).sum(axis=0)
        angles = _numbers(layout, "position", part)
        if self._limits is None or angles.shape[1] != len(series.names):
            return
        series.ranges.add(stamps, angles)
        none = (-np.inf, np.inf)
        lower, upper = np.array([self._limits.get(name, none) for name in series.names]).T
        at_limit = (angles <= lower + LIMIT_RAD) | (angles >= upper - LIMIT_RAD)
        series.at_limit += at_limit.sum(axis=0)

    def _add_frames(
        self,
        bus: BusTally,
        kind: MessageType,
        whole: list[tuple[IntArray, Matrix]],
        count: int,
    ) -> None:
        fd = self.topic.startswith(wire.FD_TOPIC_PREFIX)
        dtype, label = (
            (wire.FD_FRAME_DTYPE, wire.FD_FRAME_LAYOUT)
            if fd
            else (wire.FRAME_DTYPE, wire.FRAME_LAYOUT)
        )
        sizes = np.zeros(count, np.int64)
        framed: list[tuple[IntArray, Matrix]] = []
        for rows, matrix in whole:
            try:
                at, number = _records_in(kind, matrix[0].tobytes(), dtype, label)
            except DataError:
                self.unread += len(rows)
                continue
            if number:
                framed.append((rows, matrix[:, at : at + number * dtype.itemsize]))
                sizes[rows] = number
        starts = np.cumsum(sizes) - sizes
        frames = np.zeros(int(sizes.sum()), dtype)
        for rows, data in framed:
            records = np.ascontiguousarray(data).view(dtype)
            frames[starts[rows][:, None] + np.arange(records.shape[1])] = records
        bus.add(frames)

    def _by_layout(self, matrix: Matrix) -> Iterator[tuple[Layout, IntArray, Matrix]]:
        """Sort messages of one length; yield layout, rows and messages."""
        left = len(matrix)
        for rows, layout, _, is_kept in () if self._sorter is None else self._sorter.sort(matrix):
            if isinstance(layout, DataError):
                self.unread += 1
            elif is_kept:
                yield layout, rows, matrix if len(rows) == len(matrix) else matrix[rows]
            else:  # too many layouts
                self.unread += left if self._joints else 0
                return
            left -= len(rows)


def _sorter(kind: MessageType, *, joints: bool) -> LayoutSorter:
    most = MOST_JOINT_LISTS if joints else MOST_LAYOUTS
    return LayoutSorter(partial(layout_of, kind), most=most, in_all=joints or (not kind.has_floats))


def _records_in(
    kind: MessageType, message: bytes, dtype: np.dtype[np.void], label: str
) -> tuple[int, int]:
    """Return offset and number of the frames in a message."""
    place = records_at(message, label, dtype)
    if place is not None:
        return place
    layout = layout_of(kind, message)
    leaf = layout.leaves.get("data")
    if leaf is None:
        return 0, 0
    if label not in layout.strings.values() or leaf.count % dtype.itemsize:
        raise DataError("not frames of this layout")
    return leaf.offset, leaf.count // dtype.itemsize


def _numbers(layout: Layout, path: str, part: Matrix) -> FloatArray:
    return values_of(layout, path, part).astype(np.float64, copy=False)


def _count_nan(series: NameTallies, layout: Layout, part: Matrix) -> None:
    for path, leaf in layout.leaves.items():
        if leaf.dtype in ("<f4", "<f8"):
            series.numbers += len(part) * leaf.count
            count = int(np.isnan(values_of(layout, path, part)).sum())
            before, of = series.nan_of.get(path, (0, 0))
            series.nan_of[path] = before + count, of + len(part) * leaf.count


def _stamp(stamps: IntArray, rows: IntArray, matrix: Matrix) -> None:
    """Replace log times by header stamps that are not zero."""
    if matrix.shape[1] < _STAMP_AT + TIME.itemsize:
        return
    times = np.ascontiguousarray(matrix[:, _STAMP_AT : _STAMP_AT + TIME.itemsize]).view(TIME)[:, 0]
    stamp_ns = time_ns(times["sec"], times["nanosec"])
    usable = (matrix[:, 1] == 1) & (stamp_ns != 0)  # little-endian
    stamps[rows[usable]] = stamp_ns[usable]


def _is_stamped(kind: MessageType) -> bool:
    """Whether a message starts with a Header or a Time."""
    first = kind.fields[0].nested if kind.fields else None
    if first is not None and first.fields and first.fields[0].nested is not None:
        first = first.fields[0].nested
    return first is not None and [part.name for part in first.fields] == ["sec", "nanosec"]
