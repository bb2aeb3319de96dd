"""Error of a fitted amplitude from the steps of an encoder or of a command.

Rounding to steps of q is taken for white noise of variance q^2/12 (Widrow & Kollár, Quantization
Noise, 2008), and so it is where noise or the sampling moves each sample to another place between
two steps. It is not where the sampling is commensurate with the gait: 0.5 Hz at 50 Hz has 100
phases a cycle, the same in each, so a thousand cycles hold no more than 100 different errors.
They repeat with the gait, all of them lie at its harmonics, and the residual beside the gait
frequency shows nothing. About a mean that lies on a step or half-way between two, the second half
of a cycle mirrors the first and only 50 are left.

So the error is found by rounding again: the fitted motion, a little larger or smaller at each
draw, at the very times of the samples, with the noise that the residual has beside the steps.

A reading with hysteresis h is late by h / 2 in both directions, -(h / 2) sgn(v) of a motion with
velocity v, whose fundamental (2 / pi) h lies at right angles to the motion's (of backlash: Tustin,
J. IEE 94 IIA, 1947): a lag that the joint doesn't have. What the square wave has beyond the
harmonics of the fit decides, by the likelihood of the residual after rounding. A dead band of the
joint looks the same, and of more than a step or so it is one; up to that the lag's interval holds
both.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from undulog.capture.common.arrays import FloatArray

from .harmonic import HarmonicFit, basis, chunks, time_scale
from .series import Series

DRAWS = 48
"""Roundings of each channel, in two halves; the standard error is known within 15 %."""

DITHERED = 0.4
"""Noise above this share of a step makes rounding white: of what repeats, exp(-(2 pi 0.4)^2), a
five-hundredth of its power, is left."""

_LONG = 40_000
_DRAWS_OF_LONG = 16

_LOOKED_AT = 4096
_FEWEST = 5
"""Levels of a channel that was rounded; fewer may be all that was ever commanded."""

_PRECISIONS = (float(np.finfo(np.float32).eps), 1e-11)
"""Relative precision that values may have been stored in, or summed up in double precision."""

_SHARPEST = 20.0
"""A step is this many times what it is in doubt by, or it may be one by chance."""

_SYMMETRIC = 0.1
"""Share of a step within which a mean counts as on a step or half-way between two."""

_RANGE = 8.0
"""Draws differ in amplitude by up to this many steps, and at most by ``_SHARE`` of it."""

_SHARE = 0.2

_HYSTERESES = (0.25, 0.5, 0.75, 1.0, 1.25)
"""In steps: up to that of a count, and a quarter by which its estimate scatters."""

_DEAD_BANDS = (1.5, 1.75, 2.0)
"""In steps: what fits better is a dead band of the joint."""

_DECIDED = 7.0
"""Logarithm of the likelihood ratio from which a reading has hysteresis: a thousand to one."""

_INEXACT = 0.05
"""Standard deviation of the fitted motion in steps, at the least."""

_IMPOSSIBLE = 1e-12
"""Likelihood of a sample that the model excludes."""


def lattice_step(values: FloatArray) -> float:
    """Step of values that were rounded.

    Args:
        values: Finite, shape (n,).

    Returns:
        The largest step of which all differences between values are multiples; 0 where there is
        none, or where fewer than five values occur.
    """
    middle = max(0, (values.size - _LOOKED_AT) // 2)
    levels = np.unique(values[middle : middle + _LOOKED_AT])
    if levels.size < 2:
        return 0.0
    largest = float(np.abs(levels).max())
    for precision in _PRECISIONS:
        step = _common_step(np.diff(levels), 4 * precision * largest)
        if step > 0:
            return step
    return 0.0


def _common_step(apart: FloatArray, blur: float) -> float:
    """Step of which differences of values that are off by up to the blur are multiples, or 0."""
    apart = apart[apart > blur]
    if apart.size + 1 < _FEWEST:
        return 0.0
    step, most_steps = float(apart.min()), 1.0
    # Euclid's algorithm with real numbers: what is left of a difference is a multiple, too. The
    # step is known within the blur over the most steps that it was measured over.
    for whole in np.unique(apart).tolist():
        other = whole
        while True:
            count = round(other / step)
            doubt = blur * (1 + count / most_steps)
            left = abs(other - count * step)
            if step < _SHARPEST * doubt:
                return 0.0
            if left <= doubt:
                break
            other, step, most_steps = step, left, blur / doubt
        count = round(whole / step)
        if count > most_steps:
            step, most_steps = whole / count, float(count)
    return float(apart.sum() / np.rint(apart / step).sum())


def steady_noise(step: float, residual: float, level: float) -> float | None:
    """Return the noise of a channel beside its rounding.

    Args:
        step: Of its lattice, 0 for none.
        residual: Variance of its residual, which is large also where harmonics are left in it.
        level: Its noise level beside the gait frequency; of noise that is stronger at other
            frequencies no more than three times that is counted on.

    Returns:
        Standard deviation in the channel's unit; None where it makes rounding white, or where
        nothing is rounded.
    """
    noise = max(0.0, min(residual - step**2 / 12, 3 * level))
    return noise**0.5 if noise < (DITHERED * step) ** 2 else None


def rounding_covariance(
    series: Series, fit: HarmonicFit, channel: int, step: float, noise: float
) -> FloatArray:
    """Return the covariance of the fundamental of a rounded channel.

    Draws differ in amplitude, and half of them in phase as well. Near its mean a small wave needs
    that to reach other steps; but a wave whose quarters mirror each other at the samples has only
    half as many different errors while it keeps its phase. The larger of both counts.

    Args:
        fit: The fit that holds it.
        channel: Its index in the fit.
        noise: Standard deviation of what else moves it, from :func:`steady_noise`.

    Returns:
        Of (Re a, Im a), shape (2, 2), from draws that are the same at each call.
    """
    t_s, model, first = series.t_s, fit.model, fit.model.first
    scale = time_scale(t_s)
    theta = fit.parameters([channel], scale)[0]
    weight = fit.inverse_gram[channel][first : first + 2]
    random = np.random.default_rng(0)
    amplitude = fit.fundamental[channel]
    reach = min(_RANGE * step / max(abs(amplitude), step), _SHARE)
    half_sample = fit.omega * series.period_s / 2
    varied = np.ones((draws(series.count), 3))
    varied[:, 1] += reach * random.uniform(-1, 1, len(varied))
    varied[:, 2] = half_sample * random.uniform(-1, 1, len(varied))
    varied[::2, 2] = 0.0
    error = np.zeros((len(varied), 2))
    origin = _origin(theta[0], float(series.values[0]), step)
    for part in chunks(t_s.size):
        rows = basis(t_s[part], fit.omega, model, scale)
        trend = theta[:first] @ rows[:first] - origin
        moving = theta[first:] @ rows[first:]
        ahead = amplitude.real * rows[first + 1] - amplitude.imag * rows[first]
        place = varied @ (np.stack([trend, moving, ahead]) / step)
        rounded = place
        if noise > 0:
            rounded = place + noise / step * random.standard_normal(place.shape, np.float32)
        error += step * (np.rint(rounded) - place) @ (weight @ rows).T
    kept, turned = (part.T @ part / len(part) for part in (error[::2], error[1::2]))
    return turned + not_negative(kept - turned)


def hysteresis_covariance(
    series: Series, fit: HarmonicFit, channel: int, step: float
) -> FloatArray | None:
    """Return what hysteresis of a reading can move the fundamental by, as a covariance.

    Args:
        fit: The fit that holds it.
        channel: Its index in the fit.
        step: Of its lattice.

    Returns:
        Of (Re a, Im a), shape (2, 2), across the motion; None where the residual shows no
        hysteresis, or one that no reading has.
    """
    amplitude = fit.fundamental[channel]
    if not abs(amplitude) > 2 * _HYSTERESES[-1] * step:
        return None
    t_s, values = some_samples(series, _LOOKED_AT)
    scale = time_scale(series.t_s)
    rows = basis(t_s, fit.omega, fit.model, scale)
    residual = (values - fit.parameters([channel], scale)[0] @ rows) / step
    turns = fit.omega * t_s / (2 * np.pi) % 1
    different = np.unique(np.rint(2 * t_s.size * turns) % (2 * t_s.size)).size
    inexact = max(_INEXACT, (len(rows) / (12 * different)) ** 0.5)
    phase = np.angle(amplitude * np.exp(1j * fit.omega * t_s))
    fitted = np.linalg.qr(rows.T)[0]

    def tried(hysteresis: float) -> tuple[float, float, float]:
        late = hysteresis * _late(phase, hysteresis * step / abs(amplitude))
        late -= fitted @ (fitted.T @ late)
        return (*_likelihood(residual - late, inexact), hysteresis)

    none, *_ = _likelihood(residual, inexact)
    likelihood, noise, best = max(tried(width) for width in _HYSTERESES)
    wider = max(tried(width)[0] for width in _DEAD_BANDS)
    # What rounding does in each cycle again counts once: exp(-(2 pi s)^2) of its power.
    again = float(np.exp(-((2 * np.pi * noise) ** 2))) * (1 - different / t_s.size)
    if (1 - again) * min(likelihood - none, likelihood - wider + 2 * _DECIDED) < _DECIDED:
        return None
    across = 1j * amplitude / abs(amplitude) * (2 / np.pi) * best * step
    parts = np.array([across.real, across.imag])
    return np.outer(parts, parts)


def _likelihood(residual: FloatArray, inexact: float) -> tuple[float, float]:
    """Return the logarithm of the likelihood of what rounding leaves, in steps, and its noise."""
    noise = max(float(np.mean(residual**2)) - 1 / 12, inexact**2) ** 0.5
    ends = np.stack([residual + 0.5, residual - 0.5]) / noise
    above, below = np.asarray(ndtr(ends), dtype=np.float64)
    shares = above - below
    return float(np.sum(np.log(np.maximum(shares, _IMPOSSIBLE)))), noise


def _late(phase: FloatArray, width: float) -> FloatArray:
    """Return what a reading with a hysteresis of one is above a cosine.

    From a peak on it stays, until the motion has come back by the hysteresis.

    Args:
        phase: Of the cosine in (-pi, pi], shape (n,).
        width: Hysteresis over the amplitude.
    """
    since: FloatArray = np.where(phase < 0, phase + np.pi, phase)
    late: FloatArray = np.minimum((1 - np.cos(since)) / width, 1.0) - 0.5
    return np.where(phase < 0, -late, late)


def some_samples(series: Series, most: int) -> tuple[FloatArray, FloatArray]:
    """Return times and values of a channel, of many so many at random, always the same.

    At random, as equal steps may be in step with the cycles.
    """
    if series.count <= most:
        return series.t_s, series.values
    index = np.sort(np.random.default_rng(0).choice(series.count, most, replace=False))
    return series.t_s[index], series.values[index]


def not_negative(symmetric: FloatArray) -> FloatArray:
    """Return the part of a symmetric matrix that is not negative.

    Args:
        symmetric: Shape (n, n).

    Returns:
        The nearest matrix without negative eigenvalues, shape (n, n).
    """
    values, vectors = np.linalg.eigh(symmetric)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def draws(samples: int) -> int:
    """How many draws :func:`rounding_covariance` makes.

    Returns:
        Fewer for a record that is long.
    """
    return DRAWS if samples <= _LONG else _DRAWS_OF_LONG


def _origin(mean: float, level: float, step: float) -> float:
    """A level of the lattice; with it, a mean close to a step or to half-way is on it exactly."""
    place = 2 * (mean - level) / step
    off = (round(place) - place) / 2
    return level - off * step if abs(off) < _SYMMETRIC else level
