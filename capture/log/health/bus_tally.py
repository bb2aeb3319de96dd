"""Raw CAN frames and their sources: rate, error frames, bus load, and losses before us.

A recorder writes one ``/diagnostics`` message a second, with a status ``source NAME`` for each
source and its counts since the start as key-values. The counts of a file are those of its last
message, minus the first if the file doesn't begin with the recording (a cut, a later part).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ...common.arrays import NS, IntArray
from ...common.errors import DataError
from ...common.strict_table import Faults
from ...robot.bus_map import database_messages
from ...robot.model import Robot
from ..messages.cdr import layout_of
from ..messages.definitions import NO_VALUES, DiagnosticStatus, MessageType
from ..messages.frames import ERROR_FLAG, EXTENDED_FLAG, ID_MASK, REMOTE_FLAG, FrameArray, holds_fd
from .findings import Finding
from .rules import BAD_LOSS, GOOD_LOSS
from .tallies import BusHealth, TimingTally

LEAST_DECODED = 0.1
"""Least part of the data frames that the bus map names, unless every joint has samples: other
devices may send most frames of a bus."""

_MOST_LISTED = 8

SOURCE_PREFIX = "source "
"""Start of the name of a source's status."""

RECORDER = "recorder"
"""Name of the recorder's own status."""

ELAPSED = "elapsed_s"
"""The recorder's time since its start [s], among its values."""

FIRST_S = 5.0
"""A file whose first diagnostics are later than this in the recording doesn't begin with it."""

_COUNTS = ("frames", "dropped", "malformed", "error_frames", "reconnects", "clock_resets")


def undecoded(
    robot: str, decoded: int, frames: int, others: Mapping[str, int], *, all_joints: bool
) -> str | None:
    """Return the fault if almost no frame could be decoded.

    Args:
        robot: Name of the robot whose bus map was used.
        decoded: Data frames that carry what the map names.
        others: Identifier to number of the other data frames.
        all_joints: Whether every joint has samples.

    Returns:
        A sentence with the identifiers and the fix; None if enough was decoded.
    """
    enough = LEAST_DECODED * frames if not all_joints else 0
    if not frames or (decoded and decoded >= enough):
        return None
    count = f"only {decoded}" if decoded else "none"
    return (
        f"{count} of {frames} CAN frames can be decoded: the bus map of {robot} does not name "
        f"{counts_text(others)}; they are of another robot or bus, so import or record again with "
        "the robot that sent them (--robot; the raw frames are kept)"
    )


def counts_text(counts: Mapping[str, int], most: int = _MOST_LISTED) -> str:
    """Return counts as text, largest first, e.g. ``101 (20), 102 (10) and 3 more``."""
    parts = [f"{name} ({count})" for name, count in Counter(counts).most_common(most)]
    more = len(counts) - len(parts)
    return ", ".join(parts) + (f" and {more} more" if more else "")


def named_identifiers(robot: Robot) -> frozenset[int]:
    """Return the identifiers that a robot's bus map names, with :data:`EXTENDED_FLAG`."""
    if robot.bus is None:
        return frozenset()
    messages = database_messages(dict(robot.databases), Faults()) or {}
    matches = (messages.get(signal.message) for signal in robot.bus.signals)
    return frozenset(
        message.frame_id | (EXTENDED_FLAG if message.is_extended_frame else 0)
        for message in matches
        if message
    )


class IdentifierTally:
    """Data frames by identifier; memory is bounded, however many identifiers there are."""

    MOST = 4096
    """Largest number of identifiers."""

    def __init__(self) -> None:
        """Start empty."""
        self.frames = 0
        self.counts: Counter[int] = Counter()

    def add(self, frames: FrameArray) -> None:
        """Count frames.

        Args:
            frames: Of any kind, shape (n,); error frames and remote frames are not counted.
        """
        id_flags = frames["id_flags"]
        data = id_flags[(id_flags & np.uint32(ERROR_FLAG | REMOTE_FLAG)) == 0]
        self.frames += len(data)
        identifiers, counts = np.unique(
            data & np.uint32(EXTENDED_FLAG | ID_MASK), return_counts=True
        )
        for identifier, count in zip(identifiers.tolist(), counts.tolist(), strict=True):
            if identifier in self.counts or len(self.counts) < self.MOST:
                self.counts[identifier] += count


