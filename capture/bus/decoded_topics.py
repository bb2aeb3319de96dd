"""Decoded bus samples onto the topics of the log contract, each at its own time.

``/joint_states`` holds the positions, with velocity and effort where they come in the same frames.
A velocity or effort that comes in frames of its own, as in the replies of RMD motors, has its own
times and goes to ``/joint_velocity`` or ``/joint_effort``: putting it beside a position would make
one of the two up.

Joints that are sampled in turn share a message a round (:mod:`capture.bus.cycles`); their own
times are logged beside it, as sample time minus stamp, on the topic's offset topic.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, IntArray
from ..log.channels import JointStateChannel
from ..log.writer import SessionWriter
from ..robot import Quantity, Robot, Sensor, SensorKind
from ..units import SESSION_UNIT
from .cycles import RoundGatherer, Rounds
from .decoding import BusDecoder, DecodedSignal

SAMPLE_OFFSET_TOPIC = "/joint_sample_offset"
"""Sample time minus stamp of what the joints measure [s]."""

COMMAND_OFFSET_TOPIC = "/joint_command_offset"
"""Send time minus stamp of what the joints were told [s]."""

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
_STAMPS_KEPT = 10_000
_NS = 1_000_000_000


@dataclass(frozen=True)
class Message:
    """A message that is ready to be written.

    Attributes:
        topic: Where it goes.
        log_ns: Its log time [Unix ns].
        write: Writes it.
    """

    topic: str
    log_ns: int
    write: Callable[[], None]


class DecodedTopics:
    """Turns decoded signals into messages, block by block."""

    def __init__(self, writer: SessionWriter, robot: Robot, decoder: BusDecoder) -> None:
        """Plan the topics; each is opened when its first sample comes.

        Args:
            writer: The session.
            robot: The robot.
            decoder: Its compiled bus.
        """
        self._writer = writer
        self._sensors = {sensor.name: sensor for sensor in robot.sensors}
        self._joints = robot.joint_names
        self._offsets = {
            topic: _OffsetTopic(writer, topic, self._joints)
            for topic in (SAMPLE_OFFSET_TOPIC, COMMAND_OFFSET_TOPIC)
        }
        self._topics = [
            self._joint_topic(quantities) for quantities in _topics_of(decoder, self._joints)
        ]
        self._sensor_writers: dict[str, Callable[[int, FloatArray], None]] = {}

    def add(self, samples: Sequence[DecodedSignal]) -> list[Message]:
        """Take the samples of one block of frames.

        Args:
            samples: As :meth:`capture.bus.decoding.BusDecoder.decode` gives them.

        Returns:
            The messages that are complete now, in no order.
        """
        messages: list[Message] = []
        for topic in self._topics:
            messages += topic.add(samples)
        for sensor in self._sensors.values():
            own = [sample for sample in samples if sample.signal.target == sensor.name]
            if own:
                messages += self._sensor_messages(sensor, own)
        return messages

    def finish(self) -> list[Message]:
        """The messages that waited for more samples."""
        return [message for topic in self._topics for message in topic.finish()]

    def _joint_topic(self, quantities: tuple[Quantity, ...]) -> _JointTopic:
        is_command = quantities[0] is Quantity.COMMAND
        offsets = self._offsets[COMMAND_OFFSET_TOPIC if is_command else SAMPLE_OFFSET_TOPIC]
        return _JointTopic(self._writer, self._joints, quantities, offsets)

    def _sensor_messages(self, sensor: Sensor, samples: list[DecodedSignal]) -> list[Message]:
        if sensor.name not in self._sensor_writers:
            self._sensor_writers[sensor.name] = _open_sensor(self._writer, sensor)
        write = self._sensor_writers[sensor.name]
        columns = ["xyz".index(sample.signal.axis or "x") for sample in samples]
        t_ns, values = _side_by_side(samples, columns, 3)
        return [
            Message(sensor.topic, t, lambda t=t, row=row: write(t, row))
            for t, row in zip(t_ns.tolist(), values, strict=True)
        ]


class _OffsetTopic:
    """An offset topic, shared by the topics whose samples it times."""

    def __init__(self, writer: SessionWriter, topic: str, joints: tuple[str, ...]) -> None:
        self._writer, self._topic, self._joints = writer, topic, joints
        self._channel: JointStateChannel | None = None
        self._written: OrderedDict[int, bytes] = OrderedDict()

    def place(self, stamp_ns: int, log_ns: int, offset_s: FloatArray) -> tuple[int, list[Message]]:
        """Find a stamp for a round; returns it with the offset message, unless written already.

        Rounds of several topics that come in the same frames share a stamp and its offsets. A
        stamp that stands for other offsets is left to them: this round gets one that is earlier
        by nanoseconds, and its offsets grow by as much, so that no sample moves.
        """
        if len(self._joints) == 1:
            return stamp_ns, []
        while (known := self._written.get(stamp_ns)) is not None:
            if known == offset_s.tobytes():
                return stamp_ns, []
            stamp_ns -= 1
            offset_s = offset_s + 1e-9
        self._written[stamp_ns] = offset_s.tobytes()
        if len(self._written) > _STAMPS_KEPT:
            self._written.popitem(last=False)
        if self._channel is None:
            self._channel = self._writer.joint_state(self._topic, self._joints, unit="s")
        channel = self._channel

        def write() -> None:
            channel.write(stamp_ns, offset_s, log_time_ns=log_ns)

        return stamp_ns, [Message(self._topic, log_ns, write)]


class _JointTopic:
    """One JointState topic."""

    def __init__(
        self,
        writer: SessionWriter,
        joints: tuple[str, ...],
        quantities: tuple[Quantity, ...],
        offsets: _OffsetTopic,
    ) -> None:
        self._writer, self._joints, self._offsets = writer, joints, offsets
        self._quantities = quantities
        self._gatherer = RoundGatherer(len(joints), len(quantities))
        self._channel: JointStateChannel | None = None

    def add(self, samples: Sequence[DecodedSignal]) -> list[Message]:
        t_ns, joint, rows, values = [_NO_TIMES], [_NO_TIMES], [_NO_TIMES], [self._no_values()]
        for j, name in enumerate(self._joints):
            own = [
                sample
                for sample in samples
                if sample.signal.target == name and sample.signal.quantity in self._quantities
            ]
            if own:
                columns = [self._quantities.index(sample.signal.quantity) for sample in own]
                own_t, own_values = _side_by_side(own, columns, len(self._quantities))
                t_ns.append(own_t)
                rows.append(_rows(own))
                joint.append(np.full(len(own_t), j, dtype=np.int64))
                values.append(own_values)
        order = np.argsort(np.concatenate(rows), kind="stable")
        return self._messages(
            self._gatherer.add(
                np.concatenate(t_ns)[order],
                np.concatenate(joint)[order],
                np.concatenate(values)[order],
            )
        )

    def finish(self) -> list[Message]:
        return self._messages(self._gatherer.finish())

    def _no_values(self) -> FloatArray:
        return np.empty((0, len(self._quantities)), dtype=np.float64)

    def _messages(self, rounds: Rounds) -> list[Message]:
        messages: list[Message] = []
        for k in range(len(rounds.stamp_ns)):
            log_ns = int(rounds.last_ns[k])
            stamp_ns, offset_message = self._offsets.place(
                int(rounds.stamp_ns[k]), log_ns, rounds.offset_s[k]
            )
            messages += offset_message
            messages.append(self._message(stamp_ns, log_ns, rounds.values[k]))
        return messages

    def _message(self, stamp_ns: int, log_ns: int, values: FloatArray) -> Message:
        if self._channel is None:
            self._channel = self._writer.joint_state(
                JOINT_TOPIC[self._quantities[0]],
                self._joints,
                unit=SESSION_UNIT[self._quantities[0]],
                velocity=Quantity.VELOCITY in self._quantities[1:],
                effort=Quantity.EFFORT in self._quantities[1:],
            )
        channel = self._channel
        fields = {quantity: values[:, q] for q, quantity in enumerate(self._quantities)}
        first = fields.pop(self._quantities[0])
        velocity = fields.get(Quantity.VELOCITY, ())
        effort = fields.get(Quantity.EFFORT, ())

        def write() -> None:
            channel.write(stamp_ns, first, velocity, effort, log_time_ns=log_ns)

        return Message(JOINT_TOPIC[self._quantities[0]], log_ns, write)


_NO_TIMES: IntArray = np.empty(0, dtype=np.int64)


def _topics_of(decoder: BusDecoder, joints: tuple[str, ...]) -> list[tuple[Quantity, ...]]:
    """The quantities of each JointState topic; position first where others come with it."""
    with_position = [
        quantity
        for quantity in _BESIDE_POSITION
        if all(
            not decoder.carriers(joint, quantity)
            or decoder.carriers(joint, quantity) == decoder.carriers(joint, Quantity.POSITION)
            for joint in joints
        )
        and any(decoder.carriers(joint, quantity) for joint in joints)
    ]
    alone = [quantity for quantity in JOINT_TOPIC if quantity not in with_position]
    return [
        (quantity, *with_position) if quantity is Quantity.POSITION else (quantity,)
        for quantity in alone
    ]


def _rows(samples: Sequence[DecodedSignal]) -> IntArray:
    """Frame rows that carry any of the samples, increasing."""
    return np.unique(np.concatenate([sample.rows for sample in samples]))


def _side_by_side(
    samples: Sequence[DecodedSignal], columns: Iterable[int], width: int
) -> tuple[IntArray, FloatArray]:
    """Samples of one target, those of one frame in one row.

    Args:
        samples: The samples.
        columns: Column of each.
        width: Number of columns.

    Returns:
        Time of each row [Unix ns], shape (n,), and values, NaN where missing, shape (n, width).
    """
    rows = _rows(samples)
    t_ns = np.empty(len(rows), dtype=np.int64)
    values = np.full((len(rows), width), np.nan)
    for sample, column in zip(samples, columns, strict=True):
        at = np.searchsorted(rows, sample.rows)
        t_ns[at] = sample.t_ns
        values[at, column] = sample.values
    return t_ns, values


def _open_sensor(writer: SessionWriter, sensor: Sensor) -> Callable[[int, FloatArray], None]:
    """Open a sensor's topic; returns what writes one row of its values."""
    if sensor.kind is SensorKind.ACCELEROMETER:
        imu = writer.imu(sensor.topic, frame=sensor.name)
        return imu.write
    if sensor.kind is SensorKind.COMPASS:
        compass = writer.magnetic_field(sensor.topic, frame=sensor.name)
        return compass.write
    distance = writer.range(
        sensor.topic,
        frame=sensor.name,
        min_range=sensor.range_min or 0.0,
        max_range=sensor.range_max or 0.0,
        field_of_view=sensor.field_of_view or 0.0,
        infrared=sensor.kind is SensorKind.IR,
    )
    return lambda t_ns, row: distance.write(t_ns, float(row[0]))
