"""The recorder's loop: one thread, a tick every 20 ms, and nothing in it that waits.

Each tick takes the new frames of every source and writes them raw; decoding follows in slices.
Tasks of once a second are spread over the second's ticks, so that no tick is long.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from ..common.errors import LogWriteError, SourceError, UndulogError
from ..common.process import Priority, StopRequest, raised_priority
from ..log.messages.frames import FD_FRAME_DTYPE, FRAME_DTYPE, FrameArray
from ..log.write.channels import TimeReferenceChannel
from ..log.write.writer import SessionWriter
from ..robot.model import Robot
from ..sources.contract import EndingSource, Polled, Source, SourceContext
from ..sources.serial_port import SerialSource
from .bus_recorder import BusRecorder
from .links import SourceLink, links_of
from .pauses import Pause, PauseWatch
from .source_clock import SourceClock
from .status import EachSecond, SessionClock, TickTally

TICK_NS = 20_000_000
"""Interval of polling the sources and writing their raw frames [ns]."""

DECODE_TICKS = 10
"""Ticks between two rounds of decoding; a backlog is decoded in the next tick."""

WATCHED_TICKS = 2
"""The same with a live view."""

_PRESSED = 1000
"""After so many frames in a tick the next tick follows at once, and decoding waits: the kernel's
buffers hold only milliseconds of a burst."""

_PAUSE_NS = 1_000_000
_CATCH_UP_NS = 5_000_000_000
"""Time to receive what waits at the end, without the pauses of the process: a connection of
1 MB/s brings the 4 MB of a server's buffer."""

_CALM = 3
"""So many ticks without a burst: nothing waits any more. TCP may delay an acknowledgement, and so
what waits at the far end, by 40 ms (``TCP_DELACK_MIN`` of Linux)."""

_DRAIN_NS = 500_000_000
"""Time for frames from before the end to arrive, without the pauses of the process."""

_STEP_NS = 20_000_000
"""A longer step at the end was a pause of the process, in which nothing could arrive."""

_MOST_WAITING = 2_000_000
"""With more frames to decode (64 MB), decoding no longer waits for the end of a burst."""

_DECODE_BUDGET_NS = 4_000_000
_NS = 1_000_000_000
_LONGEST_NS = 2**31 * _NS  # what a TimeReference can hold


@dataclass(frozen=True)
class Ending:
    """Why a recording ended.

    Attributes:
        failed: Whether it had to end, or lacks what it was started for.
        requested: Whether a client of the control socket ended it.
    """

    reason: str
    failed: bool = False
    requested: bool = False


