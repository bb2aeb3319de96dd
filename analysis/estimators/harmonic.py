"""Harmonic least squares: amplitude and phase of many channels with one shared frequency.

The model of channel k, sampled at its own times t, is (IEEE Std 1057, sine fit, with harmonics)::

    y_k(t) = sum_d b_kd t^d + Re sum_h a_kh exp(j h omega t),    h = 1 .. harmonics

with one omega for all channels, and further sines of known frequencies where other channels have
rhythms of their own. Given omega it is linear; omega itself is found by Gauss-Newton
on the variable projection functional (Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973, in Kaufman's
form, BIT 15, 1975). The noise level of each channel is unknown, so the weights are those of
maximum likelihood: one over the channel's own residual variance, renewed at every step.

The linear part of the harmonic fit: basis, moments over the samples, least squares at one omega.

Nothing larger than a few columns of one chunk of samples is ever held: all that is needed are
the moments of the basis functions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import DataError
from undulog.capture.common.process import in_threads

from .series import Series, shared_times

CHUNK = 8192
"""Samples per chunk: few enough for the processor's cache, enough to keep two threads apart."""

RELATIVE_FLOOR = 1e-13
"""Residual power that counts as none, relative to the signal's: an exact channel's residual is
rounding, and must not get infinite weight."""

MAX_STEPS = 30
"""Gauss-Newton steps; from a periodogram's peak three to five are enough."""

LINEAR = 1e-7
"""A step of omega that turns the record's ends by less than this [rad] is the last: amplitudes go
on linearly with it, and what is neglected, a share of its square, is rounding."""


_Group = tuple[list[int], list[Series]]


