"""Harmonic least squares: amplitude and phase of many channels with one shared frequency.

The model of channel k, sampled at its own times t, is (IEEE Std 1057, sine fit, with harmonics)::

    y_k(t) = sum_d b_kd t^d + Re sum_h a_kh exp(j h omega t),    h = 1 .. harmonics

with one omega for all channels. Given omega it is linear; omega itself is found by Gauss-Newton
on the variable projection functional (Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973, in Kaufman's
form, BIT 15, 1975). The noise level of each channel is unknown, so the weights are those of
maximum likelihood: one over the channel's own residual variance, renewed at every step.

Nothing larger than a few columns of one chunk of samples is ever held: all that is needed are
the moments of the basis functions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import ComplexArray, FloatArray
from capture.errors import DataError

from .series import Series, shared_times

CHUNK = 16384
"""Samples per chunk: the basis of one chunk stays in the processor's cache."""

MAX_STEPS = 30
"""Gauss-Newton steps; from a periodogram's peak three to five are enough."""

RELATIVE_FLOOR = 1e-13
"""Residual power that counts as none, relative to the signal's: an exact channel's residual is
rounding, and must not get infinite weight."""


@dataclass(frozen=True)
class HarmonicModel:
    """Which basis functions are fitted.

    Attributes:
        harmonics: Highest harmonic, at least 1.
        trend: Degree of the polynomial beside them; 0 is a constant.
    """

    harmonics: int = 3
    trend: int = 0

    @property
    def size(self) -> int:
        """Parameters of one channel, p = trend + 1 + 2 harmonics."""
        return self.trend + 1 + 2 * self.harmonics


