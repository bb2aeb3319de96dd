"""Recorded commands once more, at their own times, into the twin of the session's robot."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from undulog.analysis.compare.compare import compare_sessions
from undulog.analysis.results.comparison import Comparison
from undulog.analysis.signals.reading import RESPONSE_TOPIC
from undulog.capture import Session, SessionView
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.common.interruption import StopRequest
from undulog.sim.drive.driven import Driven, find_driven
from undulog.sim.drive.in_process import drive_twin
from undulog.sim.scenario.scenario import Scenario
from undulog.sim.scenario.scenario_file import load_scenario
from undulog.sim.twin.recording import Recording
from undulog.sim.twin.twin import Sample

from .sameness import Sameness, sameness


@dataclass(frozen=True)
class Repetition:
    """What is to be run again, and where.

    Attributes:
        original: The session that commands are taken from.
        driven: Its commands.
        scenario: The world that they are given in.
    """

    original: Path
    driven: Driven
    scenario: Scenario


@dataclass(frozen=True)
class Again:
    """An experiment that was run again.

    Attributes:
        original: The session that commands were taken from.
        scenario: Where they were given again.
        recording: The new session.
        same: What of it is the same to the last bit; None where the first is no run of the twin.
        comparison: What differs as the analysis has it; None where it can't be told.
        not_compared: Why it can't.
    """

    original: Path
    scenario: Scenario
    recording: Recording
    same: Sameness | None
    comparison: Comparison | None
    not_compared: str | None


def find_repetition(
    original: Path,
    world: str | None = None,
    changes: Mapping[str, Any] | None = None,
    duration_s: float | None = None,
) -> Repetition:
    """Find a session's commands, and a world for them.

    Args:
        original: The session.
        world: A scenario's name or file; the world that the session was recorded in if None.
        changes: Keys of the world's scenario, with dots, to the values that they are to have.
        duration_s: How long [s]; as long as there are commands if None.

    Returns:
        What is to be run.

    Raises:
        UsageError: If no world is known.
        ScenarioError: If the world has faults, or a change is none of its values.
        DataError: If the commands are of another robot, or of none.
        LogError: If the session can't be read, or has no commands.
    """
    there = None if world is None else load_scenario(world, changes)
    driven = find_driven(str(original), there, changes)
    return Repetition(original, driven, driven.scenario(there, duration_s))


def replay_in_twin(
    repetition: Repetition,
    output: Path,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    on_sample: Callable[[Sample], None] | None = None,
) -> Again:
    """Give a session's commands to the twin again, record it, and compare.

    Args:
        repetition: What, and where.
        output: The session to write.
        force: Replace an existing file.
        stop: Looked at between samples: the joints come to rest, then the run ends.
        on_sample: Told of each sample after it was written.

    Returns:
        How it went.

    Raises:
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the file is there and ``force`` is not given.
        LogWriteError: If the new session can't be written.
        ImportError: If the kernels of the first run are not installed.
    """
    recording = drive_twin(
        repetition.driven, repetition.scenario, output, force=force, stop=stop, on_sample=on_sample
    )
    with Session.open(repetition.original) as first, Session.open(output) as second:
        of_twin = "physics_rate_hz" in first.metadata.get("undulog", {})
        comparison, why = compared(first, second)
    same = sameness(repetition.original, output) if of_twin else None
    return Again(repetition.original, repetition.scenario, recording, same, comparison, why)


def compared(first: SessionView, second: SessionView) -> tuple[Comparison | None, str | None]:
    """Hold a run against the one that its commands were taken from.

    Args:
        first: That one.
        second: The new one.

    Returns:
        What differs; or None, and why that can't be told, e.g. of a run shorter than two cycles.
    """
    if RESPONSE_TOPIC not in first.channels:
        return None, f"{first.path.name} has commands and no response ({RESPONSE_TOPIC})"
    try:
        return compare_sessions(first, second), None
    except (DataError, MissingChannelError) as error:
        return None, str(error)


def what_next(original: Path, again: Path, *, comparable: bool) -> list[str]:
    """What to do with a session and its repetition.

    Args:
        original: The session.
        again: The new one.
        comparable: Whether they can be compared.

    Returns:
        Commands, ready to be typed, a line each.
    """
    both = shlex.join([str(original), str(again)])
    verbs = ("view", "compare") if comparable else ("view",)
    leads = ("Next: ", "      ")
    return [f"{lead}undulog {verb} {both}" for lead, verb in zip(leads, verbs, strict=False)]
