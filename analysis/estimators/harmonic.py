"""Harmonic least squares: amplitude and phase of many channels with one shared frequency.

The model of channel k, sampled at its own times t, is (IEEE Std 1057, sine fit, with harmonics)::

    y_k(t) = sum_d b_kd t^d + Re sum_h a_kh exp(j h omega t),    h = 1 .. harmonics

with one omega for all channels, and further sines of known frequencies where other channels have
rhythms of their own. Given omega it is linear; omega itself is found by Gauss-Newton
on the variable projection functional (Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973, in Kaufman's
form, BIT 15, 1975). The noise level of each channel is unknown, so the weights are those of
maximum likelihood: one over the channel's own residual variance, renewed at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import DataError
from undulog.capture.common.threads import in_threads

from .harmonic_moments import HarmonicModel, Solved, solve
from .series import Series, shared_times

MAX_STEPS = 30
"""Gauss-Newton steps; from a periodogram's peak three to five are enough."""

LINEAR = 1e-7
"""A step of omega that turns the record's ends by less than this [rad] is the last: amplitudes go
on linearly with it, and what is neglected, a share of its square, is rounding."""


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
        model: What was fitted.
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
        moving = self.total > 0
        ratio = np.divide(self.rss, self.total, out=np.ones_like(self.rss), where=moving)
        return np.clip(1 - ratio, 0.0, 1.0)

    def parameters(self, channels: Sequence[int], scale: float) -> FloatArray:
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
        harmonic = np.stack([parts.real, parts.imag], axis=-1).reshape(index.size, -1)
        return np.concatenate([trend, harmonic], axis=1)

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
        for line, amplitude in zip(self.model.lines, self.lines[channel], strict=True):
            value = value + np.real(amplitude * np.exp(1j * line * t_s))
        return value


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

    Returns:
        The fit.

    Raises:
        DataError: If a channel has too few samples for the model.
    """
    model = model or HarmonicModel()
    solved = _solve_groups(_groups(series, model), omega, model)
    return _gathered(solved, len(series), omega, model, 0.0)


_Group = tuple[list[int], list[Series]]
_Part = tuple[list[int], Solved]


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


def _solve_groups(groups: Sequence[_Group], omega: float, model: HarmonicModel) -> list[_Part]:
    def part(group: _Group) -> _Part:
        return group[0], solve(group[1], omega, model)

    return in_threads(part, groups, sum(one.count for _, series in groups for one in series))


def _gauss_newton_step(solved: Sequence[_Part]) -> float:
    """Step of omega: sum w g^T r / sum w |P g|^2, weights one over residual variance [rad/s]."""
    numerator = denominator = 0.0
    for _, one in solved:
        # The scaled time makes both sums dimensionless in time; one division undoes it.
        numerator += float(one.weight @ one.projected) * one.moments.scale
        denominator += float(one.weight @ one.squared) * one.moments.scale**2
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
    for k, one in solved:
        moments = one.moments
        scale = moments.scale ** -np.arange(model.trend + 1.0)
        theta = one.theta + one.drift * (step * moments.scale)
        trend[k] = (theta[: model.trend + 1] * scale[:, None]).T
        trend[k, 0] += moments.mean
        parts = theta[model.first :].reshape(model.harmonics, 2, -1)
        amplitudes[k] = (parts[:, 0] + 1j * parts[:, 1]).T
        others = theta[model.trend + 1 : model.first].reshape(len(model.lines), 2, len(k))
        lines[k] = (others[:, 0] + 1j * others[:, 1]).T
        inverse[k] = one.inverse_gram
        left = one.rss - 2 * one.projected * (step * moments.scale)
        weight[k], rss[k], total[k] = one.weight, np.maximum(left, 0.0), moments.power
        information[k] = one.squared * moments.scale**2
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
