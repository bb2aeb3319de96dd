"""The linear part of the harmonic fit: basis, moments over the samples, least squares at one omega.

Nothing larger than a few columns of one chunk of samples is ever held: all that is needed are
the moments of the basis functions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError

from .series import Series


def cos_sin(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine of one set of angles.

    From the tangent q of the half angle, (1 - q^2) / (1 + q^2) and 2 q / (1 + q^2): NumPy has the
    tangent in the processor's vectors, six times as fast as cosine and sine, and a sample's share
    of a fit is little more than these two.

    Args:
        angle: [rad], any shape.

    Returns:
        Both, right to a few units of rounding, each of the angles' shape.
    """
    half = np.tan(0.5 * angle)
    square = half * half
    share = 1.0 / (1.0 + square)
    half *= 2.0
    half *= share
    np.subtract(1.0, square, out=square)
    square *= share
    return square, half


CHUNK = 8192
"""Samples per chunk: few enough for the processor's cache, enough to keep two threads apart."""

RELATIVE_FLOOR = 1e-13
"""Residual power that counts as none, relative to the signal's: an exact channel's residual is
rounding, and must not get infinite weight."""


@dataclass(frozen=True)
class HarmonicModel:
    """Which basis functions are fitted.

    Attributes:
        harmonics: Highest harmonic, at least 1.
        trend: Degree of the polynomial beside them; 0 is a constant.
        lines: Angular frequencies of further sines, of rhythms that other channels have [rad/s].
    """

    harmonics: int = 3
    trend: int = 0
    lines: tuple[float, ...] = ()

    @property
    def first(self) -> int:
        """Index of the fundamental's first row: polynomial and further lines come before it."""
        return self.trend + 1 + 2 * len(self.lines)

    @property
    def size(self) -> int:
        """Parameters of one channel, p = trend + 1 + 2 lines + 2 harmonics."""
        return self.first + 2 * self.harmonics


@dataclass(frozen=True)
class Moments:
    """Moments of the basis and its omega-derivative over one group of channels."""

    gram: FloatArray  # (q, q), q = p + 2h: basis, then scaled time times the harmonics
    cross: FloatArray  # (q, k): basis against the values
    power: FloatArray  # (k,): squares of the values
    mean: FloatArray  # (k,): means, subtracted before anything else
    scale: float  # [s]: unit of the scaled time, half the record
    mean_time: float
    count: int


@dataclass(frozen=True)
class Solved:
    """One group of k channels, solved at one omega."""

    moments: Moments
    theta: FloatArray  # (p, k)
    inverse_gram: FloatArray  # (p, p)
    rss: FloatArray  # (k,)
    weight: FloatArray  # (k,)
    squared: FloatArray  # |P g|^2 in scaled time, (k,)
    projected: FloatArray  # g^T r in scaled time, (k,)
    drift: FloatArray  # dtheta/domega in scaled time, (p, k)


def basis(
    t_s: FloatArray, omega: float, model: HarmonicModel, scale: float, spare: int = 0
) -> FloatArray:
    """Rows of the model: powers of t/scale, then cos and -sin of each line and each harmonic.

    With cos and -sin, the coefficients are the real and imaginary part of the complex amplitude.

    Args:
        t_s: Times [s], shape (n,).
        omega: Angular frequency [rad/s].
        model: Basis.
        scale: Unit of the scaled time [s].
        spare: So many rows are left at the end, to be filled.

    Returns:
        Shape (p + spare, n).
    """
    rows = np.empty((model.size + spare, t_s.size))
    rows[0] = 1.0
    for d in range(1, model.trend + 1):
        rows[d] = rows[d - 1] * (t_s / scale)
    for k, line in enumerate(model.lines):
        place = model.trend + 1 + 2 * k
        rows[place], sine = cos_sin(line * t_s)
        np.negative(sine, out=rows[place + 1])
    turned = rows[model.first : model.size].reshape(model.harmonics, 2, -1)
    turned[0, 0], sine = cos_sin(omega * t_s)
    np.negative(sine, out=turned[0, 1])
    # cos((h + 1) x) = 2 cos x cos(h x) - cos((h - 1) x), and the sine likewise.
    double = 2 * turned[0, 0]
    for h in range(1, model.harmonics):
        np.multiply(double, turned[h - 1], out=turned[h])
        if h == 1:
            turned[1, 0] -= 1.0
        else:
            turned[h] -= turned[h - 2]
    return rows


