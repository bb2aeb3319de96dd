"""The limits of a drive, joint by joint."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields

import numpy as np

from undulog.capture.arrays import FloatArray, frozen
from undulog.capture.errors import UsageError
from undulog.capture.robot import OnFault, Robot, Safety
from undulog.capture.robot.safety import missing_limits, safety_example


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
