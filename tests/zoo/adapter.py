"""Statements of undulog on signals in memory: the only module of the bench that imports it.

The signals are given to the function that analyses a session, through an object that has the
methods of an open session; nothing is written to a file. What is read of the answer are the lists
behind its first sentence, and the sentence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np

from undulog.analysis.common.answer import Verdict
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.parts import BEYOND_THE_GAIT
from undulog.capture import SessionView
from undulog.capture.common.errors import DataError, MissingChannelError, UndulogError
from undulog.capture.log.columns.topics import Channel
from undulog.capture.log.read.facts import TIMES_FROM_FPS
from undulog.capture.log.read.joint_topics import JointTopics
from undulog.capture.log.read.sample_times import JointSignals
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Robot

EPOCH_NS = 1_700_000_000_000_000_000
"""Time of the first sample [Unix ns]: any will do; that of the bags of the zoo."""

COMMANDS, STATES = "/joint_commands", "/joint_states"
FIELDS = ("position", "velocity", "effort")
UNITS = MappingProxyType({"position": "rad", "velocity": "rad/s", "effort": "N m"})

SHAPED = ("do not move alike", "The others differ")
"""Words of a sentence that states a shape; shapes within the margins are in the lists alone."""

DESCRIPTION = """
name = "drawn"
description = "A robot that was drawn; what it is made of is assumed."
clock = "host"
assumed = ["links", "servo", "joints"]
joints = [{joints}]
[defaults.link]
length = 0.06
radius = 0.025
mass = 0.1
inertia = [4e-5, 5e-5, 5e-5]
[defaults.joint]
lower = -3.2
upper = 3.2
"""
"""A robot description with the joints left open."""


@dataclass(frozen=True)
class Accused:
    """A joint that a sentence states not to follow, or of which it names a fault.

    Attributes:
        kinds: The kinds stated.
        since_s: Start [s]; None: from the beginning.
        until_s: End [s]; None: to the end.
    """

    joint: str
    kinds: frozenset[str]
    since_s: float | None
    until_s: float | None


@dataclass(frozen=True)
class Different:
    """A joint that a sentence states to respond differently from the others.

    Attributes:
        quantity: ``gain``, ``lag``, ``offset``, ``noise``, ``motion`` at a frequency that isn't
            the command's, or ``rest`` off the command.
        value: Relative for a gain, a ratio for noise, rad or s for the others.
        onset_s: Start [s]; None: no onset is stated.
    """

    joint: str
    quantity: str
    value: float
    onset_s: float | None


@dataclass(frozen=True)
class Said:
    """What the first sentence of a session states.

    Attributes:
        accused: Joints that don't follow, or have a fault.
        different: Joints that respond differently.
        shaped: Whether a shape along the joints is stated, or that all of them differ.
        alike: Whether all joints are stated to be alike.
        not_decided: Whether the sentence leaves open whether or which joints differ.
        sentence: The sentence itself.
        refused: Why there is none, or empty.
        doubted: Joints of whose position the analysis states that a sensor falsifies it.
    """

    accused: tuple[Accused, ...]
    different: tuple[Different, ...]
    shaped: bool
    alike: bool
    not_decided: bool
    sentence: str
    refused: str = ""
    doubted: tuple[str, ...] = ()


@dataclass(frozen=True)
class Signals:
    """Signals of one session in memory.

    Attributes:
        names: Of the joints, head to tail, m of them.
        t_s: Sampling times [s], increasing, shape (n,).
        commands: [rad], shape (n, m).
        positions: [rad], shape (n, m).
        efforts: [N m], shape (n, m), or None.
        description: A robot of undulog, or None.
        frame_rate_hz: Frame rate from which the times were made; 0 if they were measured.
    """

    names: tuple[str, ...]
    t_s: np.ndarray
    commands: np.ndarray
    positions: np.ndarray
    efforts: np.ndarray | None = None
    description: Robot | None = None
    frame_rate_hz: float = 0.0


def described(names: Sequence[str], planes: Sequence[str]) -> Robot:
    """Return the description of a robot: its joints with their planes, and nothing certain else.

    Args:
        names: Of the joints, head to tail.
        planes: ``horizontal`` or ``vertical`` of each of them.
    """
    joints = ", ".join(
        f'{{ name = "{name}", plane = "{plane}" }}'
        for name, plane in zip(names, planes, strict=True)
    )
    return parse_robot(DESCRIPTION.format(joints=joints), "drawn.toml", {})


def stated(signals: Signals) -> Said:
    """Return what undulog states of a session."""
    try:
        session = cast("SessionView", MemorySession(signals))
        measured = measure_session(session, without=BEYOND_THE_GAIT)
    except UndulogError as error:
        return Said((), (), False, False, True, sentence="", refused=str(error))
    answer = measured.analysis.answer
    accused = tuple(
        Accused(fault.joint, frozenset(fault.kinds), fault.since_s, fault.until_s)
        for fault in answer.not_following
    )
    different = (
        *(
            Different(difference.joint, difference.quantity, difference.deviation, None)
            for difference in answer.stand_out
        ),
        *(
            Different(change.joint, change.quantity, change.change, change.from_s)
            for change in answer.changes
        ),
        *(Different(motion.joint, "motion", motion.amplitude_rad, None) for motion in answer.extra),
        *(Different(rest.joint, "rest", rest.offset_rad, None) for rest in answer.rests),
        *(
            Different(difference.joint, difference.quantity, _beyond(difference), None)
            for difference in answer.apart
        ),
    )
    open_verdicts = (Verdict.OPEN, Verdict.NOTHING)
    not_decided = answer.undecided is not None or answer.verdict in open_verdicts
    return Said(
        accused,
        different,
        shaped=any(words in answer.sentence for words in SHAPED),
        alike=bool(answer.alike),
        not_decided=not_decided,
        sentence=answer.sentence,
        doubted=tuple(
            artefact.joint
            for artefact in measured.analysis.artefacts
            if artefact.falsifies("position")
        ),
    )


def _beyond(apart):
    """Return how far a joint is from the middle of the others: of a gain relative to it."""
    middle = sum(apart.others) / 2
    return apart.value / middle - 1 if apart.quantity == "gain" else apart.value - middle


class MemorySession:
    """Signals with the methods of an open session, as far as the analysis uses them."""

    path = Path("in-memory.mcap")
    session_id = "in-memory"
    is_remote = False
    run = robot_given = verdict = settle_s = None
    warnings: Sequence[str] = ()

    def __init__(self, signals: Signals) -> None:
        """Take the signals; nothing is copied."""
        self.robot = self.robot_as_run = signals.description
        made = {TIMES_FROM_FPS: f"{signals.frame_rate_hz:g}"} if signals.frame_rate_hz else {}
        self.metadata: Mapping[str, Mapping[str, str]] = {"undulog": made}
        t_ns = EPOCH_NS + np.rint(np.asarray(signals.t_s) * 1e9).astype(np.int64)
        self.start_ns, self.end_ns = int(t_ns[0]), int(t_ns[-1])
        columns = {
            (COMMANDS, "position"): signals.commands,
            (STATES, "position"): signals.positions,
            (STATES, "effort"): signals.efforts,
        }
        self._signals = {
            key: _joint_signals(*key, signals.names, t_ns, values)
            for key, values in columns.items()
            if values is not None
        }
        kind = partial(Channel, type_name="sensor_msgs/msg/JointState", count=t_ns.size)
        kind = partial(kind, metadata={}, encoding="cdr", schema_encoding="ros2msg")
        self.channels = {topic: kind(topic) for topic in (COMMANDS, STATES)}

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    def fingerprint(self) -> str:
        """Return nothing that anybody compares: there are no files."""
        return "0" * 64

    def forget(self) -> None:
        """Keep all: there is no file to read it from again."""

    def with_joints(self) -> "MemorySession":
        """Return itself: its topics are those of the log contract."""
        return self

    def joint_topics(self, command: str = COMMANDS, response: str = STATES) -> JointTopics:
        """Return the topics as they were chosen."""
        return JointTopics(command, response)

    def joint_channel(self, name: str) -> Channel | None:
        """Return the channel of a topic, or None."""
        return self.channels.get(name)

    def joints(self, topic: str, field: str = "position") -> JointSignals:
        """Return one quantity of all joints.

        Raises:
            MissingChannelError: If it isn't there.
            DataError: If there is no such quantity.
        """
        if field not in FIELDS:
            raise DataError(f"{field} is none of {', '.join(FIELDS)}")
        if (topic, field) not in self._signals:
            raise MissingChannelError(self.path, f"{topic} {field}", sorted(self.channels))
        return self._signals[topic, field]

    def joint_columns(
        self, fields_of: Mapping[str, Sequence[str]]
    ) -> dict[tuple[str, str], JointSignals]:
        """Return several quantities.

        Raises:
            MissingChannelError: If one of them isn't there.
        """
        return {
            (topic, field): self.joints(topic, field)
            for topic, fields in fields_of.items()
            for field in fields
        }


def _joint_signals(
    topic: str, field: str, names: Sequence[str], t_ns: np.ndarray, values: np.ndarray
) -> JointSignals:
    """Return columns as the reader of sessions gives them: all joints share their times."""
    columns = tuple(np.ascontiguousarray(column) for column in np.asarray(values).T)
    times = (t_ns,) * len(columns)
    return JointSignals(topic, field, UNITS[field], tuple(names), times, columns)