class Recorder:
    """Records sources into a session until something ends it.

    Attributes:
        ticks: Durations of the ticks.
        overruns: Number of ticks left out after one that took too long.
        ending: Set by a task to end the recording.
        watched: Whether a live view is connected.
        links: Connection of each source, by its name.
        priority: Priority of the recorder's threads.
    """

    def __init__(
        self,
        *,
        writer: SessionWriter,
        clock: SessionClock,
        sources: Sequence[Source],
        context: SourceContext,
        robot: Robot | None,
        decoded: str | None,
        each_tick: Sequence[Callable[[], None]] = (),
        each_second: Sequence[Callable[[], object]] = (),
    ) -> None:
        """Set up a recording; nothing is opened yet.

        Args:
            writer: The session; the recorder doesn't close it.
            clock: Of the session, and of the ticks.
            decoded: The source that is the robot's bus; None to decode no frames.
            each_tick: Called at the end of every tick.
            each_second: Called once a second, in different ticks.
        """
        self.ticks = TickTally()
        self.overruns = 0
        self.ending: Ending | None = None
        self.watched = False
        self.priority = Priority("not asked for")
        self.clocks: dict[str, SourceClock] = {source.name: SourceClock() for source in sources}
        self.buses: dict[str, BusRecorder] = {}
        self.links: dict[str, SourceLink] = links_of(sources)
        self._writer, self._clock, self._context = writer, clock, context
        self._time = clock.clock
        self._sources = tuple(sources)
        self._robot, self._decoded = robot, decoded
        self._each_tick = tuple(each_tick)
        tasks = (self._write_clocks, self._log_unknown_frames, lambda: gc.collect(1), *each_second)
        self._each_second = EachSecond(tasks, self._time.monotonic_ns())
        self._events = writer.log("/rosout")
        self._clock_channels: dict[str, TimeReferenceChannel] = {}
        self._received = 0  # frames in the last poll
        self._failed: set[str] = set()
        self._end_ns: int | None = None  # when the recording ended [Unix ns]
        self._later: set[str] = set()  # sources of which frames came after it
        self._odd_clocks: set[str] = set()
        self._reported_ids: dict[str, set[str]] = {source.name: set() for source in self._sources}
        self._on_event: Callable[[int, str, str, str], None] | None = None
        self._pauses: PauseWatch | None = None

    def on_event(self, listener: Callable[[int, str, str, str], None]) -> None:
        """Set a listener, called after each event: time [Unix ns], level, name, text."""
        self._on_event = listener

    def log_event(self, level: str, name: str, text: str, t_ns: int | None = None) -> None:
        """Write an event to ``/rosout``.

        Args:
            level: ``info``, ``warn`` or ``error``.
            t_ns: Time of the event [Unix ns]; now by default.
        """
        now_ns = self._clock.now_ns()
        at_ns = now_ns if t_ns is None else t_ns
        self._events.write(at_ns, level, name, text, log_time_ns=now_ns)
        if self._on_event is not None:
            self._on_event(at_ns, level, name, text)

    @property
    def backlog(self) -> int:
        """Number of recorded frames that wait to be decoded."""
        return sum(bus.backlog for bus in self.buses.values())

    def run(self, stop: StopRequest, duration_s: float | None = None) -> Ending:
        """Record until something ends it.

        Args:
            duration_s: Time after which it ends [s]; None for no limit.

        Returns:
            Why it ended. The session is whole then, but not closed.

        Raises:
            SourceError: If a source can never work, or fails to start.
            LogWriteError: If the session can't be written; the sources are stopped then.
        """
        try:
            with (
                _manual_collection()
            ):  # first: it takes long, and the buffers of sources that listen fill
                self._start()
                self._pauses = PauseWatch(self._time.monotonic_ns(), lambda: stop.continued)
                with self._urgent():
                    self._loop(stop, duration_s, self._pauses)
                    self._catch_up(self._pauses)
                    self._drain(self._pauses)
            self._finish()
        finally:
            for source in self._sources:
                self._stop_source(source)
        assert self.ending is not None  # noqa: S101 - the loop ends with one
        return self.ending

    # -- inside ----------------------------------------------------------------------------

    def _start(self) -> None:
        # Last those that listen: connecting may take half a second, and senders don't wait.
        for source in sorted(self._sources, key=lambda source: isinstance(source, EndingSource)):
            try:
                source.start(self._context)
            except UndulogError:
                raise
            except Exception as error:
                fault = f"its kind of source failed to start: {error!r}"
                raise SourceError(source.name, fault) from error
        listed = ", ".join(source.name for source in self._sources)
        self.log_event("info", "recorder", f"recording {listed}")

    @contextmanager
    def _urgent(self) -> Generator[None]:
        """Raise the priority; not beside a twin, whose physics would get it, too."""
        if any(source.robot is not None for source in self._sources):
            yield
            return
        with raised_priority() as self.priority:
            if self.priority.refused:
                self.log_event(
                    "info",
                    "recorder",
                    "priority was refused: while other programs hold the processors, frames may be "
                    "refused or stamped late; CAP_SYS_NICE allows it, and so does a service "
                    "('undulog record unit')",
                )
            yield

    def _loop(self, stop: StopRequest, duration_s: float | None, pauses: PauseWatch) -> None:
        begun_ns = due_ns = self._time.monotonic_ns()
        end_ns = None if duration_s is None else begun_ns + round(duration_s * _NS)
        tick = planned_ns = 0
        while self.ending is None:
            now_ns = self._time.monotonic_ns()
            pauses.look(now_ns, planned_ns)
            self._tick(tick, now_ns)
            if stop.signal is not None:
                self.ending = Ending(f"{stop.signal.name} was received")
            elif end_ns is not None and now_ns >= end_ns:
                self.ending = Ending(f"{duration_s:g} s are over")
            elif all(source.finished or source.name in self._failed for source in self._sources):
                self.ending = Ending("all sources have ended", failed=bool(self._failed))
            after_ns = self._time.monotonic_ns()
            self.ticks.add(after_ns - now_ns)
            pauses.look(after_ns)
            self._report_pauses(pauses)
            tick += 1
            due_ns = after_ns + _PAUSE_NS if self._received >= _PRESSED else due_ns + TICK_NS
            planned_ns = max(0, due_ns - after_ns)
            if planned_ns:
                self._time.sleep(planned_ns / _NS)
            elif after_ns > due_ns + _NS:  # stopped for a while: left-out ticks are not repeated
                self.overruns += (after_ns - due_ns) // TICK_NS
                due_ns = after_ns

    def _tick(self, tick: int, now_ns: int) -> None:
        self._take()
        waits = self.backlog
        pressed = self._received >= _PRESSED and waits < _MOST_WAITING
        every = WATCHED_TICKS if self.watched else DECODE_TICKS
        due = tick % every == 1
        if not pressed and (due or any(bus.behind for bus in self.buses.values())):
            until_ns = self._clock.now_ns() + _DECODE_BUDGET_NS
            for name, bus in self.buses.items():
                bus.decode(self._clock.now_ns, until_ns, rest=due)
                self._log_clock_events(name)
        self._each_second.run(now_ns)
        for work in self._each_tick:
            work()

    def _catch_up(self, pauses: PauseWatch) -> None:
        """Receive what was sent over connections before: the end comes after it.

        A connection holds more than this computer's buffer: the rest waits at the far end, and
        arrives as that is emptied. Senders to an :class:`EndingSource` are refused instead.
        """
        if all(isinstance(source, EndingSource) or source.robot for source in self._sources):
            return
        before_ns = self._time.monotonic_ns()
        left_ns, calm = _CATCH_UP_NS, 0
        while calm < _CALM and left_ns > 0:
            self._time.sleep(TICK_NS / _NS)
            self._take()
            now_ns = self._time.monotonic_ns()
            pauses.look(now_ns, TICK_NS)
            left_ns -= min(now_ns - before_ns, 2 * TICK_NS)
            before_ns = now_ns
            calm = 0 if self._received >= _PRESSED else calm + 1

    def _take(self) -> None:
        """Write the new frames of all sources."""
        self._poll()
        for bus in self.buses.values():
            bus.write_raw(self._clock.now_ns)

    def _report_pauses(self, pauses: PauseWatch, *, ends: bool = False) -> None:
        dropped = {source.name: source.counts.dropped for source in self._sources}
        for text in pauses.report(dropped, ends=ends):
            self.log_event("warn", "recorder", text)

    @property
    def pauses(self) -> Sequence[Pause]:
        """Times in which the process did not run."""
        return () if self._pauses is None else tuple(self._pauses.pauses)

    def _drain(self, pauses: PauseWatch) -> None:
        """End at this instant: frames before it are kept, later ones are left out.

        An :class:`EndingSource` refuses frames from now on. Of another source a later frame proves
        that all earlier ones were received; so does half a second, as no frame takes so long.
        """
        self._end_ns = self._clock.now_ns()
        for source in self._sources:
            if source.name not in self._failed:
                self._end_source(source)
        left_ns, before_ns, before = _DRAIN_NS, self._time.monotonic_ns(), self._from_ended()
        while True:
            self._take()
            now_ns = self._time.monotonic_ns()
            pauses.look(now_ns)
            count = self._from_ended()
            if count > before:  # the kernel's buffers limit what still comes
                left_ns, before = _DRAIN_NS, count
            left_ns -= min(now_ns - before_ns, _STEP_NS)
            before_ns = now_ns
            if left_ns <= 0 or not any(self._has_more(source) for source in self._sources):
                break
            self._time.sleep(_PAUSE_NS / _NS)
        self._report_pauses(pauses, ends=True)

    def _from_ended(self) -> int:
        """Return the number of frames so far of the sources that take no new ones."""
        return sum(s.counts.frames for s in self._sources if isinstance(s, EndingSource))

    def _has_more(self, source: Source) -> bool:
        """Whether frames from before the end may still come."""
        if source.finished or source.name in self._failed or source.robot is not None:
            return False
        return isinstance(source, EndingSource) or (
            source.connected and source.name not in self._later
        )

    def _poll(self) -> None:
        self._received = 0
        for source in self._sources:
            polled = self._asked(source)
            arrays = (*polled.frames, *polled.fd_frames)
            if self._end_ns is not None and not isinstance(source, EndingSource):
                kept = [self._before(self._end_ns, source, frames) for frames in arrays]
                arrays = tuple(frames for frames in kept if len(frames))
            self._received += sum(map(len, arrays))
            for event in polled.events:
                self.log_event(event.level, source.name, event.text, event.t_ns)
            for frames in arrays:
                bus = self.buses.get(source.name)
                if bus is None:
                    bus = self.buses[source.name] = self._open_bus(source)
                bus.add(frames)

    def _before(self, end_ns: int, source: Source, frames: FrameArray) -> FrameArray:
        """Return a source's frames before the end; a twin's have a time of their own."""
        before = frames["t_host_ns"] <= np.uint64(end_ns)
        if source.robot is not None or before.all():
            return frames
        self._later.add(source.name)
        return frames[before]

    @property
    def given_up(self) -> list[str]:
        """Names of the sources that failed unexpectedly."""
        return sorted(self._failed)

    def _asked(self, source: Source) -> Polled:
        """Poll a source; one that fails unexpectedly doesn't end the others."""
        if source.name in self._failed:
            return Polled()
        try:
            polled = source.poll()
            _check(polled)
            self.links[source.name].note(source, polled)
        except LogWriteError:
            raise
        except Exception as error:  # noqa: BLE001 - the other sources go on
            self._give_up(source, f"is given up: it failed with {error!r}")
            self._stop_source(source)
            return Polled()
        return polled

    def _give_up(self, source: Source, why: str) -> None:
        self._failed.add(source.name)
        self.log_event("error", source.name, f"this source {why}")

    def _end_source(self, source: Source) -> None:
        """End an :class:`EndingSource`; one that fails in that is given up."""
        try:
            if isinstance(source, EndingSource):
                source.end()
        except Exception as error:  # noqa: BLE001 - the other sources are drained
            self._give_up(source, f"can't be ended: {error!r}")

    def _stop_source(self, source: Source) -> None:
        """Release a source; one that fails in that doesn't keep the others open."""
        try:
            source.stop()
        except Exception as error:  # noqa: BLE001 - the other sources are released
            with suppress(LogWriteError):  # a full disk is reported by what ended the recording
                self._give_up(source, f"can't be released: {error!r}")

    def _open_bus(self, source: Source) -> BusRecorder:
        robot = self._robot if source.name == self._decoded else None
        return BusRecorder(
            source.name,
            self._writer,
            self.clocks[source.name],
            robot,
            directions=source.directions,
            serial=isinstance(source, SerialSource),
        )

    def _write_clocks(self) -> None:
        now_ns = self._clock.now_ns()
        for name, clock in self.clocks.items():
            pair = clock.pair()
            if pair is None:
                continue
            device_ns, host_ns = pair
            if name not in self._clock_channels:
                topic = f"/clock/{name}"
                self._clock_channels[name] = self._writer.time_reference(topic, source=name)
            if 0 <= device_ns < _LONGEST_NS:
                self._clock_channels[name].write(host_ns, device_ns, log_time_ns=now_ns)
            elif name not in self._odd_clocks:
                self._odd_clocks.add(name)
                text = f"the device's time, {device_ns} ns, doesn't fit /clock/{name}"
                self.log_event("warn", name, text)

    def _log_clock_events(self, name: str) -> None:
        for text in self.clocks[name].take_events():
            self.log_event("warn", name, text)

    def _log_unknown_frames(self) -> None:
        """Log each unknown identifier and too short frame once; the counts follow at the end."""
        for name, bus in self.buses.items():
            for text in bus.take_faults():
                self.log_event("error", name, text)
            if not bus.decodes:
                continue
            for level, what, counts in (
                ("info", "identifiers that are in no database", bus.tally.unknown),
                ("warn", "frames too short for", bus.tally.short),
            ):
                fresh = set(counts) - self._reported_ids[name]
                if fresh:
                    self._reported_ids[name] |= fresh
                    listed = ", ".join(sorted(fresh)[:8])
                    more = f" and {len(fresh) - 8} more" if len(fresh) > 8 else ""
                    self.log_event(level, name, f"{what}: {listed}{more}")

    def _finish(self) -> None:
        """Decode the backlog, and log the counts of the frames."""
        for name, bus in self.buses.items():
            bus.finish(self._clock.now_ns)
            self._log_clock_events(name)
            if bus.decodes:
                for text in bus.tally.problems():
                    self.log_event("warn", name, text)
                for text in bus.tally.notes():
                    self.log_event("info", name, text)
        self._write_clocks()
        self._log_unknown_frames()
        ending = self.ending
        assert ending is not None  # noqa: S101 - set by the loop
        self.log_event("error" if ending.failed else "info", "recorder", f"ends: {ending.reason}")


def _check(polled: Polled) -> None:
    """Check the frames of a plug-in."""
    for frames in (*polled.frames, *polled.fd_frames):
        if frames.dtype not in (FRAME_DTYPE, FD_FRAME_DTYPE):
            raise TypeError(f"poll() gave frames of the type {frames.dtype}")


@contextmanager
def _manual_collection() -> Generator[None]:
    """Disable automatic garbage collection, as a full one takes long.

    Present objects are exempt; the young generations are collected once a second.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
