"""Slow changes of a response from cycle to cycle: settling, drift, and correlated variation.

The response of joint i in cycle k, over its mean, is a complex number near 1. Its real part (gain)
and its imaginary part (minus lag) are series of their own::

    h_i(k) = X(k) beta_i + u_i(k) + e_i(k)                                                   (1)

with one of these trends for all joints, and coefficients of each series::

    steady     1
    drifting   1, P_1(k)  or  1, P_1(k), P_2(k)                  (polynomials of zero mean)
    settling   1, exp(-k / tau)
    ringing    1, exp(-k / tau) cos(delta k), exp(-k / tau) sin(delta k)

so that the first coefficient is the mean over the window, or the value that a transient approaches.
u is a first-order autoregression from cycle to cycle, e is white; each series has a variance of its
own, the correlation of u and its share of the variance are common to all.

Whether there is a trend: a likelihood-ratio test by generalised least squares. Under the steady
model RSS_1 / RSS_0 of a series is a beta variable, so the moments of the sum of their logarithms
are known. The chance is averaged over the correlations that the steady model finds likely, and
multiplied by the number of distinct trends tried (Bonferroni). Which trend: the corrected
information criterion (Hurvich & Tsai, Biometrika 76, 1989).

Intervals: correlation, white share, tau and delta lie on a grid and are weighed by the restricted
likelihood (Harville, J. Am. Stat. Assoc. 72, 1977), with a prior that is flat in the logarithm of
the variance; given them a coefficient is Student's t, so its posterior is a mixture of these (Box &
Tiao, Bayesian Inference in Statistical Analysis, 1973, section 8).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.special import gammaincc, psi, zeta

from undulog.capture.common.arrays import FloatArray

from .intervals import mixture_interval, positive_interval
from .trends import MIN_CYCLES, Shapes, Trend, families, finer, steady, transients

MOST_CYCLES = 160
"""More are averaged in blocks of several."""

SIGNIFICANT = 3e-3
"""Chance of a trend in steady responses, over all joints and trends."""

EXCESS = 0.05
"""Chance of scatter between cycles that noise within them makes, below which it may be correlated.
"""

_CORRELATIONS = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
_CELLS = (0.4, 0.2, 0.15, 0.1, 0.075, 0.04, 0.035)  # between them, of a flat prior
_WHITE = (0.0, 0.1, 0.25, 0.5, 0.75)  # share of the variance
_SAME = 0.5  # probability that gains and lags have one correlation and white share
_TRIALS = {"drifting": 1.0, "settling": 4.0, "ringing": 20.0}
_LIKELY = 0.05
_UNLIKE = 2.0  # standard errors of the logarithm of a ratio of variances
_HALF = 0.5
_ZOOMS = 8
_ENOUGH = 8  # points that a fine grid spreads over
_LEAST_WEIGHT = 1e-3
_OUT_OF_REACH = 1e9  # a transient as long as the window has no known end
_TINY = 1e-300
_CACHED = 32_768  # numbers


@dataclass(frozen=True)
class Coefficients:
    """A coefficient of k series, with the half width of its 95 % interval; both of shape (k,)."""

    value: FloatArray
    half: FloatArray


@dataclass(frozen=True)
class SlowChanges:
    """Model (1), fitted to k series of c cycles.

    Attributes:
        level: The mean over the window, or the steady value.
        change: Mean change per cycle over the window; of a transient, how far the response is from
            its level at the start of the window.
        tau: Time constant, low and high end of its interval [cycles]; NaN without a transient.
        turn: Rotation of a transient per cycle [rad]; 0 where it does not oscillate.
        correlation: Of u from cycle to cycle, of gains and of lags; 0 where their scatter is white.
        alike: Whether gains and lags scatter alike.
        dof: Degrees of freedom of the scatter of each series.
        excess: Chance that noise within the cycles makes the scatter between them.
        residuals: Independent errors of equal variance, of which ``level`` would have that times
            ``share``, shape (k, c - p).
        share: See ``residuals``; of gains and of lags.
        effective: How many independent cycles would show the level as well; the lower of gains and
            lags.
    """

    trend: Trend
    level: Coefficients
    change: Coefficients
    tau: tuple[float, float, float]
    turn: float
    correlation: tuple[float, float]
    alike: bool
    dof: int
    excess: float
    residuals: FloatArray
    share: tuple[float, float]
    effective: float


@dataclass(frozen=True)
class CycleNoise:
    """What noise within the cycles makes of k series.

    Attributes:
        variance: Of the value in one cycle, 0 where it is unknown, shape (k,).
        log_variance: Variance of the logarithm of each.
        relative: Standard deviation in each cycle over the mean one, shape (c,).
    """

    variance: FloatArray
    log_variance: float
    relative: FloatArray


@dataclass(frozen=True)
class _Noise:
    """A correlation of the grid, and the inverse root of its matrix."""

    correlation: float
    prior: float
    whiten: FloatArray  # (c, c)
    log_det: float


@dataclass(frozen=True)
class _Fits:
    """All trends of one kind with one noise, k series."""

    beta: FloatArray  # (s, p, k)
    cov: FloatArray  # (s, p, p)
    rss: FloatArray  # (s, k)
    restricted: FloatArray  # of gains and of lags (s, 2)
    full: FloatArray  # (s,)


def slow_changes(series: FloatArray, cycle: FloatArray, noise: CycleNoise) -> SlowChanges:
    """Fit model (1).

    Args:
        series: Gains of the joints, each over its mean, then their lags in the same order, shape
            (k, c).
        cycle: Number of each cycle, increasing; some may be missing, shape (c,).

    Returns:
        The fit; steady where there are fewer than ``MIN_CYCLES`` cycles.
    """
    place = cycle - cycle[0]
    noises = _noises(place, noise.relative)  # found as they are needed: c x c matrices
    white = next(noises)
    # Scatter that noise within the cycles explains has no correlation from cycle to cycle.
    grid = [white]
    shapes = _clearest(series, place, grid)
    excess = _excess(shapes, white, series, noise)
    if excess < EXCESS:
        grid = [white, *noises]
        shapes = _clearest(series, place, grid)
    return _inferred(series, place, shapes, grid, excess)


def _excess(shapes: Shapes, white: _Noise, series: FloatArray, noise: CycleNoise) -> float:
    """Return the chance that noise within cycles makes the scatter between them."""
    fits = _fit(shapes, white, series)
    s = int(np.argmax(fits.full))
    usable = noise.variance > 0
    if not np.any(usable):
        return 0.0
    n, p = shapes.designs.shape[1:]
    if n <= p:
        return 1.0
    half = (n - p) / 2
    ratio: FloatArray = np.log(fits.rss[s][usable] / (n - p) / noise.variance[usable])
    expected = _digamma(half) - math.log(half)
    # Gains and lags have one estimate of the noise.
    error = _trigamma(half) + 2 * noise.log_variance
    error = (error / max(_independent(_rest(shapes, s, white, series)), 1.0)) ** 0.5
    return 0.5 * math.erfc((float(np.mean(ratio)) - expected) / (error * math.sqrt(2.0)))


def _digamma(value: float) -> float:
    return float(psi(value))


def _trigamma(value: float) -> float:
    return float(zeta(2.0, value))


def _independent(series: FloatArray) -> float:
    """Return how many independent parts the scatter of several series has.

    Args:
        series: Without trends, shape (k, c).

    Returns:
        k^2 over the sum of squared correlations, less what independent series have by chance, 1 to
        k.
    """
    size: FloatArray = np.sqrt(np.sum(series**2, axis=1))
    used: FloatArray = series[size > 0] / size[size > 0, None]
    k = used.shape[0]
    if k < 2:
        return 1.0
    excess = float(np.sum((used @ used.T) ** 2)) - k - k * (k - 1) / max(series.shape[1] - 1, 1)
    return k * k / (k + max(excess, 0.0))


def _noises(place: FloatArray, relative: FloatArray) -> Iterator[_Noise]:
    """Yield white scatter, then every correlation with every white share."""
    apart = np.abs(place[:, None] - place)
    log_det = 2 * float(np.sum(np.log(relative)))
    yield _Noise(0.0, 0.5, np.diag(1 / relative), log_det)
    for (correlation, cell), white in product(zip(_CORRELATIONS, _CELLS, strict=True), _WHITE):
        matrix = (1 - white) * correlation**apart + white * np.diag(relative**2)
        root = np.linalg.cholesky(matrix)
        log_det = 2 * float(np.sum(np.log(np.diag(root))))
        prior = 0.5 * cell / len(_WHITE)
        yield _Noise(correlation, prior, np.asarray(np.linalg.inv(root), np.float64), log_det)


def _fit(shapes: Shapes, noise: _Noise, series: FloatArray) -> _Fits:
    n, p = shapes.designs.shape[1:]
    k = series.shape[0]
    right = noise.whiten @ series.T
    q, r = np.linalg.qr(noise.whiten @ shapes.designs)
    inverse = np.linalg.inv(r)
    turned = np.swapaxes(q, 1, 2) @ right
    rss = np.empty((len(q), k))
    for some in _parts(len(q), right.size):
        rest = q[some] @ turned[some]
        rest -= right
        np.einsum("sck,sck->sk", rest, rest, out=rss[some])
    np.maximum(rss, _TINY, out=rss)
    logs = np.log(rss).reshape(len(q), 2, k // 2).sum(axis=2)
    information = 2 * np.log(np.abs(np.diagonal(r, axis1=1, axis2=2))).sum(axis=1)
    # Over |X' X|, or it would depend on the scale of the columns.
    plain = np.linalg.slogdet(np.swapaxes(shapes.designs, 1, 2) @ shapes.designs)[1]
    information = noise.log_det + np.asarray(information - plain)[:, None]
    return _Fits(
        beta=inverse @ turned,
        cov=inverse @ np.swapaxes(inverse, 1, 2),
        rss=rss,
        restricted=-0.5 * (k / 2 * information + (n - p) * logs),
        full=-0.5 * (k * noise.log_det + n * logs.sum(axis=1)),
    )


def _parts(trends: int, size: int) -> Iterator[slice]:
    """Yield slices of so many trends that their residuals stay in the processor's cache."""
    step = max(1, _CACHED // size)
    for start in range(0, trends, step):
        yield slice(start, start + step)


@dataclass(frozen=True)
class _Posterior:
    """Weights of the grid.

    Attributes:
        weights: Of noise and trend, of gains and of lags, each of sum 1, shape (2, noises, s).
        best: Likeliest noise and trend of each, shape (2, 2).
        temper: By how much joints that scatter together say less than as many alone.
    """

    weights: FloatArray
    best: list[tuple[int, int]]
    temper: float


def _posterior(
    shapes: Shapes, fits: Sequence[_Fits], noises: Sequence[_Noise], series: FloatArray
) -> _Posterior:
    """Weigh the grid; gains and lags share the trend, but have each their correlation."""
    prior = np.array([noise.prior for noise in noises])[:, None]
    log = np.stack([fit.restricted.T for fit in fits], axis=1)  # (2, noises, s)
    weights, best = _weighed(log, prior)
    half = series.shape[0] // 2
    # What joints share shows once their scatter is white.
    white = [
        _rest(shapes, s, noises[i], series[part * half : (part + 1) * half])
        for part, (i, s) in enumerate(best)
    ]
    temper = _independent(np.concatenate(white)) / (2 * half)
    weights, best = _weighed(temper * log, prior)
    return _Posterior(weights, best, temper)


def _weighed(log: FloatArray, prior: FloatArray) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Return the weights of gains and lags, which have one correlation with probability _SAME."""
    likely = np.maximum(np.exp(log - log.max(axis=(1, 2), keepdims=True)), _TINY)
    other = likely[::-1]
    apart = np.sum(prior * other, axis=1, keepdims=True) / prior.sum()
    weights = prior * likely * (_SAME * other + (1 - _SAME) * apart)
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    return weights, [_best(weight) for weight in weights]


def _rest(shapes: Shapes, s: int, noise: _Noise, series: FloatArray) -> FloatArray:
    """Return what one trend leaves of the series, made white, shape (k, c)."""
    right = noise.whiten @ series.T
    basis = np.linalg.qr(noise.whiten @ shapes.designs[s])[0]
    return np.asarray((right - basis @ (basis.T @ right)).T, dtype=np.float64)


def _clearest(series: FloatArray, place: FloatArray, noises: Sequence[_Noise]) -> Shapes:
    """Return the trends of the likeliest kind; steady where none is clear."""
    none = steady(place.size)
    if place.size < MIN_CYCLES:
        return none
    null = [_fit(none, noise, series) for noise in noises]
    weights = _posterior(none, null, noises, series).weights[:, :, 0]
    likely = [np.flatnonzero(weight >= _LIKELY).tolist() for weight in weights]
    spread = range(1, len(noises), 5)
    tried = sorted({0, *likely[0], *likely[1], *spread})
    best, chosen = np.inf, none
    for family in families(place):
        fits = {k: _fit(family, noises[k], series) for k in tried}
        posterior = _posterior(family, [fits[k] for k in tried], [noises[k] for k in tried], series)
        chance, total = np.zeros(family.tau.size), 0.0
        for i, j in product(*likely):
            share = float(weights[0, i] * weights[1, j])
            before = np.concatenate([fit.rss[0] for fit in _halves(null[i], null[j])])
            after = np.concatenate([fit.rss for fit in _halves(fits[i], fits[j])], axis=1)
            chance += share * _chance(before, after, family, posterior.temper)
            total += share
        if not _TRIALS[family.kind] * float(chance.min()) / total <= SIGNIFICANT:
            continue
        full = np.max([fit.full for fit in fits.values()], axis=0)
        value = _criterion(family, float(full.max()), series)
        if family.free and family.tau[int(np.argmax(full))] >= family.longest:
            value += _OUT_OF_REACH
        if value < best:
            best, chosen = value, family
    if chosen.free:
        chosen = _zoomed(chosen, series, place, [noises[k] for k in tried])
    return chosen


def _halves(gains: _Fits, lags: _Fits) -> tuple[_Fits, _Fits]:
    """Return the gains of one fit and the lags of another."""
    half = gains.rss.shape[1] // 2
    return replace(gains, rss=gains.rss[:, :half]), replace(lags, rss=lags.rss[:, half:])


def _zoomed(
    shapes: Shapes, series: FloatArray, place: FloatArray, noises: Sequence[_Noise]
) -> Shapes:
    """Return transients on a grid as fine as the likelihood is narrow."""
    lowest, highest = float(shapes.tau.min()), shapes.longest
    for _ in range(_ZOOMS):
        fits = [_fit(shapes, noise, series) for noise in noises]
        weights = _posterior(shapes, fits, noises, series).weights[0].sum(axis=0)
        weights /= weights.max()
        spread = float(weights.sum() ** 2 / np.sum(weights**2))
        if spread >= _ENOUGH**shapes.free:
            break
        kept = weights >= _LEAST_WEIGHT
        if shapes.free == 1:
            tau, turn = finer(shapes.tau, kept, 24, lowest, highest), np.zeros(1)
        else:
            tau = finer(shapes.tau, kept, 12, lowest, highest)
            turn = finer(shapes.turn, kept, 16, 1e-3, np.pi - 1e-3)
        shapes = transients(place, tau, turn)
    return shapes


def _criterion(family: Shapes, log_likelihood: float, series: FloatArray) -> float:
    k, n = series.shape
    free = k * (family.designs.shape[2] + 1) + family.free + 1
    return -2 * log_likelihood + 2 * free * k * n / max(k * n - free - 1, 1)


def _chance(before: FloatArray, after: FloatArray, family: Shapes, temper: float) -> FloatArray:
    """Return the chance that steady series are explained so well by some more columns, (s,)."""
    n, p = family.designs.shape[1:]
    a, b = (n - p) / 2, (p - 1) / 2
    k = before.size
    logs: FloatArray = np.log(before / after)
    statistic: FloatArray = np.sum(logs, axis=1)
    mean = k * (_digamma(a + b) - _digamma(a))
    variance = k * (_trigamma(a) - _trigamma(a + b)) / temper
    return gammaincc(mean**2 / variance, statistic * mean / variance).astype(np.float64)


def _inferred(
    series: FloatArray,
    place: FloatArray,
    shapes: Shapes,
    noises: Sequence[_Noise],
    excess: float,
) -> SlowChanges:
    """Weigh the grid and give the coefficients."""
    fits = [_fit(shapes, noise, series) for noise in noises]
    posterior = _posterior(shapes, fits, noises, series)
    columns = shapes.designs.shape[2]
    half = series.shape[0] // 2
    dof = series.shape[1] - columns
    correlated = 1 - posterior.weights[:, 0].sum(axis=1)
    rss = [fits[i].rss[s].reshape(2, half)[part] for part, (i, s) in enumerate(posterior.best)]
    alike = abs(correlated[0] - correlated[1]) < _HALF and _alike(
        rss[0], rss[1], dof, posterior.temper
    )
    first, change = np.zeros(columns), _changes(shapes, place)
    first[0] = 1.0
    firsts = np.broadcast_to(first, change.shape)
    level, turned = (
        _mixture(fits, posterior.weights, contrast, dof, alike=alike)
        for contrast in (firsts, change)
    )
    own_shares = np.stack([fit.cov[:, 0, 0] for fit in fits])  # of the variance, (noises, s)
    residuals: list[FloatArray] = []
    shares: list[float] = []
    for part, (i, s) in enumerate(posterior.best):
        rows = slice(part * half, (part + 1) * half)
        noise = noises[i]
        whole: FloatArray = np.linalg.qr(noise.whiten @ shapes.designs[s], mode="complete")[0]
        residuals.append(series[rows] @ noise.whiten.T @ whole[:, columns:])
        shares.append(float(fits[i].cov[s, 0, 0]))
    return SlowChanges(
        trend=Trend.SETTLING if shapes.free else Trend(shapes.kind),
        level=level,
        change=turned,
        tau=positive_interval(shapes.tau, posterior.weights[0].sum(axis=0)),
        turn=float(shapes.turn[posterior.best[0][1]]),
        correlation=(
            noises[posterior.best[0][0]].correlation,
            noises[posterior.best[1][0]].correlation,
        ),
        alike=alike,
        dof=dof,
        excess=excess,
        residuals=np.concatenate(residuals),
        share=(shares[0], shares[1]),
        effective=1 / float((posterior.weights * own_shares).sum(axis=(1, 2)).max()),
    )


def _best(values: FloatArray) -> tuple[int, int]:
    i, s = np.unravel_index(int(np.argmax(values)), values.shape)
    return int(i), int(s)


def _alike(gains: FloatArray, lags: FloatArray, dof: int, temper: float) -> bool:
    """Return whether gains and lags scatter alike, so that both say how much."""
    ratio = float(np.mean(np.log(gains / lags)))
    error = (2 * _trigamma(dof / 2) / max(temper * gains.size, 1.0)) ** 0.5
    return abs(ratio) <= _UNLIKE * error


def _changes(shapes: Shapes, place: FloatArray) -> FloatArray:
    """Return the weights of the columns in :attr:`SlowChanges.change`, shape (s, p)."""
    start = shapes.designs[:, 0].copy()
    if not shapes.free:
        start = (shapes.designs[:, -1] - start) / max(float(place[-1]), 1.0)
    start[:, 0] = 0.0
    return start


def _mixture(
    fits: Sequence[_Fits], weights: FloatArray, rows: FloatArray, dof: int, *, alike: bool
) -> Coefficients:
    """Return the mean and the interval of rows @ beta."""
    half = fits[0].rss.shape[1] // 2
    parts: list[tuple[FloatArray, FloatArray]] = []
    for part, weight in enumerate(weights):
        mine, other = (slice(k * half, (k + 1) * half) for k in (part, 1 - part))
        index: list[list[int]] = np.argwhere(weight >= _LEAST_WEIGHT * weight.max()).tolist()
        share: FloatArray = np.array([weight[i, s] for i, s in index])
        share = (share / share.sum())[:, None]
        mean: FloatArray = np.stack([rows[s] @ fits[i].beta[s][:, mine] for i, s in index])
        scale: FloatArray = np.stack([fits[i].rss[s][mine] for i, s in index]) / dof
        if alike:
            scale = (scale + np.stack([fits[i].rss[s][other] for i, s in index]) / dof) / 2
        scale *= np.array([rows[s] @ fits[i].cov[s] @ rows[s] for i, s in index])[:, None]
        parts.append(
            mixture_interval(share, mean, np.sqrt(np.maximum(scale, _TINY)), dof * (1 + alike))
        )
    return Coefficients(
        np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    )
