"""From one pose to another, all joints arriving together, none faster than it may."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.safety import OnFault

from ..gait.rhythm import smoothstep
from .limits import GateLimits
from .tick import JointStatus

_PEAK = 1.5  # greatest slope of 3 x^2 - 2 x^3


class Ramp:
    """A straight way between two poses, with no rate at either end."""

    def __init__(self, start: FloatArray, target: FloatArray, rate: FloatArray) -> None:
        """Plan it.

        Args:
            start: Angles [rad], shape (m,).
            target: Angles [rad], shape (m,).
            rate: Greatest rates [rad/s], shape (m,).
        """
        self._start, self._way = start.copy(), target - start
        self.duration_s = _PEAK * float(np.max(np.abs(self._way) / rate, initial=0.0))
        """How long it takes [s]."""

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


HOLD_S = 0.2
"""So long the last pose is commanded again before nothing is sent any more [s]."""


class Ending:
    """The commands of an ending; it ends by its own time, whatever the joints do.

    It starts from the present pose: a joint's last command where the joint is near it, else the
    angle that the joint has, so that a blocked servo stops pushing.
    """

    def __init__(self, limits: GateLimits, last: FloatArray, status: JointStatus) -> None:
        """Plan it.

        Args:
            limits: Rates, position limits, and how to end.
            last: The last command [rad], shape (m,).
            status: What the joints told by now.
        """
        far = np.abs(status.angle - last) > limits.tracking_error  # False where unknown
        start = np.clip(np.where(far, status.angle, last), limits.lower, limits.upper)
        rest = np.clip(np.zeros_like(last), limits.lower, limits.upper)
        target = start if limits.on_fault is OnFault.HOLD else rest
        self._ramp = Ramp(start, target, limits.ramp_rate)
        back_s = float(np.max(np.abs(start - last) / limits.rate, initial=0.0))
        self.duration_s = back_s + self._ramp.duration_s + HOLD_S
        """How long it takes [s], with the way of the commands back to where the joints are."""

    def at(self, time_s: float) -> FloatArray:
        """What is wanted at a time.

        Args:
            time_s: Since its start [s].

        Returns:
            Joint angles [rad], shape (m,).
        """
        return self._ramp.at(time_s)


_SHOWN = 8


def why_not_from(angle: FloatArray, limits: GateLimits, waited_s: float) -> str | None:
    """Why a drive can't start from a pose.

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
        silent = _listed([names[i] for i in unknown], len(names))
        return (
            f"the pose is not known, {silent} told no angle within {waited_s:.2g} s; is the robot "
            "switched on, and does it report unasked?"
        )
    beyond = np.maximum(limits.lower - angle, angle - limits.upper)
    worst = int(np.argmax(beyond - limits.tracking_error))
    if beyond[worst] > limits.tracking_error[worst]:
        return (
            f"{names[worst]} is at {angle[worst]:.3f} rad, {beyond[worst]:.3f} rad beyond its "
            "limits; bring it back by hand"
        )
    return None


def _listed(names: list[str], of: int) -> str:
    if len(names) == of:
        return f"all {of} joints"
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
