"""Interface of gait generators, and the changes that a controller may make to them.

A gait is stepped once a control tick, in order of time, with the newest readings of the robot's
computer; it returns the joint commands and the values behind them. Each plane's phase
is *integrated*, Phi' = omega, and never computed as omega t: the two differ as soon as omega
changes.

Readings hold the newest value of each sensor at one control tick.

Gaits and controllers use these and never the true state: values are noisy, quantised and late, as
the sensors and the bus make them, and the same whether twin or robot sent them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.robot.model import Robot

CONTROL_RATE_HZ = 100
"""Rate of control and log."""

WALK = "walk"
"""The mode of a gait that only goes on."""


@dataclass(frozen=True)
class Readings:
    """The newest value of each sensor; NaN, or absent from a mapping, until the first has come.

    Attributes:
        angle: Joint angles that the encoders report [rad], shape (m,).
        velocity: Joint rates that the servos report [rad/s], shape (m,).
        ranges: Name of an infrared sensor or sonar to its distance [m]; +inf: nothing in range.
        acceleration: Name of an accelerometer to the specific force in its frame [m/s^2],
            shape (3,), NaN on an axis that it does not measure.
        magnetic_field: Name of a compass to the field in its frame [T], shape (3,), NaN likewise.
    """

    angle: FloatArray
    velocity: FloatArray
    ranges: Mapping[str, float] = field(default_factory=dict[str, float])
    acceleration: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    magnetic_field: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])

    @classmethod
    def nothing(cls, robot: Robot) -> Readings:
        """Return readings without values."""
        unknown = frozen(np.full(len(robot.joints), np.nan))
        return cls(unknown, unknown)


class GaitTick(NamedTuple):
    """Output of a gait at one control tick.

    Attributes:
        command: Joint angles to be reached [rad], shape (m,).
        values: Values of the gait, in the order of :attr:`Gait.names`, shape (k,).
        mode: One word for what the gait is about.
        clamped: Names of values that were cut to the joint limits: ``horizontal.A`` where it
            concerns all joints of the plane, ``joint03.A`` where it concerns some.
    """

    command: FloatArray
    values: FloatArray
    mode: str
    clamped: tuple[str, ...]


class Gait(Protocol):
    """A gait of the twin or the bus loop: an open-loop generator, or one under a controller."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values, e.g. ``horizontal.A``."""
        ...

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Return the commands from a time on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            readings: Newest readings; an open-loop gait ignores them.
        """
        ...


@dataclass(frozen=True)
class Modulation:
    """Changes of a generator, or of one plane, from one tick on; they may jump, the phase does not.

    Attributes:
        amplitude_factor: Multiplies each joint's amplitude, shape (m,).
        offset: Added to each joint's offset Y [rad], shape (m,).
        frequency_factor: Multiplies omega of all planes.
    """

    amplitude_factor: FloatArray
    offset: FloatArray
    frequency_factor: float = 1.0

    @classmethod
    def none(cls, joint_count: int) -> Modulation:
        """No change.

        Args:
            joint_count: m.

        Returns:
            Factors 1, offsets 0.
        """
        return cls(frozen(np.ones(joint_count)), frozen(np.zeros(joint_count)))


class Generator(Gait, Protocol):
    """A gait whose amplitude, offset and frequency a controller may change at any time."""

    def modulate(self, modulation: Modulation) -> None:
        """Change the generator from the next :meth:`Gait.step` on.

        Args:
            modulation: What to change, until the next call.

        Raises:
            UsageError: If it is of another number of joints or has a value that is not finite.
        """
