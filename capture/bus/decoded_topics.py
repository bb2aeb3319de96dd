"""Decoded bus samples onto the topics of the log contract, each at its own time.

``/joint_states`` holds the positions, with velocity and effort where they come in the same frames.
A velocity or effort that comes in frames of its own, as in the replies of RMD motors, has its own
times and goes to ``/joint_velocity`` or ``/joint_effort``: putting it beside a position would make
one of the two up.

Joints that are sampled in turn share a message a round; their own times are logged beside it, as
sample time minus stamp, on the topic's offset topic.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..log.write.channels import (
    ImuChannel,
    JointStateChannel,
    MagneticFieldChannel,
    RangeChannel,
)
from ..log.write.writer import SessionWriter, open_sensor
from ..robot.bus_map import SESSION_UNIT
from ..robot.model import BusSignal, Quantity, Robot, Sensor, SensorKind
from .decoding import DecodedSignals, Decoder
from .rounds import RoundGatherer, Rounds

_SAMPLE_OFFSET_TOPIC = "/joint_sample_offset"  # sample time minus stamp of measurements [s]
_COMMAND_OFFSET_TOPIC = "/joint_command_offset"  # send time minus stamp of commands [s]

JOINT_TOPIC: dict[Quantity, str] = {
    Quantity.COMMAND: "/joint_commands",
    Quantity.POSITION: "/joint_states",
    Quantity.VELOCITY: "/joint_velocity",
    Quantity.EFFORT: "/joint_effort",
    Quantity.CURRENT: "/joint_current",
    Quantity.VOLTAGE: "/joint_voltage",
    Quantity.TEMPERATURE: "/joint_temperature",
}
"""Topic of each quantity of a joint when it has frames or rows of its own."""

_BESIDE_POSITION = (Quantity.VELOCITY, Quantity.EFFORT)
_SCALAR = (SensorKind.IR, SensorKind.SONAR)
_STAMPS_KEPT = 10_000


@dataclass(frozen=True)
class TopicMessages:
    """Messages of one topic that are ready to be written.

    Attributes:
        sampled_ns: Time of the last sample of each [Unix ns], shape (n,).
        t_ns: Sampling time of each, its stamp [Unix ns], shape (n,).
        values: Shape (n, ...).
        write_rows: Writes them: times, values, log times [Unix ns].
    """

    topic: str
    sampled_ns: IntArray
    t_ns: IntArray
    values: FloatArray
    write_rows: Callable[[IntArray, FloatArray, IntArray], None]

    def __len__(self) -> int:
        """Return the number of messages n."""
        return len(self.t_ns)

    def part(self, which: slice | IntArray) -> TopicMessages:
        """Return some of the messages."""
        sampled_ns, t_ns, values = self.sampled_ns[which], self.t_ns[which], self.values[which]
        return replace(self, sampled_ns=sampled_ns, t_ns=t_ns, values=values)

    def write(self, log_ns: IntArray) -> None:
        """Write them.

        Args:
            log_ns: When each is recorded [Unix ns], shape (n,).
        """
        self.write_rows(self.t_ns, self.values, log_ns)


class DecodedTopics:
    """Turns decoded signals into messages, block by block."""

    def __init__(self, writer: SessionWriter, robot: Robot, decoder: Decoder) -> None:
        """Plan the topics; each is opened when its first sample comes."""
        joints = robot.joint_names
        sampled = _OffsetTopic(writer, _SAMPLE_OFFSET_TOPIC, joints)
        commanded = _OffsetTopic(writer, _COMMAND_OFFSET_TOPIC, joints)
        self._groups: list[_JointGroup] = []
        for topics in _groups_of(decoder, joints):
            offsets = commanded if topics[0][0] is Quantity.COMMAND else sampled
            self._groups.append(_JointGroup(writer, joints, topics, offsets))
        self._sensors = [_SensorTopic(writer, sensor) for sensor in robot.sensors]
        self._sensor_targets = _Targets([sensor.name for sensor in robot.sensors])

    def add(self, samples: Sequence[DecodedSignals]) -> list[TopicMessages]:
        """Take the samples of one block of frames.

        Returns:
            The messages that are complete now; sample times of joints ahead of their samples, so
            that none is left without its time if writing ends between them.
        """
        messages: list[TopicMessages] = []
        for group in self._groups:
            messages += group.add(samples)
        pieces: dict[int, list[_Piece]] = {}
        for decoded in samples:
            index = self._sensor_targets.index(decoded.signals)
            for member in self._sensor_targets.members(decoded.signals):
                selected = decoded.member == member
                column = "xyz".index(decoded.signals[0].axis or "x")
                piece = (
                    column,
                    decoded.rows[selected],
                    decoded.t_ns[selected],
                    decoded.values[selected],
                )
                pieces.setdefault(int(index[member]), []).append(piece)
        for sensor, own_pieces in pieces.items():
            messages += self._sensors[sensor].messages(own_pieces)
        return messages

    def finish(self) -> list[TopicMessages]:
        """Return the messages that waited for more samples."""
        return [message for group in self._groups for message in group.finish()]

    def forget(self) -> None:
        """Drop the samples that wait for more, after a failure."""
        for group in self._groups:
            group.forget()


_Block: TypeAlias = tuple[IntArray, IntArray, IntArray, FloatArray]
"""Samples of joints: rows, times [Unix ns], joints, values."""

_Piece: TypeAlias = tuple[int, IntArray, IntArray, FloatArray]
"""Samples of one axis of a sensor: column, rows, times [Unix ns], values."""


class _Targets:
    """Index of some targets, joints or sensors, by the members of decoded signals."""

    def __init__(self, targets: Sequence[str]) -> None:
        self._index = {target: k for k, target in enumerate(targets)}
        self._cache: dict[int, tuple[tuple[BusSignal, ...], IntArray, list[int]]] = {}

    def members(self, signals: tuple[BusSignal, ...]) -> list[int]:
        """Return the members whose target is one of these."""
        return self._of(signals)[2]

    def index(self, signals: tuple[BusSignal, ...]) -> IntArray:
        """Return the index of each member's target, -1 for others."""
        return self._of(signals)[1]

    def _of(
        self, signals: tuple[BusSignal, ...]
    ) -> tuple[tuple[BusSignal, ...], IntArray, list[int]]:
        entry = self._cache.get(id(signals))  # kept with its key, so that the id stays its own
        if entry is None:
            index = np.array([self._index.get(s.target, -1) for s in signals], dtype=np.int64)
            entry = self._cache[id(signals)] = (signals, index, np.flatnonzero(index >= 0).tolist())
        return entry


