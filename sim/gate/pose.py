"""Whether a drive can start from the pose that a robot has."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray

from .limits import GateLimits

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
