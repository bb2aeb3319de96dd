"""Recorded commands once more, at their own times, into the twin of the session's robot.

Are two sessions the same, message by message? And where not: from when on?

A twin under the same commands in the same world gives the same bytes. Where something was changed,
the first message that differs says from when on it mattered.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from undulog.analysis.compare.compare import compare_sessions
from undulog.analysis.results.comparison import Comparison
from undulog.capture import Session, SessionView
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.edited_log import RawLog
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from undulog.sim.drive.in_process import drive_twin
from undulog.sim.drive.motion import MotionSource, find_motion
from undulog.sim.scenario.scenario import Scenario
from undulog.sim.scenario.scenario_file import load_scenario
from undulog.sim.twin.recording import TwinRecording
from undulog.sim.twin.twin import Sample

EVENTS = "/rosout"
"""Events are text, which may name what was changed: they are not compared."""

_ALWAYS = 1 << 64


@dataclass(frozen=True)
class LogDifference:
    """Differences of two sessions, message by message.

    Attributes:
        same: Topics whose messages are the same: times, numbers and bytes.
        differs_s: Topic to the time of its first message that differs, from the session's start
            [s]; a message that only one session has differs.
        one_sided: Topics that only one session has.
        messages: Messages that were looked at, of the first session.
    """

    same: tuple[str, ...]
    differs_s: dict[str, float]
    one_sided: tuple[str, ...]
    messages: int

    @property
    def exact(self) -> bool:
        """Whether nothing differs."""
        return not (self.differs_s or self.one_sided)


def compare_logs(path: Path, other: Path) -> LogDifference:
    """Compare two sessions, topic by topic.

    Args:
        other: Another one, of the same time.

    Raises:
        LogError: If one can't be read.
    """
    with RawLog(path) as first, RawLog(other) as second:
        channels = first.file.channels, second.file.channels
        topics, others = ({channel.topic: key for key, channel in log.items()} for log in channels)
        same: list[str] = []
        differs_s: dict[str, float] = {}
        messages = 0
        for topic in [topic for topic in topics if topic in others and topic != EVENTS]:
            pair = _messages_of(first, topics[topic]), _messages_of(second, others[topic])
            for a, b in zip_longest(*pair):
                messages += a is not None
                if a != b:
                    at_ns = min(message[0] for message in (a, b) if message is not None)
                    differs_s[topic] = (at_ns - first.start_ns) * 1e-9
                    break
            else:
                same.append(topic)
    one_sided = tuple(sorted((topics.keys() ^ others.keys()) - {EVENTS}))
    return LogDifference(tuple(same), differs_s, one_sided, messages)


def _messages_of(log: RawLog, channel_id: int) -> Iterator[tuple[int, int, bytes]]:
    """Log time, publish time and bytes of a channel's messages."""
    for message in log.messages({channel_id}, 0, _ALWAYS):
        yield message.log_time_ns, message.publish_time_ns, message.data


@dataclass(frozen=True)
class Repetition:
    """A motion to be run again, and its scenario.

    Attributes:
        original: The session that commands are taken from.
        scenario: The world that they are given in.
        topics: Of the session's commands and responses.
    """

    original: Path
    driven: MotionSource
    scenario: Scenario
    topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC)


@dataclass(frozen=True)
class ReproducedRun:
    """An experiment that was run again.

    Attributes:
        original: The session that commands were taken from.
        scenario: Where they were given again.
        same: What of it is the same to the last bit; None where the first is no run of the twin.
        comparison: What differs as the analysis has it; None where there is none.
        not_compared: Why it can't.
    """

    original: Path
    scenario: Scenario
    recording: TwinRecording
    same: LogDifference | None
    comparison: Comparison | None
    not_compared: str | None

    @property
    def exact(self) -> bool:
        """Whether it is known to be the same to the last bit."""
        return self.same is not None and self.same.exact


def find_repetition(
    original: Path,
    world: str | None = None,
    changes: Mapping[str, Any] | None = None,
    duration_s: float | None = None,
    topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC),
) -> Repetition:
    """Find a session's commands, and a world for them.

    Args:
        world: A scenario's name or file; the world that the session was recorded in if None.
        changes: Keys of the world's scenario, with dots, to the values that they are to have.
        duration_s: How long [s]; as long as there are commands if None.
        topics: Of commands and responses.

    Returns:
        What is to be run.

    Raises:
        UsageError: If no world is known.
        ScenarioError: If the world has faults, or a change is none of its values.
        DataError: If the commands are of another robot, or of none.
        LogError: If the session can't be read, or has no commands.
    """
    there = None if world is None else load_scenario(world, changes)
    driven = find_motion(str(original), there, changes, command_topic=topics[0])
    return Repetition(original, driven, driven.scenario(there, duration_s), topics)


def replay_in_twin(
    repetition: Repetition,
    output: Path,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    on_sample: Callable[[Sample], None] | None = None,
) -> ReproducedRun:
    """Run a session's commands in the twin, record the run and compare it.

    Args:
        repetition: What, and where.
        stop: Looked at between samples: the joints come to rest, then the run ends.
        on_sample: Called with each sample after it was written.

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
        comparison, why = compared(first.with_joints(*repetition.topics), second)
    same = compare_logs(repetition.original, output) if of_twin else None
    return ReproducedRun(repetition.original, repetition.scenario, recording, same, comparison, why)


def compared(first: SessionView, second: SessionView) -> tuple[Comparison | None, str | None]:
    """Compare a run with the one that its commands were taken from.

    Returns:
        The comparison; or None, and the reason, e.g. a run shorter than two cycles.
    """
    if RESPONSE_TOPIC not in first.channels:
        return None, f"{first.path.name} has commands and no response ({RESPONSE_TOPIC})"
    try:
        return compare_sessions(first, second), None
    except (DataError, MissingChannelError) as error:
        return None, str(error)


def what_next(original: Path, again: Path, *, comparable: bool) -> list[str]:
    """Return commands that show a session and its repetition.

    Args:
        comparable: Whether they can be compared.

    Returns:
        Commands, ready to be typed, a line each.
    """
    both = shlex.join([str(original), str(again)])
    verbs = ("view", "compare") if comparable else ("view",)
    leads = ("Next: ", "      ")
    return [f"{lead}undulog {verb} {both}" for lead, verb in zip(leads, verbs, strict=False)]
