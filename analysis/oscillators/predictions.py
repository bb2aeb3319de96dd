"""What the couplings of kicks predict, and what a homogeneous chain would do.

A chain whose every joint is coupled to the others alike, by their distance only, has a P that is
constant along its diagonals. The nearest such matrix to P (its diagonals' means), with rows scaled
to sum to 1 and I - P scaled to the same norm, is compared with P.

Generators with feedback from their own servos, predicted from open-loop kicks.

    phi_i' = omega + eps (2 (q_i/A) cos phi_i - b_i) + explicit coupling

Of q_i = g_i A sin(phi_i + Delta_i) a cycle leaves eps (g_i sin Delta_i - b_i). With the bias
b_i = g_i sin Delta_i the gait goes on as it is; a small deviation d phi of the commands turns the
responses by P d phi and changes their log amplitude by R d phi, so

    d phi' = eps (diag(g cos Delta) (P - I) + diag(g sin Delta) R) d phi,

which has no parameter to fit. It holds for eps well below the rates at which the body settles.

P read as entrainment: each joint drawn by its own command, and by the other joints.

    phi_i' = omega + Gamma_i sin(psi_c,i - phi_i) + sum_j K_ij sin(phi_j - phi_i - psi_ij)

Small steady kicks of the commands then give (Gamma + L) d phi = Gamma d psi_c, with Gamma and L the
slopes in the settled pattern, so

    P = (Gamma + L)^-1 Gamma,      P^-1 - I = Gamma^-1 L.

Settled phases determine coupling relative to the entrainment only: time constants of any size give
the same P. Absolute rates need the transients after kicks (:mod:`.chain`).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import toeplitz
from scipy.special import stdtridf, stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ..common import formats
from ..common.estimate import Estimate
from ..estimators.intervals import CONFIDENCE, TAILS, NoisyMatrix, noise_draws
from ..results.coupling import LocalCoupling, Matrix, rows_of
from ..results.oscillators import (
    ENTRAINMENT_LABEL,
    BodyOscillators,
    Comparator,
    Mode,
    RelativeCoupling,
)
from .laplacian import STRONG, Spectrum, SpectrumIntervals, intervals_of, pseudospectrum, spectrum

MOST_CONDITION = 1e6
"""Condition number of P beyond which it isn't inverted."""

MOST_EXPLICIT = 1e6
"""Explicit coupling beyond which no answer is looked for [eps]."""

EXPLICIT_DRAWS = 100
"""Draws of P for the interval of the explicit coupling, each a root to find."""

_MOST_DOF = 1e6
"""Student's t is a normal distribution by then."""


def felt_response(ratio: ComplexArray, omega: float, age_s: float) -> ComplexArray:
    """Return the response as the generator receives it.

    Args:
        ratio: H = a/c as measured, shape (m,).
        omega: Of the gait [rad/s].
        age_s: How old an angle is on average when it is used [s].

    Returns:
        g exp(j Delta), the age part of Delta, shape (m,).
    """
    return (ratio * np.exp(-1j * omega * age_s)).astype(np.complex128)


def relaxation(P: FloatArray, R: FloatArray, felt: ComplexArray) -> FloatArray:
    """Return J / eps of d phi' = J d phi.

    Args:
        P: d psi / d psi_c of the open loop, shape (..., m, m).
        R: d ln|a| / d psi_c of the open loop, shape (..., m, m).
        felt: g exp(j Delta) of the open loop, shape (..., m).

    Returns:
        Shape (..., m, m); P - I where there is no lag and a gain of 1.
    """
    off = P - np.eye(P.shape[-1])
    return felt.real[..., None] * off + felt.imag[..., None] * R


def entrainment(P: NoisyMatrix) -> RelativeCoupling:
    """Read P as the matrix of an entrained chain.

    Args:
        P: d psi / d psi_c with standard errors.

    Returns:
        Gamma^-1 L = P^-1 - I. Intervals are to first order in P's errors E,
        d(P^-1) = -P^-1 E P^-1, with the degrees of freedom of a sum of variances (Welch,
        Biometrika 34, 1947).
    """
    condition = float(np.linalg.cond(P.value))
    finite = condition if np.isfinite(condition) else None
    if not condition < MOST_CONDITION:
        return RelativeCoupling(ENTRAINMENT_LABEL, None, None, finite)
    inverse = np.linalg.inv(P.value)
    squared, error = np.square(inverse), np.square(P.error)
    variance = squared @ error @ squared
    scatter = np.square(squared) @ (np.square(error) / P.dof) @ np.square(squared)
    dof = np.divide(
        np.square(variance), scatter, out=np.full(variance.shape, P.dof.min()), where=scatter > 0
    )
    half = np.asarray(stdtrit(dof, 0.5 + CONFIDENCE / 2) * np.sqrt(variance), dtype=np.float64)
    relative = inverse - np.eye(len(P.value))
    return RelativeCoupling(ENTRAINMENT_LABEL, rows_of(relative), rows_of(half), finite)


