"""Which topics of a log hold commands and responses: by name, else by the types of messages.

The topics of the log contract come first. In a log without them the type decides, and where that
leaves a choice the words of the topic's name; what was taken is reported.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from ...common.errors import DataError, JointSetError, MissingChannelError, some_names
from ..columns.names import distinct_names
from ..messages import COMMAND_TOPIC, RESPONSE_TOPIC
from ..messages.cdr import Layout, layout_of
from ..messages.definitions import (
    CONTROLLER_STATE,
    DYNAMIC_STATE,
    FLOAT_ARRAYS,
    JOINT_STATE,
    TRAJECTORY,
    PowerTopic,
)
from .joint_messages import (
    COMMAND_PARTS,
    INTERFACE_UNITS,
    JOINT_TYPES,
    STATE_PARTS,
    UNITS,
    interfaces,
    is_of_joints,
    joint_source,
)

if TYPE_CHECKING:
    from ..columns.topics import Topics

_LOOKED_AT = 2000
"""Messages of a topic; one with a message a joint names all its joints in them."""

_MOST_TOPICS = 2000
"""Topics of joints; of each the first message is decoded."""

_MOST_LISTED = 12

CONTRACT_TOPICS = frozenset(
    {
        *("/joint_sample_offset", "/joint_command_offset", "/joint_velocity", "/joint_effort"),
        *("/joint_current", "/joint_voltage", "/joint_temperature", "/gait", "/gate/wanted"),
        *("/energy_ledger", *PowerTopic),
    }
)
"""JointStates of the log contract that are neither commands nor positions."""

_COMMAND_WORDS = {"command", "commands", "cmd", "cmds", "target", "targets", "desired", "goal"} | {
    *("goals", "reference", "references", "setpoint", "setpoints", "action", "actions")
}
_NO_ANGLES = {"velocity", "velocities", "effort", "efforts", "torque", "torques", "current"}
_FEW_LISTED = 8

HOW_TO_CHOOSE = "choose with --command-topic and --response-topic"
_NO_QUANTITIES: Mapping[str, str] = MappingProxyType({})

_UNNAMED = 3
"""Rank of a JointState whose name says nothing: taken if it is the only one."""


def joint_names(topics: Topics) -> dict[str, tuple[str, ...]]:
    """Return the joints of each topic that names some, in the order in which they appear.

    Raises:
        DataError: If the log has more topics of joints than any robot.
    """
    decoders: dict[str, Callable[[bytes], Any]] = {}
    for topic in _of_joints(topics):
        with suppress(DataError):  # a damaged schema: reported where the topic is read
            decoders[topic] = topics.decoder(topic)
    joints: dict[str, dict[str, None]] = {topic: {} for topic in decoders}
    looked_at, pending = Counter[str](), set(decoders)
    for topic, message in topics.raw_of(pending):
        looked_at[topic] += 1
        try:
            carried = _joints(decoders[topic](message))
        except DataError:  # a damaged message: likewise
            joints[topic], carried = {}, []
            pending.discard(topic)
        joints[topic] |= dict.fromkeys(carried)
        if len(carried) > 1 or looked_at[topic] == _LOOKED_AT:  # all joints in one message
            pending.discard(topic)
    return {topic: tuple(names) for topic, names in joints.items() if names}


def _of_joints(topics: Topics) -> list[str]:
    """Return the topics whose type is one of joints.

    Raises:
        DataError: If there are more than of any robot.
    """
    names = [
        topic
        for topic, channel in topics.channels.items()
        if channel.type_name in JOINT_TYPES and channel.is_ros2
    ]
    if len(names) > _MOST_TOPICS:
        raise DataError(
            f"{topics.path}: {len(names)} topics of joints, over {_MOST_TOPICS}; "
            "take out some of them: undulog log cut --topics"
        )
    return names


def _joints(message: Any) -> list[str]:
    """Return the joints of a message; of a DynamicJointState those with a position."""
    if hasattr(message, "interface_values"):
        names = distinct_names(message.joint_names)
        pairs = zip(names, message.interface_values, strict=False)
        return [name for name, entry in pairs if "position" in entry.interface_names]
    return list(
        distinct_names(getattr(message, "joint_names", None) or getattr(message, "name", ()))
    )


def check_joints(path: Path, topics: Topics, joints: Sequence[str], robot: str) -> None:
    """Hold the joints of a log to those of a robot that is to describe it.

    Raises:
        JointSetError: If they are not the same; names those that only one of them has.
    """
    every: Mapping[str, tuple[str, ...]] = joint_names(topics)
    expected = set(joints)
    shared = {topic: names for topic, names in every.items() if not expected.isdisjoint(names)}
    if not shared:
        has = "; ".join(
            f"{topic} has {some_names(names, _MOST_LISTED)}" for topic, names in every.items()
        )
        raise JointSetError(
            f"{path}: none of its joints is of {robot}, which has "
            f"{some_names(joints, _MOST_LISTED)}; {has or 'it has no topic of joints'}"
        )
    logged = dict.fromkeys(name for names in shared.values() for name in names)
    strange = [name for name in logged if name not in expected]
    missing = [name for name in joints if name not in logged]
    if strange or missing:
        faults = [
            f"{what} {some_names(names, _MOST_LISTED)}"
            for what, names in (("lacks", strange), ("has, but not the log,", missing))
            if names
        ]
        raise JointSetError(
            f"{path}: its joints are not those of {robot}: the description {', and '.join(faults)}"
            " (undulog robot new --from writes one for a log)"
        )


@dataclass(frozen=True)
class JointTopics:
    """Where the joints of a log are, as :meth:`.SessionView.joints` takes the names.

    Attributes:
        command: The commands; the name that was looked for if the log has none.
        response: The responses, likewise.
        quantities: Topic of the log contract that the log lacks, such as ``/joint_current``, to
            where the values are.
        others: Other names that could be commands or responses.
        notes: What was found by its type, and interfaces that have no topic in the log contract.
        unnamed: Why arrays that could be the commands are none, where no other topic is.
        robots: Commands and responses of each of several robots with joints of the same names;
            none of them is taken.
    """

    command: str = COMMAND_TOPIC
    response: str = RESPONSE_TOPIC
    quantities: Mapping[str, str] = field(default_factory=lambda: _NO_QUANTITIES)
    others: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    unnamed: tuple[str, ...] = ()
    robots: tuple[tuple[str, str], ...] = ()

    @property
    def renamed(self) -> dict[str, str]:
        """Topic of the log contract to the name in the log, where they differ."""
        names = {COMMAND_TOPIC: self.command, RESPONSE_TOPIC: self.response, **self.quantities}
        return {topic: name for topic, name in names.items() if topic != name}


@dataclass(frozen=True)
class _Candidate:
    """A name that could be commands or responses; a lower rank is better."""

    name: str
    topic: str
    rank: int
    count: int
    joints: tuple[str, ...]


def _robots(
    commands: Sequence[_Candidate], responses: Sequence[_Candidate]
) -> tuple[tuple[str, str], ...]:
    """Return the topics of each of several robots: of one namespace, with joints that others have.

    Empty for one robot, and for several whose joints differ: their names part them.
    """
    pairs: dict[str, tuple[_Candidate, _Candidate]] = {}
    for command in commands:
        space = command.topic.rpartition("/")[0]
        of_it = (response for response in responses if response.topic.rpartition("/")[0] == space)
        state = next((candidate for candidate in of_it if candidate.topic != command.topic), None)
        if state is not None and {*command.joints} & {*state.joints}:
            pairs.setdefault(space, (command, state))
    every = Counter(name for _, state in pairs.values() for name in {*state.joints})
    if max(every.values(), default=0) < 2:
        return ()
    return tuple(sorted((command.name, state.name) for command, state in pairs.values()))


def _sorted(candidates: Iterable[_Candidate], without: str) -> list[_Candidate]:
    kept = (candidate for candidate in candidates if candidate.name != without)
    return sorted(kept, key=lambda candidate: (candidate.rank, -candidate.count, candidate.name))


class JointTopicFinder:
    """Finds the commands and responses of one log."""

    def __init__(self, path: Path, topics: Topics, joints: Sequence[str] = ()) -> None:
        """Set up.

        Args:
            joints: Of the robot, in chain order; none if it is unknown.
        """
        self._path, self._topics, self._joints = path, topics, tuple(joints)
        self._first: dict[str, bytes] | None = None
        self._named_after: dict[str, str] = {}

    @cached_property
    def _every(self) -> dict[str, tuple[str, ...]]:
        """The joints of each topic that names some."""
        return joint_names(self._topics)

    def find(self, command: str = COMMAND_TOPIC, response: str = RESPONSE_TOPIC) -> JointTopics:
        """Find commands and responses.

        Args:
            command: Topic of the commands, ``TOPIC.PART`` or ``TOPIC:JOINT,JOINT``; that of the log
                contract also stands for one that is found by its type.
            response: That of the responses, likewise.

        Raises:
            MissingChannelError: If a topic that was chosen is not there.
            DataError: If an array was chosen whose joints are unknown, or the log has more topics
                of joints than any robot.
        """
        channels = self._topics.channels
        named = {command: COMMAND_TOPIC, response: RESPONSE_TOPIC}
        search = [usual for name, usual in named.items() if name == usual and name not in channels]
        command = self._part(command, COMMAND_PARTS) if command != COMMAND_TOPIC else command
        response = self._part(response, STATE_PARTS) if response != RESPONSE_TOPIC else response
        quantities, notes = self._quantities()
        if not search:
            notes = (*self._order_notes(command, response), *notes)
            return JointTopics(command, response, quantities, notes=notes)
        every = self._every
        commands = _sorted(self._commands(every), response)
        responses = _sorted(self._responses(every), command)
        taken: dict[str, str] = {}
        robots = _robots(commands, responses)
        if len(search) > 1 and robots:
            return JointTopics(quantities=quantities, notes=notes, robots=robots)
        response_joints = every.get(response, ())
        if COMMAND_TOPIC in search and commands:
            # Of several controllers one that has joints of the responses, of several robots theirs.
            best = min(
                commands,
                key=lambda candidate: (
                    response_joints and not {*candidate.joints} & {*response_joints},
                    candidate.rank,
                    (candidate.name, response) not in robots,
                ),
            )
            command = taken["commands"] = best.name
        if RESPONSE_TOPIC in search and responses:
            source = joint_source(command, channels)
            command_topic = "" if source is None else source.topic
            best = min(
                responses,
                key=lambda candidate: (
                    candidate.rank,
                    candidate.topic != command_topic,
                    (command, candidate.name) not in robots,
                ),
            )
            unnamed = sum(response.rank == _UNNAMED for response in responses)
            if best.rank < _UNNAMED or unnamed == 1:
                response = taken["positions"] = best.name
        if set(every.get(response, ())).isdisjoint(self._names_of(command, every)):
            # Joints of another part of the robot: a controller has its own states beside them.
            source = joint_source(command, channels)
            beside = [
                response
                for response in responses
                if source is not None and response.topic == source.topic
            ]
            if beside and response == RESPONSE_TOPIC:
                response = taken["positions"] = beside[0].name
        others = [candidate.name for candidate in (*commands, *responses)]
        arrays = [topic for topic, kind, _ in self._joint_topics() if kind in FLOAT_ARRAYS]
        taken_topics = {candidate.topic for candidate in commands if candidate.name == command}
        others += [f"{topic}:JOINT,..." for topic in arrays if topic not in taken_topics]
        others = [name for name in dict.fromkeys(others) if name not in (command, response)]
        notes = (*_notes(taken, others), *self._order_notes(command, response), *notes)
        unnamed = (
            self._unnamed(arrays) if command not in channels and "commands" not in taken else ()
        )
        return JointTopics(command, response, quantities, tuple(others), notes, unnamed)

    def _names_of(self, name: str, every: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
        source = joint_source(name, self._topics.channels)
        return () if source is None else source.joints or every.get(source.topic, ())

    def _part(self, name: str, parts: Sequence[str]) -> str:
        """Return a name that was chosen, with the part or the joints that it leaves open."""
        channels = self._topics.channels
        source = joint_source(name, channels)
        if source is None:
            there = [topic for topic, _, _ in self._joint_topics()] or channels
            raise MissingChannelError(self._path, name, sorted(there), HOW_TO_CHOOSE)
        kind = channels[source.topic].type_name
        if kind == CONTROLLER_STATE and not source.part:
            filled = self._filled(source.topic, parts)
            return f"{name}.{filled[0]}" if filled else name
        if kind in FLOAT_ARRAYS and not source.joints:
            return self._named_array(source.topic)
        return name

    def _named_array(self, topic: str) -> str:
        """Return the name of an array's joints.

        Raises:
            DataError: If neither the robot nor a topic of joint states has so many.
        """
        if joints := self._joints_of(topic):
            return f"{topic}:{','.join(joints)}"
        raise DataError(
            f"{self._path}: {self._lacking_names(topic)} (or --response-topic), or give a robot "
            "that has so many"
        )

    def _lacking_names(self, topic: str) -> str:
        width, joints = self._width(topic), f", the robot {len(self._joints)} joints"
        kind = self._topics.channels[topic].type_name
        return (
            f"{topic}, {kind}, has {width} values without names{joints if self._joints else ''}: "
            f"name its joints in their order, --command-topic {topic}:JOINT,JOINT,..."
        )

    def _joints_of(self, topic: str) -> tuple[str, ...]:
        """Return the joints of an array: the robot's, or those of the states, if as many.

        Names in which a comma would not be one between names are left out.
        """
        width = self._width(topic)
        if width and width == len(self._joints):
            return self._joints
        states = _sorted(self._responses(self._every), topic)
        named = (state for state in states if len(state.joints) == width > 0)
        first = next(
            (state for state in named if not any("," in name for name in state.joints)), None
        )
        if first is None:
            return ()
        self._named_after[topic] = first.name
        return first.joints

    def _order_notes(self, *chosen: str) -> tuple[str, ...]:
        """Say whose joints arrays have that name none."""
        return tuple(
            f"{topic} names no joints: those of {states} are taken in their order (others: "
            f"--command-topic {topic}:JOINT,JOINT,...)"
            for topic, states in self._named_after.items()
            if any(name.startswith(f"{topic}:") for name in chosen)
        )

    def _unnamed(self, arrays: Iterable[str]) -> tuple[str, ...]:
        return tuple(
            self._lacking_names(topic)
            for topic in arrays
            if _of_angles(topic) and self._width(topic) and not self._joints_of(topic)
        )

    def _commands(self, every: Mapping[str, tuple[str, ...]]) -> Iterator[_Candidate]:
        for topic, kind, count in self._joint_topics():
            words, joints = _words(topic), every.get(topic, ())
            if kind == CONTROLLER_STATE:
                for part in self._filled(topic, COMMAND_PARTS)[:1]:
                    yield _Candidate(f"{topic}.{part}", topic, 0, count, joints)
            elif kind in FLOAT_ARRAYS:
                if _of_angles(topic) and (array_joints := self._joints_of(topic)):
                    yield _Candidate(
                        f"{topic}:{','.join(array_joints)}", topic, 3, count, array_joints
                    )
            elif kind == TRAJECTORY:
                yield _Candidate(topic, topic, 2, count, joints)
            elif words & _COMMAND_WORDS:
                yield _Candidate(topic, topic, 1, count, joints)

    def _responses(self, every: Mapping[str, tuple[str, ...]]) -> Iterator[_Candidate]:
        for topic, kind, count in self._joint_topics():
            joints = every.get(topic, ())
            if kind == CONTROLLER_STATE:
                for part in self._filled(topic, STATE_PARTS)[:1]:
                    yield _Candidate(f"{topic}.{part}", topic, 1, count, joints)
            elif kind == DYNAMIC_STATE:
                yield _Candidate(topic, topic, 2, count, joints)
            elif kind == JOINT_STATE and not _words(topic) & _COMMAND_WORDS:
                usual = topic.rsplit("/", 1)[-1] == RESPONSE_TOPIC[1:]
                yield _Candidate(topic, topic, 0 if usual else _UNNAMED, count, joints)

    def _joint_topics(self) -> list[tuple[str, str, int]]:
        """Return topic, type and number of messages of topics that could be either."""
        return [
            (topic, channel.type_name, channel.count)
            for topic, channel in self._topics.channels.items()
            if channel.type_name in JOINT_TYPES and channel.is_ros2 and channel.count
            if topic not in CONTRACT_TOPICS and self._is_readable(topic)
        ]

    def _is_readable(self, topic: str) -> bool:
        try:
            return is_of_joints(self._topics.message_type(topic))
        except DataError:  # a damaged schema: whoever reads the topic reports it
            return False

    def _quantities(self) -> tuple[dict[str, str], tuple[str, ...]]:
        """Return the further quantities that DynamicJointStates have, and notes on the rest."""
        quantities: dict[str, str] = {}
        notes: list[str] = []
        for topic, channel in self._topics.channels.items():
            if channel.type_name != DYNAMIC_STATE or not channel.count:
                continue
            layout = self._first_layout(topic)
            every = interfaces(layout).values() if layout else ()
            carried = dict.fromkeys(name for names in every for name in names)
            for interface in INTERFACE_UNITS:
                usual = f"/joint_{interface}"
                if interface in carried and usual not in self._topics.channels:
                    quantities.setdefault(usual, f"{topic}.{interface}")
            rest = [name for name in carried if name not in UNITS and name not in INTERFACE_UNITS]
            if rest:
                listed = some_names(rest, _FEW_LISTED)
                notes.append(f"{topic} has interfaces that aren't analysed: {listed}")
        return quantities, tuple(notes)

    def _filled(self, topic: str, parts: Sequence[str]) -> list[str]:
        """Return the parts of a controller state that have positions in its first message."""
        layout = self._first_layout(topic)
        return [part for part in parts if layout and f"{part}.positions" in layout.leaves]

    def _width(self, topic: str) -> int:
        """Return the number of values in the first message of an array."""
        layout = self._first_layout(topic)
        leaf = layout.leaves.get("data") if layout else None
        return leaf.count if leaf else 0

    def _first_layout(self, topic: str) -> Layout | None:
        if self._first is None:  # of all topics in one pass
            self._first, pending = {}, set(_of_joints(self._topics))
            for name, message in self._topics.raw_of(pending):
                pending.discard(name)
                self._first[name] = message
        try:
            first = self._first.get(topic)
            return None if first is None else layout_of(self._topics.message_type(topic), first)
        except DataError:  # whoever reads the topic reports it
            return None


def _of_angles(topic: str) -> bool:
    """Whether the words of a topic's name are of commanded angles."""
    words = _words(topic)
    return bool(words & _COMMAND_WORDS) and not words & _NO_ANGLES


def _words(topic: str) -> set[str]:
    return {*re.split(r"[^a-z]+", topic.lower())}


def _notes(taken: Mapping[str, str], others: Sequence[str]) -> tuple[str, ...]:
    if not taken:
        return ()
    sentence = " and ".join(f"{kind} on {name}" for kind, name in taken.items())
    rest = f"; other joints: {some_names(others, _FEW_LISTED)}" if others else ""
    return (f"{sentence}, found by type{rest} ({HOW_TO_CHOOSE})",)
