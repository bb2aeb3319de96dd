"""The columns of a session that an analysis needs, and what is known about how it was run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import NS, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, MissingChannelError, some_names
from undulog.capture.judgement.naming import NAMED
from undulog.capture.judgement.publishers import are_of_two_nodes
from undulog.capture.judgement.session import in_turn
from undulog.capture.log.messages.definitions import PowerTopic
from undulog.capture.log.read.joint_topics import (
    HOW_TO_CHOOSE,
    RESPONSE_TOPIC,
    JointTopics,
)
from undulog.capture.log.read.pauses import without_pauses
from undulog.capture.log.read.sample_times import LARGEST, MOST_JOINTS, JointSignals, Signal
from undulog.capture.robot.model import Robot

from ..common.remarks import Lacking, Leading, Note
from ..estimators.turning import turning_beside_others
from ..response.rhythm import DRIVEN_SHARE

DRAG_RATIO = 10.0
"""K = c_n / c_t where nothing says otherwise; 0.5 / 0.05 of the twin's ground."""

CURRENT_TOPIC = "/joint_current"
VOLTAGE_TOPIC = "/joint_voltage"

QUANTITIES = ("command", "position", "velocity", "effort", "current", "voltage", "reference")
"""What is read of each joint."""

_OF_ITS_OWN = {"velocity": ("/joint_velocity", "position"), "effort": ("/joint_effort", "position")}


@dataclass(frozen=True)
class Columns:
    """Signals by joint name; a joint or a quantity that was not recorded is absent.

    Attributes:
        names: All joints, head to tail.
        command: Commanded positions [rad].
        position: Measured positions [rad].
        velocity: [rad/s].
        effort: [N m].
        current: Motor current [A].
        voltage: Motor voltage [V].
        reference: Positions by a second sensor [rad].
        powers: Mean powers [W] that were accumulated within each sampling interval, by topic.
        topics: Quantity, as the attributes above are called, to the topic that it was read from.
        excitation: What the commands follow from outside, of any unit.
    """

    names: tuple[str, ...]
    command: Mapping[str, Signal]
    position: Mapping[str, Signal]
    velocity: Mapping[str, Signal]
    effort: Mapping[str, Signal]
    current: Mapping[str, Signal]
    voltage: Mapping[str, Signal]
    reference: Mapping[str, Signal]
    powers: Mapping[PowerTopic, Mapping[str, Signal]]
    topics: Mapping[str, str]
    excitation: Mapping[str, Signal] = field(default_factory=dict[str, Signal])

    def of(self, quantity: str) -> Mapping[str, Signal]:
        """Return one of ``QUANTITIES``, signals by joint name."""
        signals: Mapping[str, Signal] = getattr(self, quantity)
        return signals

    @cached_property
    def turning(self) -> frozenset[str]:
        """Joints whose command turns without end, beside others that swing."""
        return frozenset(turning_beside_others(self._usable_commands))

    @cached_property
    def _usable_commands(self) -> dict[str, FloatArray]:
        usable = {n: s.values[np.abs(s.values) <= LARGEST] for n, s in self.command.items()}
        return {name: values for name, values in usable.items() if values.size}

    def commanded(self) -> tuple[str, ...]:
        """Return joints whose command moves more than ``DRIVEN_SHARE`` of the largest.

        Joints that turn without end are among them, and no measure for the others.
        """
        swing = {name: float(np.ptp(values)) for name, values in self._usable_commands.items()}
        swings = (size for name, size in swing.items() if name not in self.turning)
        least = DRIVEN_SHARE * max(swings, default=0.0)
        return tuple(name for name in self.names if swing.get(name, 0.0) > least)


