"""95 % intervals, equivalence tests, and ratios of norms with noise.

Two one-sided tests: only they can support the claim that joints are alike.

Schuirmann, J. Pharmacokinetics and Biopharmaceutics 15 (1987), doi 10.1007/BF01068419; claimed for
all joints at once, so the largest p counts and needs no correction (intersection-union test,
Berger, Technometrics 24, 1982).

Ratios of norms of noisy matrices, with noise taken off and intervals that hold near zero.

A norm of noise is never zero: of D = truth + e the mean of ||D||^2 is ||truth||^2 + E||e||^2, so
E||e||^2 is subtracted. By the triangle inequality ||truth|| lies within ||D|| -+ ||e||, so with q
the quantile of ||e|| the interval ||D|| -+ q covers at least as often as q says, also where the
truth is zero and a bootstrap would not.

Variance of contrasts between joints whose noise is not independent.

Noise that joints share (of a clock, a bus, a body that rocks) cancels in one contrast of their
responses and adds up in another, and no sum of the joints' own variances shows which. But each
joint's residual is there in the same bins beside omega, so a contrast has bins of its own: the
weighted sum of the joints' bins. Their mean power is the contrast's variance, with two degrees
of freedom a bin, whatever is shared by whom.

The error of ln H = ln a - ln c is, to first order, e = da / a - dc / c: a complex number whose
real part is the error of log gain and whose imaginary part is that of arg H, minus the lag. The
noise near omega is taken to be stationary, so the two parts have the same variance, half of
E|e|^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, gammaln, stdtr, stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

from ..common.estimate import Estimate, Interval
from .spectrum import ResidualBins

EQUIVALENT_GAIN = 0.02
EQUIVALENT_LAG_RAD = np.pi / 180
"""Default margins: 2 % in gain, 1 degree in lag."""

CONFIDENCE = 0.95
TAILS = ((1 - CONFIDENCE) / 2, 1 - (1 - CONFIDENCE) / 2)
"""Quantiles at the ends of an interval."""

DRAWS = 400

_MOST_STEPS = 60
_EXACT = 1e-12
_TINY = 1e-300


@dataclass(frozen=True)
class ResponseErrors:
    """What the errors of ln H of m joints would be in each of L bins beside omega.

    Attributes:
        bins: Complex, shape (m, L), scaled so that E[e_i conj(e_j)] of the errors e of ln H of
            joints i and j is the mean over l of ``bins[i, l] * conj(bins[j, l])``. The real part
            of that is twice the covariance of their log gains and twice that of their lags.
        rounding: Covariance of (ln|H|, arg H) that rounding to steps adds to what the bins show
            and that no two joints share, shape (m, 2, 2).
        turn: Lag error that one standard error of the shared frequency makes [rad], shape (m,);
            it is the same error in all joints.
        steps: Variances of ln|H| and arg H by rounding to steps alone, shape (m, 2); None for zero.
    """

    bins: ComplexArray
    rounding: FloatArray
    turn: FloatArray
    steps: FloatArray | None = None

    def select(self, chosen: Sequence[int] | IntArray) -> ResponseErrors:
        """Some of the joints.

        Args:
            chosen: Indices, k of them.
        """
        index = np.asarray(chosen, dtype=np.int64)
        steps = None if self.steps is None else self.steps[index]
        return ResponseErrors(self.bins[index], self.rounding[index], self.turn[index], steps)


def response_errors(
    command: ComplexArray,
    command_bins: ResidualBins,
    response: ComplexArray,
    response_bins: ResidualBins,
    *,
    omega_variance: float = 0.0,
    delay_between_s: FloatArray | float = 0.0,
) -> ResponseErrors:
    """Errors of ln H in each bin: response_bins / a - command_bins / c, scaled to the estimate.

    Args:
        command: Fundamentals c of the commands, shape (m,).
        response: Fundamentals a of the responses, shape (m,).
        response_bins: Their residuals, in the same bins.
        omega_variance: Variance of the shared frequency [(rad/s)^2].
        delay_between_s: Mean sampling time of the response minus that of the command [s], (m,).

    Returns:
        The errors; NaN for a joint whose command or response is zero.
    """
    parts: list[ComplexArray] = []
    rounding, steps = np.zeros((2, response.size, 2, 2))
    for amplitude, bins in ((response, response_bins), (command, command_bins)):
        nonzero = np.abs(amplitude) > 0
        inverse = np.full(amplitude.shape, np.nan, dtype=np.complex128)
        np.divide(1.0, amplitude, out=inverse, where=nonzero)
        parts.append((inverse * np.sqrt(bins.spread))[:, None] * bins.values)
        # Multiplied by 1/a, errors of (Re a, Im a) become those of (ln|a|, arg a).
        turned = np.stack([inverse, 1j * inverse], axis=1)
        turned = np.stack([turned.real, turned.imag], axis=1)
        rounding += turned @ bins.rounding @ turned.transpose(0, 2, 1)
        if bins.steps is not None:
            steps += turned @ bins.steps @ turned.transpose(0, 2, 1)
    turn = np.zeros(response.size) + omega_variance**0.5 * np.asarray(delay_between_s)
    alone = np.einsum("mii->mi", steps)
    return ResponseErrors(parts[0] - parts[1], rounding, turn, alone)


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


def holm(p: FloatArray) -> FloatArray:
    """Return step-down p-values that hold for the whole family (Holm 1979).

    Args:
        p: Of each by itself, shape (k,).

    Returns:
        Adjusted, shape (k,).
    """
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted


def welch_satterthwaite(variances: FloatArray, dof: FloatArray) -> FloatArray:
    """Return the degrees of freedom of a sum of estimated variances (Welch, Biometrika 34, 1947).

    Args:
        variances: Shape (parts, ...).
        dof: Degrees of freedom of each, same shape.

    Returns:
        Shape (...); the smallest of the parts where all variances are zero.
    """
    total = np.sum(variances, axis=0)
    scatter = np.sum(variances**2 / dof, axis=0)
    return np.divide(total**2, scatter, out=np.min(dof, axis=0), where=scatter > 0)


def t_factor(dof: float) -> float:
    """Two-sided Student factor on a standard error, at 95 %."""
    return float(stdtrit(dof, 0.5 + CONFIDENCE / 2))


def around(value: float, half: float) -> Interval:
    """Return the interval of a value with a half width."""
    return value - half, value + half


@dataclass(frozen=True)
class NoisyMatrix:
    """A measured matrix; columns are independent of each other.

    Attributes:
        value: Shape (n, m).
        error: Standard errors, same shape.
        dof: Degrees of freedom of the errors, same shape.
        correlation: Of a column's errors, shape (n, n); None where they are independent.
    """

    value: FloatArray
    error: FloatArray
    dof: FloatArray
    correlation: FloatArray | None = None

    @property
    def half(self) -> FloatArray:
        """Half widths of the 95 % intervals, one by one, shape (n, m)."""
        return self.error * stdtrit(self.dof, 0.5 + CONFIDENCE / 2)

    @property
    def half_together(self) -> FloatArray:
        """Half widths that hold for all elements off the diagonal together (Bonferroni)."""
        m = len(self.value)
        return self.error * stdtrit(self.dof, 1 - (1 - CONFIDENCE) / (2 * m * (m - 1)))


def noise_draws(matrix: NoisyMatrix, seed: int) -> FloatArray:
    """Return the errors that a measured matrix may have.

    Returns:
        Student draws, shape (DRAWS, n, m). Where errors of a column are correlated their variances
        come from the same runs, so all are too small together.
    """
    random = np.random.default_rng(seed)
    if matrix.correlation is None:
        dof = np.broadcast_to(matrix.dof, (DRAWS, *matrix.dof.shape))
        return matrix.error * random.standard_t(dof)
    values, vectors = np.linalg.eigh(matrix.correlation)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    normal = root @ random.standard_normal((DRAWS, *matrix.error.shape))
    level = random.uniform(size=(DRAWS, 1, 1))
    return matrix.error * normal * np.sqrt(matrix.dof / chdtri(matrix.dof, level))


def norm_ratio(
    above: FloatArray | ComplexArray,
    above_noise: FloatArray | ComplexArray,
    below: FloatArray | ComplexArray,
    below_noise: FloatArray | ComplexArray,
) -> Estimate:
    """A ratio of two Frobenius norms.

    Args:
        above: Any shape.
        above_noise: Draws of its error, shape (draws, ...).
        below: Any shape.

    Returns:
        The ratio with its interval, at least 95 %; without a value where what is below can't be
        told from noise, without an interval where its norm's interval reaches zero.
    """
    (top, top_half), (bottom, bottom_half) = (
        _norm(*pair) for pair in ((above, above_noise), (below, below_noise))
    )
    plain = [float(np.linalg.norm(values)) for values in (above, below)]
    if bottom == 0:
        return Estimate()
    if plain[1] <= bottom_half:
        return Estimate(top / bottom)
    low = max(0.0, plain[0] - top_half) / (plain[1] + bottom_half)
    return Estimate(top / bottom, (low, (plain[0] + top_half) / (plain[1] - bottom_half)))


def _norm(
    value: FloatArray | ComplexArray, noise: FloatArray | ComplexArray
) -> tuple[float, float]:
    """Return the norm without what noise adds, and the quantile of the noise's own norm."""
    sizes: FloatArray = np.linalg.norm(noise.reshape(len(noise), value.size), axis=1).astype(
        np.float64
    )
    squared = float(np.linalg.norm(value)) ** 2 - float(np.mean(sizes**2))
    # Two norms share the 5 %.
    return max(0.0, squared) ** 0.5, float(np.quantile(sizes, 1 - (1 - CONFIDENCE) / 2))


