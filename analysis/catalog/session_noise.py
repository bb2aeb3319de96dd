r"""Noise of joints from session to session: its size, memory and tails.

Sessions of one robot have memory: servos warm up, batteries age, joints are mounted anew. The
series of a joint, less what all joints of a session have in common, is taken as

.. math:: e_i = \rho e_{i-1} + \sqrt{1 - \rho^2}\, \sigma_j z_i

with a scatter for each joint, with rho pooled over the joints, and the tails of z (Student's t)
over the quantities, too: where joints are mounted anew or batteries fail, all have outliers. The
lag-one correlation of short series is biased towards zero (Kendall, Biometrika 41, 1954), and more
so once conditions and the other joints are subtracted. So rho and the tails are those whose
simulated estimates have the observed one as their median, and the upper 90 % limit of rho is that
whose estimates are above the observed one in 90 % of the simulations (inversion of a test). What is
subtracted and which values are missing is the same in each simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

_RHOS = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
"""Lag-one correlations that are simulated; beyond, noise is a random walk over 50 sessions."""
_TAILS = np.array([0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5])
"""Inverse degrees of freedom that are simulated: from normal noise to infinite variance."""
_DRAWS = (50, 200)
"""Fewest and most simulations of each: with 200 the 10 % point has a level of 8 to 12 %; a long
series narrows the limit itself."""
_MOST_VALUES = 400_000
"""Simulated values of each, for 200 simulations of 60 sessions of 25 joints."""
_UPPER = 0.9
_KEPT = 0.8
"""Share of the differences, the smallest, that the scatter is computed from: with a fifth at
changes and outliers it is hardly larger."""
_TRIMMED = 0.4377
r"""Mean of the smallest 80 % of squares of standard normal numbers: 1 - 2 q phi(q) / 0.8, with q =
1.2816 the 90 % point and phi the density."""


@dataclass(frozen=True)
class SessionNoise:
    """Noise of the joints of a robot in one quantity.

    Attributes:
        rho: Lag-one correlation from session to session, without bias in the median.
        upper: Its upper 90 % limit.
        tail: Inverse degrees of freedom of the innovations; 0 for normal ones.
        least_tail: Its lower 90 % limit: noise whose tails aren't shown is normal.
        sampling: Variance, by chance, of the logarithm of a joint's scatter.
        scatter: Standard deviation of each joint, shape (n_joints,).
    """

    rho: float
    upper: float
    tail: float
    least_tail: float
    sampling: float
    scatter: FloatArray


def relative_to_others(values: FloatArray, conditions: IntArray) -> FloatArray:
    """Subtract what all joints of a session have in common.

    It is the median, over the joints, of their deviations from their own medians in sessions of the
    same condition: a joint that changes doesn't move it.

    Args:
        values: Shape (..., n_sessions, n_joints), NaN where unknown.
        conditions: Number of each session's condition, shape (n_sessions,).
    """
    return values - _median(centred(values, conditions), axis=-1)


def centred(values: FloatArray, conditions: IntArray) -> FloatArray:
    """Subtract the median of each joint in each condition; shape (..., n_sessions, n_joints)."""
    residuals = np.empty_like(values)
    for condition in np.unique(conditions):
        rows = conditions == condition
        residuals[..., rows, :] = values[..., rows, :] - _median(values[..., rows, :], axis=-2)
    return residuals


def _median(values: FloatArray, axis: int) -> FloatArray:
    """Return the median of what is not NaN, NaN without any; the axis is kept, of length 1."""
    ordered = np.sort(values, axis=axis)
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[axis] - 1)
    ends = [np.take_along_axis(ordered, index, axis=axis) for index in (low, high)]
    return 0.5 * (ends[0] + ends[1])


def scatter(residuals: FloatArray, rho: float, sampling: float) -> FloatArray:
    """Return the standard deviation of each joint, from differences of consecutive sessions.

    Changes and outliers of a joint move few of its differences. Short series give a scatter with a
    large error, and the largest of many statistics would be that of a joint whose scatter is small
    by chance: so its logarithm is shrunk to the mean of the joints, by as much as chance explains
    of their spread (empirical Bayes; Efron and Morris, J. Am. Stat. Assoc. 68, 1973).

    Args:
        residuals: As :func:`centred` gives them, shape (..., n_sessions, n_joints).
        sampling: Variance of the logarithm by chance.

    Returns:
        Shape (..., n_joints), 0 for a joint that is constant.
    """
    size = _log_scatter(residuals, rho)
    count = np.isfinite(size).sum(axis=-1, keepdims=True)
    mean = np.nansum(size, axis=-1, keepdims=True) / np.maximum(count, 1)
    spread = np.nansum((size - mean) ** 2, axis=-1, keepdims=True) / np.maximum(count - 1, 1)
    weight = 1 - np.minimum(sampling / np.maximum(spread, np.finfo(float).tiny), 1.0)
    shrunk = np.exp(mean + weight * (size - mean))
    return np.where(np.isfinite(shrunk), shrunk, 0.0)


def _log_scatter(residuals: FloatArray, rho: float) -> FloatArray:
    """Return ln standard deviation, of each joint by itself; NaN for one that is constant."""
    squares = np.sort(np.diff(residuals, axis=-2) ** 2, axis=-2)
    most: FloatArray = np.ceil(_KEPT * np.isfinite(squares).sum(axis=-2, keepdims=True))
    rank: IntArray = np.arange(int(squares.shape[-2]))[:, None]
    kept = np.where(rank < most, squares, 0.0)
    mean = kept.sum(axis=-2) / np.maximum(most[..., 0, :], 1)
    variance = mean / (2 * (1 - rho) * _TRIMMED)
    return 0.5 * np.log(np.where(variance > 0, variance, np.nan))


def estimate_noise(
    series: Sequence[FloatArray], conditions: IntArray, rng: np.random.Generator
) -> list[SessionNoise]:
    """Estimate the noise of each quantity; they share the tails.

    Args:
        series: As :func:`relative_to_others` gives them, each of shape (n_sessions, n_joints).
        conditions: Number of each session's condition, shape (n_sessions,).
    """
    noises: list[SessionNoise] = []
    observed, simulated = 0.0, np.zeros((len(_TAILS), 1))
    for relative in series:
        residuals, present = centred(relative, conditions), np.isfinite(relative)
        draws = int(np.clip(_MOST_VALUES // relative.size, *_DRAWS))
        normal, even = rng.standard_normal((draws, *relative.shape)), np.ones_like(relative[0])
        by_rho = np.stack(
            [_lag_one(_residuals_of(normal, rho, even, present, conditions)) for rho in _RHOS]
        )
        lag_one = float(_lag_one(residuals))
        rho = _inverted(lag_one, np.median(by_rho, axis=1), _RHOS)
        upper = _inverted(lag_one, np.quantile(by_rho, 1 - _UPPER, axis=1), _RHOS)
        drawn = [
            _residuals_of(innovations(normal, tail, rng), rho, even, present, conditions)
            for tail in _TAILS
        ]
        observed += float(_heaviness(residuals))
        simulated = simulated + np.stack([_heaviness(values) for values in drawn])
        by_chance = _log_scatter(drawn[0], rho)
        sampling = float(by_chance[:, np.isfinite(by_chance).all(axis=0)].var(axis=0).mean())
        size = scatter(residuals, rho, sampling)
        noises.append(SessionNoise(rho, upper, 0.0, 0.0, sampling, size))
    tail = _inverted(observed, np.median(simulated, axis=1), _TAILS)
    least = _inverted(observed, np.quantile(simulated, _UPPER, axis=1), _TAILS)
    return [replace(noise, tail=tail, least_tail=least) for noise in noises]


def _inverted(observed: float, simulated: FloatArray, parameters: FloatArray) -> float:
    return float(np.interp(observed, np.maximum.accumulate(simulated), parameters))


def _lag_one(residuals: FloatArray) -> FloatArray:
    """Return the mean over the joints of their lag-one correlation, without its ends; shape (...).

    A fifth of the joints, with the largest and with the smallest, is left out: of a joint that
    changes it is near 1.
    """
    products = np.nansum(residuals[..., 1:, :] * residuals[..., :-1, :], axis=-2)
    power = np.nansum(residuals**2, axis=-2)
    varies = power > 0
    ratio = np.sort(np.where(varies, products / np.where(varies, power, 1.0), np.nan), axis=-1)
    count = varies.sum(axis=-1, keepdims=True)
    cut = (count + 2) // 5  # one of three
    rank: IntArray = np.arange(int(ratio.shape[-1]))
    kept: BoolArray = np.logical_and(rank >= cut, rank < count - cut)
    return np.where(kept, ratio, 0.0).sum(axis=-1) / np.maximum(kept.sum(axis=-1), 1)


def _heaviness(residuals: FloatArray) -> FloatArray:
    """Return the 97.5 % point over the median of all joints' standardised differences.

    A fortieth of the values may be changes and outliers without moving it much.
    """
    sizes = np.abs(np.diff(residuals, axis=-2))
    middle = _median(sizes, axis=-2)
    sizes = np.where(middle > 0, sizes / np.where(middle > 0, middle, 1.0), np.nan)
    flat = np.sort(sizes.reshape(*sizes.shape[:-2], -1), axis=-1)
    last = np.isfinite(flat).sum(axis=-1, keepdims=True) - 1
    point = np.maximum(np.floor(0.975 * last).astype(np.int64), 0)
    return np.nan_to_num(np.take_along_axis(flat, point, axis=-1)[..., 0])


def innovations(normal: FloatArray, tail: float, rng: np.random.Generator) -> FloatArray:
    """Turn normal numbers into those of Student's t with ``1 / tail`` degrees of freedom."""
    if tail <= 0:
        return normal
    return normal / np.sqrt(tail * rng.chisquare(1 / tail, normal.shape))


def simulate(
    noise: SessionNoise,
    tail: float,
    present: BoolArray,
    conditions: IntArray,
    normal: FloatArray,
) -> FloatArray:
    """Simulate fleets without changes and outliers, at the upper limit of the memory.

    Args:
        tail: Inverse degrees of freedom of the innovations.
        present: Whether a joint has a value in a session, shape (n_sessions, n_joints).
        conditions: Number of each session's condition, shape (n_sessions,).

        normal: Normal numbers, shape (draws, n_sessions, n_joints).

    Returns:
        As :func:`centred` gives the fleet itself, shape (draws, n_sessions, n_joints).
    """
    innovation = innovations(normal, tail, np.random.default_rng(2))
    return _residuals_of(innovation, noise.upper, noise.scatter, present, conditions)


def _residuals_of(
    innovation: FloatArray,
    rho: float,
    size: FloatArray,
    present: BoolArray,
    conditions: IntArray,
) -> FloatArray:
    values = innovation.copy()
    for k in range(1, values.shape[-2]):
        values[..., k, :] *= np.sqrt(1 - rho**2)
        values[..., k, :] += rho * values[..., k - 1, :]
    values = np.where(present, size * values, np.nan)
    return centred(relative_to_others(values, conditions), conditions)
