"""Responses that change from cycle to cycle: what they settle at, and how they drift.

A gait whose amplitude moves has the same ratio of response and command in each cycle. A gait whose
frequency moves slowly is analysed over its own phase instead of time: with the phase
omega t + P(t) of the commands, P a polynomial, every channel is taken at the times t + P(t)/omega,
at which the commands are periodic. Over that time each cycle has the ratio of response and command,
and :mod:`.analysis.estimators.slow_changes` finds what of it is a trend, correlated variation, or
noise.

A lightly damped bending mode rings for seconds after the start, and least squares over its tail
gives a wrong gain with a small residual. A body mode shows in all joints, so one model is fitted to
all of them; no single joint has cycles enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from ..common.estimate import Estimate
from ..estimators.demodulation import amplitudes, cycle_sums, starts_of
from ..estimators.harmonic import HarmonicFit, cos_sin
from ..estimators.intervals import ResponseErrors, around, t_factor
from ..estimators.series import Series, shared_times
from ..estimators.slow_changes import EXCESS, MOST_CYCLES, CycleNoise, SlowChanges, slow_changes
from ..estimators.trends import MIN_CYCLES, Trend
from .response import Response
from .rhythm import NYQUIST_SHARE

DRIFT_PER_CYCLE = 1e-4
"""Change of ln H per cycle, mean over the window, below which a motion counts as settled."""

MOVING = 1e-3
"""Change of a command's amplitude over the window, and phase [rad] by which a frequency that is
constant misses it, below which the gait counts as steady."""

LEAST_EFFECTIVE = 4.0
LEAST_CYCLES = 8
"""With fewer cycles, or fewer independent ones, variation shows its correlation too poorly for an
interval of 95 %."""

_SIGNIFICANT = 1e-3
_CLEAR_EXCESS = 1e-3
_ROUNDING = 1e-9  # of an amplitude
_DEGREES = (2, 3, 4)
_BLOCK = 1 << 20  # samples that are looked at together

_BESIDE = (1.5, 2.5)  # times the gait frequency, where noise within a cycle is read
_POWER = float(np.log(_BESIDE[0]) / np.log(_BESIDE[1] / _BESIDE[0]))
_SPREAD = (1 + _POWER) ** 2 + _POWER**2  # of the logarithm, times the number of cycles


@dataclass(frozen=True)
class CycleRatios:
    """Response over command in each cycle.

    Attributes:
        number: Of each cycle in which all channels are known, shape (c,).
        command: Amplitudes of m commands over their means, shape (m, c).
        ratio: H of m joints, shape (m, c).
        noise: Variance of ln H that noise within a cycle makes, for each part, shape (m,).
    """

    number: FloatArray
    command: ComplexArray
    ratio: ComplexArray
    noise: FloatArray


@dataclass(frozen=True)
class ResponseChanges:
    """How the response of a group changes over its window.

    Attributes:
        slow: The model of gains and lags, relative to ``reference``.
        reference: What ``slow`` is relative to, shape (m,).
        excess: Chance that noise within the cycles makes the scatter between them.
        period_s: Length of a cycle [s].
        cycles: How many cycles there are.
        scatter: Standard deviation of log gain and of lag from cycle to cycle beyond the noise
            within cycles, 0 where there is none, shape (2, m).
        amplitude_drift: Relative change of the commands' amplitudes per cycle; None where they
            stay.
    """

    slow: SlowChanges
    reference: ComplexArray
    excess: float
    period_s: float
    cycles: int
    scatter: FloatArray
    amplitude_drift: Estimate | None

    @property
    def trend(self) -> Trend:
        """What of the trend is large enough to count."""
        return self.slow.trend if self.largest > DRIFT_PER_CYCLE else Trend.STEADY

    @property
    def uncertain(self) -> bool:
        """Whether the variation shows too few independent cycles for its interval to hold."""
        few = self.slow.effective < LEAST_EFFECTIVE or self.cycles < LEAST_CYCLES
        return self.varies and few

    @property
    def varies(self) -> bool:
        """Whether cycles vary by more than noise within them."""
        return self.excess < _CLEAR_EXCESS and float(self.scatter.max()) > DRIFT_PER_CYCLE

    def of_joint(self, joint: int) -> tuple[Estimate, Estimate]:
        """Return :attr:`.SlowChanges.change` of log gain and of lag [rad] of one joint."""
        size = float(np.abs(self._level[joint]))
        gain_half, lag_half = (
            self.slow.change.half.reshape(2, self.reference.size)[:, joint] / size
        ).tolist()
        change = complex(self.per_joint[joint])
        return (
            Estimate(change.real, around(change.real, gain_half)),
            Estimate(-change.imag, around(-change.imag, lag_half)),
        )

    @property
    def _level(self) -> ComplexArray:
        gain, phase = self.slow.level.value.reshape(2, self.reference.size)
        return gain + 1j * phase

    @property
    def time_constant_s(self) -> Estimate:
        """Time constant [s]; empty without a transient that counts."""
        if self.trend is not Trend.SETTLING:
            return Estimate()
        tau, low, high = (self.period_s * cycles for cycles in self.slow.tau)
        return Estimate(tau, (low, high))

    @property
    def per_joint(self) -> ComplexArray:
        """:attr:`.SlowChanges.change` of ln H, shape (m,)."""
        gain, phase = self.slow.change.value.reshape(2, self.reference.size)
        return np.asarray((gain + 1j * phase) / self._level)

    @property
    def largest(self) -> float:
        """Largest change of ln H per cycle, mean over the window."""
        size = float(np.max(np.abs(self.per_joint), initial=0.0))
        settling = self.slow.trend is Trend.SETTLING
        return size * min(self.slow.tau[0] / self.cycles, 1.0) if settling else size


def response_changes(
    commands: Sequence[Series], responses: Sequence[Series], fit: HarmonicFit, channels: IntArray
) -> ResponseChanges | None:
    """Follow the responses of a group cycle by cycle.

    Args:
        commands: Commands of m joints.
        responses: Responses of the same joints.
        channels: Indices in the fit of the commands, then of the responses, shape (2, m).

    Returns:
        None where there are too few cycles, or no noise at all.
    """
    cycles = _cycles(commands, responses, fit, channels)
    if cycles is None:
        return None
    late = cycles.ratio[:, cycles.number.size // 2 :]
    reference = late.mean(axis=1)
    relative = cycles.ratio / reference[:, None]
    series = np.concatenate([relative.real, relative.imag])
    if float(np.ptp(series, axis=1).max()) < _ROUNDING:
        return None
    size = np.mean(np.abs(cycles.command), axis=0)
    noise = CycleNoise(np.tile(cycles.noise, 2), _SPREAD / cycles.number.size, size.mean() / size)
    changes = slow_changes(series, cycles.number, noise)
    scatter = np.mean(changes.residuals**2, axis=1) - noise.variance
    return ResponseChanges(
        changes,
        reference,
        changes.excess,
        2 * np.pi / fit.omega,
        cycles.number.size,
        np.sqrt(np.maximum(scatter, 0.0)).reshape(2, reference.size) * (changes.excess < EXCESS),
        _amplitude_drift(cycles),
    )


def with_changes(response: Response, changes: ResponseChanges) -> Response:
    """Return the response as it is once settled, or in the mean over the window.

    Where neither the response nor the gait changes, the values stay as they are, and the variances
    are raised where cycles vary by more than the noise beside the gait frequency shows.
    """
    slow = changes.slow
    moving = slow.trend is not Trend.STEADY or changes.amplitude_drift is not None
    if not moving and changes.excess > _CLEAR_EXCESS:
        return response
    shape = (2, changes.reference.size)
    level = slow.level.value.reshape(shape)
    size = np.hypot(*level)
    relative = level[0] + 1j * level[1]
    factor = t_factor(slow.dof)
    # Turned into the direction of the level, whose angle is small.
    variance = (slow.level.half.reshape(shape) / size / factor) ** 2
    dof = np.full(size.size, slow.dof)
    if not moving:
        within = np.stack([response.log_gain_variance, response.lag_variance])
        before = within * (np.array([t_factor(freedom) for freedom in response.dof]) / factor) ** 2
        variance = np.maximum(variance, before) if slow.alike else variance
        relative = response.ratio / changes.reference
    if response.errors is not None and response.errors.steps is not None:
        # Rounding repeats with the samples' phases: it isn't what cycles vary by.
        variance = np.maximum(variance, response.errors.steps.T)
    half = slow.residuals.reshape(*shape, slow.residuals.shape[1])
    bins = np.sqrt(slow.share[0]) * half[0] + 1j * np.sqrt(slow.share[1]) * half[1]
    circular = np.mean(np.abs(bins) ** 2, axis=1) / 2
    rounding = np.zeros((size.size, 2, 2))
    for part in (0, 1):
        rounding[:, part, part] = np.maximum(variance[part] - circular, 0.0)
    errors = ResponseErrors(bins, rounding, np.zeros(size.size))
    return Response(changes.reference * relative, variance[0], variance[1], dof, errors)


def _cycles(
    commands: Sequence[Series], responses: Sequence[Series], fit: HarmonicFit, channels: IntArray
) -> CycleRatios | None:
    every = (*commands, *responses)
    turn_s = 2 * np.pi / fit.omega
    stop = min(float(channel.t_s[-1] + channel.period_s) for channel in every)
    start = max(float(channel.t_s[0]) for channel in every)
    count = int((stop - start) / turn_s + 0.01)
    if count < MIN_CYCLES:
        return None
    # The last whole cycles: the beginning is the least settled. Longer ones where they are many.
    several = -(-count // MOST_CYCLES)
    count //= several
    edges = stop - turn_s * several * np.arange(count, -1.0, -1.0)
    whole = np.empty((len(every), count), dtype=np.complex128)
    noise = np.empty(len(every))
    at = channels.ravel()
    if not fit.amplitudes[at, 0].all():
        return None
    for block in _blocks(every):
        t_s, members = every[block[0]].t_s, at[block]
        amplitude = fit.amplitudes[members, :1]
        rest = np.stack([every[k].values for k in block]) - fit.predict(members, t_s)
        starts = starts_of(t_s, edges - 1e-6 * turn_s)
        amplitude_change = amplitudes(t_s, rest, starts, fit.omega)
        whole[block] = _without_image(1 + amplitude_change / amplitude, amplitude, edges, fit.omega)
        noise[block] = _noise_within(every[block[0]], rest, starts, fit.omega, amplitude_change)
    noise /= np.abs(fit.amplitudes[at, 0]) ** 2
    whole = whole.reshape(2, len(commands), count)
    usable: BoolArray = np.all(np.isfinite(whole), axis=(0, 1)).reshape(count)
    usable &= np.all(np.abs(whole[0]) > _ROUNDING, axis=0)
    if np.count_nonzero(usable) < MIN_CYCLES:
        return None
    whole = whole[:, :, usable]
    mean = fit.fundamental[channels[1]] / fit.fundamental[channels[0]]
    variances = noise.reshape(2, len(commands)).sum(axis=0)
    number = several * np.flatnonzero(usable).astype(np.float64)
    return CycleRatios(number, whole[0], whole[1] / whole[0] * mean[:, None], variances)


def _blocks(series: Sequence[Series]) -> Iterator[list[int]]:
    """Yield the indices of channels that share their times, few where they are long."""
    for group in shared_times(series):
        most = max(1, _BLOCK // max(series[group[0]].count, 1))
        for first in range(0, len(group), most):
            yield group[first : first + most]


def _without_image(
    relative: ComplexArray, amplitude: ComplexArray, edges: FloatArray, omega: float
) -> ComplexArray:
    """Take off what a change within each cycle makes at minus the gait frequency.

    Of Re (a + a' s) exp(j omega t), s from the middle of whole cycles, least squares find
    a + j conj(a') exp(-2 j omega t_edge) / (2 omega).

    Args:
        relative: Shape (m, c).
        amplitude: Shape (m, 1).
    """
    if relative.shape[1] < 2:
        return relative
    rate = np.gradient(relative, (edges[:-1] + edges[1:]) / 2, axis=1)
    turned = np.conj(amplitude) / amplitude * np.exp(-2j * omega * edges[:-1])
    return np.asarray(relative - 1j * np.conj(rate) * turned / (2 * omega))


def _noise_within(
    sampled: Series, values: FloatArray, starts: IntArray, omega: float, amplitude: ComplexArray
) -> FloatArray:
    """Return the variance that noise gives each part of a cycle's amplitude, shape (m,).

    Its level is read at 1.5 and 2.5 times the gait frequency, from what is left in each cycle
    without a constant and that cycle's own amplitude, and extrapolated to the gait frequency as a
    power of the frequency, if it rises towards it; what the fit takes of it there is added.

    Args:
        sampled: A channel with their n times.
        values: Shape (m, n).
        starts: Shape (c + 1,).
        amplitude: Shape (m, c).
    """
    inside = slice(int(starts[0]), int(starts[-1]))
    cosine, sine = cos_sin(0.5 * omega * sampled.t_s[inside])
    wave: ComplexArray = cosine + 1j * sine
    turn = wave * wave
    filled = np.diff(starts)
    finite: ComplexArray = np.where(np.isfinite(amplitude), amplitude, 0.0).astype(np.complex128)
    rest: FloatArray = values[:, inside] - (np.repeat(finite, filled, axis=1) * turn).real
    starts = starts - starts[0]
    rest = rest - np.repeat(cycle_sums(rest, starts) / np.maximum(filled, 1), filled, axis=1)
    usable = filled > 0
    levels: list[FloatArray] = []
    for beside, kept in zip(_BESIDE, _KEPT, strict=True):
        if beside * omega * sampled.period_s > 2 * np.pi * NYQUIST_SHARE:
            break
        wave = wave * turn
        power: FloatArray = np.abs(cycle_sums(wave * rest, starts)) ** 2
        levels.append(np.mean(power[:, usable] / filled[usable], axis=1) / kept)
    if not levels:
        return np.zeros(len(values))
    least = np.min(levels, axis=0)
    ratio = np.divide(levels[0], levels[-1], out=np.ones_like(least), where=least > 0)
    rise = np.maximum(ratio, 1.0) ** _POWER
    variance = 2 * rise * levels[0] * float(np.mean(1 / filled[usable]))
    return np.where(least > 0, variance, 0.0)


def _kept(beside: float) -> float:
    """Return the share of noise there that a cycle's constant and amplitude leave."""
    turn = 2 * np.pi * np.arange(512) / 512
    rows = np.stack([np.ones(512), np.cos(turn), np.sin(turn)])
    taken = rows @ np.exp(1j * beside * turn) / np.sqrt(np.sum(rows**2, axis=1))
    return 1.0 - float(np.sum(np.abs(taken) ** 2)) / 512


_KEPT = tuple(_kept(offset) for offset in _BESIDE)


def _amplitude_drift(cycles: CycleRatios) -> Estimate | None:
    """Return the relative change of the commands' amplitudes per cycle, None where they stay."""
    size: FloatArray = np.log(np.abs(cycles.command))
    place = cycles.number - cycles.number.mean()
    power = float(place @ place)
    slope: FloatArray = np.asarray(size @ place / power, dtype=np.float64)
    rest: FloatArray = size - size.mean(axis=1, keepdims=True) - slope[:, None] * place
    moved = float(np.max(np.abs(slope))) * float(np.ptp(place))
    clear = _stands_out(float(np.sum(slope**2)) * power, slope.size, rest, 2)
    if moved < MOVING or not clear:
        return None
    common: FloatArray = np.mean(rest, axis=0)
    dof = place.size - 2
    error = (float(np.sum(common**2)) / dof / power) ** 0.5
    mean = float(np.mean(slope))
    return Estimate(mean, around(mean, t_factor(dof) * error))


def _stands_out(explained: float, columns: int, rest: FloatArray, fitted: int) -> bool:
    scatter = float(np.sum(rest**2))
    dof = rest.size - fitted * rest.shape[0]
    if scatter <= 0 or dof <= 0:
        return dof > 0
    ratio = explained / columns / (scatter / dof)
    return not fdtrc(columns, dof, ratio) >= _SIGNIFICANT


@dataclass(frozen=True)
class Pace:
    """How the frequency of the commands moves.

    Attributes:
        series: Channels at the times of the commands' own phase.
        drift: Change of the angular frequency per second, mean over the window [rad/s^2].
        half: Half width of its 95 % interval.
    """

    series: list[Series]
    drift: float
    half: float

    @property
    def hz_per_s(self) -> Estimate:
        """Change of the frequency [Hz/s]."""
        drift = self.drift / (2 * np.pi)
        return Estimate(drift, around(drift, self.half / (2 * np.pi)))


def moving_pace(
    series: Sequence[Series], commands: int, fit: HarmonicFit, least: float = MOVING
) -> Pace | None:
    """Take channels over the phase of their commands.

    Args:
        series: The first ones of them are commands.
        commands: How many.
        fit: Of all, with one frequency.
        least: Phase by which one frequency must miss the commands [rad].

    Returns:
        None where the frequency stays.
    """
    driving = series[:commands]
    turn_s = 2 * np.pi / fit.omega
    start = max(float(command.t_s[0]) for command in driving)
    stop = min(float(command.t_s[-1]) for command in driving)
    whole = int((stop - start) / turn_s + 0.01)
    if whole < MIN_CYCLES:
        return None
    several = -(-whole // MOST_CYCLES)  # cycles together
    edges = start + turn_s * several * np.arange(whole // several + 1.0)
    phases: list[FloatArray] = []
    weights: list[float] = []
    for block in _blocks(driving):
        t_s, amplitude = driving[block[0]].t_s, fit.amplitudes[block, :1]
        rest = np.stack([driving[k].values for k in block]) - fit.predict(np.array(block), t_s)
        relative = 1 + amplitudes(t_s, rest, starts_of(t_s, edges), fit.omega) / amplitude
        relative = _without_image(relative, amplitude, edges, fit.omega)
        finite = np.isfinite(relative).all(axis=1)
        phases.extend(np.unwrap(np.angle(relative[finite])))
        weights.extend((fit.weight[block] * np.abs(amplitude[:, 0]) ** 2)[finite].tolist())
    if not phases:
        return None
    middle: FloatArray = (edges[:-1] + edges[1:]) / 2
    centre, scale = float(middle.mean()), float(np.ptp(middle)) / 2
    place: FloatArray = (middle - centre) / scale
    phase: FloatArray = np.average(phases, axis=0, weights=weights)
    coefficients = _polynomial(place, phase, least)
    if coefficients is None:
        return None
    curve = np.polynomial.Polynomial(coefficients)
    ends = curve(np.array([-1.0, 1.0]))
    line = np.polynomial.Polynomial([ends.mean(), (ends[1] - ends[0]) / 2])
    bend = (curve - line) / fit.omega
    moved: dict[int, FloatArray] = {}
    result: list[Series] = []
    for channel in series:
        if id(channel.t_s) not in moved:
            t_s = channel.t_s + bend((channel.t_s - centre) / scale)
            if np.any(np.diff(t_s) <= 0):
                return None
            moved[id(channel.t_s)] = t_s
        result.append(Series(channel.name, moved[id(channel.t_s)], channel.values))
    design = place[:, None] ** np.arange(float(coefficients.size))
    rest = phase - design @ coefficients
    # Of the slope at the end less that at the start, over 2 scale^2.
    row = np.array([n * (1 - (-1.0) ** (n - 1)) for n in range(coefficients.size)])
    row /= 2 * scale**2
    dof = place.size - coefficients.size
    spread = float(row @ np.linalg.inv(design.T @ design) @ row) * float(rest @ rest) / dof
    return Pace(result, float(row @ coefficients), t_factor(dof) * spread**0.5)


def _polynomial(place: FloatArray, phase: FloatArray, least: float) -> FloatArray | None:
    """Return the coefficients of the phase where it bends; None where it doesn't."""
    chosen: FloatArray | None = None
    before = phase - _fitted(place, phase, 1)[1]
    for degree in _DEGREES:
        if place.size <= degree + 2:
            break
        coefficients, value = _fitted(place, phase, degree)
        rest: FloatArray = phase - value
        gained = float(before @ before - rest @ rest)
        clear = _stands_out(gained, 1, rest[None], degree + 1)
        if gained / place.size > (least / 4) ** 2 and clear:
            chosen, before = coefficients, rest
    return chosen


def _fitted(place: FloatArray, values: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of a polynomial, ascending, and its values."""
    design = place[:, None] ** np.arange(degree + 1.0)
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0].astype(np.float64)
    return coefficients, np.asarray(design @ coefficients, dtype=np.float64)
