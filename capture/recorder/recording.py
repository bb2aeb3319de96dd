"""A recording from its settings: sources, sink, health, control and live view put together."""

from __future__ import annotations

import dataclasses
import os
import platform
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from mcap.records import Metadata

from ..common.arrays import NS
from ..common.errors import LogWriteError, SocketInUseError, SourceError, UsageError
from ..common.process import StopRequest
from ..log.mcap.batch import MessageBatch, MessageFields
from ..log.write.durable_sink import DurableSink
from ..log.write.mcap_sink import Description, MessageSink
from ..log.write.ring_sink import RingStorage
from ..log.write.writer import SessionWriter
from ..sources.contract import SourceContext, open_sources
from .bus_recorder import decoded_source, robot_of
from .control import ControlServer
from .control_client import default_sockets
from .control_requests import RequestHandler
from .free_space import FreeSpace
from .health import LiveHealth
from .links import SourceLink, link_faults
from .live_feed import LiveFeed
from .loop import Ending, Recorder
from .record_report import RecordReport
from .screen import plain_line
from .settings import RecordSettings
from .status import EventLine, RecorderSnapshot, SessionClock, statuses
from .systemd import Notifier

_EVENTS_SHOWN = 8
_VIEW, _HEALTH = "live view", "live health"
_NOT_JUDGED = "the recorder could not judge all of it: 'undulog log check' does"
_RATE_UPDATES = 10


class TappedSink:
    """Passes records to a sink, and those that it accepted to listeners, which never wait."""

    def __init__(self, sink: MessageSink, listeners: Sequence[LiveHealth | LiveFeed]) -> None:
        """Connect a sink with its listeners."""
        self._sink = sink
        self._write = sink.write
        self._listeners = tuple(listeners)
        self._offers = tuple(listener.offer for listener in listeners)
        self._batch_offers = tuple(listener.offer_batch for listener in listeners)

    def define(self, record: Description) -> None:
        """See :meth:`MessageSink.define`."""
        self._sink.define(record)
        for listener in self._listeners:
            listener.define(record)

    def write(self, *message: *MessageFields) -> None:
        """See :meth:`MessageSink.write`."""
        self._write(*message)
        for offer in self._offers:
            offer(*message)

    def write_batch(self, batch: MessageBatch) -> None:
        """See :meth:`MessageSink.write_batch`."""
        self._sink.write_batch(batch)
        for offer in self._batch_offers:
            offer(batch)

    def close(self, last: tuple[Metadata, ...]) -> None:
        """See :meth:`MessageSink.close`."""
        self._sink.close(last)


