"""Frequency responses of joints to commands of any kind: what a command excites, and the answer.

A command is one of sines, a periodic multisine, a sweep, steps, or a band of noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import next_fast_len
from scipy.special import fdtri, stdtrit

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.console import Warn
from undulog.capture.common.process import in_threads

from ..estimators.series import Series, moves
from ..results.estimate import Estimate, Interval
from ..results.frequency_response import DIRECT, INDIRECT, JointFrequencyResponse
from .delay_model import DelayModel, fit_delay
from .nonparametric import (
    LineResponse,
    even_times,
    excited_lines,
    find_tones,
    indirect_response,
    line_power,
    local_response,
    resampled,
    tone_response,
    window,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

LEAST_SAMPLES = 128
REPEATED = 1e-3
"""Two periods are one if they differ by less than this share of the variance."""

_LIKELY = 10 * REPEATED  # by the parabola
_MOST_TRIED = 256  # a strong line of a multisine nearly repeats many times in a period
_SEEN = 2048  # places at which the exact period is sought

LEVELS = 8
"""A command with at most so many values is one of steps."""

_SWEPT = 0.97  # rank correlation of a sweep's instantaneous frequency with time
_POWER = 1e-4  # of the strongest bin, smoothed: below it a bin isn't excited
_SMOOTHING = 5  # bins
_LONGEST = 16  # times the samples at the median interval: rates may change within a record


class Kind(StrEnum):
    """Kinds of excitation."""

    TONES = "sum of sines"
    PERIODIC = "periodic multisine"
    CHIRP = "chirp"
    STEPS = "steps"
    NOISE = "broadband"


@dataclass(frozen=True)
class Excitation:
    """What one command excites.

    Attributes:
        tones_hz: Frequencies [Hz], where lines apart from each other make up the command.
        period_s: Of a command that repeats at least twice [s], else NaN.
    """

    kind: Kind
    tones_hz: FloatArray
    period_s: float


def find_excitation(command: Series) -> Excitation | None:
    """Classify a command.

    Args:
        command: Its samples, without gaps.

    Returns:
        None where it doesn't move, has fewer than :data:`LEAST_SAMPLES` samples, or has gaps after
        all: longer ones than the time that it covers.
    """
    if command.count < LEAST_SAMPLES or not moves(command.values):
        return None
    if command.t_s[-1] - command.t_s[0] > _LONGEST * command.count * command.period_s:
        return None
    # At its own sampling interval, so that steps stay between the same samples of each period.
    even = resampled(command, np.arange(command.t_s[0], command.t_s[-1], command.period_s))
    values = even - np.mean(command.values)
    tones = find_tones(command, even)
    repeated = _period(values) if tones is None or tones.size > 1 else None
    period_s = float("nan") if repeated is None else repeated * command.period_s
    if repeated is not None:
        kind = Kind.PERIODIC
    elif tones is not None:
        kind = Kind.TONES
    elif np.unique(command.values).size <= LEVELS:
        kind = Kind.STEPS
    else:
        kind = Kind.CHIRP if _is_chirp(values) else Kind.NOISE
    return Excitation(kind, np.zeros(0) if tones is None else tones, period_s)


def excited_bins(spectrum: FloatArray) -> IntArray:
    """Return the bins of a power spectrum that the command excites, without the constant.

    Args:
        spectrum: |U|^2 from bin 0 on, shape (n,).
    """
    smooth = np.convolve(spectrum, np.ones(_SMOOTHING) / _SMOOTHING, mode="same")
    smooth[:1] = 0.0
    return np.flatnonzero(smooth > _POWER * smooth.max())


def _period(values: FloatArray) -> float | None:
    """Return the period in samples, where the command repeats at least twice."""
    from scipy.interpolate import CubicSpline

    n = values.size
    size = next_fast_len(2 * n, real=True)
    correlation = np.fft.irfft(np.abs(np.fft.rfft(values, size)) ** 2, size)[:n]
    energy = np.concatenate([[0.0], np.cumsum(values**2)])
    lags = np.arange(1, n // 2 + 2)
    # sum (u(t + L) - u(t))^2 over its mean square, by lag L.
    both = energy[n] - energy[lags] + energy[n - lags]
    differ = (both - 2 * correlation[lags]) / np.maximum(both, np.finfo(float).tiny)
    if not (differ > 0.5).any():
        return None
    # The first small lags are smoothness, not repetition.
    least = _minima(differ, int(np.argmax(differ > 0.5)))
    before, at, after = differ[least - 1], differ[least], differ[least + 1]
    # Near the period the difference is a parabola: its vertex lies between two samples.
    bend = np.maximum(before - 2 * at + after, np.finfo(float).tiny)
    beside = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    likely = np.flatnonzero(at - 0.25 * (before - after) * beside < _LIKELY)[:_MOST_TRIED]
    if not likely.size:
        return None
    curve = CubicSpline(np.arange(n, dtype=np.float64), values)
    for whole, part, known in zip(lags[least[likely]], beside[likely], at[likely], strict=True):
        lag, left = _exact_lag(curve, float(whole + part))
        if min(known, left) < REPEATED:
            return lag if left <= known else float(whole)
    return None


def _minima(values: FloatArray, first: int) -> IntArray:
    """Return the local minima behind an index, without both ends."""
    inner = values[1:-1]
    found = 1 + np.flatnonzero((inner <= values[:-2]) & (inner <= values[2:]))
    return found[found > first]


def _exact_lag(curve: CubicSpline, lag: float) -> tuple[float, float]:
    """Return the lag of least difference between two samples, and the difference there.

    The step of Gauss and Newton from the parabola's vertex; sum (u(t + L) - u(t))^2 over its mean
    square, at up to :data:`_SEEN` places spread over the command.
    """
    last = curve.x[-1] - lag - 1
    place = np.arange(0.0, last, max(1, round(last / _SEEN)))
    now, rate = curve(place), curve(place + lag, 1)
    power = float(rate @ rate)
    step = float(rate @ (curve(place + lag) - now)) / power if power > 0 else 0.0
    lag -= min(max(step, -0.5), 0.5)
    later = curve(place + lag)
    return lag, float(np.sum((later - now) ** 2) / np.sum(later**2 + now**2))


def _is_chirp(values: FloatArray) -> bool:
    """Whether the instantaneous frequency rises or falls all the time."""
    from scipy.stats import spearmanr

    crossings = np.flatnonzero(np.diff(np.signbit(values)))
    if crossings.size < 8:
        return False
    found = spearmanr(np.arange(crossings.size - 1), np.diff(crossings))
    return abs(float(found.statistic)) > _SWEPT


LINES = 40
"""Frequencies at which the response to a band is given."""

SAME_COMMAND = 0.999
"""Commands that correlate so much are one input."""

MOST_JOINTS = 128
"""Responses of more joints are not estimated: each takes tens of milliseconds."""

LEAST_PERIODS = 2
_FREEDOM = 12  # of the noise, complex
_HIGHEST = 0.25  # of the sampling rate: beyond it splines are not exact
_HALF_POWER = 1 / np.sqrt(2)
_ROUNDING = 1e-9  # of a gain
_LONG_GAP = 0.01  # of the record
_SPARE = 16  # samples beyond the parameters of the tones
_COMPARED = 4096  # samples by which commands are compared


def frequency_responses(
    commands: Mapping[str, Series],
    responses: Mapping[str, Series],
    warn: Warn,
    references: Mapping[str, Series] | None = None,
) -> tuple[JointFrequencyResponse, ...]:
    """Estimate the response of each joint to its own command.

    Args:
        commands: By joint, without gaps.
        responses: By joint; those without a command that moves are left out.
        references: By joint, what its command follows from outside. Responses are by the indirect
            method where there is one that moves.

    Returns:
        One result a joint, in the order of the commands, of the first :data:`MOST_JOINTS`.
    """
    moving = (name for name, one in commands.items() if moves(one.values))
    answered = (name for name in moving if name in responses and responses[name].count)
    known = list(islice(answered, MOST_JOINTS))
    if next(answered, None) is not None:
        warn(f"frequency responses are those of the first {MOST_JOINTS} joints that are driven")
    sharing = _same_commands({name: commands[name] for name in known})

    def of_joint(name: str) -> JointFrequencyResponse | None:
        external = (references or {}).get(name)
        if external is not None and not moves(external.values):
            external = None
        known_series = [commands[name], responses[name], *([] if external is None else [external])]
        command, response, *reference = _unbroken(known_series)
        excitation = find_excitation((reference or [command])[0])
        if excitation is None:
            return None
        estimates = _estimates([command, response, *reference], excitation)
        lines = next(estimates)
        if lines is None or not lines.frequency_hz.size:
            return None
        return replace(
            joint_response(response.name, str(excitation.kind), sharing[name], lines),
            distortion=None if reference else _distortion(command, response, excitation),
            # The halves of a chirp excite different bands.
            halves_agree=None if excitation.kind is Kind.CHIRP else _agreement(*estimates),
            method=INDIRECT if reference else DIRECT,
        )

    samples = sum(commands[name].count + responses[name].count for name in known)
    return tuple(one for one in in_threads(of_joint, known, samples) if one is not None)


def estimate(
    command: Series, response: Series, excitation: Excitation, reference: Series | None = None
) -> LineResponse | None:
    """Estimate the response of one joint.

    Args:
        excitation: Of the command, or of the external reference.
        reference: What the command follows from outside; the method is the indirect one then.

    Returns:
        At the tones, or at up to :data:`LINES` frequencies of the excited band; None where the
        record is too short.
    """
    known = [command, response, *([] if reference is None else [reference])]
    return next(_estimates(known, excitation))


def _estimates(series: Sequence[Series], excitation: Excitation) -> Iterator[LineResponse | None]:
    """Estimate the response of the whole record, of its first and of its second half.

    Args:
        series: Command, response and, if any, external reference.
    """
    start, stop = series[0].t_s[0], series[0].t_s[-1]
    tones = excitation.tones_hz
    if tones.size:
        middle = (start + stop) / 2
        for limits in (start, stop), (start, middle), (middle, stop):
            command, response, *reference = (one.between(*limits) for one in series)
            enough = response.count > 2 * tones.size + _SPARE
            yield (
                sound_lines(tone_response(command, response, tones, looped=bool(reference)))
                if enough
                else None
            )
        return
    if min(one.count for one in series) <= _SPARE:
        yield from (None, None, None)
        return
    t_s, step = even_times(start, stop, max(one.period_s for one in series))
    even = [resampled(one, t_s) for one in series]
    half = t_s.size // 2
    for part in slice(None), slice(half), slice(half, None):
        yield _of_band([one[part] for one in even], step)


def _of_band(even: Sequence[FloatArray], step: float) -> LineResponse | None:
    """Estimate a response at up to :data:`LINES` frequencies of the excited band.

    Args:
        even: Command, response and, if any, external reference, each of shape (n,).
        step: Their sampling interval [s].
    """
    # Without the mean; a straight line taken off would leak unlike the rest.
    u, y, *reference = (np.fft.rfft(one - one.mean()) for one in even)
    half = window(1, freedom=_FREEDOM)
    bins = excited_bins(np.abs((reference or [u])[0]) ** 2)
    bins = bins[(bins > half // 2) & (bins < 2 * _HIGHEST * u.size)]
    if u.size <= 4 * half or not bins.size:
        return None
    wanted = _log_spaced(float(bins[0]), float(bins[-1]), LINES)
    chosen = np.array(sorted({int(bins[np.abs(bins - each).argmin()]) for each in wanted}))
    if reference:
        value, variance, freedom = indirect_response(y, u, reference[0], chosen, half)
    else:
        found = local_response(y, u[None], chosen, half)
        value, variance, freedom = found.value[:, 0], found.variance[:, 0], found.freedom
    frequency = chosen / (even[0].size * step)
    return sound_lines(
        LineResponse(frequency, value, variance, np.full(chosen.size, float(freedom)))
    )


def sound_lines(lines: LineResponse) -> LineResponse:
    """Leave out lines without a value, and give those without noise that of rounding."""
    gain = np.abs(lines.value)
    variance = np.maximum(lines.variance, (_ROUNDING * gain) ** 2)
    known = np.isfinite(gain) & np.isfinite(variance) & (variance > 0) & (lines.freedom > 0)
    return LineResponse(
        lines.frequency_hz[known], lines.value[known], variance[known], lines.freedom[known]
    )


def _log_spaced(low: float, high: float, count: int) -> FloatArray:
    return np.asarray(np.geomspace(low, high, count), dtype=np.float64)


def _unbroken(series: Sequence[Series]) -> list[Series]:
    """Return the longest stretch that all have without a long gap; short ones are bridged."""
    start = max(one.t_s[0] for one in series)
    stop = min(one.t_s[-1] for one in series)
    breaks = [(stop, start)] if start > stop else []
    for one in series:
        step = np.diff(one.t_s)
        long = np.flatnonzero(step > _LONG_GAP * (stop - start))
        breaks.extend(zip(one.t_s[long].tolist(), one.t_s[long + 1].tolist(), strict=True))
    starts = [start, *(after for _, after in breaks)]
    stops = [min([stop, *(before for before, _ in breaks if before >= one)]) for one in starts]
    k = int(np.argmax(np.subtract(stops, starts)))
    limits = starts[k], stops[k] + 1e-9
    return [one.between(*limits) for one in series]


def _same_commands(commands: Mapping[str, Series]) -> dict[str, tuple[str, ...]]:
    """Return for each joint the others whose commands are the same but for sign and scale."""
    names = list(commands)
    if not names:
        return {}
    first = commands[names[0]]
    t_s = first.t_s[:: -(-first.count // _COMPARED)]
    table = np.array([commands[name].at(t_s) for name in names])
    with np.errstate(invalid="ignore"):
        correlation = np.abs(np.atleast_2d(np.corrcoef(table)))
    return {
        name: tuple(
            other
            for j, other in enumerate(names)
            if other != name and correlation[i, j] > SAME_COMMAND
        )
        for i, name in enumerate(names)
    }


def joint_response(
    joint: str, excitation: str, sharing: tuple[str, ...], lines: LineResponse
) -> JointFrequencyResponse:
    """Return the result of one joint, without distortion and comparison of halves.

    Args:
        excitation: Kind of its command.
        sharing: Other joints with the same command.
        lines: At least one, with variances above 0; see :func:`sound_lines`.
    """
    gain = np.abs(lines.value)
    sd = np.sqrt(lines.variance / 2)
    reach: FloatArray = np.asarray(stdtrit(2 * lines.freedom, 0.975) * sd, dtype=np.float64)
    known = gain > lines.radius()
    model = fit_delay(
        lines.frequency_hz, lines.value, lines.variance, float(np.median(lines.freedom))
    )
    lag = -np.angle(lines.value)
    delay = Estimate()
    if np.isfinite(model.delay_s):
        width = 1.96 * model.delay_sd_s
        delay = Estimate(model.delay_s, (model.delay_s - width, model.delay_s + width))
    return JointFrequencyResponse(
        joint=joint,
        excitation=excitation,
        shares_command=sharing,
        frequency_hz=tuple(lines.frequency_hz.tolist()),
        gain=tuple(gain.tolist()),
        gain_ci95=tuple(_intervals(gain, reach)),
        lag_rad=tuple(lag.tolist()),
        lag_ci95=tuple(
            interval if sure else None
            for interval, sure in zip(_intervals(lag, reach / gain), known, strict=True)
        ),
        coherence=tuple((gain**2 / (gain**2 + lines.variance)).tolist()),
        delay_s=delay,
        delay_model=model.orders,
        bandwidth_hz=_bandwidth(lines, gain, model),
        resonance_hz=_resonance(lines, gain, reach),
    )


def _intervals(values: FloatArray, reach: FloatArray) -> list[Interval]:
    return [
        (float(low), float(high)) for low, high in zip(values - reach, values + reach, strict=True)
    ]


def _bandwidth(lines: LineResponse, gain: FloatArray, model: DelayModel) -> float | None:
    """Return where the gain falls 3 dB below the lowest line's, by the model if there is one."""
    frequency, curve = lines.frequency_hz, gain
    if model.orders is not None:
        frequency = _log_spaced(float(frequency[0]), float(frequency[-1]), 2000)
        curve = np.abs(model.response(frequency))
    below = np.flatnonzero(curve < _HALF_POWER * curve[0])
    if not below.size:
        return None
    after = int(below[0])
    level = _HALF_POWER * curve[0]
    share = (curve[after - 1] - level) / (curve[after - 1] - curve[after])
    return float(frequency[after - 1] * (frequency[after] / frequency[after - 1]) ** share)