class _OffsetTopic:
    """An offset topic, shared by the topics whose samples it times."""

    def __init__(self, writer: SessionWriter, topic: str, joints: tuple[str, ...]) -> None:
        self._writer, self._topic, self._joints = writer, topic, joints
        self._channel: JointStateChannel | None = None
        self._written: OrderedDict[int, bytes] = OrderedDict()

    def place(self, rounds: Rounds) -> tuple[IntArray, list[TopicMessages]]:
        """Return a stamp for each round, and the offset messages that were not written before.

        Rounds of several topics that come in the same frames share a stamp and its offsets. A
        stamp that stands for other offsets is left to them: this round gets one that is earlier
        by nanoseconds (later at the begin of 1970, as none is negative), and its offsets grow by as
        much, so that no sample moves.
        """
        if len(self._joints) == 1 or not len(rounds.stamp_ns):
            return rounds.stamp_ns, []
        stamps_ns, fresh, offsets_s = rounds.stamp_ns.tolist(), list[int](), list[FloatArray]()
        for k, offset_s in enumerate(rounds.offset_s):
            stamps_ns[k], fresh_s = self._place(stamps_ns[k], offset_s)
            if fresh_s is not None:
                fresh.append(k)
                offsets_s.append(fresh_s)
        placed_ns = np.array(stamps_ns, dtype=np.int64)
        if not fresh:
            return placed_ns, []
        if self._channel is None:
            self._channel = self._writer.joint_state(self._topic, self._joints, unit="s")
        channel = self._channel

        def write_rows(t_ns: IntArray, values: FloatArray, log_ns: IntArray) -> None:
            none = np.empty((len(t_ns), 0))
            channel.write_rows(t_ns, values, none, none, log_time_ns=log_ns)

        sampled_ns, values = rounds.last_ns[fresh], np.array(offsets_s)
        messages = TopicMessages(self._topic, sampled_ns, placed_ns[fresh], values, write_rows)
        return placed_ns, [messages]

    def _place(self, stamp_ns: int, offset_s: FloatArray) -> tuple[int, FloatArray | None]:
        """Return a round's stamp, and its offsets unless they are written."""
        step_ns = -1 if stamp_ns > _STAMPS_KEPT else 1
        while (written := self._written.get(stamp_ns)) is not None:
            if written == offset_s.tobytes():
                return stamp_ns, None
            stamp_ns += step_ns
            offset_s = offset_s - step_ns * 1e-9
        self._written[stamp_ns] = offset_s.tobytes()
        if len(self._written) > _STAMPS_KEPT:
            self._written.popitem(last=False)
        return stamp_ns, offset_s

    def forget(self) -> None:
        """Write all further offsets: the messages of the last call may be lost."""
        self._written.clear()


