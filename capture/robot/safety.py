"""How far a robot may be driven: the ``safety`` of a robot description.

Nothing here has a default that matters: a limit that the file does not give is None, and a robot
that lacks one that arming needs is not driven (:func:`missing_limits`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ..common.arrays import FloatArray, frozen
from ..common.config import Positive

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

    max_rate: Positive | None = None
    ramp_rate: Positive | None = None
    max_tracking_error: Positive | None = None
    max_current: Positive | None = None
    max_temperature: float | None = None
    min_voltage: Positive | None = None
    reply_timeout_s: Positive | None = None
    max_late_s: Positive | None = None
    fault_after_s: Positive = 0.3
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