def chunks(count: int) -> Iterator[slice]:
    """Slices that cut a record into pieces of at most ``CHUNK`` samples.

    Args:
        count: Samples in the record.

    Yields:
        Consecutive slices.
    """
    for start in range(0, count, CHUNK):
        yield slice(start, min(start + CHUNK, count))


def time_scale(t_s: FloatArray) -> float:
    """Unit of the scaled time of a record: half its length [s].

    Args:
        t_s: Times [s], shape (n,).

    Returns:
        Half the span [s]; 1 for an instant.
    """
    return float(t_s[-1] - t_s[0]) / 2 or 1.0


def solve(series: Sequence[Series], omega: float, model: HarmonicModel) -> Solved:
    """Least squares of channels that share their sampling times, at one omega.

    Args:
        series: The channels, k of them.
        omega: Angular frequency [rad/s].
        model: Basis.

    Returns:
        Parameters, and what a step of omega needs.

    Raises:
        DataError: If the basis functions can't be told apart at these times.
    """
    return _solve(_moments(series, omega, model), model)


def _moments(group: Sequence[Series], omega: float, model: HarmonicModel) -> Moments:
    t_s = group[0].t_s
    scale = time_scale(t_s)
    mean = np.array([one.values.mean() for one in group])
    p, q = model.size, model.size + 2 * model.harmonics
    gram = np.zeros((q, q))
    cross = np.zeros((q, len(group)))
    power = np.zeros(len(group))
    for part in chunks(t_s.size):
        rows = basis(t_s[part], omega, model, scale, spare=q - p)
        np.multiply(rows[model.first : p], t_s[part] / scale, out=rows[p:])
        values = np.stack([one.values[part] for one in group]) - mean[:, None]
        gram += rows @ rows.T
        cross += rows @ values.T
        power += np.einsum("kn,kn->k", values, values)
    return Moments(gram, cross, power, mean, scale, float(t_s.mean()), t_s.size)


def _solve(moments: Moments, model: HarmonicModel) -> Solved:
    """Least squares from the moments."""
    p = model.size
    gram, cross = moments.gram, moments.cross
    try:
        inverse: FloatArray = np.linalg.inv(gram[:p, :p]).astype(np.float64)
    except np.linalg.LinAlgError as error:
        raise DataError(
            "the harmonics cannot be told apart at these sampling times; take a longer window "
            "or fewer harmonics"
        ) from error
    theta = inverse @ cross[:p]
    rss = np.maximum(moments.power - np.einsum("pk,pk->k", theta, cross[:p]), 0.0)
    # g = dy/d(omega scale) = sum_h h (t/scale) (Im-part row * Re a - Re-part row * Im a).
    gamma = -_turned(theta[model.first :], model)
    slope = gram[:p, p:] @ gamma
    squared = np.einsum("dk,dk->k", gamma, gram[p:, p:] @ gamma) - np.einsum(
        "pk,pk->k", slope, inverse @ slope
    )
    left = cross[p:] - gram[p:, :p] @ theta
    projected = np.einsum("dk,dk->k", gamma, left)
    # The normal equations' derivative: the rows turn, and so does the model.
    change = -slope
    change[model.first :] += _turned(left, model)
    return Solved(
        moments,
        theta,
        inverse,
        rss,
        weight=_weights(moments, rss, model),
        squared=np.maximum(squared, 0.0),
        projected=projected,
        drift=inverse @ change,
    )


def _turned(harmonic: FloatArray, model: HarmonicModel) -> FloatArray:
    """What belongs to each harmonic's cos and -sin, (2h, k), swapped as their derivatives are.

    The derivative of cos(h x) is h times -sin(h x), and that of -sin(h x) is -h times cos(h x).
    """
    order = np.arange(1, model.harmonics + 1.0)[:, None]
    parts = harmonic.reshape(model.harmonics, 2, -1)
    return np.stack([order * parts[:, 1], -order * parts[:, 0]], axis=1).reshape(harmonic.shape)


def _weights(moments: Moments, rss: FloatArray, model: HarmonicModel) -> FloatArray:
    """One over each channel's residual variance; 0 for a channel that is constant."""
    noise = np.maximum(rss, RELATIVE_FLOOR * moments.power) / max(moments.count - model.size, 1)
    return np.divide(1.0, noise, out=np.zeros_like(noise), where=noise > 0)