class _JointGroup:
    """JointState topics whose samples come in the same frames, hence in the same rounds."""

    def __init__(
        self,
        writer: SessionWriter,
        joints: tuple[str, ...],
        topics: Sequence[tuple[Quantity, ...]],
        offsets: _OffsetTopic,
    ) -> None:
        self._joints, self._offsets = joints, offsets
        self._targets = _Targets(joints)
        self._columns = [quantity for topic in topics for quantity in topic]
        self._gatherer = RoundGatherer(len(joints), len(self._columns))
        self._topics: list[_JointTopic] = []
        for quantities in topics:
            first = self._columns.index(quantities[0])
            columns = slice(first, first + len(quantities))
            self._topics.append(_JointTopic(writer, joints, quantities, columns))

    def add(self, samples: Sequence[DecodedSignals]) -> list[TopicMessages]:
        blocks = self._blocks(samples)
        if not blocks:
            return []
        if len(blocks) > 1:
            blocks = [self._together(blocks)]
        return self._messages(self._gatherer.add(*blocks[0][1:]))

    def finish(self) -> list[TopicMessages]:
        return self._messages(self._gatherer.finish())

    def forget(self) -> None:
        self._gatherer.forget()
        self._offsets.forget()

    def _blocks(self, samples: Sequence[DecodedSignals]) -> list[_Block]:
        """Return rows, times, joints, values; signals of the same frames side by side."""
        blocks: dict[int, _Block] = {}
        for decoded in samples:
            quantity = decoded.signals[0].quantity
            if quantity not in self._columns or not self._targets.members(decoded.signals):
                continue
            block = blocks.get(id(decoded.rows))
            joint = self._targets.index(decoded.signals)[decoded.member]
            if block is None or (block[2] != joint).any():
                values = np.full((len(joint), len(self._columns)), np.nan)
                block = (decoded.rows, decoded.t_ns, joint, values)
                key = id(decoded.rows) if id(decoded.rows) not in blocks else -len(blocks) - 1
                blocks[key] = block
            block[3][:, self._columns.index(quantity)] = decoded.values
        kept = [block for block in blocks.values() if (block[2] >= 0).all()]
        mixed = [block for block in blocks.values() if (block[2] < 0).any()]
        for rows, t_ns, joint, values in mixed:
            present = joint >= 0
            kept.append((rows[present], t_ns[present], joint[present], values[present]))
        return kept

    def _together(self, blocks: Sequence[_Block]) -> _Block:
        """Join blocks; samples of one joint in one frame share a row."""
        rows = np.concatenate([block[0] for block in blocks])
        t_ns = np.concatenate([block[1] for block in blocks])
        joint = np.concatenate([block[2] for block in blocks])
        values = np.concatenate([block[3] for block in blocks])
        keys, place = np.unique(rows * len(self._joints) + joint, return_inverse=True)
        merged = np.full((len(keys), values.shape[1]), np.nan)
        for column in range(values.shape[1]):
            present = ~np.isnan(values[:, column])
            merged[place[present], column] = values[present, column]
        merged_t = np.empty(len(keys), dtype=np.int64)
        merged_t[place] = t_ns
        return keys // len(self._joints), merged_t, keys % len(self._joints), merged

    def _messages(self, rounds: Rounds) -> list[TopicMessages]:
        stamp_ns, messages = self._offsets.place(rounds)
        for topic in self._topics:
            messages += topic.messages(stamp_ns, rounds)
        return messages


