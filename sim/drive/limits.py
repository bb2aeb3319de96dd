"""The limits of a drive, joint by joint.

The clamp is the last stage before the encoder: it limits position and rate of commands.

Commands are spaced so that rates hold in real time, not only from tick to tick.

The clamp bounds a step by what the greatest rate allows in one control period. Deadlines are
anchored at the first tick, so behind a tick that came late the next one is due in less than a
period: the servos would have to move as far in less time. The later command waits then until
the rate allows its step. No step takes more than a period, so that no wait is longer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import NS, BoolArray, FloatArray, IntArray, frozen
from undulog.capture.common.errors import UsageError, some_names
from undulog.capture.robot.model import JOINT_LIMITS, OnFault, Robot, Safety

from ..gait.wave import smoothstep
from .outcome import JointStatus

_EXAMPLES = {
    "max_rate": "4.0            # rad/s, of commands",
    "ramp_rate": "0.5           # rad/s, to the first pose and down again",
    "max_tracking_error": "0.35 # rad, between command and measured angle",
    "reply_timeout_s": "0.25    # a joint that reports nothing for so long is lost",
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

_ROUNDING = 1e-12  # rad; a command that is off a limit in its last bits was not cut

_PEAK = 1.5  # greatest slope of 3 x^2 - 2 x^3

HOLD_S = 0.2
"""So long the last pose is commanded again before nothing is sent any more [s]."""

_SHOWN = 8


def missing_limits(robot: Robot) -> tuple[str, ...]:
    """The limits that a robot lacks to be driven over its bus.

    Rates, tracking error and the two times are always needed; limits of current, temperature and
    voltage where the robot tells these on its bus.

    Returns:
        Names of fields of :class:`Safety`, in its order; empty if there is nothing to add.
    """
    safety = robot.safety or Safety()
    reported = {
        str(signal.quantity)
        for signal in (robot.bus.signals if robot.bus is not None else ())
        if signal.direction == "rx"
    }
    missing: list[str] = []
    for limit in _EXAMPLES:
        if _OF_QUANTITY.get(limit, "") not in {"", *reported}:
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
    """Limits of a drive; arrays have shape (m,), in the order of the robot's joints.

    Attributes:
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
        texts: dict[str, str] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                numbers: list[float] = value.tolist()
                same = len({repr(number) for number in numbers}) == 1
                texts[field.name] = repr(numbers[0]) if same else json.dumps(numbers)
            elif field.name != "joint_names":
                texts[field.name] = str(value)
        return texts


