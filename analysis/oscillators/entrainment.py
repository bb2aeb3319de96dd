"""P read as entrainment: each joint drawn by its own command, and by the other joints.

    phi_i' = omega + Gamma_i sin(psi_c,i - phi_i) + sum_j K_ij sin(phi_j - phi_i - psi_ij)

Small steady kicks of the commands then give (Gamma + L) d phi = Gamma d psi_c, with Gamma and L the
slopes in the settled pattern, so

    P = (Gamma + L)^-1 Gamma,      P^-1 - I = Gamma^-1 L.

Settled phases tell coupling relative to the entrainment only: times of any size give the same P.
Absolute rates need the way back from kicks (:mod:`.chain`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import FloatArray

from ..estimators.intervals import CONFIDENCE
from ..estimators.norm_ratio import Noisy

MOST_CONDITION = 1e6
"""Condition number of P beyond which it isn't inverted."""


@dataclass(frozen=True)
class Entrainment:
    """Gamma^-1 L.

    Attributes:
        relative: P^-1 - I: minus the coupling K_ij / Gamma_i off the diagonal; None where P is
            singular; shape (m, m).
        half: Half widths of the 95 % intervals, one by one, shape (m, m).
        condition_number: Of P: what its inversion may multiply relative errors by.
    """

    relative: FloatArray | None
    half: FloatArray | None
    condition_number: float


def entrainment(P: Noisy) -> Entrainment:
    """Read P as an entrained chain.

    Args:
        P: d psi / d psi_c with standard errors.

    Returns:
        The reading. Intervals are to first order in P's errors E, d(P^-1) = -P^-1 E P^-1, with the
        degrees of freedom of a sum of variances (Welch, Biometrika 34, 1947).
    """
    condition = float(np.linalg.cond(P.value))
    if not condition < MOST_CONDITION:
        return Entrainment(None, None, condition)
    inverse = np.linalg.inv(P.value)
    squared, error = np.square(inverse), np.square(P.error)
    variance = squared @ error @ squared
    scatter = np.square(squared) @ (np.square(error) / P.dof) @ np.square(squared)
    dof = np.divide(
        np.square(variance), scatter, out=np.full(variance.shape, P.dof.min()), where=scatter > 0
    )
    half = np.asarray(stdtrit(dof, 0.5 + CONFIDENCE / 2) * np.sqrt(variance), dtype=np.float64)
    return Entrainment(inverse - np.eye(len(P.value)), half, condition)
