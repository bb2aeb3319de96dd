"""The twin's sensor samples as frames of the robot's bus, each with its own time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from undulog.capture.bus.encoding import BusEncoder, BusValue
from undulog.capture.bus.map_entry import bus_messages, frame_id
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.log.messages.frames import FrameArray, empty_frames
from undulog.capture.robot.model import Direction, Quantity, Robot, SensorKind

from ..scenario.scenario import CONTROL_RATE_HZ
from ..sensing.contract import JointSample, RangeSample, SensorSample

_OF_JOINT = (
    Quantity.POSITION,
    Quantity.VELOCITY,
    Quantity.EFFORT,
    Quantity.CURRENT,
    Quantity.VOLTAGE,
)
_NS = 1_000_000_000
_PERIOD_NS = _NS // CONTROL_RATE_HZ


class ReplyEncoder:
    """What a robot's servos and sensors say on its bus.

    A frame's device time is the sampling time of what it carries. A frame that carries several
    joints has the time of the last of them; sensors that share a frame and were not read at the
    same time have a frame each, with the others unknown.
    """

    def __init__(self, robot: Robot) -> None:
        """Compile.

        Args:
            robot: The robot.

        Raises:
            DataError: If it has no bus, or a message that is no classic CAN frame.
        """
        bus, messages = bus_messages(robot)
        self._encoder = BusEncoder(robot, Direction.RX)
        self._joints = robot.joint_names
        index = {name: i for i, name in enumerate(self._joints)}
        self._targets: dict[str, list[int]] = {}
        self._last_joint: dict[int, int] = {}
        for signal in bus.signals:
            if signal.direction is not Direction.RX:
                continue
            identifier = frame_id(messages[signal.message])
            self._targets.setdefault(signal.target, []).append(identifier)
            joint = index.get(signal.target, -1)
            self._last_joint[identifier] = max(joint, self._last_joint.get(identifier, -1))
        self._keys: list[list[BusValue]] = [
            [(name, quantity, "") for name in self._joints] for quantity in _OF_JOINT
        ]
        self._vector_of = {
            sensor.name: (
                Quantity.ACCELERATION
                if sensor.kind is SensorKind.ACCELEROMETER
                else Quantity.MAGNETIC_FIELD
            )
            for sensor in robot.sensors
        }
        coded = {(s.target, s.quantity) for s in bus.signals if s.unknown is not None}
        offered = set(_OF_JOINT) | set(self._vector_of.values()) | {Quantity.RANGE}
        self._made_up = sorted(
            {
                f"{target} {quantity}"
                for target, quantity, _ in self._encoder.values
                if quantity not in offered and (target, quantity) not in coded
            }
        )

    @property
    def made_up(self) -> list[str]:
        """What the frames have to carry, the twin doesn't have and the map can't call unknown."""
        return self._made_up

    def identifiers(self, target: str = "") -> IntArray:
        """Identifiers of frames, with flags.

        Args:
            target: A joint or sensor that they carry; empty for all.

        Returns:
            Shape (k,), sorted.
        """
        chosen = [self._targets.get(target, [])] if target else self._targets.values()
        return np.unique(np.array([each for part in chosen for each in part], dtype=np.int64))

    def frames(self, samples: Sequence[SensorSample], clock_ns: Callable[[int], int]) -> FrameArray:
        """Encode samples.

        Args:
            samples: In the order of their arrival.
            clock_ns: The robot's clock at a moment of simulated time, both [ns].

        Returns:
            The frames, with device times and no host times; those of the servos in the order of
            the map, then those of the sensors.
        """
        parts: list[FrameArray] = [empty_frames(0)]
        together: dict[int, dict[BusValue, float]] = {}
        for sample in samples:
            if isinstance(sample, JointSample):
                parts.append(self._cycle(sample, clock_ns))
                continue
            values = together.setdefault(round(sample.time_s * _NS), {})
            if isinstance(sample, RangeSample):
                values[sample.name, Quantity.RANGE, ""] = sample.distance
            else:
                quantity = self._vector_of[sample.name]
                for axis, value in zip("xyz", sample.vector.tolist(), strict=True):
                    values[sample.name, quantity, axis] = value
        for elapsed_ns, values in together.items():
            frames = self._encoder.encode(values)
            frames["t_device_ns"] = clock_ns(elapsed_ns)
            parts.append(frames)
        return np.concatenate(parts)

    def at_rest(self, angle: FloatArray, t_ns: int) -> FrameArray:
        """What the servos of a robot that has not moved yet say.

        Args:
            angle: Joint angles [rad], shape (m,).
            t_ns: The robot's clock [ns].

        Returns:
            Their frames, in the order of the map; what the twin knows no better is 0.
        """
        values: dict[BusValue, float] = {}
        for keys, quantity in zip(self._keys, _OF_JOINT, strict=True):
            known = _numbers(angle) if quantity is Quantity.POSITION else [0.0] * len(keys)
            values.update(zip(keys, known, strict=True))
        frames = self._encoder.encode(values)
        frames["t_device_ns"] = t_ns
        return frames

    def _cycle(self, sample: JointSample, clock_ns: Callable[[int], int]) -> FrameArray:
        """One polling cycle of the servos."""
        fields = (sample.position, sample.velocity, sample.effort, sample.current, sample.voltage)
        values: dict[BusValue, float] = {}
        for keys, field in zip(self._keys, fields, strict=True):
            values.update(zip(keys, _numbers(field), strict=True))
        frames = self._encoder.encode(values)
        joint = [self._last_joint[each] for each in frames["id_flags"].tolist()]
        start_ns = clock_ns(sample.cycle * _PERIOD_NS)
        offset_ns = np.rint(sample.offset_s[joint] * _NS).astype(np.int64)
        frames["t_device_ns"] = start_ns + offset_ns
        return frames


def _numbers(values: FloatArray) -> list[float]:
    return values.tolist()
