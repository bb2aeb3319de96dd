"""The twin as a source of a recording: ``twin:SCENARIO``, in real time or as fast as it can."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from queue import Empty, Full, Queue

from undulog.capture.common.arrays import NS
from undulog.capture.common.errors import SimulationError, SourceError, UndulogError, UsageError
from undulog.capture.robot.model import ClockDomain, Robot
from undulog.capture.sources.contract import (
    Polled,
    SourceAddress,
    SourceContext,
    SourceCounts,
    SourceEvent,
)

from ..gait.contract import CONTROL_RATE_HZ
from ..physics.engine import engine_type
from ..scenario.scenario import Scenario
from ..scenario.scenario_file import load_scenario
from .session_log import SessionLog, session_facts
from .twin import Sample, Twin

_AHEAD = 100  # samples that the twin may be ahead of the recording

_PERIOD_NS = NS // CONTROL_RATE_HZ


class TwinSource:
    """Runs a scenario beside the recorder, in a thread of its own."""

    def __init__(self, address: SourceAddress, scenario: Scenario) -> None:
        """Wrap a scenario; :meth:`start` runs it.

        Args:
            address: The source as it was asked for.
        """
        self.name = address.name
        self.clock = ClockDomain.SIMULATED
        self.directions = False
        self.robot: Robot | None = scenario.robot
        self.counts = SourceCounts()
        self._address, self._scenario = address, scenario
        self._queue: Queue[Sample | UndulogError | None] = Queue(_AHEAD)
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._log: SessionLog | None = None
        self._twin: Twin | None = None
        self._context: SourceContext | None = None
        self.finished = False

    @property
    def facts(self) -> Mapping[str, str]:
        """Metadata of the run for the session."""
        return session_facts(self._scenario)

    @property
    def connected(self) -> bool:
        """Whether the twin runs."""
        return self._thread is not None and not self.finished

    def start(self, context: SourceContext) -> None:
        """Set the robot on the ground and let it go."""
        self._context = context
        try:
            if (duration_s := context.facts.get("duration_s")) is not None:
                self._scenario = self._scenario.changed(duration_s=float(duration_s))
            self._twin = Twin(self._scenario)
        except UsageError as error:
            raise SourceError(self._address.text, str(error)) from error
        self._log = SessionLog(context.writer, self._twin, epoch_ns=context.now_ns())
        fast = context.facts.get("fast") == "true"
        self._thread = threading.Thread(target=self._run, args=(fast,), name=self.name, daemon=True)
        self._thread.start()

    def poll(self) -> Polled:
        """Write the samples that are due."""
        events: list[SourceEvent] = []
        while not self.finished and self._log is not None and self._context is not None:
            try:
                item = self._queue.get_nowait()
            except Empty:
                break
            if isinstance(item, Sample):
                self._log.write(item)
                self.counts.dropped = item.tick - self.counts.frames  # ticks are numbered from 0
                self.counts.frames += 1
                continue
            self.finished = True
            if self._twin is not None:
                self._log.receive(self._twin.flush())
            level, text = "error", str(item)
            if item is None:
                level, text = "info", f"{self._scenario.name} has ended"
            events.append(SourceEvent(self._context.now_ns(), level, text))
        return Polled(events=tuple(events))

    def stop(self) -> None:
        """End the run; safe to call twice."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._twin is not None:
            self._twin.close()
            self._twin = None

    def _run(self, fast: bool) -> None:
        """In the thread: samples into the queue, each not before its time."""
        assert self._twin is not None  # noqa: S101 - start made it
        begun = time.monotonic_ns()
        last: UndulogError | None = None
        try:
            for sample in self._twin.samples():
                ahead_s = (begun + sample.tick * _PERIOD_NS - time.monotonic_ns()) * 1e-9
                if not fast and ahead_s > 0:
                    self._ended.wait(ahead_s)
                if not self._put(sample):
                    return
        except SimulationError as error:
            last = error
        self._put(last)

    def _put(self, item: Sample | UndulogError | None) -> bool:
        while not self._ended.is_set():
            try:
                self._queue.put(item, timeout=0.1)
            except Full:
                continue
            return True
        return False


def open_twin(address: SourceAddress) -> TwinSource:
    """Open a scenario as a source.

    Args:
        address: ``twin:SCENARIO``, a shipped name or a TOML file.

    Raises:
        UsageError: If there is no such scenario, or an option is given.
        ScenarioError: If the scenario's file has faults.
        ImportError: If its engine is not installed.
    """
    if address.options:
        given = ", ".join(address.options)
        raise UsageError(f"{address.text}: a twin takes no options; found {given}")
    scenario = load_scenario(address.rest)
    engine_type(scenario.engine)  # is told before a recording is begun
    return TwinSource(address, scenario)
