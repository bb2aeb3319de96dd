"""Run a scenario into a session file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from capture.errors import SimulationError
from capture.interruption import StopRequest
from capture.log.writer import SessionWriter
from capture.robot import ClockDomain

from .physics.ledger import TERMS
from .scenario import Scenario
from .session_log import SessionLog, session_facts
from .twin import Sample, Twin


@dataclass(frozen=True)
class Recording:
    """What was recorded.

    Attributes:
        path: The session file.
        session_id: Hash of scenario, seed and robot.
        sample_count: Samples of each joint.
        duration_s: Simulated time from the first sample to the last.
        complete: Whether the run reached its planned end.
        energy: The ledger at the end [J], by term.
    """

    path: Path
    session_id: str
    sample_count: int
    duration_s: float
    complete: bool
    energy: dict[str, float]


def record(
    scenario: Scenario,
    path: Path | str,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    on_sample: Callable[[Sample], None] | None = None,
) -> Recording:
    """Run a scenario into a session file.

    The file is whole however the run ends: at its planned end, by a stop request (between two
    samples), or by a failed simulation (then it holds what came before, and the failure).

    Args:
        scenario: What to run.
        path: The file to create.
        force: Replace an existing file.
        stop: Looked at between samples.
        on_sample: Told of each sample after it was written, e.g. to show progress.

    Returns:
        What was recorded.

    Raises:
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the file is there and ``force`` is not given.
        LogWriteError: If the file can't be written.
    """
    sample: Sample | None = None
    with (
        Twin(scenario) as twin,
        SessionWriter(
            path,
            session_id=scenario.session_id,
            epoch_ns=scenario.epoch_ns,
            robot=scenario.robot,
            clock={"twin": ClockDomain.SIMULATED},
            metadata=session_facts(scenario),
            force=force,
        ) as writer,
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
            log.hear(twin.flush())
            log.say("error", str(error))
            writer.set_verdict("bad", [str(error)])
            raise
        log.hear(twin.flush())
        assert sample is not None  # noqa: S101 - a run has at least two samples
        complete = sample.tick == scenario.tick_count - 1
        if complete:
            log.say("info", f"end at {sample.time_s:g} s")
            writer.set_verdict("good")
        else:
            text = f"stopped at {sample.time_s:g} s of {scenario.duration_s:g} s"
            log.say("warn", text)
            writer.set_verdict("degraded", [text])
    return Recording(
        path=Path(path),
        session_id=scenario.session_id,
        sample_count=sample.tick + 1,
        duration_s=sample.time_s,
        complete=complete,
        energy=dict(zip(TERMS, sample.energy.tolist(), strict=True)),
    )
