"""Modes of I - P, the signed Laplacian of what the body couples.

With P = d psi / d psi_c of open-loop kicks (:mod:`.analysis.experiment.local_coupling`) and
generators with feedback from their own servos, eps P_ij is the embodied coupling, and deviations of
the phases relax as

    d phi' = -eps (I - P) d phi,

for small lags (:mod:`.predictions` has the complete equation). Rows of P sum to 1, by time shift,
so all phases together are a mode of rate 0, whatever the noise: it is left out exactly, by looking
at deviations from the mean only, B'(I - P) B with columns of B orthonormal and orthogonal to 1.
Entries of P may be negative: other rates may be near zero, or below it, and then the body leaves
that pattern alone, or drives it.

P is not normal. Its eigenvalues may move by far more than its entries, so each has an interval and
its condition number |x| |y| / |y'x| (Golub & Van Loan, Matrix Computations, 2013, 7.2.2), and the
pseudospectrum is computed (Trefethen & Embree, Spectra and Pseudospectra, 2005).

How far the eigenvalues of I - P may move if P is off by so much.

z is an eigenvalue of some A + E with |E| = s exactly where the smallest singular value of z I - A
is s (Trefethen & Embree, Spectra and Pseudospectra, 2005, theorem 2.1). The level that the noise of
P has then encloses the rates that the data allow. A is I - P on deviations from the mean phase, as
in :mod:`.laplacian`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eig

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ..common.estimate import Estimate
from ..estimators.intervals import CONFIDENCE, TAILS, NoisyMatrix, noise_draws
from ..results.coupling import rows_of
from ..results.oscillators import Levels

STRONG = 0.1
"""A rate of I - P above this counts as strong: the body brings such a pattern back in 10/eps."""

POINTS = 41
"""Of the grid, each way."""

MARGIN = 0.1
"""Of the grid around the eigenvalues."""


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of I - P without that of all phases together, the slowest first.

    Attributes:
        rates: Eigenvalues [eps], by their real parts, shape (m - 1,).
        patterns: Right eigenvectors less their means, one a column, shape (m, m - 1).
        sensitivity: Condition number of each eigenvalue, 1 in a normal matrix, shape (m - 1,).
    """

    rates: ComplexArray
    patterns: ComplexArray
    sensitivity: FloatArray

    @property
    def gap(self) -> float:
        """Real part of the slowest rate [eps]."""
        return float(self.rates[0].real)

    @property
    def strong(self) -> int:
        """Modes with a rate above ``STRONG``."""
        return int(np.count_nonzero(self.rates.real > STRONG))


@dataclass(frozen=True)
class SpectrumIntervals:
    """What noise of P leaves open.

    Attributes:
        real: 95 % intervals of the rates' real parts, shape (m - 1, 2).
        imag: Of their imaginary parts, shape (m - 1, 2).
        gap: The slowest rate's real part.
        growth: Largest rate at which the sum of squares of a deviation can grow for a while [eps].
    """

    real: FloatArray
    imag: FloatArray
    gap: Estimate
    strong: Estimate
    growth: Estimate


def spectrum(P: FloatArray) -> Spectrum:
    """Return modes of I - P.

    Args:
        P: d psi / d psi_c, rows sum to 1, shape (m, m).
    """
    solution = eig(of_deviations(P), left=True, right=True)
    values, left, right = (np.asarray(array, dtype=np.complex128) for array in solution)
    overlap = np.abs(np.sum(left.conj() * right, axis=0))  # columns are of length 1
    order = np.lexsort((values.imag, values.real))
    patterns = (_basis(len(P)) @ right[:, order]).astype(np.complex128)
    return Spectrum(values[order], patterns, 1.0 / overlap[order])


