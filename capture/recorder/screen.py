"""A recording on one screen: the verdict first, then its details.

States are words; colours only help (blue, yellow and a reversed red, distinct also for the
colour-blind).

A terminal can stop taking text at any time (Ctrl-S, a dead connection, a full pipe), and a write to
it blocks then. So a thread of its own draws the latest state, and is abandoned if it is stuck.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from textwrap import wrap
from typing import TextIO

from rich.cells import cell_len
from rich.console import Console
from rich.live import Live
from rich.text import Text

from ..common.amounts import format_size
from ..common.arrays import NS
from ..common.console import Cells, TerminalColumn, cut, fit, plain, table
from ..log.health.findings import WAITS_FOR_COMMANDS
from ..log.health.rules import has_rhythm
from ..log.messages.definitions import ERROR, OK
from .status import (
    EventLine,
    RecorderSnapshot,
    SourceSnapshot,
    TopicSnapshot,
    combined,
    group_of,
    source_state,
)

STYLES = {"good": "bold cyan", "degraded": "bold yellow", "bad": "bold white on red"}
"""Of verdicts."""

_LEVELS = {"warn": "yellow", "error": "bold white on red", "fatal": "bold white on red"}
_MUTED = "bright_black"
_EVENTS = 4
_REASONS = 3
_SHOWN_ALONE = 3
_DASH = "-"


SOURCE_COLUMNS = (
    TerminalColumn("source", 10, left=True),
    TerminalColumn("state", 16, left=True),
    TerminalColumn("frames/s", 8),
    TerminalColumn("lost", 6),
    TerminalColumn("unread", 6),
    TerminalColumn("load", 5),
    TerminalColumn("drift/ppm", 9),
    TerminalColumn("jitter/ms", 9),
    TerminalColumn("frames", 11, spare=1),
    TerminalColumn("bus errors", 10, spare=1),
    TerminalColumn("reconnects", 10, spare=1),
)
TOPIC_COLUMNS = (
    TerminalColumn("topic", 16, left=True),
    TerminalColumn("msgs/s", 8),
    TerminalColumn("age/s", 6),
    TerminalColumn("gaps", 5),
    TerminalColumn("missing", 7),
    TerminalColumn("jitter", 6),
    TerminalColumn("lost", 6),
    TerminalColumn("messages", 10, spare=1),
    TerminalColumn("joints", 20, left=True, spare=1),
)

LINE_EVERY_S = 10.0
"""Interval of the lines without a terminal [s]."""

PATIENCE_S = 1.0
"""Longest wait for the drawing thread at the end of a recording [s]."""

_PRINTED = ("warn", "error", "fatal")


def screen(snapshot: RecorderSnapshot, width: int = 80, height: int | None = None) -> Text:
    """Draw a recording.

    Args:
        width: Most characters in a line.
        height: Most lines; topics that don't fit are counted. None for no limit.
    """
    head = [*_headline(snapshot, width), *_verdict(snapshot, width)]
    cells = [_source_cells(source) for source in snapshot.sources]
    sources, _ = table(SOURCE_COLUMNS, cells, width, cropped=True)
    events = [_event(event, snapshot, width) for event in snapshot.events[-_EVENTS:]]
    if events:
        events = [Text(), Text("latest events", style="bold"), *events]
    rows = [_topic_cells(row) for row in _rows(snapshot.topics)]
    room = len(rows)
    if height is not None:
        used = len(head) + 1 + len(sources) + 2 + len(events) + 1
        room = max(height - used, 0)
    hidden = 0
    if len(rows) > room:
        hidden = len(rows) - max(room - 1, 0)
        rows = rows[: max(room - 1, 0)]
    topics = table(TOPIC_COLUMNS, rows, width, cropped=True)[0] if rows else []
    if hidden:
        topics.append(Text(f"and {hidden} more", style=_MUTED))
    lines = [*head, Text(), *sources, *([Text(), *topics] if topics else []), *events]
    return Text("\n").join(lines)


def plain_line(snapshot: RecorderSnapshot) -> str:
    """Return time, verdict, size, sources and heaviest reason in one line."""
    parts = [
        f"{clock_time(snapshot.elapsed_s)} {snapshot.verdict}{_waiting(snapshot)}",
        f"{snapshot.messages:,} messages, {format_size(snapshot.size)}",
    ]
    for source in snapshot.sources:
        _, state = source_state(source)
        rate = f", {source.rate_hz:.0f} frames/s" if source.rate_hz is not None else ""
        parts.append(f"{source.name} {state}{rate}")
    if snapshot.free is not None:
        parts.append(_room(snapshot))
    if snapshot.reasons:
        more = len(snapshot.reasons) - 1
        parts.append(snapshot.reasons[0] + (f" (and {more} more)" if more else ""))
    return plain("; ".join(parts))


def _waiting(snapshot: RecorderSnapshot) -> str:
    return f", {snapshot.state}" if snapshot.state == WAITS_FOR_COMMANDS else ""


def event_line(event: EventLine) -> str:
    """Return an event in one line."""
    return plain(f"{event.level}: {event.name}: {event.text}")


def clock_time(time_s: float) -> str:
    """Format a duration [s] as ``1:02:03``."""
    minutes, seconds = divmod(int(time_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"


def time_left(time_s: float) -> str:
    """Format a duration [s] in its one or two largest units, e.g. ``3 h 20 min``."""
    minutes = int(time_s // 60)
    if minutes < 1:
        return f"{int(time_s)} s"
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 10:
        return f"{hours} h {minutes} min"
    return f"{hours} h" if hours < 48 else f"{hours // 24} d"


# -- the parts ---------------------------------------------------------------------------------


def _headline(snapshot: RecorderSnapshot, width: int) -> list[Text]:
    what = f"{snapshot.state} {_shorter(snapshot.path, width - 21 - len(snapshot.state))}"
    robot = f"  {snapshot.robot}" if snapshot.robot else ""
    time = clock_time(snapshot.elapsed_s)
    first = Text()
    first.append(fit(what + robot, width - len(time) - 1), "bold")
    first.append(" " + time, "bold")
    facts = [format_size(snapshot.size)]
    if snapshot.byte_rate is not None:
        facts[0] += f" (+{format_size(int(snapshot.byte_rate))}/s)"
    if snapshot.part is not None:
        facts.append(f"part {snapshot.part}")
    facts.append(f"{snapshot.messages:,} messages")
    if snapshot.free is not None:
        facts.append(_room(snapshot))
    return [first, Text(cut(" | ".join(facts), width))]


def _room(snapshot: RecorderSnapshot) -> str:
    left_s = snapshot.time_left_s
    room = f"{format_size(snapshot.free or 0)} free"
    return room if left_s is None else f"{room}, full in {time_left(left_s)}"


def _verdict(snapshot: RecorderSnapshot, width: int) -> list[Text]:
    line = Text()
    line.append(f" {snapshot.verdict.upper()} ", STYLES[snapshot.verdict])
    count = len(snapshot.reasons)
    why = "nothing found so far" if not count else f"so far, {count} reason{'s' * (count != 1)}"
    why += _waiting(snapshot)
    late = ""
    if snapshot.tick_p99_s is not None:
        late = f" | tick p99 {snapshot.tick_p99_s * 1e3:.1f} ms"
    if snapshot.backlog:
        late += f" | {snapshot.backlog} frames to decode"
    line.append(cut(f" {why}{late}", width - len(snapshot.verdict) - 2))
    lines = [line]
    for reason in snapshot.reasons[:_REASONS]:
        folded = wrap(cut(reason, 4 * width), width - 4, max_lines=2, placeholder=" …")
        parts = (cut(part, width - 4) for part in folded)  # wrap counts characters
        lines += [Text(("    " if k else "  ") + part) for k, part in enumerate(parts)]
    if count > _REASONS:
        lines.append(Text(f"  and {count - _REASONS} more", style=_MUTED))
    return lines


def _event(event: EventLine, snapshot: RecorderSnapshot, width: int) -> Text:
    ago_s = max(snapshot.now_ns - event.t_ns, 0) / NS
    at = clock_time(max(snapshot.elapsed_s - ago_s, 0.0))
    line = Text(f"{at} ")
    line.append(event.level, _LEVELS.get(event.level, ""))
    line.append(cut(f" {event.name}: {event.text}", width - len(at) - 1 - len(event.level)))
    return line


def _rows(topics: Sequence[TopicSnapshot]) -> list[TopicSnapshot]:
    """Combine many sensors of one kind into one row; leave out topics without a rhythm."""
    groups: dict[str, list[TopicSnapshot]] = {}
    for topic in topics:
        if not has_rhythm(topic.topic):
            continue
        group = group_of(topic.topic)
        name = topic.topic if group == "joints" else f"/{group}"
        groups.setdefault(name, []).append(topic)
    rows: list[TopicSnapshot] = []
    for name, members in groups.items():
        if len(members) <= _SHOWN_ALONE:
            rows += members
        else:
            rows.append(combined(f"{name}/ ({len(members)})", members))
    return rows


def _source_cells(source: SourceSnapshot) -> Cells:
    level, state = source_state(source)
    clock = source.clock
    drift = jitter = _DASH
    if clock is not None and clock.own_clock:
        jitter = f"{clock.jitter_s * 1e3:.2f}"
        drift = "..." if clock.drift_ppm is None else f"{clock.drift_ppm:+.1f}"
    style = {OK: "", ERROR: _LEVELS["error"]}.get(level, _LEVELS["warn"])
    return [
        (source.name, ""),
        (state.replace("connected, lost", "on, lost"), style),
        (_DASH if source.age_s is None else _rate(source.rate_hz), ""),
        _counted(source.dropped),
        _counted(source.malformed),
        (_DASH if source.load is None else f"{source.load[1]:.0%}", ""),
        (drift, ""),
        (jitter, ""),
        (_DASH if source.frames is None else f"{source.frames:,}", ""),
        _counted(source.error_frames),
        _counted(source.reconnects),
    ]


def _topic_cells(row: TopicSnapshot) -> Cells:
    conditions = {
        f"{len(row.frozen)} frozen": row.frozen,
        f"{len(row.at_limit)} at limits": row.at_limit,
        f"{row.nan} NaN": row.nan,
    }
    faults = ", ".join(text for text, holds in conditions.items() if holds)
    return [
        (row.topic, ""),
        (_rate(row.rate_hz), ""),
        (f"{row.age_s:.1f}", ""),
        _counted(row.gaps),
        _counted(row.missing),
        (_DASH if row.jitter is None else f"{row.jitter:.0%}", ""),
        _counted(row.dropped),
        (f"{row.count:,}", ""),
        (faults or _DASH, _LEVELS["warn"] if faults else ""),
    ]


def _rate(rate_hz: float | None) -> str:
    if rate_hz is None:
        return "..."
    return f"{rate_hz:.0f}" if rate_hz >= 99.95 else f"{rate_hz:.1f}"


def _counted(count: int | None) -> tuple[str, str]:
    """Format a count of faults, marked unless it is zero."""
    return (_DASH, _MUTED) if count is None else (str(count), _LEVELS["warn"] if count else "")


def _shorter(path: str, width: int) -> str:
    """Shorten a path to its end."""
    width = max(width, 8)
    if cell_len(path) <= width:
        return path
    ends = (path[k:] for k in range(max(1, len(path) - width), len(path) + 1))
    return "…" + next(end for end in ends if cell_len(end) < width)


class Terminal:
    """Displays a recording: a screen on a terminal, else a line every ten seconds."""

    def __init__(self, stream: TextIO, *, quiet: bool = False) -> None:
        """Display on a stream, e.g. ``sys.stderr``, from the first :meth:`show` on."""
        self._stream, self._quiet = stream, quiet
        self._latest: RecorderSnapshot | None = None
        self._wake = threading.Condition()
        self._closing = False
        self._thread: threading.Thread | None = None

    def show(self, snapshot: RecorderSnapshot) -> None:
        """Display a state, without waiting for a stuck terminal."""
        if self._quiet:
            return
        with self._wake:
            self._latest = snapshot
            self._wake.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
            self._thread.start()

    def close(self) -> bool:
        """End, and clear the screen of a terminal.

        Returns:
            Whether all was written; if not, nothing more should be, since that might block.
        """
        if self._thread is None:
            return True
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(PATIENCE_S)
        return not self._thread.is_alive()

    # -- the thread ------------------------------------------------------------------------

    def _run(self) -> None:
        # The terminal or the stream may be closed: the recording continues.
        with suppress(OSError, ValueError), self._own() as stream:
            if stream.isatty():
                self._draw(stream)
            else:
                self._print(stream)

    @contextmanager
    def _own(self) -> Generator[TextIO]:
        """Open a second stream to the same file.

        A stuck write holds the lock of its stream; with that of stderr the interpreter could not
        end.
        """
        try:
            number = os.dup(self._stream.fileno())
        except OSError:  # not a file: a test's text in memory
            yield self._stream
            return
        with os.fdopen(number, "w", encoding="utf-8", errors="replace") as stream:
            yield stream

    def _next(self) -> RecorderSnapshot | None:
        """Wait for a new state; None at the end."""
        with self._wake:
            self._wake.wait_for(lambda: self._latest is not None or self._closing)
            latest, self._latest = self._latest, None
            return latest

    def _draw(self, stream: TextIO) -> None:
        console = Console(file=stream)
        with Live(
            console=console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        ) as live:
            while (snapshot := self._next()) is not None:
                width, height = console.size
                live.update(screen(snapshot, width, height - 1), refresh=True)

    def _print(self, stream: TextIO) -> None:
        due_s = 0.0
        last: EventLine | None = None
        while (snapshot := self._next()) is not None:
            events = snapshot.events
            for event in events[events.index(last) + 1 :] if last in events else events:
                last = event
                if event.level in _PRINTED:
                    stream.write(event_line(event) + "\n")
            if snapshot.elapsed_s >= due_s:
                due_s = snapshot.elapsed_s + LINE_EVERY_S
                stream.write(plain_line(snapshot) + "\n")
            stream.flush()
