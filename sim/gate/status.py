"""What the servos tell of themselves, as the gate looks at it."""

from __future__ import annotations

from dataclasses import dataclass

from undulog.capture.common.arrays import FloatArray


@dataclass(frozen=True)
class JointStatus:
    """The newest values of each joint; NaN where none came or it is too old. Shapes are (m,).

    Attributes:
        angle: Measured angles [rad].
        current: Currents [A].
        temperature: [degC].
        voltage: Supply voltages [V].
        silence_s: Time since the last angle [s]; inf before the first.
    """

    angle: FloatArray
    current: FloatArray
    temperature: FloatArray
    voltage: FloatArray
    silence_s: FloatArray
