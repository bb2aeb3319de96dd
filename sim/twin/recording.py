"""Run a scenario into a session file."""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType

from undulog.capture.common.console import refuse_existing
from undulog.capture.common.errors import LogWriteError, SimulationError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.write.mcap_sink import write_error
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.robot.model import ClockDomain

from ..gait.contract import Gait
from ..physics.ledger import TERMS
from ..scenario.scenario import Kernels, Scenario
from .session_log import SessionLog, session_facts
from .twin import Sample, Twin


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
class Recording:
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
    part = output.with_name(f"{output.name}.part")
    with ExitStack() as stack:
        stack.callback(_remove, part)
        stack.push(partial(_name, part, output))
        writer = stack.enter_context(
            SessionWriter(
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
        )
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
    """Give a session its name, unless it could not be written."""
    if isinstance(error, LogWriteError):
        return
    try:
        part.replace(output)
    except OSError as found:
        raise write_error(output, found) from found


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
) -> Recording:
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
    return Recording(
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