def homogeneous(P: FloatArray) -> FloatArray:
    """Return the homogeneous comparator of a chain.

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
    """Return the laplacian of a chain coupled to its next neighbours both ways, with open ends.

    Returns:
        Shape (m, m); its eigenvalues are 4 sin^2(k pi / 2m), k = 0 .. m - 1.
    """
    L = 2.0 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)
    L[0, 0] = L[-1, -1] = 1.0
    return L


def explicit_coupling(P: FloatArray, rate: float = STRONG) -> float | None:
    """Find the coupling between next neighbours that the body's coupling needs in addition.

    Args:
        P: d psi / d psi_c, shape (m, m).
        rate: That every mode but the uniform one is to have at least [eps].

    Returns:
        The smallest K [eps], both ways and the same for all pairs, for which the slowest mode of
        I - P + K L has this rate, L the path's Laplacian; 0 where none is needed, None where none
        is enough.
    """
    from scipy.optimize import brentq  # a quarter of a second, when it is needed

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


def body_oscillators(coupling: LocalCoupling) -> BodyOscillators:
    """Predict oscillators with feedback from their servos.

    Args:
        coupling: From kicks around one gait.

    Returns:
        Modes, comparator, and what explicit coupling must add.
    """
    m, correlation = len(coupling.joints), None
    if coupling.scatter is not None:
        correlation = np.array(coupling.scatter.correlation)[:m, :m]
    P = measured(coupling.P, correlation)
    modes, ends = spectrum(P.value), intervals_of(P.value, P.value + noise_draws(P, 21))
    like = spectrum(homogeneous(P.value))
    explicit = _explicit(P)
    return BodyOscillators(
        answer=_answer(modes, ends, like, explicit),
        joints=coupling.joints,
        slowest=ends.gap,
        strong=ends.strong,
        strong_above=STRONG,
        growth=ends.growth,
        modes=_modes(modes, ends),
        comparator=Comparator(like.gap, like.strong, tuple(like.rates.real.tolist())),
        explicit_coupling=explicit,
        pseudospectrum=pseudospectrum(P),
        entrainment=entrainment(P),
    )


def measured(matrix: Matrix, correlation: FloatArray | None = None) -> NoisyMatrix:
    """Convert a matrix of a result with its errors.

    Args:
        correlation: Of a column's errors, shape (m, m), or None.

    Returns:
        Value, errors, and the degrees of freedom that the intervals' factor implies.
    """
    value, error, half = (
        np.array(values) for values in (matrix.value, matrix.standard_error, matrix.ci95_half)
    )
    # The degrees of freedom from the factor between the two.
    factor = np.divide(half, error, out=np.full(half.shape, np.nan), where=error > 0)
    dof = np.asarray(stdtridf(0.5 + CONFIDENCE / 2, factor), dtype=np.float64)
    usable = np.where(np.isfinite(dof) & (dof > 0), dof, _MOST_DOF)
    return NoisyMatrix(value, error, np.minimum(usable, _MOST_DOF), correlation)


def _modes(modes: Spectrum, ends: SpectrumIntervals) -> tuple[Mode, ...]:
    return tuple(
        Mode(
            real=Estimate(float(rate.real), tuple(ends.real[k].tolist())),
            imag=Estimate(float(rate.imag), tuple(ends.imag[k].tolist())),
            sensitivity=float(modes.sensitivity[k]),
            pattern_abs=tuple(np.abs(modes.patterns[:, k]).tolist()),
            pattern_rad=tuple(np.angle(modes.patterns[:, k]).tolist()),
        )
        for k, rate in enumerate(modes.rates.tolist())
    )


def _explicit(P: NoisyMatrix) -> Estimate:
    value = explicit_coupling(P.value)
    if value is None:
        return Estimate()
    draws = [
        explicit_coupling(P.value + noise_draw)
        for noise_draw in noise_draws(P, 41)[:EXPLICIT_DRAWS]
    ]
    if None in draws:
        return Estimate(value)
    low, high = np.quantile(np.array(draws, dtype=np.float64), TAILS).tolist()
    return Estimate(value, (min(value, low), max(value, high)))


def _answer(modes: Spectrum, ends: SpectrumIntervals, like: Spectrum, explicit: Estimate) -> str:
    count = len(modes.rates)
    answer = (
        f"through the body alone the slowest of {count} patterns {_pace(ends.gap)} and "
        f"{modes.strong} relax at more than {STRONG:g} eps (a homogeneous chain as "
        f"strong: {formats.number(like.gap, 3)} eps, {like.strong})"
    )
    if explicit.value is None:
        return f"{answer}; no coupling of next neighbours lifts all of them to {STRONG:g} eps"
    if explicit.value == 0.0:
        return f"{answer}; that is enough without explicit coupling"
    return (
        f"{answer}; explicit coupling must supply the gap: "
        f"{formats.estimate(explicit, ' eps', most=3)} between next neighbours lifts all to "
        f"{STRONG:g} eps"
    )


def _pace(gap: Estimate) -> str:
    """Describe how a pattern relaxes or grows."""
    if gap.value is None or gap.value >= 0.0:
        return f"relaxes at {formats.estimate(gap, ' eps', most=4)}"
    ends = None if gap.ci95 is None else (-gap.ci95[1], -gap.ci95[0])
    return f"grows at {formats.estimate(Estimate(-gap.value, ends), ' eps', most=4)}"
