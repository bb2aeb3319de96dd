"""The twin's sensor samples as frames of the robot's bus, each with its own time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from undulog.capture.bus.encoding import BusEncoder, BusValue
from undulog.capture.bus.map_entry import bus_messages, frame_id
from undulog.capture.common.arrays import NS, BoolArray, FloatArray, IntArray
from undulog.capture.log.messages.frames import DIR_RX, ERROR_FLAG, FrameArray, empty_frames
from undulog.capture.robot.model import Direction, Quantity, Robot, SensorKind
from undulog.capture.sources.events import BUS_OFF, RESTARTED

from ..gait.contract import CONTROL_RATE_HZ
from ..physics.sensing import JointSample, RangeSample, SensorSample
from ..scenario.bus_faults import BusFault, BusFaultKind

_OF_JOINT = (
    Quantity.POSITION,
    Quantity.VELOCITY,
    Quantity.EFFORT,
    Quantity.CURRENT,
    Quantity.VOLTAGE,
)
_PERIOD_NS = NS // CONTROL_RATE_HZ

STREAM = 50
"""Number of the random stream that decides which frames are hit."""

_PROTOCOL_VIOLATION, _BUS_ERROR = 0x008, 0x080  # linux/can/error.h


class ReplyEncoder:
    """Encodes samples of a robot's servos and sensors as frames.

    A frame's device time is the sampling time of what it carries. A frame that carries several
    joints has the time of the last of them; sensors that share a frame and were not read at the
    same time have a frame each, with the others unknown.

    Attributes:
        made_up: What the frames have to carry, the twin doesn't have and the map can't call
            unknown.
    """

    def __init__(self, robot: Robot) -> None:
        """Compile.

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
        self.made_up = sorted(
            {
                f"{target} {quantity}"
                for target, quantity, _ in self._encoder.values
                if quantity not in offered and (target, quantity) not in coded
            }
        )

    def identifiers(self, target: str = "") -> IntArray:
        """Identifiers of frames, with flags.

        Args:
            target: A joint or sensor that they carry; empty for all.

        Returns:
            Shape (k,), sorted.
        """
        chosen = [self._targets.get(target, [])] if target else self._targets.values()
        return np.unique(
            np.array([identifier for part in chosen for identifier in part], dtype=np.int64)
        )

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
            values = together.setdefault(round(sample.time_s * NS), {})
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
        """Encode the servos of a robot that has not moved yet.

        Args:
            angle: Joint angles [rad], shape (m,).
            t_ns: The robot's clock [ns].

        Returns:
            Their frames, in the order of the map; what the twin knows no better is 0.
        """
        values = dict.fromkeys(itertools.chain(*self._keys), 0.0)
        values.update(zip(self._keys[0], _numbers(angle), strict=True))  # the position's
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
        joint = [self._last_joint[frame] for frame in frames["id_flags"].tolist()]
        start_ns = clock_ns(sample.cycle * _PERIOD_NS)
        frames["t_device_ns"] = start_ns + np.rint(sample.offset_s[joint] * NS).astype(np.int64)
        return frames


def _numbers(values: FloatArray) -> list[float]:
    return values.tolist()


