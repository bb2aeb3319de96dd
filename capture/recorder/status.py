"""A recording's state, its statuses on ``/diagnostics``, and its clock.

``undulog log check`` reads the counts of the sources from the statuses; the names of their keys are
those of :class:`.capture.log.health.bus_tally.SourceHealth`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..common.arrays import NS
from ..common.clock import REAL, Clock
from ..log.health.bus_tally import ELAPSED, RECORDER, SOURCE_PREFIX
from ..log.health.rules import GOOD_LOSS, VERDICTS, has_rhythm
from ..log.messages.definitions import ERROR, OK, STALE, WARN, DiagnosticStatus
from ..log.messages.frames import FRAME_TOPIC_PREFIXES
from .source_clock import ClockEstimate

_PER_DECADE = 40
_EDGES_NS = [round(1e3 * 10 ** (k / _PER_DECADE)) for k in range(7 * _PER_DECADE + 1)]

SLOW_TICK_S = 0.05
"""Ticks of 5 ms whose 99 % point is over this: the computer can't keep up."""

LOW_TIME_S = 600.0
"""Disk for less than this is a warning."""

NO_TIME_S = 60.0
"""Disk for less than this is an error."""

SILENT_S = 1.0
"""A source without a frame for longer is stale [s]; ``log check`` reports a silence."""

_REASONS = 8


class SessionClock:
    """Unix time at the start plus monotonic time since.

    The wall clock may be set during a recording (NTP, a user, a GPS fix); that changes no order and
    no duration in the session.
    """

    def __init__(self, clock: Clock = REAL) -> None:
        """Start now."""
        before = clock.monotonic_ns()
        self.epoch_ns = clock.wall_ns()
        self._zero = self.epoch_ns - (before + clock.monotonic_ns()) // 2
        self.clock = clock
        """What it reads."""

    def now_ns(self) -> int:
        """Return the time of the session [Unix ns], which never decreases."""
        return self._zero + self.clock.monotonic_ns()


class EachSecond:
    """Runs tasks once a second each by the clock, at most one a call."""

    def __init__(self, tasks: Sequence[Callable[[], object]], now_ns: int) -> None:
        """Spread the tasks over the first second after ``now_ns`` [ns, monotonic]."""
        self._tasks = tuple(tasks)
        step_ns = NS // (len(tasks) + 1)
        self._due_ns = [now_ns + (k + 1) * step_ns for k in range(len(tasks))]

    def run(self, now_ns: int) -> None:
        """Run the task that is due for longest, if any."""
        k = min(range(len(self._due_ns)), key=self._due_ns.__getitem__)
        if self._due_ns[k] > now_ns:
            return
        late = now_ns - self._due_ns[k] >= NS
        self._due_ns[k] = now_ns + NS if late else self._due_ns[k] + NS
        self._tasks[k]()


@dataclass(frozen=True)
class TickTimes:
    """Durations of ticks: median, 99 % point (to 6 %) and maximum [s]; 0 without ticks."""

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
        """Count one tick."""
        self._bins[bisect_right(_EDGES_NS, duration_ns)] += 1
        self._count += 1
        self._longest_ns = max(self._longest_ns, duration_ns)

    def result(self) -> TickTimes:
        """Return the durations of the ticks so far."""
        return TickTimes(self._count, self._point(0.5), self._point(0.99), self._longest_ns * 1e-9)

    def _point(self, part: float) -> float:
        """Return the upper edge of the bin of a quantile [s]."""
        rank, seen = part * self._count, 0
        for edge, number in zip((*_EDGES_NS, self._longest_ns), self._bins, strict=True):
            seen += number
            if number and seen >= rank:
                return min(edge, self._longest_ns) * 1e-9
        return 0.0


@dataclass(frozen=True)
class TopicSnapshot:
    """One topic.

    Attributes:
        rate_hz: Messages a second over the last seconds; None before there is a rate.
        age_s: Time since the last message [s].
        gaps: Gaps so far; None without a regular rhythm, as ``missing`` and ``jitter``.
        missing: Samples missing in them.
        jitter: Standard deviation of the intervals as a part of their median.
        dropped: Missing sequence numbers; None without sequence numbers.
        at_limit: Joints at their limits.
        frozen: Joints that stood while their commands moved.
        nan: Values that are not a number.
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
        address: Address on the command line.
        finished: Whether no more frames will come.
        frames: Frames so far; None for a source that writes its own topics.
        rate_hz: Frames a second over the last seconds; None before there is a rate.
        age_s: Time since the last frame [s]; None before the first.
        dropped: Frames lost before the recorder; None if unknown.
        malformed: Packets that could not be read.
        error_frames: Frames that report a bus error.
        reconnects: How often the connection came back.
        load: Part of the bitrate in the last second, without and with the most stuff bits; None
            where the bitrate is not known.
        clock: None before the first sample.
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
    """An event of ``/rosout``.

    Attributes:
        t_ns: Time [Unix ns].
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
        now_ns: The session's clock [Unix ns].
        elapsed_s: Time since the start [s].
        byte_rate: Bytes written a second, over the last 10 snapshots; None before there is a rate.
        free: Free bytes of the disk; None if unknown.
        part: Number of the part, from 1; None for a ring.
        verdict: ``good``, ``degraded`` or ``bad``, of the data so far.
        reasons: Reasons for a verdict that is not good, heaviest first.
        notes: Remarks that are no faults.
        sources: In the order of the command line.
        events: The latest ones, oldest first.
        tick_p99_s: 99 % point of the recorder's ticks [s].
        tick_max_s: The longest tick [s].
        backlog: Recorded frames that wait to be decoded.
        unsynced: Messages that power loss would cost.
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

    @property
    def time_left_s(self) -> float | None:
        """Time until the disk is full at this rate [s]; None if unknown."""
        if self.free is None or not self.byte_rate or self.byte_rate <= 0.0:
            return None
        return self.free / self.byte_rate


