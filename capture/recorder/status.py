"""A recording's state as the statuses of ``/diagnostics``, one message a second.

``undulog log check`` reads the counts of the sources again from there; the names of their keys are
those of :class:`.capture.log.health.sources.SourceHealth`.

Time in the recorder: its clock, the duration of its ticks, tasks once a second.

The clock of a recording: Unix time at its start, and monotonic time from there on.

The wall clock may be set while a robot is being recorded (NTP, a user, a GPS fix); nothing of that
may change an order or a duration in the session.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ..log.health.rules import GOOD_LOSS, VERDICTS, has_rhythm
from ..log.health.sources import ELAPSED, RECORDER, SOURCE_PREFIX
from ..log.messages.definitions import ERROR, OK, STALE, WARN, DiagnosticStatus
from ..log.messages.frames import FRAME_TOPIC_PREFIXES
from .source_clock import ClockEstimate


class SessionClock:
    """Unix time at the start plus monotonic time since."""

    def __init__(self) -> None:
        """Start now."""
        before = time.monotonic_ns()
        self.epoch_ns = time.time_ns()
        self._zero = self.epoch_ns - (before + time.monotonic_ns()) // 2

    def now_ns(self) -> int:
        """The present time of the session [Unix ns]; never goes back."""
        return self._zero + time.monotonic_ns()


_NS = 1_000_000_000


class EachSecond:
    """Runs tasks once a second each, at most one a call.

    By the clock, not by counting calls: under load these come more often, or less.
    """

    def __init__(self, tasks: Sequence[Callable[[], object]], now_ns: int) -> None:
        """Begin in a second from now, in the order given.

        Args:
            now_ns: A monotonic clock [ns].
        """
        self._tasks = tuple(tasks)
        step_ns = _NS // (len(tasks) + 1)
        self._due_ns = [now_ns + (k + 1) * step_ns for k in range(len(tasks))]

    def run(self, now_ns: int) -> None:
        """Run the task that has waited for longest, if one is due.

        Args:
            now_ns: The same clock [ns].
        """
        if not self._tasks:
            return
        k = min(range(len(self._due_ns)), key=self._due_ns.__getitem__)
        if self._due_ns[k] > now_ns:
            return
        late = now_ns - self._due_ns[k] >= _NS
        self._due_ns[k] = now_ns + _NS if late else self._due_ns[k] + _NS
        self._tasks[k]()


_PER_DECADE = 40
_EDGES_NS = [round(1e3 * 10 ** (k / _PER_DECADE)) for k in range(7 * _PER_DECADE + 1)]


@dataclass(frozen=True)
class TickTimes:
    """Durations of ticks.

    Attributes:
        p50_s: Median [s], 0 without ticks.
        p99_s: 99 % point [s], to 6 %.
        max_s: Longest [s].
    """

    count: int
    p50_s: float
    p99_s: float
    max_s: float


class TickTally:
    """Counts durations in bins of equal ratio, 40 a decade from 1 us to 10 s."""

    def __init__(self) -> None:
        """Start empty."""
        self._bins = [0] * (len(_EDGES_NS) + 1)
        self._count = self._longest_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one tick.

        Args:
            duration_ns: How long it took [ns].
        """
        self._bins[bisect_right(_EDGES_NS, duration_ns)] += 1
        self._count += 1
        self._longest_ns = max(self._longest_ns, duration_ns)

    def result(self) -> TickTimes:
        """What the ticks so far took."""
        return TickTimes(self._count, self._point(0.5), self._point(0.99), self._longest_ns * 1e-9)

    def _point(self, part: float) -> float:
        """Upper edge of the bin that the quantile falls into [s]."""
        wanted, seen = part * self._count, 0
        for edge, number in zip((*_EDGES_NS, self._longest_ns), self._bins, strict=True):
            seen += number
            if number and seen >= wanted:
                return min(edge, self._longest_ns) * 1e-9
        return 0.0


@dataclass(frozen=True)
class TopicSnapshot:
    """One topic.

    Attributes:
        rate_hz: Messages a second over the last seconds; None before there is a rate.
        age_s: Time since the last message [s].
        gaps: Gaps in the rhythm so far; None where there is no steady rhythm.
        missing: Samples missing in them; None the same.
        jitter: Standard deviation of the intervals as a part of their median; None the same.
        dropped: Messages dropped, as sequence numbers prove; None where they prove nothing.
        at_limit: Joints that are held at their limits.
        frozen: Joints that stood while their commands moved.
        nan: Numbers that are not a number.
    """

    topic: str
    count: int
    rate_hz: float | None
    age_s: float
    gaps: int | None = None
    missing: int | None = None
    jitter: float | None = None
    dropped: int | None = None
    at_limit: tuple[str, ...] = ()
    frozen: tuple[str, ...] = ()
    nan: int = 0


