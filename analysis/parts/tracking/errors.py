"""Standard errors of a regression whose residual is correlated, and largest where a joint moves.

The error of a parameter is that of sums over blocks of time, each as large as what the model leaves
in it (Liang & Zeger, Biometrika 73, 1986, doi 10.1093/biomet/73.1.13), with Student's distribution
for as many blocks as would have the weight of all, each with the same. Where a few blocks have all
of the weight, they don't show the error; and where a stationary residual with the autocorrelation
that it has over the whole record explains what they show, its error is more precise (Newey & West,
Econometrica 55, 1987, doi 10.2307/1913610).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.judgement.levels import FEWEST

from ...estimators.intervals import t_factor

MOST = 64
"""Blocks at most: with more, Student's quantile falls by less than 2 %."""

TAPER = 4
"""Correlation times after which an autocorrelation counts no more."""

DECIDES = 0.95
"""Level at which blocks show more than a stationary residual would."""

STRONGEST = 0.95
"""Largest correlation of neighbouring blocks that is reckoned with."""

TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Errors:
    """Errors of r parameters.

    Attributes:
        sd: Standard errors, shape (r,).
        freedom: Degrees of freedom of each, at least 1, shape (r,).
        inflation: What the autocorrelation of the residual makes of each variance, a factor of at
            least 1, shape (r,).
    """

    sd: FloatArray
    freedom: FloatArray
    inflation: FloatArray

    def half(self, k: int) -> float:
        """Return half of parameter k's 95 % interval."""
        return t_factor(float(self.freedom[k])) * float(self.sd[k])


def errors_of(
    t_s: FloatArray, design: FloatArray, residual: FloatArray, chosen: FloatArray
) -> Errors | None:
    """Return the errors of linear combinations of a regression's parameters.

    Args:
        t_s: Times of the n samples [s], shape (n,).
        design: Derivatives of the model by its p parameters, shape (n, p).
        residual: What the model leaves, shape (n,).
        chosen: The combinations, shape (r, p).

    Returns:
        None where the parameters can't be separated, or the record is shorter than what its
        residual takes to forget.
    """
    count, p = design.shape
    scale = np.sqrt(np.mean(design**2, axis=0)) + TINY
    scaled = design / scale
    gram: FloatArray = scaled.T @ scaled
    if np.linalg.cond(gram) > 1 / np.finfo(np.float64).eps:
        return None
    rows = np.asarray(chosen / scale @ np.linalg.inv(gram), dtype=np.float64)  # (r, p)
    parts: FloatArray = scaled @ rows.T  # (n, r): what each sample adds to an estimate
    power = np.sum(parts**2, axis=0)
    plain = power * float(residual @ residual) / max(count - p, 1)
    correlation, memory = _autocorrelation(residual)
    blocks = int(min(count / max(2 * memory, count / MOST), count // 2))
    length_s, several = float(t_s[-1] - t_s[0]), max(blocks, FEWEST)
    edges: FloatArray = t_s[0] + length_s * np.arange(several, dtype=np.float64) / several
    starts: IntArray = np.unique(np.searchsorted(t_s, edges))
    sums = np.add.reduceat(parts * residual[:, None], starts, axis=0)  # (b, r)
    shares = np.add.reduceat(parts**2, starts, axis=0)
    weight = power**2 / np.maximum(np.sum(shares**2, axis=0), TINY)
    freedom: FloatArray = weight - p
    squares = np.sum(sums**2, axis=0)
    rho = np.sum(sums[1:] * sums[:-1], axis=0) / np.maximum(squares, TINY)
    rho = np.clip(rho, 0.0, STRONGEST)
    of_blocks = squares * (1 + rho) / (1 - rho) * weight / np.maximum(freedom, 1)
    inflation = _inflation(parts, correlation, TAPER * memory)
    independent: FloatArray = count / np.maximum(inflation, 1.0)  # samples that would show as much
    stationary = plain * inflation * independent / np.maximum(independent - p, 1)
    # Blocks show it only roughly: they decide where they say clearly more.
    limit = fdtri(np.maximum(freedom, 1), count, DECIDES)
    enough = (freedom >= FEWEST / 2) & (of_blocks > limit * stationary)
    freedom = np.asarray(np.where(enough, freedom, independent - p), np.float64)
    if not (freedom >= 1).all():
        return None
    variance = np.asarray(np.where(enough, of_blocks, stationary), np.float64)
    return Errors(np.sqrt(variance), freedom, np.maximum(inflation, 1.0))


def _autocorrelation(residual: FloatArray) -> tuple[FloatArray, int]:
    """Return the autocorrelation, shape (n,), and the samples after which it is below 1/e."""
    count = residual.size
    spectrum = np.fft.rfft(residual - residual.mean(), 2 * count)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2)[:count]
    correlation = covariance / max(float(covariance[0]), TINY)
    below = np.flatnonzero(correlation < 1 / np.e)
    return correlation, int(below[0]) if below.size else count


def _inflation(parts: FloatArray, correlation: FloatArray, longest: int) -> FloatArray:
    """Return the variance of sums of correlated values over that of white ones, shape (r,)."""
    count = len(parts)
    lags = np.arange(min(longest + 1, count))
    taper = correlation[lags] * (1 - lags / (longest + 1))  # Bartlett's keeps it positive
    spectra = np.abs(np.fft.rfft(parts, 2 * count, axis=0)) ** 2
    products = np.fft.irfft(spectra, axis=0)[lags]  # (l, r): sums of parts times later parts
    whole = products[0] + 2 * taper[1:] @ products[1:]
    return np.maximum(whole / np.maximum(products[0], TINY), 1 / count)
