"""The limits of a drive, joint by joint."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Robot
from undulog.capture.robot.safety import JOINT_LIMITS, OnFault, Safety

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


@dataclass(frozen=True)
class GateLimits:
    """What a drive keeps to; arrays have shape (m,), in the order of the robot's joints.

    Attributes:
        joint_names: The joints.
        lower: Lower limits of commands [rad].
        upper: Upper limits of commands [rad].
        rate: Greatest rates of commands [rad/s], at most those of the joints' servos.
        ramp_rate: Greatest rates on the way to the first pose and down [rad/s], at most ``rate``.
        tracking_error: Greatest distances of measured angles from their commands [rad].
        current: Greatest currents [A]; NaN where it isn't watched.
        temperature: Greatest temperatures [degC]; NaN likewise.
        voltage: Least voltages [V]; NaN likewise.
        reply_timeout_s: A joint that says nothing for so long is lost [s].
        late_s: So late a control tick may be [s].
        fault_after_s: So long an excess may last [s].
        on_fault: How a drive ends that has to end early.
    """

    joint_names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    rate: FloatArray
    ramp_rate: FloatArray
    tracking_error: FloatArray
    current: FloatArray
    temperature: FloatArray
    voltage: FloatArray
    reply_timeout_s: float
    late_s: float
    fault_after_s: float
    on_fault: OnFault

    def facts(self) -> dict[str, str]:
        """For a session's metadata: each limit, as one number where all joints have the same."""
        found: dict[str, str] = {}
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, np.ndarray):
                numbers: list[float] = value.tolist()
                same = len({repr(number) for number in numbers}) == 1
                found[each.name] = repr(numbers[0]) if same else json.dumps(numbers)
            elif each.name != "joint_names":
                found[each.name] = str(value)
        return found


def gate_limits(robot: Robot) -> GateLimits:
    """The limits of a robot's description.

    Args:
        robot: The robot.

    Returns:
        Its limits.

    Raises:
        UsageError: If it lacks one; names all that are missing, with an example.
    """
    missing = missing_limits(robot)
    safety = robot.safety or Safety()
    if missing or safety.reply_timeout_s is None or safety.max_late_s is None:
        raise UsageError(
            f"{robot.name} can't be armed: its description lacks {', '.join(missing)} in [safety]; "
            "add what is right for this robot to its file, e.g.\n"
            f"{safety_example(missing)}\n"
            "and name that file with --robot"
        )
    lower, upper = robot.limits()
    names = robot.joint_names
    servo_rate = np.array([joint.max_velocity for joint in robot.joints])
    rate = frozen(np.minimum(safety.values("max_rate", names), servo_rate))
    return GateLimits(
        joint_names=names,
        lower=lower,
        upper=upper,
        rate=rate,
        ramp_rate=frozen(np.minimum(safety.values("ramp_rate", names), rate)),
        tracking_error=safety.values("max_tracking_error", names),
        current=safety.values("max_current", names),
        temperature=safety.values("max_temperature", names),
        voltage=safety.values("min_voltage", names),
        reply_timeout_s=safety.reply_timeout_s,
        late_s=safety.max_late_s,
        fault_after_s=safety.fault_after_s,
        on_fault=safety.on_fault,
    )