class RunningRecording:
    """A running recording, and the actions that its control socket offers."""

    def __init__(
        self,
        settings: RecordSettings,
        stop: StopRequest,
        *,
        notifier: Notifier | None = None,
    ) -> None:
        """Open everything that must exist before the first sample.

        Args:
            notifier: Reports readiness and signs of life; None for no service manager.

        Raises:
            UsageError: If the settings contradict each other, or the output exists.
            SourceError: If a source can never work.
            LogWriteError: If the session can't be created, or too little space is free.
            ControlError: If the control socket can't be made.
        """
        self._settings, self._stop = settings, stop
        self._show: Callable[[RecorderSnapshot], None] | None = None
        self._notifier = notifier or Notifier({})
        self._sources = open_sources(settings.sources)
        robot = self._robot = robot_of(settings, self._sources)
        decoded = decoded_source(settings, self._sources, robot)
        if settings.fast and any(source.robot is None for source in self._sources):
            raise UsageError("--fast is for a twin alone; a bus has its own time")
        self._free = FreeSpace(settings.output)
        self._clock = SessionClock()
        self._session_id = uuid.uuid4().hex
        self._health = LiveHealth(robot)
        self._events: deque[EventLine] = deque(maxlen=_EVENTS_SHOWN)
        self._sizes: deque[tuple[int, int]] = deque(maxlen=_RATE_UPDATES)
        self._snapshot: RecorderSnapshot | None = None
        with ExitStack() as opened:  # closes in turn if a later step fails
            opened.callback(self._free.close)
            self._require_free()
            self._control = _control_of(settings)  # first: two recorders never share one
            opened.callback(self._control.close)
            self._feed = LiveFeed(self._control.path.with_suffix(".live"))
            self.live_socket = self._feed.path
            opened.callback(self._feed.close)
            self._storage = storage = _storage_of(settings)
            sink = storage.sink if isinstance(storage, RingStorage) else storage
            self._writer = SessionWriter(
                settings.output,
                session_id=self._session_id,
                epoch_ns=self._clock.epoch_ns,
                robot=robot,
                clock={source.name: source.clock for source in self._sources},
                metadata=self._facts(),
                sink=TappedSink(sink, (self._health, self._feed)),
            )
            opened.callback(self._writer.close)
            self._diagnostics = self._writer.diagnostics()
            self._recorder = Recorder(
                writer=self._writer,
                clock=self._clock,
                sources=self._sources,
                context=SourceContext(self._clock.now_ns, self._writer, _twin_facts(settings)),
                robot=robot,
                decoded=decoded,
                each_tick=(self._each_tick,),
                each_second=(self._look, self._diagnose, self._publish_status, self._check_disk),
            )
            self._recorder.on_event(self._note_event)
            self._control.serve(
                RequestHandler(self, self._writer, self._recorder.log_event, self._clock.now_ns)
            )
            opened.pop_all()
        # The recording continues without a task of these that fails.
        self._optional_tasks: dict[str, Callable[[], None]] = {
            _VIEW: self._feed.pump,
            _HEALTH: lambda: self._health.step(self._clock.now_ns()),
        }

    def _require_free(self) -> None:
        free = self._free()
        if free < self._settings.floor:
            raise LogWriteError(
                self._settings.output,
                f"only {free / 1e6:.0f} MB are free there, less than the floor of "
                f"{self._settings.floor / 1e6:.0f} MB (--floor)",
            )

    def warn(self, name: str, text: str) -> None:
        """Write a warning to ``/rosout``."""
        self._recorder.log_event("warn", name, text)

    def run(self, show: Callable[[RecorderSnapshot], None] | None = None) -> RecordReport:
        """Record until something ends it, and finalise.

        Args:
            show: Displays the recording, once a second.

        Raises:
            SourceError: If a source can never work; no file is left then.
        """
        ending, useless = Ending("an error", failed=True), False
        self._show = show
        try:
            self._notifier.ready(f"recording {self._settings.output}")
            ending = self._recorded()
        except SourceError:
            useless = True
            raise
        finally:
            self._notifier.stopping()
            ending = self._finalised(ending)
            self._feed.close()
            report = self._report(ending)
            self._control.close(report.as_json())
            self._free.close()
            if useless:  # nothing was recorded: the name is free for another try
                for file in report.files:
                    file.unlink(missing_ok=True)
        return report

    # -- requests of the control socket --------------------------------------------------------

    def status(self) -> Mapping[str, Any]:
        """See :meth:`.RecorderActions.status`."""
        facts = dataclasses.asdict(self._snapshot or self._look())
        return {"output": facts.pop("path"), "bytes": facts.pop("size"), **facts, "trouble": None}

    def mark(self, text: str) -> Mapping[str, Any]:
        """See :meth:`.RecorderActions.mark`."""
        storage = self._storage  # without a ring the mark is in the session like every event
        return storage.mark(text) if isinstance(storage, RingStorage) else {}

    def split(self) -> Mapping[str, Any]:
        """See :meth:`.RecorderActions.split`."""
        if isinstance(self._storage, RingStorage):
            raise UsageError("a ring has no parts; 'undulog record mark' writes what it holds")
        path = self._storage.split()
        return {"part": self._storage.part, "file": str(path)}

    def stop(self) -> None:
        """End the recording after this tick."""
        self._recorder.ending = Ending("it was stopped", requested=True)

    # -- in the loop -------------------------------------------------------------------------

    def _each_tick(self) -> None:
        self._control.poll()
        for name in tuple(self._optional_tasks):
            try:
                self._optional_tasks[name]()
            except LogWriteError:
                raise
            except Exception as error:  # noqa: BLE001 - the recording goes on without it
                del self._optional_tasks[name]
                text = f"the {name} is given up: it failed with {error!r}"
                self._recorder.log_event("error", "recorder", text)
        self._notifier.alive()

    def _look(self) -> RecorderSnapshot:
        """Take a new snapshot."""
        for level, text in self._storage.tick():
            self._recorder.log_event(level, "recorder", text)
        for text in self._control.take_faults():
            self._recorder.log_event("error", "recorder", text)
        now_ns = self._clock.now_ns()
        self._sizes.append((now_ns, self._storage.size))
        (began, had), (ended, has) = self._sizes[0], self._sizes[-1]
        measures, times = self._health.result(), self._recorder.ticks.result()
        state, verdict, reasons = self._health.standing(self._sources)
        clocks = self._recorder.clocks
        self._snapshot = RecorderSnapshot(
            session_id=self._session_id,
            path=str(self._storage.part_path),
            robot=self._robot.name if self._robot is not None else None,
            state=state,
            now_ns=now_ns,
            elapsed_s=(now_ns - self._clock.epoch_ns) / NS,
            messages=self._storage.messages,
            size=self._storage.size,
            byte_rate=(has - had) * NS / (ended - began) if ended > began else None,
            free=self._free(),
            part=self._storage.part,
            verdict=verdict,
            reasons=reasons,
            notes=measures.notes,
            sources=tuple(
                self._health.source(source, text, clocks.get(source.name))
                for text, source in zip(self._settings.sources, self._sources, strict=True)
            ),
            topics=self._health.topics(),
            events=tuple(self._events),
            tick_p99_s=times.p99_s,
            tick_max_s=times.max_s,
            backlog=self._recorder.backlog,
            unsynced=self._storage.unsynced,
        )
        return self._snapshot

    def _diagnose(self) -> None:
        if self._snapshot is not None:
            self._diagnostics.write(self._clock.now_ns(), statuses(self._snapshot))

    def _publish_status(self) -> None:
        if self._snapshot is None:
            return
        self._notifier.status(plain_line(self._snapshot))
        self._recorder.watched = self._feed.connected
        if self._show is not None:
            self._show(self._snapshot)

    def _check_disk(self) -> None:
        if (reason := self._storage.must_end) and self._recorder.ending is None:
            self._recorder.ending = Ending(reason, failed=True)
        if self._recorder.ending is not None:
            return
        if self._storage.shortage is not None:
            raise self._storage.shortage
        free = self._free()
        if free < self._settings.floor:
            self._recorder.ending = Ending(
                f"only {free / 1e6:.0f} MB are left on the disk, less than the floor of "
                f"{self._settings.floor / 1e6:.0f} MB; nothing later is recorded",
                failed=True,
            )

    def _note_event(self, t_ns: int, level: str, name: str, text: str) -> None:
        self._events.append(EventLine(t_ns, level, name, text))

    # -- the end -----------------------------------------------------------------------------

    def _recorded(self) -> Ending:
        try:
            # A twin's time is its own: it gets the duration, and ends by itself.
            twins = all(source.robot is not None for source in self._sources)
            duration_s = None if twins else self._settings.duration_s
            ending = self._recorder.run(self._stop, duration_s)
            for fault in (faults := link_faults(self._links())):
                self._recorder.log_event("error", "recorder", fault)
        except LogWriteError as error:
            return Ending(str(error), failed=True)
        return _failed(ending, *faults) if faults else ending

    def _links(self) -> dict[str, SourceLink]:
        """Return the links of all sources but those given up, which have a report of their own."""
        given_up = self._recorder.given_up
        return {name: link for name, link in self._recorder.links.items() if name not in given_up}

    def _finalised(self, ending: Ending) -> Ending:
        """Write verdict and summary, and close; return the ending, or the error in it."""
        try:
            self._writer.note_at_end("undulog.clock", self._clock_facts())
            self._writer.note_at_end("undulog.recorder", self._recorder_facts(ending))
            self._diagnose_last(ending)
            if _HEALTH in self._optional_tasks:
                verdict = self._health.final()
                self._writer.set_verdict(verdict.verdict, verdict.reasons)
            else:
                self._writer.set_verdict("degraded", [_NOT_JUDGED])
        finally:
            try:
                self._writer.close()
            except LogWriteError as error:
                full = str(error) if ending.reason in str(error) else f"{ending.reason}; {error}"
                text = full if ending.failed else str(error)
                ending = dataclasses.replace(ending, reason=text, failed=True)
        return self._with_places(ending)

    def _with_places(self, ending: Ending) -> Ending:
        """Add to the reason where the session is, if it was deleted or moved meanwhile."""
        if not self._storage.must_end:
            return ending
        files = self._storage.files()
        there = [str(file) for file in files if file.exists()]
        gone = [file.name for file in files if not file.exists()]
        texts = [self._storage.must_end] if self._storage.must_end not in ending.reason else []
        texts.append(ending.reason)
        if there:
            what = "all that was accepted" if not gone else "what was accepted since"
            texts.append(f"{what} is in {', '.join(there)}")
        if gone and there:
            texts.append(f"{', '.join(gone)} went with the folder")
        return dataclasses.replace(ending, reason="; ".join(texts), failed=True)

    def _diagnose_last(self, ending: Ending) -> None:
        """Write the last state of the sources, which a check of the file uses."""
        if ending.failed and self._storage.shortage is not None:
            return  # the disk takes no more; the last second's state is in the file
        self._look()
        self._diagnose()

    def _clock_facts(self) -> dict[str, str]:
        facts: dict[str, str] = {}
        for name, clock in self._recorder.clocks.items():
            if clock.pair() is not None:
                facts |= {f"{name}.{key}": text for key, text in clock.result().facts().items()}
        return facts

    def _recorder_facts(self, ending: Ending) -> dict[str, str]:
        times, pauses = self._recorder.ticks.result(), self._recorder.pauses
        return {
            "ended": ending.reason,
            "priority": self._recorder.priority.text,
            "ticks": str(times.count),
            "tick_p50_s": f"{times.p50_s:.3g}",
            "tick_p99_s": f"{times.p99_s:.3g}",
            "tick_max_s": f"{times.max_s:.3g}",
            "ticks_left_out": str(self._recorder.overruns),
            "pauses": str(len(pauses)),
            "paused_s": f"{sum(pause.ended_ns - pause.began_ns for pause in pauses) / NS:.3f}",
        }

    # -- facts -------------------------------------------------------------------------------

    def _facts(self) -> dict[str, str]:
        system = platform.uname()
        facts = {
            "host": system.node,
            "kernel": f"{system.system} {system.release} {system.machine}",
            "python": platform.python_version(),
        }
        for key in ("operator", "notes"):
            if value := getattr(self._settings, key):
                facts[key] = value
        for text, source in zip(self._settings.sources, self._sources, strict=True):
            facts[f"source.{source.name}"] = text
            facts |= {f"source.{source.name}.{k}": v for k, v in source.facts.items()}
        return facts | dict(self._settings.metadata)

    def _report(self, ending: Ending) -> RecordReport:
        measures = self._health.result()
        files = self._storage.files()
        if lost := self._recorder.given_up:
            ending = _failed(ending, f"given up before, see /rosout: {', '.join(lost)}")
        return RecordReport(
            files=files,
            session_id=self._session_id,
            robot=self._robot.name if self._robot is not None else None,
            duration_s=(self._clock.now_ns() - self._clock.epoch_ns) / NS,
            messages=self._storage.messages,
            size=sum(file.stat().st_size for file in files if file.exists()),
            verdict=measures.verdict,
            reasons=measures.reasons,
            ending=ending,
            sources={s.name: dataclasses.asdict(s.counts) for s in self._sources},
            recorder=self._recorder_facts(ending),
            rescued=self._storage.rescued,
        )


def _failed(ending: Ending, *faults: str) -> Ending:
    """Return an ending that failed for further reasons."""
    return dataclasses.replace(ending, reason="; ".join((ending.reason, *faults)), failed=True)


def _storage_of(settings: RecordSettings) -> DurableSink | RingStorage:
    if settings.ring_s is not None:
        return RingStorage(settings.output, settings.ring_s)
    split_s = settings.split_time_s
    return DurableSink(
        settings.output,
        force=settings.force,
        split_size=settings.split_size,
        split_ns=None if split_s is None else round(split_s * NS),
    )


def _control_of(settings: RecordSettings) -> ControlServer:
    """Open the socket of the settings, or the first default one that is free."""
    if settings.socket is not None:
        return ControlServer(settings.socket)
    usual, other = default_sockets(settings.output, os.environ)
    try:
        return ControlServer(usual)
    except SocketInUseError:
        return ControlServer(other)


def _twin_facts(settings: RecordSettings) -> dict[str, str]:
    facts = {"fast": str(settings.fast).lower()}
    if settings.duration_s is not None:
        facts["duration_s"] = repr(settings.duration_s)
    return facts
