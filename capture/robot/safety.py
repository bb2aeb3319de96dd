"""How far a robot may be driven: the ``safety`` of a robot description.

Nothing here has a default that matters: a limit that the file does not give is None, and a robot
that lacks one that arming needs is not driven (:func:`missing_limits`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import FloatArray, frozen

if TYPE_CHECKING:
    from .model import Robot

_EXAMPLES = {
    "max_rate": "4.0            # rad/s, of commands",
    "ramp_rate": "0.5           # rad/s, to the first pose and down again",
    "max_tracking_error": "0.35 # rad, between command and measured angle",
    "reply_timeout_s": "0.25    # a joint that says nothing for so long is lost",
    "max_late_s": "0.2          # a control tick that is later stops the drive",
    "max_current": "1.4         # A",
    "max_temperature": "70.0    # degC",
    "min_voltage": "5.0         # V",
}
_OF_QUANTITY = {
    "max_current": "current",
    "max_temperature": "temperature",
    "min_voltage": "voltage",
}

JOINT_LIMITS = (
    "max_rate",
    "ramp_rate",
    "max_tracking_error",
    "max_current",
    "max_temperature",
    "min_voltage",
)
"""The limits that a single joint may have otherwise."""


class OnFault(StrEnum):
    """What the joints do when a drive has to end early."""

    HOLD = "hold"
    RAMP_DOWN = "ramp-down"


@dataclass(frozen=True)
class Safety:
    """Limits of driving a robot over its bus.

    Attributes:
        max_rate: Greatest rate of a command [rad/s].
        ramp_rate: Greatest rate of a command on the way to the first pose, and down [rad/s].
        max_tracking_error: Greatest distance of a measured angle from its command [rad].
        max_current: Greatest current of a servo [A].
        max_temperature: Greatest temperature of a servo [degC].
        min_voltage: Least supply voltage of a servo [V].
        reply_timeout_s: A joint that says nothing for so long is lost [s].
        max_late_s: So late a control tick may be [s].
        fault_after_s: Tracking error and current are a fault when they last so long [s].
        on_fault: How a drive ends that has to end early.
        of: Limits that single joints have otherwise: joint, limit, value.
    """

    max_rate: float | None = None
    ramp_rate: float | None = None
    max_tracking_error: float | None = None
    max_current: float | None = None
    max_temperature: float | None = None
    min_voltage: float | None = None
    reply_timeout_s: float | None = None
    max_late_s: float | None = None
    fault_after_s: float = 0.3
    on_fault: OnFault = OnFault.RAMP_DOWN
    of: tuple[tuple[str, str, float], ...] = ()

    def values(self, limit: str, joint_names: tuple[str, ...]) -> FloatArray:
        """One limit of each joint.

        Args:
            limit: One of :data:`JOINT_LIMITS`.
            joint_names: The joints.

        Returns:
            Shape (m,); NaN where there is none.
        """
        common: float | None = getattr(self, limit)
        own = {joint: value for joint, name, value in self.of if name == limit}
        fallback = math.nan if common is None else common
        return frozen(np.array([own.get(name, fallback) for name in joint_names]))


def missing_limits(robot: Robot) -> tuple[str, ...]:
    """The limits that a robot lacks to be driven over its bus.

    Rates, tracking error and the two times are always needed; limits of current, temperature and
    voltage where the robot tells these on its bus.

    Args:
        robot: The robot.

    Returns:
        Names of fields of :class:`Safety`, in its order; empty if there is nothing to add.
    """
    safety = robot.safety or Safety()
    told = {
        str(signal.quantity)
        for signal in (robot.bus.signals if robot.bus is not None else ())
        if signal.direction == "rx"
    }
    missing: list[str] = []
    for limit in _EXAMPLES:
        if _OF_QUANTITY.get(limit, "") not in {"", *told}:
            continue
        if limit in JOINT_LIMITS:
            lacks = bool(np.isnan(safety.values(limit, robot.joint_names)).any())
        else:
            lacks = getattr(safety, limit) is None
        if lacks:
            missing.append(limit)
    return tuple(missing)


def safety_example(limits: tuple[str, ...]) -> str:
    """A ``safety`` table as a robot's file would have it.

    Args:
        limits: Its fields, of :func:`missing_limits`.

    Returns:
        TOML, with units as comments.
    """
    return "\n".join(["[safety]", *(f"{name} = {_EXAMPLES[name]}" for name in limits)])
