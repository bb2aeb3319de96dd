"""How a drive ends that has to end early: holding, or down to straight joints."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.safety import OnFault

from .limits import GateLimits
from .ramp import Ramp
from .status import JointStatus

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
