"""What the robot's computer knows, from the frames on its bus.

Each value is the newest that came. One that has not come for a while is unknown again: a controller
must not act on a distance of long ago.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from undulog.capture.bus.decoding import BusDecoder, DecodedSignals, FrameTally
from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.log.messages.frames import FrameArray
from undulog.capture.robot.model import Quantity, Robot

from ..gait.contract import Readings
from ..gate.tick import JointStatus

OLDEST_S = 0.5
"""A value older than this counts as unknown [s]; the slowest sensors come several times in it."""

_AXES = "xyz"
_OF_JOINTS = (
    Quantity.POSITION,
    Quantity.VELOCITY,
    Quantity.CURRENT,
    Quantity.TEMPERATURE,
    Quantity.VOLTAGE,
)
_VECTORS = (Quantity.ACCELERATION, Quantity.MAGNETIC_FIELD)
_TOLD = {*_OF_JOINTS, Quantity.RANGE, *_VECTORS}


class BusReadings:
    """Gathers decoded frames; ask :meth:`readings` once a control tick."""

    def __init__(self, robot: Robot, oldest_s: float = OLDEST_S) -> None:
        """Know nothing yet.

        Args:
            robot: The robot; it has a bus map.
            oldest_s: So old a value may be [s].

        Raises:
            DataError: If the robot has no bus, or not the databases that its map needs.
        """
        self._decoder = BusDecoder(_as_far_as_told(robot))
        self._oldest_s = oldest_s
        self._joints = {name: i for i, name in enumerate(robot.joint_names)}
        self._range_max = {
            sensor.name: sensor.range_max if sensor.range_max is not None else math.inf
            for sensor in robot.sensors
        }
        count = len(robot.joints)
        self._joint_values: dict[Quantity, FloatArray] = {}
        self._joint_times: dict[Quantity, FloatArray] = {}
        for quantity in _OF_JOINTS:
            self._joint_values[quantity] = np.full(count, np.nan)
            self._joint_times[quantity] = np.full(count, -np.inf)
        self._ranges: dict[str, tuple[float, float]] = {}
        self._vectors: dict[Quantity, dict[str, tuple[float, FloatArray]]] = {
            q: {} for q in _VECTORS
        }
        self.tally = FrameTally()
        """What became of the frames so far."""
        self.angles: IntArray = np.zeros(count, dtype=np.int64)
        """Angles received of each joint so far, shape (m,)."""

    def add(self, frames: FrameArray, time_s: float) -> None:
        """Take frames, in the order in which they came.

        Args:
            frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).
            time_s: When they came, on the loop's clock [s].
        """
        samples, tally = self._decoder.decode(frames)
        self.tally.add(tally)
        for decoded in samples:
            self._take(decoded, time_s)

    def readings(self, time_s: float) -> Readings:
        """What is known.

        Args:
            time_s: Now, on the loop's clock [s].

        Returns:
            The newest values; NaN, or absent, what has not come or is too old.
        """
        since_s = time_s - self._oldest_s
        angle = self._newest(Quantity.POSITION, since_s)
        velocity = self._newest(Quantity.VELOCITY, since_s)
        acceleration, field = (
            {name: vector for name, (at_s, vector) in self._vectors[q].items() if at_s >= since_s}
            for q in _VECTORS
        )
        ranges = {name: value for name, (at_s, value) in self._ranges.items() if at_s >= since_s}
        return Readings(angle, velocity, ranges, acceleration, field)

    def status(self, time_s: float) -> JointStatus:
        """What is known of the servos.

        Args:
            time_s: Now, on the loop's clock [s].

        Returns:
            The newest values of each joint, NaN likewise, and how long it has been silent.
        """
        since_s = time_s - self._oldest_s
        return JointStatus(
            angle=self._newest(Quantity.POSITION, since_s),
            current=self._newest(Quantity.CURRENT, since_s),
            temperature=self._newest(Quantity.TEMPERATURE, since_s),
            voltage=self._newest(Quantity.VOLTAGE, since_s),
            silence_s=frozen(time_s - self._joint_times[Quantity.POSITION]),
        )

    def _newest(self, quantity: Quantity, since_s: float) -> FloatArray:
        """A joint quantity, NaN where it is older."""
        values, times = self._joint_values[quantity], self._joint_times[quantity]
        return frozen(np.where(times >= since_s, values, np.nan))

    def _take(self, decoded: DecodedSignals, time_s: float) -> None:
        """Keep the values that are known; of several of one target the last one stays."""
        quantity, axis = decoded.signals[0].quantity, decoded.signals[0].axis
        if quantity in self._joint_values:
            own = np.array([self._joints[signal.target] for signal in decoded.signals])
            known = np.isfinite(decoded.values)  # no servo is at infinity
            joints = own[decoded.member[known]]
            self._joint_values[quantity][joints] = decoded.values[known]
            self._joint_times[quantity][joints] = time_s
            if quantity is Quantity.POSITION:
                np.add.at(self.angles, joints, 1)
            return
        members: list[int] = decoded.member.tolist()
        values: list[float] = decoded.values.tolist()
        for member, value in zip(members, values, strict=True):
            if math.isnan(value):
                continue
            target = decoded.signals[member].target
            if quantity is Quantity.RANGE:
                # REP 117: a reading beyond the greatest range means that nothing is in it.
                beyond = value > self._range_max[target]
                self._ranges[target] = time_s, math.inf if beyond else value
            elif quantity in _VECTORS:
                known = self._vectors[quantity]
                vector = known[target][1].copy() if target in known else np.full(3, np.nan)
                vector[_AXES.index(axis)] = value
                known[target] = time_s, frozen(vector)


def _as_far_as_told(robot: Robot) -> Robot:
    """The robot with a bus map of what a gait is told: the rest costs time in every tick."""
    if robot.bus is None:
        return robot
    signals = tuple(signal for signal in robot.bus.signals if signal.quantity in _TOLD)
    return dataclasses.replace(robot, bus=dataclasses.replace(robot.bus, signals=signals))