def read_columns(
    session: SessionView,
    command_topic: str,
    response_topic: str,
    warn: Warn,
    *,
    reference_topic: str | None = None,
    excitation_topic: str | None = None,
) -> Columns:
    """Read the joints' signals; warn of those that are missing.

    Args:
        command_topic: Topic of the commands, as :meth:`.SessionView.joint_topics` takes it.
        response_topic: Topic of the responses, likewise.
        warn: Takes one sentence for each thing missing.
        reference_topic: JointState topic of a second sensor of the positions, or None.
        excitation_topic: JointState topic of what the commands follow from outside, or None.

    Raises:
        MissingChannelError: If neither topic is there, or one that was chosen is not; the message
            lists those that are.
        DataError: If a topic has no joints, there are too many joints, it isn't known which of
            several robots is meant, or two nodes publish a topic in turn.
    """
    topics = session.joint_topics(command_topic, response_topic)
    _check_robots(session, topics)
    command_topic, response_topic = topics.command, topics.response
    sources = {
        "command": (command_topic, "position"),
        "position": (response_topic, "position"),
        "velocity": (response_topic, "velocity"),
        "effort": (response_topic, "effort"),
        "current": (topics.quantities.get(CURRENT_TOPIC, CURRENT_TOPIC), "position"),
        "voltage": (topics.quantities.get(VOLTAGE_TOPIC, VOLTAGE_TOPIC), "position"),
        **{topic: (topic, "position") for topic in PowerTopic},
    }
    chosen = {"reference": reference_topic, "excitation": excitation_topic}
    chosen = {key: topic for key, topic in chosen.items() if topic is not None}
    sources |= {key: (topic, "position") for key, topic in chosen.items()}
    asked = [((command_topic, response_topic), HOW_TO_CHOOSE)]
    asked += [((topic,), f"choose with --{key}-topic") for key, topic in chosen.items()]
    for names, how in asked:
        if not any(session.joint_channel(name) for name in names):
            damage = f" ({'; '.join(session.warnings)})" if session.warnings else ""
            there = topics.others or sorted(session.channels)
            missing = " or ".join(names) + damage
            raise MissingChannelError(session.path, missing, there, how)
    sources = {key: source for key, source in sources.items() if session.joint_channel(source[0])}
    recorded = _read(session, sources)
    if response_topic == RESPONSE_TOPIC:
        # A bus that gives them in frames of their own has them on topics of their own.
        separate = {
            key: source for key, source in _OF_ITS_OWN.items() if source[0] in session.channels
        }
        separate = {key: source for key, source in separate.items() if key not in recorded}
        recorded |= _read(session, separate) if separate else {}
        sources |= separate
    for note in topics.notes:
        warn(Note(note))
    for key, kind, topic in (
        ("command", "commands", command_topic),
        ("position", "positions", response_topic),
    ):
        if key not in recorded:
            option = "--command-topic" if key == "command" else "--response-topic"
            named = f" (other joints: {', '.join(topics.others)}; choose with {option})"
            logged = "no command logged: " if key == "command" else ""
            nulls = f"gain and lag are null{named if topics.others else ''}"
            if key == "command" and topics.unnamed:
                why = " and ".join(topics.unnamed)
                warn(Leading(f"no commands of named joints: {why}; gain and lag are null"))
                continue
            warn(Lacking(f"{logged}no {kind} on {topic}: {nulls}"))
    accumulated = PowerTopic.MECHANICAL in recorded and PowerTopic.MECHANICAL_PLUS in recorded
    if not accumulated and ("velocity" not in recorded or "effort" not in recorded):
        lacking = " and ".join(key for key in ("effort", "velocity") if key not in recorded)
        warn(Note(f"{response_topic} carries no {lacking}: mechanical energies are null"))
    _check_nodes(session, recorded)
    _check_voltage(session, recorded, warn)
    seen = dict.fromkeys(session.robot.joint_names if session.robot is not None else ())
    for key in ("command", "position"):
        if key in recorded:
            seen |= dict.fromkeys(recorded[key].names)
    if len(seen) > MOST_JOINTS:
        raise DataError(
            f"{session.path.name}: {len(seen)} joints on {response_topic} and {command_topic}; at "
            f"most {MOST_JOINTS} are analysed"
        )
    by_name = {
        key: {name: signals.signal(name) for name in signals.names}
        for key, signals in recorded.items()
    }
    _leave_out_pauses(by_name, response_topic, session.start_ns, warn)
    absent: dict[str, Signal] = {}
    return Columns(
        names=tuple(seen) if session.robot is not None else by_number(tuple(seen), warn),
        **{key: by_name.get(key, absent) for key in QUANTITIES},
        powers={topic: by_name.get(topic, absent) for topic in PowerTopic},
        topics={key: sources[key][0] for key in recorded},
        excitation=by_name.get("excitation", absent),
    )


def by_number(names: tuple[str, ...], warn: Warn) -> tuple[str, ...]:
    """Return joints in the order of their numbers, where the file has them sorted as text.

    As text ``joint_10`` comes before ``joint_2``, and no wave runs along such a chain.
    """
    ordered = tuple(sorted(names, key=_parts))
    if names == ordered or list(names) != sorted(names):
        return names
    warn(Note(f"joints are taken in the order of their numbers: {some_names(ordered, NAMED)}"))
    return ordered