def _resonance(lines: LineResponse, gain: FloatArray, reach: FloatArray) -> float | None:
    top = int(np.argmax(gain))
    if gain[top] - reach[top] <= gain[0] + reach[0]:
        return None
    return float(lines.frequency_hz[top])


def _distortion(command: Series, response: Series, excitation: Excitation) -> float | None:
    """Return the power at lines that a periodic command leaves out, over that at its own.

    Noise is taken off by the scatter over periods. Other joints' motion is in it, too.
    """
    if not excitation.period_s > 0:
        return None
    length = round(excitation.period_s / max(command.period_s, response.period_s))
    step = excitation.period_s / length
    periods = int((command.t_s[-1] - command.t_s[0]) / excitation.period_s)
    if periods < LEAST_PERIODS:
        return None
    # The last periods: at the beginning there may be a transient.
    t_s = command.t_s[-1] - np.arange(periods * length)[::-1] * step
    shape = (periods, length)
    u, y = (np.fft.rfft(resampled(one, t_s).reshape(shape)) for one in (command, response))
    lines = excited_lines(u.mean(axis=0)[None])
    power = line_power(y)
    free = np.setdiff1d(np.arange(int(lines[0]), int(lines[-1])), lines, assume_unique=True)
    if not free.size:
        return None
    share = float(power[free].mean() / power[lines].mean())
    return max(share, 0.0) ** 0.5


def _agreement(first: LineResponse | None, second: LineResponse | None) -> tuple[int, int] | None:
    """Compare the two halves of a record, at the lines that both have."""
    if first is None or second is None:
        return None
    if first.frequency_hz.size != second.frequency_hz.size:
        return None
    differ = np.abs(first.value - second.value) ** 2
    quantile = fdtri(2, 2 * (first.freedom + second.freedom), 0.95)
    agree = differ <= (first.variance + second.variance) * quantile
    return int(agree.sum()), int(agree.size)
