"""How far the eigenvalues of I - P may move if P is off by so much.

z is an eigenvalue of some A + E with |E| = s exactly where the smallest singular value of z I - A
is s (Trefethen & Embree, Spectra and Pseudospectra, 2005, theorem 2.1). The level that the noise of
P has then encloses the rates that the data allow. A is I - P on deviations from the mean phase, as
in :mod:`.laplacian`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ..estimators.intervals import CONFIDENCE
from ..estimators.norm_ratio import Noisy, noise_draws
from .laplacian import of_deviations

POINTS = 41
"""Of the grid, each way."""

MARGIN = 0.1
"""Of the grid around the eigenvalues."""


@dataclass(frozen=True)
class Pseudospectrum:
    """Levels on a grid of the complex plane.

    Attributes:
        real: Of z [eps], shape (r,).
        imag: Of z [eps], shape (c,).
        level: Smallest singular value of z I - A, shape (r, c).
        noise: The spectral norm that the error of A stays below, 95 %.
    """

    real: FloatArray
    imag: FloatArray
    level: FloatArray
    noise: float


def smallest_singular(P: FloatArray, real: FloatArray, imag: FloatArray) -> FloatArray:
    """sigma_min(z I - A) on a grid.

    Args:
        P: d psi / d psi_c, shape (m, m).
        real: Of z, shape (r,).
        imag: Of z, shape (c,).

    Returns:
        Shape (r, c).
    """
    z = (real[:, None] + 1j * imag[None, :])[..., None, None]
    values = np.linalg.svd(z * np.eye(len(P) - 1) - of_deviations(P), compute_uv=False)
    return values[..., -1].astype(np.float64)


def pseudospectrum(P: Noisy, seed: int = 21) -> Pseudospectrum:
    """The levels around all eigenvalues.

    Args:
        P: With standard errors.
        seed: Of the draws that tell the noise's norm.

    Returns:
        Levels and the noise's own.
    """
    here = of_deviations(P.value)
    error = of_deviations(P.value + noise_draws(P, seed)) - here
    noise = np.linalg.norm(error, ord=2, axis=(1, 2))
    reach = float(np.quantile(noise, CONFIDENCE))
    values: ComplexArray = np.linalg.eigvals(here).astype(np.complex128)
    margin = MARGIN + reach
    left, right = float(values.real.min()), float(values.real.max())
    real = np.linspace(left - margin, right + margin, POINTS)
    top = float(np.abs(values.imag).max()) + margin
    imag = np.linspace(-top, top, POINTS)
    return Pseudospectrum(real, imag, smallest_singular(P.value, real, imag), reach)
