"""What a homogeneous chain of the same strength would do, and what is lacking.

A chain whose every joint is coupled to the others alike, by their distance only, has a P that is
constant along its diagonals. The nearest such matrix to P (its diagonals' means), with rows scaled
to sum to 1 and I - P scaled to the same norm, is compared with P.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import brentq

from undulog.capture.common.arrays import FloatArray

from .laplacian import STRONG, spectrum

MOST_EXPLICIT = 1e6
"""Explicit coupling beyond which no answer is looked for [eps]."""


def homogeneous(P: FloatArray) -> FloatArray:
    """The homogeneous comparator of a chain.

    Args:
        P: d psi / d psi_c, rows sum to 1, shape (m, m).

    Returns:
        Toeplitz but for its rows' scale: they sum to 1, and ||I - P|| is that of P (Frobenius).
    """
    m = len(P)
    below = [float(np.diagonal(P, -k).mean()) for k in range(m)]
    ahead = [float(np.diagonal(P, k).mean()) for k in range(m)]
    means = np.asarray(toeplitz(below, ahead), dtype=np.float64)
    off = np.eye(m) - means / means.sum(axis=1, keepdims=True)
    scale = np.linalg.norm(np.eye(m) - P) / np.linalg.norm(off)
    return np.eye(m) - scale * off


def path_laplacian(m: int) -> FloatArray:
    """Laplacian of a chain coupled to its next neighbours both ways, with open ends.

    Args:
        m: Oscillators.

    Returns:
        Shape (m, m); its eigenvalues are 4 sin^2(k pi / 2m), k = 0 .. m - 1.
    """
    L = 2.0 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)
    L[0, 0] = L[-1, -1] = 1.0
    return L


def explicit_coupling(P: FloatArray, rate: float = STRONG) -> float | None:
    """What coupling between next neighbours must add to that through the body.

    Args:
        P: d psi / d psi_c, shape (m, m).
        rate: That every mode but the uniform one is to have at least [eps].

    Returns:
        The smallest K [eps], both ways and the same for all pairs, for which the slowest mode of
        I - P + K L has this rate, L the path's Laplacian; 0 where none is needed, None where none
        is enough.
    """
    L = path_laplacian(len(P))

    def lacking(K: float) -> float:
        return spectrum(P - K * L).gap - rate

    if lacking(0.0) >= 0.0:
        return 0.0
    enough = rate
    while lacking(enough) < 0.0:
        enough *= 2.0
        if enough > MOST_EXPLICIT:
            return None
    return float(brentq(lacking, 0.0, enough, xtol=1e-6))