def gate_limits(robot: Robot) -> GateLimits:
    """The limits of a robot's description.

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


class Spacing:
    """When the frames of a command may be sent.

    It knows when each frame of the command before was handed to the bus: a burst that was held up
    half way, e.g. as the process was stopped, holds up what follows by as much as it needs.

    Attributes:
        waits: Commands that have to wait, so far.
        longest_s: The longest of these waits [s].
    """

    def __init__(self, rate: FloatArray, now_ns: Callable[[], int]) -> None:
        """Nothing was sent yet.

        Args:
            rate: Greatest rates [rad/s], shape (m,).
            now_ns: The clock [ns].
        """
        self.waits, self.longest_s = 0, 0.0
        self._rate, self._now_ns = rate, now_ns
        self._last: FloatArray | None = None
        self._sent_ns: IntArray = np.empty(0, dtype=np.int64)

    def earliest_ns(self, command: FloatArray, count: int) -> IntArray:
        """The earliest times at which a command's frames may be sent.

        Args:
            command: Joint angles [rad], shape (m,).
            count: How many frames carry it; always in the same order.

        Returns:
            Each frame's, on the clock [ns], shape (count,); 0 where nothing was sent before.
        """
        if self._last is None:
            return np.zeros(count, dtype=np.int64)
        need_s = float(np.max(np.abs(command - self._last) / self._rate))
        before = self._sent_ns
        if len(before) != count:  # not the same frames: none of them earlier than all of those
            before = np.full(count, before.max())
        earliest = before + math.ceil(need_s * NS)
        wait_s = (int(earliest.max()) - self._now_ns()) / NS
        if wait_s > 0.0:
            self.waits += 1
            self.longest_s = max(self.longest_s, wait_s)
        return earliest

    def sent(self, command: FloatArray, sent_ns: IntArray) -> None:
        """Note that a command was sent.

        Args:
            command: Joint angles [rad], shape (m,).
            sent_ns: When the bus had each of its frames, on the clock [ns], shape (n,).
        """
        self._last, self._sent_ns = command, sent_ns


class Clamped(NamedTuple):
    """A command that may be sent.

    Attributes:
        command: Joint angles [rad], shape (m,); finite, whatever was wanted.
        by_position: Joints that were cut to their position limits, shape (m,).
        by_rate: Joints that were held back to their greatest rate, shape (m,).
        unconfirmed: Joints that were held back as the bus had not confirmed the commands before,
            shape (m,).
        not_finite: Joints for which something was wanted that is no angle, shape (m,).
    """

    command: FloatArray
    by_position: BoolArray
    by_rate: BoolArray
    unconfirmed: BoolArray
    not_finite: BoolArray


class Clamp:
    """Cuts commands to position limits, and their steps to the greatest rate.

    It knows the command before, which the servos hold: a step is measured from there, and is at
    most what the greatest rate allows in one control period, also where ticks were left out. What
    was late is caught up step by step and never by a jump; that the steps are a period apart in
    true time, too, is for :mod:`.sim.drive.limits`.

    Attributes:
        last: What was commanded last, at first the pose [rad], shape (m,).
        cuts: Commands of single joints that were changed, by why.
    """

    def __init__(self, limits: GateLimits, pose: FloatArray, period_s: float) -> None:
        """Start from a pose.

        Args:
            pose: The angles that the joints have [rad], shape (m,); finite.
            period_s: Control period [s].

        Raises:
            ValueError: If the pose isn't known.
        """
        if not np.isfinite(pose).all():
            raise ValueError("the pose to start from has angles that are not known")
        self._limits, self._reach = limits, limits.rate * period_s
        self.last: FloatArray = np.clip(pose, limits.lower, limits.upper)
        self.cuts: dict[str, int] = dict.fromkeys(Clamped._fields[1:], 0)

    def apply(
        self, requested: FloatArray, bounds: tuple[FloatArray, FloatArray] | None = None
    ) -> Clamped:
        """Make a command fit to be sent; it counts as sent.

        Args:
            requested: Joint angles [rad], shape (m,); anything.
            bounds: Least and greatest angles that the commands on their way leave [rad], shapes
                (m,), the last command among them; None: all.

        Returns:
            The command, and what was changed.
        """
        limits = self._limits
        finite = np.isfinite(requested)
        within = np.clip(np.where(finite, requested, self.last), limits.lower, limits.upper)
        stepped = np.clip(within, self.last - self._reach, self.last + self._reach)
        command = stepped
        if bounds is not None:  # the last command is within, but for rounding
            least, greatest = np.minimum(bounds[0], self.last), np.maximum(bounds[1], self.last)
            command = np.clip(stepped, least, greatest)
        by_position = finite & (np.abs(within - requested) > _ROUNDING)
        by_rate = np.abs(stepped - within) > _ROUNDING
        unconfirmed = np.abs(command - stepped) > _ROUNDING
        self.last = command
        outcome = Clamped(command.copy(), by_position, by_rate, unconfirmed, ~finite)
        for why, joints in zip(self.cuts, outcome[1:], strict=True):
            self.cuts[why] += int(joints.sum())
        return outcome


class Ramp:
    """A straight way between two poses, with no rate at either end.

    Attributes:
        duration_s: How long it takes [s].
    """

    def __init__(self, start: FloatArray, target: FloatArray, rate: FloatArray) -> None:
        """Plan it.

        Args:
            start: Angles [rad], shape (m,).
            target: Angles [rad], shape (m,).
            rate: Greatest rates [rad/s], shape (m,).
        """
        self._start, self._way = start.copy(), target - start
        self.duration_s = _PEAK * float(np.max(np.abs(self._way) / rate))

    def at(self, time_s: float) -> FloatArray:
        """The pose at a time.

        Args:
            time_s: Since its start [s].

        Returns:
            Angles [rad], shape (m,); the target from its end on.
        """
        if time_s >= self.duration_s:
            return self._start + self._way
        return self._start + smoothstep(time_s / self.duration_s) * self._way


class EndingRamp:
    """The commands of an ending; it ends by its own time, whatever the joints do.

    It starts from the present pose: a joint's last command where the joint is near it, else the
    angle that the joint has, so that a blocked servo stops pushing.

    Attributes:
        duration_s: How long it takes [s], with the way of the commands back to where the joints
            are.
    """

    def __init__(self, limits: GateLimits, last: FloatArray, status: JointStatus) -> None:
        """Plan it.

        Args:
            limits: Rates, position limits, and how to end.
            last: The last command [rad], shape (m,).
            status: Newest values of the joints.
        """
        far = np.abs(status.angle - last) > limits.tracking_error  # False where unknown
        start = np.clip(np.where(far, status.angle, last), limits.lower, limits.upper)
        rest = np.clip(np.zeros_like(last), limits.lower, limits.upper)
        target = start if limits.on_fault is OnFault.HOLD else rest
        self._ramp = Ramp(start, target, limits.ramp_rate)
        back_s = float(np.max(np.abs(start - last) / limits.rate))
        self.duration_s = back_s + self._ramp.duration_s + HOLD_S

    def at(self, time_s: float) -> FloatArray:
        """Return the requested command at a time.

        Args:
            time_s: Since its start [s].

        Returns:
            Joint angles [rad], shape (m,).
        """
        return self._ramp.at(time_s)


def why_not_from(angle: FloatArray, limits: GateLimits, waited_s: float) -> str | None:
    """Return why a drive can't start from a pose.

    Args:
        angle: Measured angles [rad], NaN where none came, shape (m,).
        limits: Position limits, and how far beyond them a joint may be found.
        waited_s: How long angles were waited for [s].

    Returns:
        One sentence; None if it can.
    """
    names = limits.joint_names
    unknown = np.flatnonzero(np.isnan(angle)).tolist()
    if unknown:
        silent = some_names([names[i] for i in unknown], _SHOWN)
        if len(unknown) == len(names):
            silent = f"all {len(names)} joints"
        return (
            f"the pose is not known, {silent} reported no angle within {waited_s:.2g} s; is the "
            "robot switched on, and does it report unasked?"
        )
    beyond = np.maximum(limits.lower - angle, angle - limits.upper)
    worst = int(np.argmax(beyond - limits.tracking_error))
    if beyond[worst] > limits.tracking_error[worst]:
        return (
            f"{names[worst]} is at {angle[worst]:.3f} rad, {beyond[worst]:.3f} rad beyond its "
            "limits; bring it back by hand"
        )
    return None