def frame_bits(frames: FrameArray) -> tuple[IntArray, IntArray]:
    """Return the length of classic CAN frames on the wire, with interframe space.

    Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis:
    refuted, revisited and revised" (2007): C = g + 8 s + 13 + floor((g + 8 s - 1) / 4), with
    g = 34 for 11-bit and 54 for 29-bit identifiers; the last term is the most stuff bits.

    Args:
        frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).

    Returns:
        Fewest and most bits, each of shape (n,); 0 for error frames, which are not sent on the bus.
    """
    flags = frames["id_flags"]
    g = np.where(flags & EXTENDED_FLAG, 54, 34)
    s = np.where(flags & REMOTE_FLAG, 0, np.minimum(frames["dlc"], 8)).astype(np.int64)
    on_bus = (flags & ERROR_FLAG) == 0
    fewest = g + 8 * s + 13
    return fewest * on_bus, (fewest + (g + 8 * s - 1) // 4) * on_bus


class BusTally:
    """Frames of one bus and one kind.

    CAN FD frames are counted and timed. Their length on the wire is not estimated: their data may
    have another bit rate, which is unknown.

    Attributes:
        identifiers: The data frames by identifier.
    """

    def __init__(self, horizon_s: int | None = None) -> None:
        """Start empty.

        Args:
            horizon_s: Sum up seconds that are older than this before the newest [s]; None to keep
                all of them.
        """
        self.identifiers = IdentifierTally()
        self._timing = TimingTally()
        self._errors = 0
        self._horizon_s = horizon_s
        self._bits: dict[int, tuple[int, int]] = {}
        self._closed = self._peak = (0, 0)  # of the seconds that were summed up

    def add(self, frames: FrameArray) -> None:
        """Add the next frames.

        Args:
            frames: In the order of the log, shape (n,).
        """
        if not len(frames):
            return
        t_ns = frames["t_host_ns"].astype(np.int64)
        self._timing.add(t_ns)
        self._errors += int(((frames["id_flags"] & ERROR_FLAG) != 0).sum())
        self.identifiers.add(frames)
        if holds_fd(frames):
            return
        fewest, most = frame_bits(frames)
        seconds, place = np.unique(t_ns // NS, return_inverse=True)
        sums = [np.bincount(place, bits).astype(np.int64).tolist() for bits in (fewest, most)]
        for second, low, high in zip(seconds.tolist(), *sums, strict=True):
            had = self._bits.get(second, (0, 0))
            self._bits[second] = (had[0] + low, had[1] + high)
        if self._horizon_s is not None and len(self._bits) > 2 * self._horizon_s:
            self._close(max(self._bits) - self._horizon_s)

    def result(self, topic: str, bitrate: int | None) -> BusHealth:
        """Return the health of the bus so far; ``bitrate`` is in bit/s, None if unknown."""
        timing = self._timing.result()
        span_s = (timing.last_ns - timing.first_ns) / NS
        load = peak = None
        if bitrate and span_s > 0 and self._bits:
            every = [self._closed, *self._bits.values()]
            low, high = (sum(bits[k] for bits in every) for k in (0, 1))
            load = low / span_s / bitrate, high / span_s / bitrate
            every[0] = self._peak
            low, high = (max(bits[k] for bits in every) for k in (0, 1))
            peak = low / bitrate, high / bitrate
        return BusHealth(
            topic,
            timing.count,
            timing.rate_hz,
            self._errors,
            timing.longest_s,
            timing.longest_at_ns,
            load,
            peak,
        )

    def last_second(self, bitrate: int | None) -> tuple[float, float] | None:
        """Return the load of the last whole second.

        Args:
            bitrate: [bit/s], None if unknown.

        Returns:
            Part of the bitrate without and with the most stuff bits; None if unknown.
        """
        if not bitrate or not self._bits:
            return None
        low, high = self._bits.get(max(self._bits) - 1, (0, 0))
        return low / bitrate, high / bitrate

    def _close(self, before: int) -> None:
        for second in [second for second in self._bits if second < before]:
            low, high = self._bits.pop(second)
            self._closed = self._closed[0] + low, self._closed[1] + high
            self._peak = max(self._peak[0], low), max(self._peak[1], high)


@dataclass(frozen=True)
class SourceHealth:
    """One source of a recording, as the recorder counted it.

    Attributes:
        name: E.g. ``can0``.
        dropped: Frames lost before the recorder, by the source's own counters; None without
            counters.
        malformed: Packets or lines that could not be read.
        error_frames: Frames that report a bus error.
        reconnects: How often the connection came back.
        clock_resets: How often the device's clock was set or restarted.
    """

    name: str
    frames: int
    dropped: int | None = None
    malformed: int = 0
    error_frames: int = 0
    reconnects: int = 0
    clock_resets: int = 0


def read_statuses(kind: MessageType, message: bytes) -> tuple[DiagnosticStatus, ...]:
    """Return the statuses of one ``diagnostic_msgs/DiagnosticArray``, in its order.

    Raises:
        DataError: If the message can't be decoded.
    """
    layout = layout_of(kind, message)
    text, statuses = layout.strings, list[DiagnosticStatus]()
    while (at := f"status[{len(statuses)}]") + ".name" in text:
        values: dict[str, str] = {}
        k = 0
        while (item := f"{at}.values[{k}]") + ".key" in text:
            values[text[f"{item}.key"]] = text[f"{item}.value"]
            k += 1
        level = message[layout.leaves[f"{at}.level"].offset]
        name, content, device = (
            text[f"{at}.{part}"] for part in ("name", "message", "hardware_id")
        )
        statuses.append(DiagnosticStatus(level, name, content, device, values))
    return tuple(statuses)


def measure_sources(kind: MessageType, first: bytes, last: bytes) -> tuple[SourceHealth, ...]:
    """Return the sources of a recording between its first and its last diagnostics.

    Args:
        first: The first message of ``/diagnostics`` in the file.
        last: The last one.

    Returns:
        The sources of frames by name; none if the messages are not a recorder's, or can't be
        decoded.
    """
    try:
        before = {status.name: status.values for status in read_statuses(kind, first)}
        after = read_statuses(kind, last)
    except DataError:
        return ()  # counted as unread of the channel
    late = _number(before.get(RECORDER, NO_VALUES), ELAPSED) > FIRST_S
    if late and first == last:
        return ()  # one message has no counts of the time of the file
    healths: list[SourceHealth] = []
    for status in after:
        if not status.name.startswith(SOURCE_PREFIX) or "frames" not in status.values:
            continue
        base = before.get(status.name, NO_VALUES) if late else NO_VALUES
        counts = {
            key: int(_number(status.values, key) - _number(base, key))
            for key in _COUNTS
            if key in status.values
        }
        healths.append(SourceHealth(status.name.removeprefix(SOURCE_PREFIX), **counts))
    return tuple(sorted(healths, key=lambda source: source.name))


def judge_source(source: SourceHealth) -> Iterator[Finding]:
    """Yield findings on one source."""
    label = f"source {source.name}"
    if not source.frames:
        yield Finding(1, f"{label} gave nothing")
        return
    if source.dropped:
        expected = source.frames + source.dropped
        part = source.dropped / expected
        lost = f"{label} lost {source.dropped} of {expected} frames before the recorder"
        yield Finding(2 if part >= BAD_LOSS else 1, f"{lost} ({100 * part:.2g}%)")
    if source.malformed:
        weight = int(source.malformed > GOOD_LOSS * source.frames)
        yield Finding(weight, f"{label} sent {source.malformed} packets that can't be read")
    if source.reconnects:
        yield Finding(0, f"{label} was connected again {_times(source.reconnects)}")
    if source.clock_resets:
        times = _times(source.clock_resets)
        yield Finding(0, f"the clock of {label} was set or restarted {times}")


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _number(values: Mapping[str, str], key: str) -> float:
    try:
        return float(values.get(key, "0"))
    except ValueError:
        return 0.0
