"""Counts of a recorder's sources: losses that are not visible in the frames.

A recorder writes one ``/diagnostics`` message a second, with a status ``source NAME`` for each
source and its counts since the start as key-values. The counts of a file are those of its last
message, minus the first if the file doesn't begin with the recording (a cut, a later part).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ...common.errors import DataError
from ..messages.cdr import layout_of
from ..messages.definitions import NO_VALUES, DiagnosticStatus, MessageType
from .rules import BAD_LOSS, GOOD_LOSS, Finding

SOURCE_PREFIX = "source "
"""Start of the name of a source's status."""

RECORDER = "recorder"
"""Name of the recorder's own status."""

ELAPSED = "elapsed_s"
"""The recorder's time since its start [s], among its values."""

FIRST_S = 5.0
"""A file whose first diagnostics are later than this in the recording doesn't begin with it."""

_COUNTS = ("frames", "dropped", "malformed", "error_frames", "reconnects", "clock_resets")


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
    dropped: int | None
    malformed: int
    error_frames: int
    reconnects: int
    clock_resets: int


def read_statuses(kind: MessageType, message: bytes) -> tuple[DiagnosticStatus, ...]:
    """Return the statuses of one ``diagnostic_msgs/DiagnosticArray``, in its order.

    Raises:
        DataError: If the message can't be decoded.
    """
    layout = layout_of(kind, message)
    text, found = layout.strings, list[DiagnosticStatus]()
    while (at := f"status[{len(found)}]") + ".name" in text:
        values: dict[str, str] = {}
        k = 0
        while (item := f"{at}.values[{k}]") + ".key" in text:
            values[text[f"{item}.key"]] = text[f"{item}.value"]
            k += 1
        level = message[layout.leaves[f"{at}.level"].offset]
        name, said, device = (text[f"{at}.{part}"] for part in ("name", "message", "hardware_id"))
        found.append(DiagnosticStatus(level, name, said, device, values))
    return tuple(found)


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
    found: list[SourceHealth] = []
    for status in after:
        if not status.name.startswith(SOURCE_PREFIX) or "frames" not in status.values:
            continue
        base = before.get(status.name, NO_VALUES) if late else NO_VALUES
        counts = {
            key: int(_number(status.values, key) - _number(base, key))
            for key in _COUNTS
            if key in status.values
        }
        found.append(
            SourceHealth(
                name=status.name.removeprefix(SOURCE_PREFIX),
                frames=counts["frames"],
                dropped=counts.get("dropped"),
                malformed=counts.get("malformed", 0),
                error_frames=counts.get("error_frames", 0),
                reconnects=counts.get("reconnects", 0),
                clock_resets=counts.get("clock_resets", 0),
            )
        )
    return tuple(sorted(found, key=lambda source: source.name))


def judge_source(source: SourceHealth) -> list[Finding]:
    """Return findings on one source."""
    found: list[Finding] = []
    label = f"source {source.name}"
    if not source.frames:
        return [Finding(1, f"{label} gave nothing")]
    if source.dropped:
        expected = source.frames + source.dropped
        part = source.dropped / expected
        found.append(
            Finding(
                2 if part >= BAD_LOSS else 1,
                f"{label} lost {source.dropped} of {expected} frames before the recorder "
                f"({100 * part:.2g}%)",
            )
        )
    if source.malformed:
        weight = int(source.malformed > GOOD_LOSS * source.frames)
        sentence = f"{label} sent {source.malformed} packets that can't be read"
        found.append(Finding(weight, sentence))
    if source.reconnects:
        found.append(Finding(0, f"{label} was connected again {_times(source.reconnects)}"))
    if source.clock_resets:
        sentence = f"the clock of {label} was set or restarted {_times(source.clock_resets)}"
        found.append(Finding(0, sentence))
    return found


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _number(values: Mapping[str, str], key: str) -> float:
    try:
        return float(values.get(key, "0"))
    except ValueError:
        return 0.0