def _parts(name: str) -> tuple[tuple[str, int], ...]:
    """Return a name's letters, each with the number that follows."""
    parts = re.findall(r"(\D*)(\d*)", name)
    return tuple((letters, int(digits or -1)) for letters, digits in parts)


def _leave_out_pauses(
    by_name: dict[str, dict[str, Signal]], topic: str, start_ns: int, warn: Warn
) -> None:
    """Leave out of the measured quantities what a driver repeats while its bus is silent."""
    measured = [key for key in ("position", "velocity", "effort") if key in by_name]
    if "position" not in measured:
        return
    commands = by_name.get("command", {})
    pauses_ns, thinned = without_pauses(commands, *(by_name[key] for key in measured))
    if not len(pauses_ns):
        return
    by_name.update(zip(measured, thinned, strict=True))
    lasted_s = (pauses_ns[:, 1] - pauses_ns[:, 0]) / NS
    longest = int(lasted_s.argmax())
    since_s = (int(pauses_ns[longest, 0]) - start_ns) / NS
    pauses = "1 pause" if len(pauses_ns) == 1 else f"{len(pauses_ns)} pauses"
    warn(
        f"{topic}: all joints repeat their values together for {lasted_s.sum():.3g} s, in {pauses} "
        f"(the longest from {since_s:.3g} s on): the bus or its driver paused; left out"
    )


def drag_ratio(session: SessionView) -> float:
    """Return c_n / c_t for the viscous null: of the twin's ground, else the default."""
    stated = None if session.run is None else session.run.drag_ratio
    return DRAG_RATIO if stated is None else stated


def planes_of(robot: Robot | None) -> dict[str, str]:
    """Return ``horizontal`` or ``vertical`` by joint name; empty without a robot description."""
    return {} if robot is None else {joint.name: joint.plane.value for joint in robot.joints}


def by_plane(robot: Robot | None, names: Iterable[str]) -> dict[str, list[str]]:
    """Return names by plane, in their order; all under ``chain`` without a robot description."""
    planes = planes_of(robot)
    result: dict[str, list[str]] = {}
    for name in names:
        result.setdefault(planes.get(name, "chain"), []).append(name)
    return result


def _read(session: SessionView, sources: Mapping[str, tuple[str, str]]) -> dict[str, JointSignals]:
    """All in one pass if all are there; else one by one, leaving out what is empty."""
    topics: dict[str, list[str]] = {topic: [] for topic, _ in sources.values()}
    for topic, kind in dict.fromkeys(sources.values()):
        topics[topic].append(kind)
    try:
        signals = session.joint_columns(topics)
        return {key: signals[source] for key, source in sources.items()}
    except MissingChannelError:
        some: dict[str, JointSignals] = {}
        for key, (topic, kind) in sources.items():
            try:
                some[key] = session.joints(topic, kind)
            except MissingChannelError:
                continue
        return some


def _check_robots(session: SessionView, topics: JointTopics) -> None:
    """Raise DataError if it isn't known which of several robots is meant."""
    if topics.robots:
        choices = (
            f"--command-topic {first} --response-topic {second}" for first, second in topics.robots
        )
        raise DataError(
            f"{session.path.name}: {len(topics.robots)} robots with joints of the same names; "
            f"choose one: {', or '.join(choices)}"
        )


def _check_nodes(session: SessionView, signals: Mapping[str, JointSignals]) -> None:
    """Raise DataError if commands or positions come from two nodes."""
    for key in ("command", "position"):
        if key in signals and are_of_two_nodes(signals[key].values):
            why = f"{in_turn(signals[key].topic)}; record one of them alone"
            raise DataError(f"{session.path.name}: {why}")


def _check_voltage(session: SessionView, signals: dict[str, JointSignals], warn: Warn) -> None:
    """E_el needs the voltage at the motor: a bridge's duty times the supply, not the supply."""
    both = {"current": CURRENT_TOPIC, "voltage": VOLTAGE_TOPIC}
    lacking = [topic for key, topic in both.items() if key not in signals]
    accumulated = PowerTopic.ELECTRICAL in signals and PowerTopic.ELECTRICAL_PLUS in signals
    if lacking:
        if not accumulated:
            warn(Note(f"no {' and no '.join(lacking)}: electrical energies are null"))
        signals.pop("current", None)
        return
    if not accumulated and "scenario" not in session.metadata.get("undulog", {}):
        taken = f"{VOLTAGE_TOPIC} is taken as the voltage at the motor"
        warn(Note(f"{taken}: if it is the supply's, E_el is too large"))