def mixture_interval(
    share: FloatArray, mean: FloatArray, scale: FloatArray, dof: int
) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the half width of a mixture of Student's t, each of shape (k,).

    Args:
        share: Of each part, shape (p, 1).
        mean: Shape (p, k).
        scale: Shape (p, k).
        dof: Degrees of freedom of all parts.
    """
    centre = (share * mean).sum(axis=0)
    quantile = np.array([[(1 - CONFIDENCE) / 2], [(1 + CONFIDENCE) / 2]])
    peak = float(np.exp(gammaln((dof + 1) / 2) - gammaln(dof / 2))) / (np.pi * dof) ** 0.5
    # Newton's steps from where all parts have their own quantile, within what brackets it.
    bounds = mean[:, np.newaxis] + stdtrit(dof, quantile) * scale[:, np.newaxis]
    low, high = bounds.min(axis=0), bounds.max(axis=0)
    ends: FloatArray = (share[:, np.newaxis] * bounds).sum(axis=0)
    for _ in range(_MOST_STEPS):
        t = (ends - mean[:, np.newaxis]) / scale[:, np.newaxis]
        excess: FloatArray = np.sum(share[:, np.newaxis] * stdtr(dof, t), axis=0) - quantile
        density = share[:, np.newaxis] * peak * (1 + t**2 / dof) ** (-(dof + 1) / 2)
        low, high = np.where(excess < 0, ends, low), np.where(excess < 0, high, ends)
        slope = np.maximum(np.sum(density / scale[:, np.newaxis], axis=0), _TINY)
        step = ends - excess / slope
        inside = (step >= low) & (step <= high)
        before, ends = ends, np.where(inside, step, (low + high) / 2)
        if np.all(np.abs(ends - before) <= _EXACT * (np.abs(ends - centre) + scale.min(axis=0))):
            break
    return centre, np.maximum(ends[1] - centre, centre - ends[0])


def positive_interval(values: FloatArray, weights: FloatArray) -> tuple[float, float, float]:
    """Return the median of a positive quantity and its interval."""
    order = np.argsort(values, kind="stable")
    running = np.cumsum(weights[order])
    middle = running - weights[order] / 2
    levels = (0.5, (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
    quantiles = np.exp(np.interp(levels, middle, np.log(values[order])))
    return float(quantiles[0]), float(quantiles[1]), float(quantiles[2])
