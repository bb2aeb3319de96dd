"""Run a scenario into a session file, or as a source of a recording: ``twin:SCENARIO``."""

from __future__ import annotations

import gc
import hashlib
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import Empty, Full, Queue
from types import TracebackType

from undulog.capture.common.arrays import NS
from undulog.capture.common.console import refuse_existing
from undulog.capture.common.errors import (
    LogWriteError,
    SimulationError,
    SourceError,
    UndulogError,
    UsageError,
)
from undulog.capture.common.part_files import claimed_part
from undulog.capture.common.process import StopRequest
from undulog.capture.log.write.mcap_sink import write_error
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.robot.model import ClockDomain, Robot
from undulog.capture.sources.contract import (
    Polled,
    SourceAddress,
    SourceContext,
    SourceCounts,
    SourceEvent,
)

from ..gait.contract import CONTROL_RATE_HZ, Gait
from ..physics.engine import engine_type
from ..physics.ledger import TERMS
from ..scenario.scenario import Kernels, Scenario
from ..scenario.scenario_file import load_scenario
from .session_log import SessionLog, session_facts
from .twin import Sample, Twin

_AHEAD = 100  # samples that the twin may be ahead of the recording

_PERIOD_NS = NS // CONTROL_RATE_HZ


@contextmanager
def quick_collections() -> Generator[None]:
    """Restrict garbage collection to new objects: a full one takes longer than a tick."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@dataclass(frozen=True)
class TwinRecording:
    """What was recorded.

    Attributes:
        session_id: Hash of scenario, seed and robot.
        sample_count: Samples of each joint.
        duration_s: Simulated time from the first sample to the last.
        complete: Whether the run reached its planned end.
        energy: The ledger at the end [J], by term.
        contact_s: For how long each link touched an obstacle [s], those that did, by name.
    """

    path: Path
    session_id: str
    sample_count: int
    duration_s: float
    complete: bool
    energy: dict[str, float]
    contact_s: dict[str, float]


@dataclass(frozen=True)
class Driver:
    """The gait that commands the joints in place of that of the scenario.

    Attributes:
        gait: The commands; a run that is stopped has come to rest by then.
        facts: What the session's metadata says of it.
        attachments: File name to TOML text that explains it, e.g. ``plan.toml``.
        records: Other metadata records that explain it, by name.
    """

    gait: Gait
    facts: Mapping[str, str]
    attachments: Mapping[str, bytes]
    records: Mapping[str, Mapping[str, str]] = field(default_factory=dict[str, Mapping[str, str]])

    def session_id(self, scenario: Scenario) -> str:
        """Hash of everything that decides what the run gives.

        Returns:
            32 hexadecimal digits.
        """
        lines = [f"{key}={value}".encode() for key, value in sorted(self.facts.items())]
        parts = [scenario.session_id.encode(), *lines, *self.attachments.values()]
        return hashlib.sha256(b"\0".join(parts)).hexdigest()[:32]


@contextmanager
def open_session(
    scenario: Scenario,
    path: Path | str,
    driver: Driver | None = None,
    *,
    kernels: Kernels = Kernels.NUMPY,
    force: bool = False,
) -> Generator[SessionWriter]:
    """Create the session of a run, and finalise it after the block, however that is left.

    It appears under its name then; until then it is ``PATH.part``, which only a kill leaves behind.

    Args:
        driver: The gait that commands the joints; that of the scenario if None.

    Yields:
        The session, with everything that explains the run and no sample.

    Raises:
        OutputExistsError: If the file is there and ``force`` is not given.
        LogWriteError: If the file can't be written.
    """
    output = Path(path)
    refuse_existing(output, force=force)
    with ExitStack() as stack:
        try:
            part = stack.enter_context(claimed_part(output))
        except OSError as error:
            raise write_error(output, error) from error
        try:
            writer = SessionWriter(
                part,
                session_id=_session_id(scenario, driver, kernels),
                epoch_ns=scenario.epoch_ns,
                robot=scenario.robot,
                clock={"twin": ClockDomain.SIMULATED},
                metadata={
                    **session_facts(scenario, kernels),
                    **(driver.facts if driver is not None else {}),
                },
                force=True,
            )
        except BaseException:
            _remove(part)
            raise
        stack.push(partial(_name, part, output))
        stack.enter_context(writer)
        if driver is not None:
            writer.explain(driver.attachments, driver.records)
        yield writer


def _remove(part: Path) -> None:
    with suppress(OSError):  # on a disk that can't be written there is none
        part.unlink()


def _name(
    part: Path,
    output: Path,
    _kind: type[BaseException] | None,
    error: BaseException | None,
    _trace: TracebackType | None,
) -> None:
    """Give a session its name, or remove it if it could not be written."""
    if isinstance(error, LogWriteError):
        _remove(part)
        return
    try:
        part.replace(output)
    except OSError as failure:
        _remove(part)
        raise write_error(output, failure) from failure


def _session_id(scenario: Scenario, driver: Driver | None, kernels: Kernels) -> str:
    session_id = scenario.session_id if driver is None else driver.session_id(scenario)
    if kernels is Kernels.NUMPY:
        return session_id
    # Others round otherwise.
    return hashlib.sha256(f"{session_id}\0{kernels}".encode()).hexdigest()[:32]


def record(
    scenario: Scenario,
    path: Path | str,
    *,
    driver: Driver | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
    on_sample: Callable[[Sample], None] | None = None,
    kernels: Kernels = Kernels.NUMPY,
) -> TwinRecording:
    """Run a scenario into a session file.

    The file is whole however the run ends: at its planned end, by a stop request (between two
    samples), or by a failed simulation (then it holds what came before, and the failure).

    Args:
        driver: Who commands the joints; the scenario's own gait if None.
        on_sample: Called with each sample after it is written.
        kernels: What computes the force laws.

    Raises:
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the file is there and ``force`` is not given.
        LogWriteError: If the file can't be written.
    """
    sample: Sample | None = None
    with (
        Twin(scenario, None if driver is None else driver.gait, kernels=kernels) as twin,
        open_session(scenario, path, driver, kernels=kernels, force=force) as writer,
    ):
        log = SessionLog(writer, twin)
        try:
            for sample in twin.samples():
                log.write(sample)
                if on_sample is not None:
                    on_sample(sample)
                if stop is not None and stop.requested:
                    break
        except SimulationError as error:
            log.end("bad", str(error))
            log.log_event("error", str(error))
            raise
        assert sample is not None  # noqa: S101 - a run has at least two samples
        complete = sample.tick == scenario.tick_count - 1
        level, verdict, at = "info", "good", f"{sample.time_s:g} s"
        if complete:
            text = f"end at {at}"
        elif driver is not None:  # a stop request lets it come to rest first
            text = f"at rest at {at} of {scenario.duration_s:g} s: it was stopped"
        else:
            level, verdict = "warn", "degraded"
            text = f"stopped at {at} of {scenario.duration_s:g} s"
        log.end(verdict, text)
        log.log_event(level, text)
    return TwinRecording(
        path=Path(path),
        session_id=_session_id(scenario, driver, kernels),
        sample_count=sample.tick + 1,
        duration_s=sample.time_s,
        complete=complete,
        energy=dict(zip(TERMS, sample.energy.tolist(), strict=True)),
        contact_s={
            link.name: seconds
            for link, seconds in zip(scenario.robot.links, sample.contact_s.tolist(), strict=True)
            if seconds > 0.0
        },
    )


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
    engine_type(scenario.engine)  # a missing engine is an error before a recording is begun
    return TwinSource(address, scenario)
