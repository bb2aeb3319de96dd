r"""Noise of joints from session to session: its size, memory and tails.

Sessions of one robot have memory: servos warm up, batteries age, joints are mounted anew. The
series of a joint, less what all joints of a session have in common, is taken as

.. math:: e_i = \rho e_{i-1} + \sqrt{1 - \rho^2}\, \sigma_j z_i

with a scatter for each joint, with rho pooled over the joints, and over the quantities that don't
contradict it, and the tails of z (Student's t) over all. The
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

_RHOS = np.array([0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 0.95, 0.98])
"""Lag-one correlations that are simulated; beyond, noise is a random walk over 50 sessions."""
_TAILS = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5])
"""Inverse degrees of freedom that are simulated: from normal noise to infinite variance."""
_DRAWS = (50, 100)
"""Fewest and most simulations of each: with 100 the 10 % point has a level of 7 to 13 %; a long
series narrows the limit itself."""
_MOST_VALUES = 200_000
"""Simulated values of each, for 100 simulations of 80 sessions of 25 joints."""
_UPPER = 0.9
_ALIKE = 0.95
"""Quantities whose correlation lies in its interval of this level have that of all together."""
_KEPT = 0.8
"""Share of the differences, the smallest, that the scatter is computed from: with a fifth at
changes and outliers it is hardly larger."""
_SAME = 1e-12
"""Variance over the largest of the joints that is one of rounding: of few joints one is the median,
less which it is 0, in many sessions."""
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
    varies = variance > _SAME * variance.max(axis=-1, keepdims=True)
    return 0.5 * np.log(np.where(varies, variance, np.nan))


def estimate_noise(
    series: Sequence[FloatArray], conditions: IntArray, rng: np.random.Generator
) -> list[SessionNoise]:
    """Estimate the noise of each quantity; they share the tails, and the memory where they agree.

    Args:
        series: As :func:`relative_to_others` gives them, each of shape (n_sessions, n_joints).
        conditions: Number of each session's condition, shape (n_sessions,).
    """
    if not series:
        return []
    draws = int(np.clip(_MOST_VALUES // max(relative.size for relative in series), *_DRAWS))
    normals = [rng.standard_normal((draws, *relative.shape)) for relative in series]
    single = [
        _lag_one_of(relative, conditions, normal)
        for relative, normal in zip(series, normals, strict=True)
    ]
    total = sum(lag_one for lag_one, _ in single)
    total_by_rho = np.sum([by_rho for _, by_rho in single], axis=0)
    common, upper = _memory(total, total_by_rho, 0.5, 1 - _UPPER)
    noises: list[SessionNoise] = []
    observed, simulated = 0.0, np.zeros((len(_TAILS), 1))
    for relative, normal, (lag_one, by_rho) in zip(series, normals, single, strict=True):
        least, most = _memory(lag_one, by_rho, (1 + _ALIKE) / 2, (1 - _ALIKE) / 2)
        alike = least <= common <= most
        memory = (common, upper) if alike else _memory(lag_one, by_rho, 0.5, 1 - _UPPER)
        noise = _scatter_of(relative, memory, conditions, normal)
        present = np.isfinite(relative)
        even = replace(noise, upper=noise.rho, scatter=np.ones_like(noise.scatter))
        observed += float(_heaviness(centred(relative, conditions), noise))
        simulated = simulated + np.stack(
            [
                _heaviness(simulate(even, tail, present, conditions, normal), noise)
                for tail in _TAILS
            ]
        )
        noises.append(noise)
    tail = _inverted(observed, np.median(simulated, axis=1), _TAILS)
    least_tail = _inverted(observed, np.quantile(simulated, _UPPER, axis=1), _TAILS)
    return [replace(noise, tail=tail, least_tail=least_tail) for noise in noises]


def _lag_one_of(
    relative: FloatArray, conditions: IntArray, normal: FloatArray
) -> tuple[float, FloatArray]:
    """Return the lag-one correlation as observed, and simulated, shape (n_rhos, draws)."""
    even, present = np.ones_like(relative[0]), np.isfinite(relative)
    draws = [_lag_one(_residuals_of(normal, rho, even, present, conditions)) for rho in _RHOS]
    return float(_lag_one(centred(relative, conditions))), np.stack(draws)


def _memory(observed: float, by_rho: FloatArray, *quantiles: float) -> tuple[float, ...]:
    """Return the correlations of which the observed one is a quantile."""
    return tuple(_inverted(observed, np.quantile(by_rho, q, axis=1), _RHOS) for q in quantiles)


def _scatter_of(
    relative: FloatArray, memory: Sequence[float], conditions: IntArray, normal: FloatArray
) -> SessionNoise:
    """Return noise with the scatter of each joint; its tails are not known here."""
    rho, upper = memory
    even, present = np.ones_like(relative[0]), np.isfinite(relative)
    drawn = _residuals_of(normal, rho, even, present, conditions)
    by_chance = _log_scatter(drawn, rho)
    complete = by_chance[:, np.isfinite(by_chance).all(axis=0)]
    sampling = float(complete.var(axis=0).mean()) if complete.size else 0.0
    size = scatter(centred(relative, conditions), rho, sampling)
    return SessionNoise(rho, upper, 0.0, 0.0, sampling, size)


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


def _heaviness(residuals: FloatArray, noise: SessionNoise) -> FloatArray:
    """Return the 97.5 % point over the median of all joints' differences over their scatter.

    A fortieth of the values may be changes and outliers without moving it much.
    """
    size = scatter(residuals, noise.rho, noise.sampling)[..., None, :]
    sizes = np.where(
        size > 0, np.abs(np.diff(residuals, axis=-2)) / np.maximum(size, 1e-300), np.nan
    )
    flat = np.sort(sizes.reshape(*sizes.shape[:-2], -1), axis=-1)
    last = np.maximum(np.isfinite(flat).sum(axis=-1, keepdims=True) - 1, 0)
    points = [np.floor(share * last).astype(np.int64) for share in (0.5, 0.975)]
    middle, far = (np.take_along_axis(flat, point, axis=-1)[..., 0] for point in points)
    return np.nan_to_num(far / middle)


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