@dataclass(frozen=True)
class SourceSnapshot:
    """One source.

    Attributes:
        name: What the session calls it.
        address: As the command line named it.
        finished: Whether nothing will come any more.
        frames: Frames so far; None for a source that writes topics of its own.
        rate_hz: Frames a second over the last seconds; None before there is a rate.
        age_s: Time since the last frame [s]; None before the first.
        dropped: Frames lost before the recorder; None where the source can't tell.
        malformed: Packets that could not be read.
        error_frames: Frames that report a bus error.
        reconnects: How often the connection came back.
        load: Part of the bitrate in the last second, without and with the most stuff bits; None
            where the bitrate is not known.
        clock: What is known of its clock; None before the first sample.
    """

    name: str
    address: str
    connected: bool
    finished: bool = False
    frames: int | None = 0
    rate_hz: float | None = None
    age_s: float | None = None
    dropped: int | None = None
    malformed: int = 0
    error_frames: int = 0
    reconnects: int = 0
    load: tuple[float, float] | None = None
    clock: ClockEstimate | None = None


@dataclass(frozen=True)
class EventLine:
    """An event, as it stands in ``/rosout``.

    Attributes:
        t_ns: When [Unix ns].
        level: ``debug``, ``info``, ``warn``, ``error`` or ``fatal``.
    """

    t_ns: int
    level: str
    name: str
    text: str


@dataclass(frozen=True)
class RecorderSnapshot:
    """The recording.

    Attributes:
        path: The file, or the part that is being written.
        robot: Name of the robot, or None.
        state: What the recorder does: ``recording``, ``waiting`` (a ring that waits for its
            trigger), ``stopping``.
        now_ns: The session's clock [Unix ns].
        elapsed_s: Time since the start [s].
        byte_rate: Bytes written a second, over the last while; None before there is a rate.
        free: Free bytes where the file is; None where that can't be said.
        part: Number of the part, from 1; None where the session is not split.
        verdict: ``good``, ``degraded`` or ``bad``, of what came so far.
        reasons: Why it is not better, heaviest first.
        notes: What is worth knowing and no fault.
        sources: In the order of the command line.
        events: The latest ones, oldest first.
        tick_p99_s: 99 % point of the recorder's ticks [s].
        tick_max_s: The longest tick [s].
        backlog: Frames that are safe and wait to be decoded.
        unsynced: Messages that power loss would cost.
        trouble: What the recorder itself can't do, one sentence, or None.
    """

    session_id: str
    path: str
    robot: str | None
    state: str
    now_ns: int
    elapsed_s: float
    messages: int
    size: int
    byte_rate: float | None
    free: int | None
    part: int | None
    verdict: str
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    sources: tuple[SourceSnapshot, ...]
    topics: tuple[TopicSnapshot, ...]
    events: tuple[EventLine, ...] = ()
    tick_p99_s: float | None = None
    tick_max_s: float | None = None
    backlog: int = 0
    unsynced: int = 0
    trouble: str | None = None

    @property
    def time_left_s(self) -> float | None:
        """How long the disk lasts at this rate [s]; None where that can't be said."""
        if self.free is None or not self.byte_rate or self.byte_rate <= 0.0:
            return None
        return self.free / self.byte_rate


SLOW_TICK_S = 0.05
"""Ticks of 5 ms whose 99 % point is over this: the computer can't keep up."""

LOW_TIME_S = 600.0
"""Disk for less than this is a warning."""

NO_TIME_S = 60.0
"""Disk for less than this is an error."""

SILENT_S = 1.0
"""A source without a frame for longer has gone stale; ``log check`` calls it a silence."""

_REASONS = 8


def statuses(snapshot: RecorderSnapshot) -> tuple[DiagnosticStatus, ...]:
    """The statuses of one moment.

    Returns:
        The recorder, the session, each source, each group of topics.
    """
    groups: dict[str, list[TopicSnapshot]] = {}
    for topic in snapshot.topics:
        if has_rhythm(topic.topic):
            groups.setdefault(group_of(topic.topic), []).append(topic)
    return (
        _recorder(snapshot),
        _session(snapshot),
        *(_source(source) for source in snapshot.sources),
        *(_group(name, topics) for name, topics in sorted(groups.items())),
    )


def group_of(topic: str) -> str:
    """Topics that are shown as one: all of the joints, all infrared sensors, each bus.

    Args:
        topic: E.g. ``/joint_states`` or ``/ir/07``.

    Returns:
        E.g. ``joints`` or ``ir``.
    """
    if topic.startswith("/joint_"):
        return "joints"
    if topic.startswith(FRAME_TOPIC_PREFIXES):
        return topic.removeprefix("/")
    return topic.removeprefix("/").split("/")[0]