def of_deviations(P: FloatArray) -> FloatArray:
    """Return I - P as it acts on deviations from the mean phase.

    Args:
        P: d psi / d psi_c, rows sum to 1, shape (..., m, m).

    Returns:
        B'(I - P) B, shape (..., m - 1, m - 1).
    """
    basis = _basis(P.shape[-1])
    return basis.T @ (np.eye(P.shape[-1]) - P) @ basis


def _basis(m: int) -> FloatArray:
    """Return orthonormal columns, all orthogonal to 1, shape (m, m - 1)."""
    whole = np.linalg.qr(np.column_stack([np.ones(m), np.eye(m)[:, 1:]]))[0]
    return whole[:, 1:].astype(np.float64)


def growth(P: FloatArray) -> float:
    """Return the numerical abscissa of P - I: the fastest initial growth of |d phi| [eps].

    Args:
        P: d psi / d psi_c, shape (m, m).

    Returns:
        Largest eigenvalue of the symmetric part, on deviations that sum to 0.
    """
    rates = of_deviations(P)
    return -float(np.linalg.eigvalsh((rates + rates.T) / 2)[0])


def intervals_of(P: FloatArray, drawn: FloatArray) -> SpectrumIntervals:
    """Return intervals of the modes of I - P from draws of P.

    Each draw's eigenvalues are dealt to those of P so that they move least. Noise pushes
    eigenvalues apart and lowers the lowest, in P as in the draws made of it: an interval is the
    draws' one, mirrored at the estimate (the basic bootstrap).

    Args:
        P: Its rows sum to 1, shape (m, m).
        drawn: P with errors that it may have, shape (draws, m, m).
    """
    here = spectrum(P)
    draws = [spectrum(matrix) for matrix in drawn]
    dealt = np.array([_dealt(here.rates, modes.rates) for modes in draws])
    strong, counts = float(here.strong), [float(modes.strong) for modes in draws]
    low, high = np.quantile(counts, TAILS).tolist()
    fastest = growth(P)
    growing = _mirrored(np.array(fastest), np.array([growth(matrix) for matrix in drawn]))
    real = _mirrored(here.rates.real, dealt.real)
    return SpectrumIntervals(
        real=real,
        imag=_mirrored(here.rates.imag, dealt.imag),
        # Of the slowest mode itself: the lowest of several close ones is biased in every draw.
        gap=Estimate(here.gap, tuple(real[0].tolist())),
        strong=Estimate(strong, (min(strong, low), max(strong, high))),
        growth=Estimate(fastest, tuple(growing.tolist())),
    )


def _dealt(rates: ComplexArray, others: ComplexArray) -> ComplexArray:
    """Return another draw's rates in the order of these."""
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, when it is needed

    _, order = linear_sum_assignment(np.abs(rates[:, None] - others[None, :]))
    return others[order]


def _mirrored(value: FloatArray, draws: FloatArray) -> FloatArray:
    """Return basic bootstrap intervals, shape (..., 2)."""
    return np.stack([2.0 * value - end for end in np.quantile(draws, TAILS[::-1], axis=0)], axis=-1)


def smallest_singular(P: FloatArray, real: FloatArray, imag: FloatArray) -> FloatArray:
    """Return sigma_min(z I - A) on a grid.

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


def pseudospectrum(P: NoisyMatrix) -> Levels:
    """Return the levels around all eigenvalues, and the level of the noise of P."""
    here = of_deviations(P.value)
    error = of_deviations(P.value + noise_draws(P, 21)) - here
    noise = np.linalg.norm(error, ord=2, axis=(1, 2))
    reach = float(np.quantile(noise, CONFIDENCE))
    values = np.linalg.eigvals(here)
    margin = MARGIN + reach
    left, right = float(values.real.min()), float(values.real.max())
    real = np.linspace(left - margin, right + margin, POINTS)
    top = float(np.abs(values.imag).max()) + margin
    imag = np.linspace(-top, top, POINTS)
    level = smallest_singular(P.value, real, imag)
    return Levels(tuple(real.tolist()), tuple(imag.tolist()), rows_of(level), reach)
