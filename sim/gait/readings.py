"""What the robot's computer knows at one control tick: the newest value of each sensor.

Gaits and controllers see this and never the truth: values are noisy, quantised and late, as the
sensors and the bus make them, and the same whether twin or robot sent them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.robot.model import Robot


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
        """What is known before anything was reported.

        Args:
            robot: The robot.

        Returns:
            Readings without a value.
        """
        unknown = frozen(np.full(len(robot.joints), np.nan))
        return cls(unknown, unknown)
