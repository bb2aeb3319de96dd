"""Two one-sided tests: only they can support the claim that joints are alike.

Schuirmann, J. Pharmacokinetics and Biopharmaceutics 15 (1987), doi 10.1007/BF01068419; claimed for
all joints at once, so the largest p counts and needs no correction (intersection-union test,
Berger, Technometrics 24, 1982).
"""

from __future__ import annotations

import numpy as np
from scipy.special import stdtr

from undulog.capture.common.arrays import FloatArray

EQUIVALENT_GAIN = 0.02
EQUIVALENT_LAG_RAD = np.pi / 180
"""Default margins: 2 % in gain, 1 degree in lag."""


def equivalence_p(
    deviation: FloatArray, error: FloatArray, dof: FloatArray | float, margin: float
) -> float:
    """p-value against 'some deviation is as large as the margin'.

    Args:
        deviation: Estimates, shape (m,).
        error: Their standard errors, in the same unit, shape (m,).
        dof: Degrees of freedom of the errors, shape (m,) or one for all.
        margin: Positive, in the same unit.

    Returns:
        Small where all m deviations are shown to lie within the margin.
    """
    room = margin - np.abs(deviation)
    score = np.divide(room, error, out=np.sign(room) * np.inf, where=error > 0)
    return float(np.max(stdtr(dof, -score)))
