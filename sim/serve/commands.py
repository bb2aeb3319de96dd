"""Command frames as the servos take them."""

from __future__ import annotations

import numpy as np

from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.common.arrays import BoolArray, FloatArray, frozen
from undulog.capture.log.messages.frames import FrameArray
from undulog.capture.robot.model import Direction, Quantity, Robot

WATCHDOG_S = 0.5
"""After so long without a command a servo's silence is told; it holds its angle all the while."""

_SLACK = 1e-9  # rad; a limit of 30 degrees and 30 degrees from the bus differ in the last bit


class CommandLatch:
    """The last command of each servo, which it holds until the next one comes.

    Attributes:
        frames: Frames with at least one command.
        cut: Names of joints that were told to go beyond their limits.
    """

    def __init__(self, robot: Robot) -> None:
        """Start without a command: straight joints, or as near to that as the limits allow.

        Args:
            robot: The robot.

        Raises:
            DataError: If it has no bus.
        """
        self._decoder = BusDecoder(robot)
        self._names = robot.joint_names
        self._index = {name: i for i, name in enumerate(self._names)}
        self._lower, self._upper = robot.limits()
        self._angle = np.clip(np.zeros(len(robot.joints)), self._lower, self._upper)
        self._time_ns = np.full(len(robot.joints), -1, dtype=np.int64)
        signals = robot.bus.signals if robot.bus is not None else ()
        commanded = {
            signal.target
            for signal in signals
            if signal.quantity is Quantity.COMMAND and signal.direction is Direction.TX
        }
        self.commanded: BoolArray = frozen(np.array([n in commanded for n in robot.joint_names]))
        self.frames = 0
        self.cut: set[str] = set()

    @property
    def angle(self) -> FloatArray:
        """The angles to be reached [rad], shape (m,)."""
        return self._angle.copy()

    def take(self, frames: FrameArray, *, heard: bool = True) -> BoolArray:
        """Take frames.

        Args:
            frames: What was sent on the bus, marked as sent by the computer, with device times;
                what carries no command is passed over, shape (n,).
            heard: Whether the servos hear them.

        Returns:
            Joints that were commanded, shape (m,).
        """
        told = np.zeros(len(self._index), dtype=np.bool_)
        samples, tally = self._decoder.decode(frames)
        self.frames += tally.decoded
        for decoded in samples:
            if decoded.signals[0].quantity is not Quantity.COMMAND:
                continue
            joint = np.array([self._index[signal.target] for signal in decoded.signals])
            own, values = joint[decoded.member], decoded.values
            known = ~np.isnan(values)
            own, values = own[known], values[known]
            told[own] = True
            if heard:
                cut = np.clip(values, self._lower[own], self._upper[own])
                self.cut |= {self._names[i] for i in own[np.abs(cut - values) > _SLACK].tolist()}
                self._angle[own] = cut  # of several commands the last one stays
                self._time_ns[own] = frames["t_device_ns"][decoded.rows[known]]
        return told

    def silent(self, now_ns: int, longest_ns: int) -> BoolArray:
        """Joints that had commands and have not had one for long.

        Args:
            now_ns: The robot's clock [ns].
            longest_ns: How long a silence may be [ns].

        Returns:
            Shape (m,).
        """
        return (self._time_ns >= 0) & (now_ns - self._time_ns > longest_ns)
