"""Register maps of serial servos: address, size and meaning of what a session holds.

After Feetech's memory tables of STS3215 and SCS0009 and the ROBOTIS e-Manual, control tables of
XL430-W250, XL330-M288, XM430-W350 and XM540-W270.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from .model import Direction, Quantity


@dataclass(frozen=True)
class Register:
    """One register of a servo.

    Attributes:
        size: Number of bytes.
        unit: Unit of ``scale * raw + offset``.
        sign_bit: Bit of the sign beside a magnitude; None without one.
        signed: Two's complement.
        big_endian: Most significant byte first.
    """

    name: str
    address: int
    size: int
    quantity: Quantity
    unit: str
    scale: float
    offset: float = 0.0
    sign_bit: int | None = None
    signed: bool = False
    big_endian: bool = False

    @property
    def direction(self) -> Direction:
        """To the servo for a command, else from it."""
        return Direction.TX if self.quantity is Quantity.COMMAND else Direction.RX

    def raw(self, data: bytes) -> int:
        """Return the number in a register's bytes."""
        number = int.from_bytes(data, "big" if self.big_endian else "little", signed=self.signed)
        if self.sign_bit is not None and number >> self.sign_bit & 1:
            return (1 << self.sign_bit) - number
        return number

    def bytes_of(self, value: float) -> bytes:
        """Return the bytes of a value in ``unit``, or of the nearest that they can hold."""
        number = round((value - self.offset) / self.scale)
        bits = 8 * self.size - self.signed if self.sign_bit is None else self.sign_bit
        most = (1 << bits) - 1
        negative = self.signed or self.sign_bit is not None
        number = max(-most if negative else 0, min(number, most))
        if self.sign_bit is not None and number < 0:
            number = (1 << self.sign_bit) - number
        order = "big" if self.big_endian else "little"
        return number.to_bytes(self.size, order, signed=self.signed)


_TURN = 2 * math.pi
_STEP = _TURN / 4096  # 12 bits a turn
_RPM = 0.229  # rev/min, the velocity unit of the X series

_STS = (
    Register("goal_position", 42, 2, Quantity.COMMAND, "rad", _STEP, -math.pi, 15),
    Register("present_position", 56, 2, Quantity.POSITION, "rad", _STEP, -math.pi, 15),
    Register("present_velocity", 58, 2, Quantity.VELOCITY, "rad/s", _STEP, 0.0, 15),
    Register("present_voltage", 62, 1, Quantity.VOLTAGE, "V", 0.1),
    Register("present_temperature", 63, 1, Quantity.TEMPERATURE, "degC", 1.0),
    Register("present_current", 69, 2, Quantity.CURRENT, "mA", 6.5, 0.0, 15),
)
_SCS_STEP = math.radians(300) / 1024
_SCS = tuple(
    replace(register, big_endian=True, scale=_SCS_STEP, offset=-512 * _SCS_STEP)
    if register.unit == "rad"
    else replace(register, big_endian=True, scale=_SCS_STEP)
    if register.unit == "rad/s"
    else register
    for register in _STS
    if register.quantity is not Quantity.CURRENT
)
_X = (
    Register("goal_position", 116, 4, Quantity.COMMAND, "rad", _STEP, -math.pi, signed=True),
    Register("present_velocity", 128, 4, Quantity.VELOCITY, "rpm", _RPM, signed=True),
    Register("present_position", 132, 4, Quantity.POSITION, "rad", _STEP, -math.pi, signed=True),
    Register("present_input_voltage", 144, 2, Quantity.VOLTAGE, "V", 0.1),
    Register("present_temperature", 146, 1, Quantity.TEMPERATURE, "degC", 1.0),
)


def _x_with_current(milliampere: float) -> tuple[Register, ...]:
    current = Register("present_current", 126, 2, Quantity.CURRENT, "mA", milliampere, signed=True)
    return (*_X, current)


SERVOS: Mapping[str, Mapping[str, tuple[Register, ...]]] = {
    "feetech": {"sts3215": _STS, "sts3250": _STS, "scs0009": _SCS},
    "dynamixel2": {
        "xl430": _X,  # its address 126 is a load, in per mille of no stated torque
        "xc430": _X,
        "xl330": _x_with_current(1.0),
        "xm430": _x_with_current(2.69),
        "xm540": _x_with_current(2.69),
        "xh430": _x_with_current(2.69),
    },
}
"""Protocol to model to registers. Angle 0 is the middle of the range, as the servos have it."""
