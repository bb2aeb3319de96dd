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
"""

from __future__ import annotations

import numpy as np

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
    step, known = float(apart.min()), 1.0
    # Euclid's algorithm with real numbers: what is left of a difference is a multiple, too. The
    # step is known within the blur over the most steps that it was measured over.
    for whole in np.unique(apart).tolist():
        other = whole
        while True:
            count = round(other / step)
            doubt = blur * (1 + count / known)
            left = abs(other - count * step)
            if step < _SHARPEST * doubt:
                return 0.0
            if left <= doubt:
                break
            other, step, known = step, left, blur / doubt
        count = round(whole / step)
        if count > known:
            step, known = whole / count, float(count)
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
    one: Series, fit: HarmonicFit, channel: int, step: float, noise: float
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
    t_s, model, first = one.t_s, fit.model, fit.model.first
    scale = time_scale(t_s)
    theta = fit.parameters([channel], scale)[0]
    weight = fit.inverse_gram[channel][first : first + 2]
    random = np.random.default_rng(0)
    amplitude = fit.fundamental[channel]
    reach = min(_RANGE * step / max(abs(amplitude), step), _SHARE)
    half_sample = fit.omega * one.period_s / 2
    varied = np.ones((draws(one.count), 3))
    varied[:, 1] += reach * random.uniform(-1, 1, len(varied))
    varied[:, 2] = half_sample * random.uniform(-1, 1, len(varied))
    varied[::2, 2] = 0.0
    error = np.zeros((len(varied), 2))
    origin = _origin(theta[0], float(one.values[0]), step)
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
