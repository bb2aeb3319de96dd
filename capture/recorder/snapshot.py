"""A running recording at one moment: what the terminal, ``/diagnostics`` and a status show."""

from __future__ import annotations

from dataclasses import dataclass

from .source_clock import ClockEstimate


@dataclass(frozen=True)
class TopicSnapshot:
    """One topic.

    Attributes:
        topic: Its name.
        count: Messages so far.
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
        connected: Whether data can come.
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
        name: Who says it.
        text: One sentence.
    """

    t_ns: int
    level: str
    name: str
    text: str


@dataclass(frozen=True)
class RecorderSnapshot:
    """The recording.

    Attributes:
        session_id: Its id.
        path: The file, or the part that is being written.
        robot: Name of the robot, or None.
        state: What the recorder does: ``recording``, ``waiting`` (a ring that waits for its
            trigger), ``stopping``.
        now_ns: The session's clock [Unix ns].
        elapsed_s: Time since the start [s].
        messages: Messages accepted.
        size: Bytes written.
        byte_rate: Bytes written a second, over the last while; None before there is a rate.
        free: Free bytes where the file is; None where that can't be said.
        part: Number of the part, from 1; None where the session is not split.
        verdict: ``good``, ``degraded`` or ``bad``, of what came so far.
        reasons: Why it is not better, heaviest first.
        notes: What is worth knowing and no fault.
        sources: In the order of the command line.
        topics: By name.
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
