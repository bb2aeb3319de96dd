"""How far the twin is from the robot, joint by joint: RMS, gain and time.

Without a gait to assume: the measured angle is regressed on the twin's angle q and its rate::

    measured = (1 + g) (q - d q')

to first order in d; g is what the robot's amplitude is larger by, d how much later it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

_STILL = 1e-3
"""A joint that moves less has no gain [rad, RMS]."""


@dataclass(frozen=True)
class Misfit:
    """One joint.

    Attributes:
        rms: Of measured minus twin [rad].
        gain: g, positive where the robot moves more than the twin; None of a joint that is still.
        late_s: d [s], positive where the robot is later; likewise.
    """

    rms: float
    gain: float | None = None
    late_s: float | None = None


def misfit(times_s: FloatArray, measured: FloatArray, twin: FloatArray) -> Misfit:
    """Hold one joint against the twin's.

    Args:
        times_s: Sampling times [s], shape (n,).
        measured: Less the mean [rad], shape (n,).
        twin: Likewise.

    Returns:
        What is between them.
    """
    rms = float(np.sqrt(np.mean((measured - twin) ** 2)))
    if np.sqrt(np.mean(twin**2)) < _STILL or np.unique(times_s).size < times_s.size:
        return Misfit(rms)
    rate = np.gradient(twin, times_s)
    along, late = np.linalg.lstsq(np.stack([twin, rate - rate.mean()], axis=1), measured)[0]
    return Misfit(rms, float(along - 1.0), float(-late / along))