def _recorder(snapshot: RecorderSnapshot) -> DiagnosticStatus:
    level, message = OK, snapshot.state
    left_s = snapshot.time_left_s
    if snapshot.tick_p99_s is not None and snapshot.tick_p99_s > SLOW_TICK_S:
        level, message = WARN, "the computer can't keep up with the recorder's ticks"
    if left_s is not None and left_s < LOW_TIME_S:
        level = ERROR if left_s < NO_TIME_S else WARN
        message = f"the disk is full in {left_s:.0f} s"
    if snapshot.trouble is not None:
        level, message = ERROR, snapshot.trouble
    values = {
        ELAPSED: f"{snapshot.elapsed_s:.3f}",
        "state": snapshot.state,
        "messages": str(snapshot.messages),
        "size_bytes": str(snapshot.size),
        "free_bytes": _number(snapshot.free),
        "part": _number(snapshot.part),
        "tick_p99_s": _number(snapshot.tick_p99_s),
        "tick_max_s": _number(snapshot.tick_max_s),
        "backlog_frames": str(snapshot.backlog),
        "unsynced_messages": str(snapshot.unsynced),
    }
    return _status(level, RECORDER, message, "", values)


def _session(snapshot: RecorderSnapshot) -> DiagnosticStatus:
    message = snapshot.verdict
    if snapshot.reasons:
        message = f"{snapshot.verdict}: {snapshot.reasons[0]}"
    values = {"verdict": snapshot.verdict, "reasons": str(len(snapshot.reasons))}
    values |= {f"reason.{k + 1}": text for k, text in enumerate(snapshot.reasons[:_REASONS])}
    level = (OK, WARN, ERROR)[VERDICTS.index(snapshot.verdict)]
    return _status(level, "session", message, "", values)


def _source(source: SourceSnapshot) -> DiagnosticStatus:
    level, message = source_state(source)
    values = {
        "frames": _number(source.frames),
        "rate_hz": _number(source.rate_hz),
        "dropped": _number(source.dropped),
        "malformed": str(source.malformed),
        "error_frames": str(source.error_frames),
        "reconnects": str(source.reconnects),
        "load": _number(source.load[1] if source.load is not None else None),
    }
    if source.clock is not None:
        values |= {f"clock_{key}": value for key, value in source.clock.facts().items()}
    return _status(level, SOURCE_PREFIX + source.name, message, source.address, values)


def source_state(source: SourceSnapshot) -> tuple[int, str]:
    """What a source's state is called.

    Returns:
        Level of :mod:`.capture.log.messages.definitions` and a few words.
    """
    if source.finished:
        return OK, "ended"
    if not source.connected:
        return ERROR, "not connected"
    if source.age_s is not None and source.age_s > SILENT_S:
        return STALE, f"silent for {source.age_s:.0f} s"
    if source.dropped:
        return WARN, f"connected, lost {source.dropped}"
    return OK, "connected"


def _group(name: str, topics: Sequence[TopicSnapshot]) -> DiagnosticStatus:
    missing = sum(topic.missing or 0 for topic in topics)
    dropped = sum(topic.dropped or 0 for topic in topics)
    count = sum(topic.count for topic in topics)
    jitters = [topic.jitter for topic in topics if topic.jitter is not None]
    at_limit = sorted({joint for topic in topics for joint in topic.at_limit})
    frozen = sorted({joint for topic in topics for joint in topic.frozen})
    said = {
        f"{missing} samples missing": missing > GOOD_LOSS * (count + missing),
        f"{dropped} messages dropped": dropped > 0,
        f"frozen: {', '.join(frozen)}": bool(frozen),
        f"at their limits: {', '.join(at_limit)}": bool(at_limit),
    }
    wrong = [text for text, holds in said.items() if holds]
    values = {
        "topics": str(len(topics)),
        "messages": str(count),
        "rate_hz": _number(math.fsum(topic.rate_hz or 0.0 for topic in topics)),
        "oldest_s": _number(max(topic.age_s for topic in topics)),
        "gaps": str(sum(topic.gaps or 0 for topic in topics)),
        "missing": str(missing),
        "dropped": str(dropped),
        "jitter": _number(max(jitters, default=None)),
        "nan": str(sum(topic.nan for topic in topics)),
    }
    return _status(WARN if wrong else OK, f"topics {name}", "; ".join(wrong) or "ok", "", values)


def _status(
    level: int, name: str, message: str, hardware: str, values: dict[str, str]
) -> DiagnosticStatus:
    known = {key: value for key, value in values.items() if value}
    return DiagnosticStatus(level, name, message, hardware, known)


def _number(value: float | None) -> str:
    """A number as text, empty where it isn't known."""
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.6g}"