class _JointTopic:
    """One JointState topic: some columns of a group."""

    def __init__(
        self,
        writer: SessionWriter,
        joints: tuple[str, ...],
        quantities: tuple[Quantity, ...],
        columns: slice,
    ) -> None:
        self._writer, self._joints = writer, joints
        self._quantities, self._columns = quantities, columns
        self._channel: JointStateChannel | None = None

    def messages(self, stamp_ns: IntArray, rounds: Rounds) -> list[TopicMessages]:
        """The messages of the rounds that have anything of this topic."""
        values = rounds.values[:, :, self._columns]
        present = ~np.isnan(values).all(axis=(1, 2))
        if not present.any():
            return []
        first, rest = self._quantities[0], self._quantities[1:]
        if self._channel is None:
            self._channel = self._writer.joint_state(
                JOINT_TOPIC[first],
                self._joints,
                unit=SESSION_UNIT[first],
                velocity=Quantity.VELOCITY in rest,
                effort=Quantity.EFFORT in rest,
            )
        channel = self._channel
        column = {quantity: k for k, quantity in enumerate(self._quantities)}

        def write_rows(t_ns: IntArray, values: FloatArray, log_ns: IntArray) -> None:
            none = np.empty((len(t_ns), 0))
            velocity, effort = (
                values[:, :, column[quantity]] if quantity in rest else none
                for quantity in _BESIDE_POSITION
            )
            channel.write_rows(t_ns, values[:, :, 0], velocity, effort, log_time_ns=log_ns)

        filled = stamp_ns[present], values[present]
        return [TopicMessages(JOINT_TOPIC[first], rounds.last_ns[present], *filled, write_rows)]


def _groups_of(decoder: Decoder, joints: tuple[str, ...]) -> list[list[tuple[Quantity, ...]]]:
    """Return the JointState topics, as their quantities, grouped by the frames that bring them.

    Position comes first where velocity or effort come with it.
    """
    groups: list[list[tuple[Quantity, ...]]] = []
    for topic in _topics_of(decoder, joints):
        for group in groups:
            if _comes_with(decoder, joints, topic[0], group[0][0]):
                group.append(topic)
                break
        else:
            if any(decoder.carriers(joint, topic[0]) for joint in joints):
                groups.append([topic])
    return groups


def _topics_of(decoder: Decoder, joints: tuple[str, ...]) -> list[tuple[Quantity, ...]]:
    """Return the quantities of each JointState topic; position first where others come with it."""
    with_position = [
        quantity
        for quantity in _BESIDE_POSITION
        if _comes_with(decoder, joints, quantity, Quantity.POSITION)
    ]
    alone = [quantity for quantity in JOINT_TOPIC if quantity not in with_position]
    return [
        (quantity, *with_position) if quantity is Quantity.POSITION else (quantity,)
        for quantity in alone
    ]


def _comes_with(
    decoder: Decoder, joints: tuple[str, ...], quantity: Quantity, other: Quantity
) -> bool:
    """Return whether every joint that has the quantity has it in the frames of the other one."""
    by_joint = [(joint, decoder.carriers(joint, quantity)) for joint in joints]
    return any(carriers for _, carriers in by_joint) and all(
        not carriers or carriers == decoder.carriers(joint, other) for joint, carriers in by_joint
    )


class _SensorTopic:
    """The topic of one sensor."""

    def __init__(self, writer: SessionWriter, sensor: Sensor) -> None:
        self._writer, self._sensor = writer, sensor
        self._channel: ImuChannel | MagneticFieldChannel | RangeChannel | None = None

    def messages(self, pieces: Sequence[_Piece]) -> list[TopicMessages]:
        """Join the values of each frame into one message."""
        if not any(len(rows) for _, rows, _, _ in pieces):
            return []
        if self._channel is None:
            self._channel = open_sensor(self._writer, self._sensor)
        if len(pieces) == 1 and self._sensor.kind in _SCALAR:
            _, _, t_ns, row = pieces[0]
            values = row[:, None]
        else:
            t_ns, values = _side_by_side(pieces)
        present = ~np.isnan(values).all(axis=1)  # a frame of several sensors may be of the others
        t_ns = t_ns[present]
        topic, write_rows = self._sensor.topic, self._channel.write_rows
        return [TopicMessages(topic, t_ns, t_ns, values[present], write_rows)]


def _side_by_side(pieces: Sequence[_Piece]) -> tuple[IntArray, FloatArray]:
    """Times [Unix ns], shape (n,), and values, NaN where missing, shape (n, 3), one row a frame."""
    first = pieces[0][1]
    shared = all(np.array_equal(rows, first) for _, rows, _, _ in pieces[1:])
    rows = first if shared else np.unique(np.concatenate([rows for _, rows, _, _ in pieces]))
    t_ns = np.empty(len(rows), dtype=np.int64)
    values = np.full((len(rows), 3), np.nan)
    for column, own_rows, own_t, own_values in pieces:
        at = slice(None) if shared else np.searchsorted(rows, own_rows)
        t_ns[at] = own_t
        values[at, column] = own_values
    return t_ns, values