class FaultLine:
    """Applies faults to a robot and its bus.

    Attributes:
        lost: Replies that were lost.
        hit: Transmissions that were hit by noise.
    """

    def __init__(
        self, faults: Sequence[BusFault], robot: Robot, replies: ReplyEncoder, seed: int
    ) -> None:
        """Start with all faults ahead.

        Args:
            faults: The faults.
            replies: Encodes what its joints report.
            seed: Of the random losses and errors.
        """
        self._of = {kind: [f for f in faults if f.kind is kind] for kind in BusFaultKind}
        self._joint = {name: i for i, name in enumerate(robot.joint_names)}
        self._replies = replies
        self._random = np.random.default_rng([seed, STREAM])
        self._held: dict[BusFault, float] = {}
        self._off = False
        self._late: list[tuple[int, FrameArray]] = []
        self.lost = self.hit = 0

    def command(self, command: FloatArray, angle: FloatArray, time_s: float) -> FloatArray:
        """Apply the faults to commands.

        Args:
            command: Joint angles to be reached [rad], shape (m,).
            angle: The newest angles that the encoders told [rad], NaN before the first, shape (m,).
            time_s: Time since the start [s].

        Returns:
            The same, but for a stuck servo the angle that it had when it got stuck.
        """
        acting = [fault for fault in self._of[BusFaultKind.STUCK] if fault.acts(time_s)]
        if not acting:
            return command
        command = command.copy()
        for fault in acting:
            i = self._joint[fault.joint]
            stuck = command[i] if np.isnan(angle[i]) else angle[i]
            command[i] = self._held.setdefault(fault, float(stuck))
        return command

    def samples(self, samples: Sequence[SensorSample], time_s: float) -> list[SensorSample]:
        """Apply the faults to sensor samples.

        Args:
            time_s: Time since the start [s].

        Returns:
            The same, but for a frozen encoder its last angle, and for a servo with a winding
            that draws too much that current.
        """
        frozen, drawing = (
            [fault for fault in self._of[kind] if fault.acts(time_s)]
            for kind in (BusFaultKind.FROZEN, BusFaultKind.OVER_CURRENT)
        )
        if not (frozen or drawing):
            return list(samples)
        reported: list[SensorSample] = []
        for sample in samples:
            if not isinstance(sample, JointSample):
                reported.append(sample)
                continue
            position, current = sample.position.copy(), sample.current.copy()
            for fault in frozen:
                i = self._joint[fault.joint]
                position[i] = self._held.setdefault(fault, float(position[i]))
            for fault in drawing:
                current[self._joint[fault.joint]] = fault.value
            reported.append(sample._replace(position=position, current=current))
        return reported

    def is_receiving(self, time_s: float) -> bool:
        """Whether the robot receives frames.

        Args:
            time_s: Time since the start [s].
        """
        return not any(fault.acts(time_s) for fault in self._of[BusFaultKind.BUS_OFF])

    def replies(self, frames: FrameArray, now_ns: int, time_s: float) -> FrameArray:
        """Apply the faults to the robot's frames.

        Args:
            frames: What it sends now, shape (n,).
            now_ns: The robot's clock [ns].
            time_s: Time since the start [s].

        Returns:
            What is on the bus by now: frames, those of before that were late, and error frames.
        """
        parts: list[FrameArray] = []
        if self._off == self.is_receiving(time_s):
            self._off = not self._off
            parts.append(_error_frames(BUS_OFF if self._off else RESTARTED, now_ns, 1))
        for fault in self._of[BusFaultKind.LOST]:
            if fault.acts(time_s) and len(frames):
                frames = frames[~self._losses(fault, frames)]
        waiting = sum(fault.value for fault in self._of[BusFaultKind.DELAY] if fault.acts(time_s))
        if waiting or self._late:
            self._late.append((now_ns + round(waiting * NS), frames))
            due = [late for due_ns, late in self._late if due_ns <= now_ns]
            self._late = [late for late in self._late if late[0] > now_ns]
            frames = np.concatenate([empty_frames(0), *due])
        if not self._off:
            parts.append(self._noisy(frames, now_ns, time_s))
        return np.concatenate([empty_frames(0), *parts])

    def _losses(self, fault: BusFault, frames: FrameArray) -> BoolArray:
        struck = self._random.random(len(frames)) < fault.value
        struck &= np.isin(frames["id_flags"], self._replies.identifiers(fault.joint))
        self.lost += int(struck.sum())
        return struck

    def _noisy(self, frames: FrameArray, now_ns: int, time_s: float) -> FrameArray:
        """Frames, each after as many error frames as attempts to send it were hit."""
        for fault in self._of[BusFaultKind.NOISE]:
            if not fault.acts(time_s) or not len(frames):
                continue
            hits = self._random.geometric(1.0 - fault.value, len(frames)) - 1
            self.hit += int(hits.sum())
            errors = _error_frames(_PROTOCOL_VIOLATION | _BUS_ERROR, now_ns, int(hits.sum()))
            frames = np.insert(frames, np.repeat(np.arange(len(frames)), hits), errors)
        return frames


def _error_frames(classes: int, now_ns: int, count: int) -> FrameArray:
    frames = empty_frames(count)
    frames["id_flags"] = ERROR_FLAG | classes
    frames["dlc"] = 8
    frames["dir"] = DIR_RX
    frames["t_device_ns"] = now_ns
    return frames