def statuses(snapshot: RecorderSnapshot) -> tuple[DiagnosticStatus, ...]:
    """Return the statuses of the recorder, the session, each source and each group of topics."""
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
    """Return the group of a topic: ``joints`` of ``/joint_states``, ``ir`` of ``/ir/07``."""
    if topic.startswith("/joint_"):
        return "joints"
    if topic.startswith(FRAME_TOPIC_PREFIXES):
        return topic.removeprefix("/")
    return topic.removeprefix("/").split("/")[0]


def combined(name: str, topics: Sequence[TopicSnapshot]) -> TopicSnapshot:
    """Combine topics into one: sums of the counts and rates, the worst of the other values."""

    def values(key: str) -> list[Any]:
        return [value for topic in topics if (value := getattr(topic, key)) is not None]

    def total(key: str) -> int | None:
        return sum(values(key)) if values(key) else None

    def joints(key: str) -> tuple[str, ...]:
        return tuple(sorted({joint for topic in topics for joint in getattr(topic, key)}))

    return TopicSnapshot(
        topic=name,
        count=sum(topic.count for topic in topics),
        rate_hz=math.fsum(values("rate_hz")) if values("rate_hz") else None,
        age_s=max(topic.age_s for topic in topics),
        gaps=total("gaps"),
        missing=total("missing"),
        jitter=max(values("jitter"), default=None),
        dropped=total("dropped"),
        at_limit=joints("at_limit"),
        frozen=joints("frozen"),
        nan=sum(topic.nan for topic in topics),
    )


def _recorder(snapshot: RecorderSnapshot) -> DiagnosticStatus:
    level, message = OK, snapshot.state
    left_s = snapshot.time_left_s
    if snapshot.tick_p99_s is not None and snapshot.tick_p99_s > SLOW_TICK_S:
        level, message = WARN, "the computer can't keep up with the recorder's ticks"
    if left_s is not None and left_s < LOW_TIME_S:
        level = ERROR if left_s < NO_TIME_S else WARN
        message = f"the disk is full in {left_s:.0f} s"
    values = {
        ELAPSED: f"{snapshot.elapsed_s:.3f}",
        "state": snapshot.state,
        "messages": snapshot.messages,
        "size_bytes": snapshot.size,
        "free_bytes": snapshot.free,
        "part": snapshot.part,
        "tick_p99_s": snapshot.tick_p99_s,
        "tick_max_s": snapshot.tick_max_s,
        "backlog_frames": snapshot.backlog,
        "unsynced_messages": snapshot.unsynced,
    }
    return _status(level, RECORDER, message, values)


def _session(snapshot: RecorderSnapshot) -> DiagnosticStatus:
    message = ": ".join((snapshot.verdict, *snapshot.reasons[:1]))
    values = {"verdict": snapshot.verdict, "reasons": len(snapshot.reasons)}
    values |= {f"reason.{k + 1}": text for k, text in enumerate(snapshot.reasons[:_REASONS])}
    return _status((OK, WARN, ERROR)[VERDICTS.index(snapshot.verdict)], "session", message, values)


def _source(source: SourceSnapshot) -> DiagnosticStatus:
    level, message = source_state(source)
    counts = ("frames", "rate_hz", "dropped", "malformed", "error_frames", "reconnects")
    values = {key: getattr(source, key) for key in counts}
    values["load"] = source.load[1] if source.load is not None else None
    if source.clock is not None:
        values |= {f"clock_{key}": value for key, value in source.clock.facts().items()}
    return _status(level, SOURCE_PREFIX + source.name, message, values, source.address)


def source_state(source: SourceSnapshot) -> tuple[int, str]:
    """Return the level of a source's state, as in diagnostics, and its description."""
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
    group = combined(name, topics)
    missing, dropped = group.missing or 0, group.dropped or 0
    conditions = {
        f"{missing} samples missing": missing > GOOD_LOSS * (group.count + missing),
        f"{dropped} messages dropped": dropped > 0,
        f"frozen: {', '.join(group.frozen)}": bool(group.frozen),
        f"at their limits: {', '.join(group.at_limit)}": bool(group.at_limit),
    }
    wrong = [text for text, holds in conditions.items() if holds]
    values = {
        "topics": len(topics),
        "messages": group.count,
        "rate_hz": group.rate_hz or 0.0,
        "oldest_s": group.age_s,
        "gaps": group.gaps or 0,
        "missing": missing,
        "dropped": dropped,
        "jitter": group.jitter,
        "nan": group.nan,
    }
    return _status(WARN if wrong else OK, f"topics {name}", "; ".join(wrong) or "ok", values)


def _status(
    level: int,
    name: str,
    message: str,
    values: Mapping[str, float | str | None],
    hardware: str = "",
) -> DiagnosticStatus:
    texts = {
        key: f"{value:.6g}" if isinstance(value, float) else str(value)
        for key, value in values.items()
        if value not in (None, "")
    }
    return DiagnosticStatus(level, name, message, hardware, texts)