@dataclass(frozen=True)
class HarmonicFit:
    """A fitted model; K channels, h harmonics, p parameters a channel.

    Attributes:
        omega: Shared angular frequency [rad/s].
        amplitudes: Complex amplitudes a_kh at t = 0 in the unit of the channel, shape (K, h).
        trend: Polynomial coefficients b_kd, ascending powers of t [unit/s^d], shape (K, d + 1).
        inverse_gram: (Phi^T Phi)^-1 for the parameters (b in scaled time, then Re a, Im a of each
            harmonic), shape (K, p, p).
        information: |P g|^2, the squared length of dy/domega outside the span of the model:
            Fisher information of omega is their sum over noise variance, shape (K,).
        weight: One over residual variance, the channel's weight in the fit of omega, shape (K,).
        rss: Sum of squared residuals, shape (K,).
        total: Sum of squares about the mean, shape (K,).
        count: Samples, shape (K,).
        mean_time_s: Mean sampling time, shape (K,).
        model: What was fitted.
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
        moving = self.total > 0
        ratio = np.divide(self.rss, self.total, out=np.ones_like(self.rss), where=moving)
        return np.clip(1 - ratio, 0.0, 1.0)

    def predict(self, channel: int, t_s: FloatArray) -> FloatArray:
        """The fitted model of one channel.

        Args:
            channel: Index of the channel.
            t_s: Times [s], any shape.

        Returns:
            Values in the channel's unit, shape of ``t_s``.
        """
        value = np.zeros_like(t_s)
        for coefficient in self.trend[channel][::-1]:
            value = value * t_s + coefficient
        for h, amplitude in enumerate(self.amplitudes[channel], start=1):
            value = value + np.real(amplitude * np.exp(1j * h * self.omega * t_s))
        return value


@dataclass(frozen=True)
class _Moments:
    """Moments of the basis and its omega-derivative over one group of channels."""

    gram: FloatArray  # (q, q), q = p + 2h: basis, then scaled time times the harmonics
    cross: FloatArray  # (q, k): basis against the values
    power: FloatArray  # (k,): squares of the values
    mean: FloatArray  # (k,): means, subtracted before anything else
    scale: float  # [s]: unit of the scaled time, half the record
    mean_time: float
    count: int


def fit_shared(
    series: Sequence[Series], omega_guess: float, model: HarmonicModel | None = None
) -> HarmonicFit:
    """Fit all channels with one frequency, estimated from all of them.

    Args:
        series: Channels, each on its own times.
        omega_guess: Start [rad/s], within about a quarter of 2 pi over the record's length.
        model: Basis; three harmonics and a constant if None.

    Returns:
        The fit.

    Raises:
        DataError: If a channel has too few samples for the model, or no frequency fits.
    """
    model = model or HarmonicModel()
    groups = _groups(series, model)
    span = max(float(one.t_s[-1] - one.t_s[0]) for one in series)
    omega = omega_guess
    for _ in range(MAX_STEPS):
        step = _gauss_newton_step(groups, omega, model)
        # A step beyond a quarter of a frequency bin leaves the basin of this peak.
        step = float(np.clip(step, -np.pi / (2 * span), np.pi / (2 * span)))
        omega += step
        if not 0 < omega < np.inf:
            raise DataError(
                f"no frequency fits: the search from {omega_guess / (2 * np.pi):.4g} Hz left the "
                "positive frequencies; the record is too short or has no rhythm"
            )
        if abs(step) * span < 1e-9:
            break
    return fit_at(series, omega, model)


def fit_at(
    series: Sequence[Series], omega: float, model: HarmonicModel | None = None
) -> HarmonicFit:
    """Fit all channels at a known frequency.

    Args:
        series: Channels, each on its own times.
        omega: Angular frequency [rad/s].
        model: Basis; three harmonics and a constant if None.

    Returns:
        The fit.

    Raises:
        DataError: If a channel has too few samples for the model.
    """
    model = model or HarmonicModel()
    count = len(series)
    amplitudes = np.zeros((count, model.harmonics), dtype=np.complex128)
    trend = np.zeros((count, model.trend + 1))
    inverse = np.zeros((count, model.size, model.size))
    information, weight, rss, total, samples, mean_time = np.zeros((6, count))
    for members, group in _groups(series, model):
        moments = _moments(group, omega, model)
        theta, inverse_gram, residual_power, tangent = _solve(moments, model)
        weights = _weights(moments, residual_power, model)
        scale = moments.scale ** -np.arange(model.trend + 1.0)
        for column, k in enumerate(members):
            trend[k] = theta[: model.trend + 1, column] * scale
            trend[k, 0] += moments.mean[column]
            parts = theta[model.trend + 1 :, column].reshape(model.harmonics, 2)
            amplitudes[k] = parts[:, 0] + 1j * parts[:, 1]
            inverse[k] = inverse_gram
            weight[k] = weights[column]
            rss[k] = residual_power[column]
            total[k] = moments.power[column]
            information[k] = tangent[0][column] * moments.scale**2
            samples[k] = moments.count
            mean_time[k] = moments.mean_time
    return HarmonicFit(
        omega=float(omega),
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
    )


def basis(t_s: FloatArray, omega: float, model: HarmonicModel, scale: float) -> FloatArray:
    """Rows of the model: powers of t/scale, then cos and -sin of each harmonic.

    With cos and -sin, the coefficients are the real and imaginary part of the complex amplitude.

    Args:
        t_s: Times [s], shape (n,).
        omega: Angular frequency [rad/s].
        model: Basis.
        scale: Unit of the scaled time [s].

    Returns:
        Shape (p, n).
    """
    rows = np.empty((model.size, t_s.size))
    rows[0] = 1.0
    for d in range(1, model.trend + 1):
        rows[d] = rows[d - 1] * (t_s / scale)
    # Powers of one rotation instead of a sine and a cosine for every harmonic.
    rotation = np.exp(1j * omega * t_s)
    turned: ComplexArray = np.ones_like(rotation)
    for h in range(model.harmonics):
        turned = turned * rotation
        rows[model.trend + 1 + 2 * h] = turned.real
        rows[model.trend + 2 + 2 * h] = -turned.imag
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


_Group = tuple[list[int], list[Series]]


def _groups(series: Sequence[Series], model: HarmonicModel) -> list[_Group]:
    if not series:
        raise DataError("nothing to fit: no channel has samples in the window")
    for one in series:
        if one.count <= model.size + 1:
            raise DataError(
                f"{one.name}: {one.count} samples are too few to fit {model.size} parameters "
                "and a frequency; take a longer window"
            )
    return [(members, [series[k] for k in members]) for members in shared_times(series)]


def _moments(group: Sequence[Series], omega: float, model: HarmonicModel) -> _Moments:
    t_s = group[0].t_s
    scale = time_scale(t_s)
    mean = np.array([one.values.mean() for one in group])
    p, q = model.size, model.size + 2 * model.harmonics
    gram = np.zeros((q, q))
    cross = np.zeros((q, len(group)))
    power = np.zeros(len(group))
    for part in chunks(t_s.size):
        rows = np.empty((q, part.stop - part.start))
        rows[:p] = basis(t_s[part], omega, model, scale)
        np.multiply(rows[model.trend + 1 : p], t_s[part] / scale, out=rows[p:])
        values = np.stack([one.values[part] for one in group]) - mean[:, None]
        gram += rows @ rows.T
        cross += rows @ values.T
        power += np.einsum("kn,kn->k", values, values)
    return _Moments(gram, cross, power, mean, scale, float(t_s.mean()), t_s.size)


def _solve(
    moments: _Moments, model: HarmonicModel
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
    """Linear parameters, inverse Gram matrix, residual power, and |P g|^2 with g^T r."""
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
    order = np.repeat(np.arange(1, model.harmonics + 1.0), 2)[:, None]
    harmonic = theta[model.trend + 1 :].reshape(model.harmonics, 2, -1)
    gamma = order * np.stack([-harmonic[:, 1], harmonic[:, 0]], axis=1).reshape(
        p - 1 - model.trend, -1
    )
    slope = gram[:p, p:] @ gamma
    squared = np.einsum("dk,dk->k", gamma, gram[p:, p:] @ gamma) - np.einsum(
        "pk,pk->k", slope, inverse @ slope
    )
    projected = np.einsum("dk,dk->k", gamma, cross[p:] - gram[p:, :p] @ theta)
    return theta, inverse, rss, (np.maximum(squared, 0.0), projected)


def _gauss_newton_step(groups: Sequence[_Group], omega: float, model: HarmonicModel) -> float:
    """Step of omega: sum w g^T r / sum w |P g|^2, weights one over residual variance [rad/s]."""
    numerator = denominator = 0.0
    for _, group in groups:
        moments = _moments(group, omega, model)
        _, _, rss, (squared, projected) = _solve(moments, model)
        weight = _weights(moments, rss, model)
        # The scaled time makes both sums dimensionless in time; one division undoes it.
        numerator += float(weight @ projected) * moments.scale
        denominator += float(weight @ squared) * moments.scale**2
    if denominator == 0:
        raise DataError("no frequency fits: every channel is constant")
    return numerator / denominator


def _weights(moments: _Moments, rss: FloatArray, model: HarmonicModel) -> FloatArray:
    """One over each channel's residual variance; 0 for a channel that is constant."""
    noise = np.maximum(rss, RELATIVE_FLOOR * moments.power) / max(moments.count - model.size, 1)
    return np.divide(1.0, noise, out=np.zeros_like(noise), where=noise > 0)