def cos_sin(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine of one set of angles.

    From the tangent q of the half angle, (1 - q^2) / (1 + q^2) and 2 q / (1 + q^2): NumPy has the
    tangent in the vectors of some processors, six times as fast as cosine and sine, on others it
    still costs less than the two, and a sample's share of a fit is little more than these.

    Args:
        angle: [rad], shape (n,).

    Returns:
        Both, right to a few units of rounding, each of shape (n,).
    """
    cosine, sine = np.empty_like(angle), np.empty_like(angle)
    for part in chunks(angle.size):
        half = np.tan(0.5 * angle[part])
        square = half * half
        share = 1.0 / (1.0 + square)
        half *= 2.0
        np.multiply(half, share, out=sine[part])
        np.subtract(1.0, square, out=square)
        np.multiply(square, share, out=cosine[part])
    return cosine, sine


def chunks(count: int) -> Iterator[slice]:
    """Slices that cut a record into pieces of at most ``CHUNK`` samples."""
    for start in range(0, count, CHUNK):
        yield slice(start, min(start + CHUNK, count))


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
    turned = rows[model.first : model.size].reshape(model.harmonics, 2, t_s.size)
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

    Returns:
        Parameters, and what a step of omega needs.

    Raises:
        DataError: If the basis functions can't be told apart at these times.
    """
    return _solve(_moments(series, omega, model), model)


def _moments(group: Sequence[Series], omega: float, model: HarmonicModel) -> Moments:
    t_s = group[0].t_s
    scale = time_scale(t_s)
    mean = np.array([channel.values.mean() for channel in group])
    p, q = model.size, model.size + 2 * model.harmonics
    gram = np.zeros((q, q))
    cross = np.zeros((q, len(group)))
    power = np.zeros(len(group))
    for part in chunks(t_s.size):
        rows = basis(t_s[part], omega, model, scale, spare=q - p)
        np.multiply(rows[model.first : p], t_s[part] / scale, out=rows[p:])
        values = np.stack([channel.values[part] for channel in group]) - mean[:, None]
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
            "the harmonics cannot be separated at these sampling times; take a longer window "
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
    parts = harmonic.reshape(model.harmonics, 2, harmonic.shape[1])
    return np.stack([order * parts[:, 1], -order * parts[:, 0]], axis=1).reshape(harmonic.shape)


def _weights(moments: Moments, rss: FloatArray, model: HarmonicModel) -> FloatArray:
    """One over each channel's residual variance; 0 for a channel that is constant."""
    noise = np.maximum(rss, RELATIVE_FLOOR * moments.power) / (moments.count - model.size)
    return np.divide(1.0, noise, out=np.zeros_like(noise), where=noise > 0)


@dataclass(frozen=True)
class HarmonicFit:
    """A fitted model; K channels, h harmonics, p parameters a channel.

    Attributes:
        omega: Shared angular frequency [rad/s].
        amplitudes: Complex amplitudes a_kh at t = 0 in the unit of the channel, shape (K, h).
        trend: Polynomial coefficients b_kd, ascending powers of t [unit/s^d], shape (K, d + 1).
        inverse_gram: (Phi^T Phi)^-1 for the parameters (b in scaled time, then Re and Im of each
            further line and of each harmonic), shape (K, p, p).
        information: |P g|^2, the squared length of dy/domega outside the span of the model:
            Fisher information of omega is their sum over noise variance, shape (K,).
        weight: One over residual variance, the channel's weight in the fit of omega, shape (K,).
        rss: Sum of squared residuals, shape (K,).
        total: Sum of squares about the mean, shape (K,).
        count: Samples, shape (K,).
        mean_time_s: Mean sampling time, shape (K,).
        lines: Complex amplitudes of the model's further lines, shape (K, lines).
    """

    omega: float
    amplitudes: ComplexArray
    trend: FloatArray
    inverse_gram: FloatArray
    information: FloatArray
    weight: FloatArray
    rss: FloatArray
    total: FloatArray
    count: FloatArray
    mean_time_s: FloatArray
    model: HarmonicModel
    lines: ComplexArray

    @property
    def frequency_hz(self) -> float:
        """Shared frequency [Hz]."""
        return self.omega / (2 * np.pi)

    @property
    def fundamental(self) -> ComplexArray:
        """Complex amplitudes at the gait frequency, shape (K,)."""
        return self.amplitudes[:, 0]

    @property
    def explained(self) -> FloatArray:
        """Share of each channel's variance that the model explains, shape (K,); 0 if constant."""
        ratio = np.divide(self.rss, self.total, out=np.ones_like(self.rss), where=self.total > 0)
        return np.maximum(1 - ratio, 0.0)

    def parameters(self, channels: Sequence[int] | IntArray, scale: float) -> FloatArray:
        """Coefficients of the basis rows of some channels.

        Args:
            channels: Their indices, k of them.
            scale: Unit of the rows' scaled time [s].

        Returns:
            Trend in scaled time, then real and imaginary part of each further line and of each
            harmonic, shape (k, p).
        """
        index = np.asarray(channels, dtype=np.int64)
        trend = self.trend[index] * scale ** np.arange(self.model.trend + 1.0)
        parts = np.concatenate([self.lines[index], self.amplitudes[index]], axis=1)
        harmonic = np.stack([parts.real, parts.imag], axis=2).reshape(
            len(parts), 2 * parts.shape[1]
        )
        return np.concatenate([trend, harmonic], axis=1)

    def predict(self, channel: int | IntArray, t_s: FloatArray) -> FloatArray:
        """Return the fitted model of one channel, or of some.

        Args:
            channel: Index, or indices of shape (m,).
            t_s: Times [s], any shape.

        Returns:
            Values in the channel's unit, shape of ``t_s``, after m where there are indices.
        """
        index = np.atleast_1d(channel)
        theta, times = self.parameters(index, 1.0), t_s.ravel()
        value = np.empty((index.size, times.size))
        for part in chunks(times.size):
            np.matmul(theta, basis(times[part], self.omega, self.model, 1.0), out=value[:, part])
        value = value.reshape(index.size, *t_s.shape)
        return value if np.ndim(channel) else value[0]


def fit_shared(
    series: Sequence[Series], omega_guess: float, model: HarmonicModel | None = None
) -> HarmonicFit:
    """Fit all channels with one frequency, estimated from all of them.

    Args:
        series: Channels, each on its own times.
        omega_guess: Start [rad/s], within about a quarter of 2 pi over the record's length.
        model: Basis; three harmonics and a constant if None.

    Raises:
        DataError: If a channel has too few samples for the model, or no frequency fits.
    """
    model = model or HarmonicModel()
    groups = _groups(series, model)
    span = max(float(channel.t_s[-1] - channel.t_s[0]) for channel in series)
    omega = omega_guess
    for _ in range(MAX_STEPS):
        solved = _solve_groups(groups, omega, model)
        step = _gauss_newton_step(solved)
        if abs(step) * span < LINEAR:
            return _gathered(solved, len(series), omega, model, step)
        # A step beyond a quarter of a frequency bin leaves the basin of this peak.
        step = float(np.clip(step, -np.pi / (2 * span), np.pi / (2 * span)))
        omega += step
        if not 0 < omega < np.inf:
            raise DataError(
                f"no frequency fits: the search from {omega_guess / (2 * np.pi):.4g} Hz left the "
                "positive frequencies; the record is too short or has no rhythm"
            )
    return fit_at(series, omega, model)


def fit_at(
    series: Sequence[Series], omega: float, model: HarmonicModel | None = None
) -> HarmonicFit:
    """Fit all channels at a known frequency.

    Args:
        series: Channels, each on its own times.
        omega: Angular frequency [rad/s].
        model: Basis; three harmonics and a constant if None.

    Raises:
        DataError: If a channel has too few samples for the model.
    """
    model = model or HarmonicModel()
    solved = _solve_groups(_groups(series, model), omega, model)
    return _gathered(solved, len(series), omega, model, 0.0)


_Part = tuple[list[int], Solved]


def _groups(series: Sequence[Series], model: HarmonicModel) -> list[_Group]:
    if not series:
        raise DataError("nothing to fit: no channel has samples in the window")
    for channel in series:
        if channel.count <= model.size + 1:
            raise DataError(
                f"{channel.name}: {channel.count} samples are too few to fit {model.size} "
                "parameters and a frequency; take a longer window"
            )
    return [(members, [series[k] for k in members]) for members in shared_times(series)]


def _solve_groups(groups: Sequence[_Group], omega: float, model: HarmonicModel) -> list[_Part]:
    def part(group: _Group) -> _Part:
        return group[0], solve(group[1], omega, model)

    return in_threads(
        part, groups, sum(channel.count for _, series in groups for channel in series)
    )


def _gauss_newton_step(solved: Sequence[_Part]) -> float:
    """Step of omega: sum w g^T r / sum w |P g|^2, weights one over residual variance [rad/s]."""
    numerator = denominator = 0.0
    for _, solution in solved:
        # The scaled time makes both sums dimensionless in time; one division undoes it.
        numerator += float(solution.weight @ solution.projected) * solution.moments.scale
        denominator += float(solution.weight @ solution.squared) * solution.moments.scale**2
    if denominator == 0:
        raise DataError("no frequency fits: every channel is constant")
    return numerator / denominator


def _gathered(
    solved: Sequence[_Part], count: int, omega: float, model: HarmonicModel, step: float
) -> HarmonicFit:
    """All groups' parameters in the order of the channels, after a last small step of omega."""
    amplitudes = np.zeros((count, model.harmonics), dtype=np.complex128)
    trend = np.zeros((count, model.trend + 1))
    lines = np.zeros((count, len(model.lines)), dtype=np.complex128)
    inverse = np.zeros((count, model.size, model.size))
    information, weight, rss, total, samples, mean_time = np.zeros((6, count))
    for k, solution in solved:
        moments = solution.moments
        scale = moments.scale ** -np.arange(model.trend + 1.0)
        theta = solution.theta + solution.drift * (step * moments.scale)
        trend[k] = (theta[: model.trend + 1] * scale[:, None]).T
        trend[k, 0] += moments.mean
        parts = theta[model.first :].reshape(model.harmonics, 2, len(k))
        amplitudes[k] = (parts[:, 0] + 1j * parts[:, 1]).T
        others = theta[model.trend + 1 : model.first].reshape(len(model.lines), 2, len(k))
        lines[k] = (others[:, 0] + 1j * others[:, 1]).T
        inverse[k] = solution.inverse_gram
        left = solution.rss - 2 * solution.projected * (step * moments.scale)
        weight[k], rss[k], total[k] = solution.weight, np.maximum(left, 0.0), moments.power
        information[k] = solution.squared * moments.scale**2
        samples[k], mean_time[k] = moments.count, moments.mean_time
    return HarmonicFit(
        omega=float(omega + step),
        amplitudes=amplitudes,
        trend=trend,
        inverse_gram=inverse,
        information=information,
        weight=weight,
        rss=rss,
        total=total,
        count=samples,
        mean_time_s=mean_time,
        model=model,
        lines=lines,
    )
