"""Frequency responses of joints to commands of any kind (:mod:`.excitation`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.console import Warn
from undulog.capture.common.process import in_threads

from ...common.estimate import Estimate, Interval
from ...estimators.series import Series, moves
from .delay_model import DelayModel, fit_delay
from .excitation import Excitation, ExcitationKind, excited_bins, find_excitation, swept_band
from .nonparametric import (
    ORDER,
    LineResponse,
    even_times,
    excited_lines,
    indirect_response,
    line_power,
    local_response,
    resampled,
    tone_response,
    window,
)
from .result import DIRECT, INDIRECT, JointFrequencyResponse

if TYPE_CHECKING:
    pass

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
    moving = (name for name, command in commands.items() if moves(command.values))
    answered = (name for name in moving if name in responses and responses[name].count)
    names = list(islice(answered, MOST_JOINTS))
    if next(answered, None) is not None:
        warn(f"frequency responses are those of the first {MOST_JOINTS} joints that are driven")
    sharing = _same_commands({name: commands[name] for name in names})

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
            halves_agree=None
            if excitation.kind is ExcitationKind.CHIRP
            else _agreement(*estimates),
            method=INDIRECT if reference else DIRECT,
        )

    samples = sum(commands[name].count + responses[name].count for name in names)
    return tuple(
        response for response in in_threads(of_joint, names, samples) if response is not None
    )


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
    series = [command, response, *([] if reference is None else [reference])]
    return next(_estimates(series, excitation))


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
            command, response, *reference = (channel.between(*limits) for channel in series)
            enough = response.count > 2 * tones.size + _SPARE
            yield (
                sound_lines(tone_response(command, response, tones, looped=bool(reference)))
                if enough
                else None
            )
        return
    if min(channel.count for channel in series) <= _SPARE:
        yield from (None, None, None)
        return
    t_s, step = even_times(start, stop, max(channel.period_s for channel in series))
    even = [resampled(channel, t_s) for channel in series]
    whole = _of_band(even, step)
    yield None if whole is None else sound_lines(whole)
    half = t_s.size // 2
    for part in slice(half), slice(half, None):
        yield None if whole is None else _of_band([values[part] for values in even], step, whole)


def _of_band(
    even: Sequence[FloatArray], step: float, at: LineResponse | None = None
) -> LineResponse | None:
    """Estimate a response at up to :data:`LINES` frequencies of the excited band.

    Args:
        even: Command, response and, if any, external reference, each of shape (n,).
        step: Their sampling interval [s].
        at: Lines of the whole record, near which those of a part of it are.

    Returns:
        Values are NaN where the part isn't excited; None where there are too few bins.
    """
    # Without the mean; a straight line taken off would leak unlike the rest.
    u, y, *reference = (np.fft.rfft(values - values.mean()) for values in even)
    half = window(1, freedom=_FREEDOM)
    if u.size <= 4 * half:
        return None
    length_s = even[0].size * step
    driver = even[-1] if reference else even[0]
    bins = _usable_bins((reference or [u])[0], driver - driver.mean(), step, half)
    if not bins.size:
        return None
    if at is None:
        targets = _log_spaced(float(bins[0]), float(bins[-1]), LINES)
        chosen = np.array(sorted({int(bins[np.abs(bins - target).argmin()]) for target in targets}))
    else:
        chosen = np.unique(np.rint(at.frequency_hz * length_s).astype(np.int64))
        chosen = chosen[(chosen > 0) & (chosen < u.size)]
    if reference:
        value, variance, freedom = indirect_response(y, u, reference[0], chosen, half)
    else:
        local = local_response(y, u[None], chosen, half)
        value, variance, freedom = local.value[:, 0], local.variance[:, 0], local.freedom
    value = np.where(np.isin(chosen, bins), value, np.nan)
    return LineResponse(chosen / length_s, value, variance, np.full(chosen.size, float(freedom)))


def _usable_bins(spectrum: ComplexArray, values: FloatArray, step: float, half: int) -> IntArray:
    """Return the bins at which a response can be estimated.

    Those of the command's energy, within the frequencies of a sweep, below a quarter of the
    sampling rate, and with as many such bins in their window as it has unknowns: fewer would be
    estimated from what leaks beside them.
    """
    bins = excited_bins(np.abs(spectrum) ** 2)
    if (band := swept_band(values, step)) is not None:
        frequency = bins / (values.size * step)
        bins = bins[(frequency >= band[0]) & (frequency <= band[1])]
    bins = bins[(bins > half // 2) & (bins < 2 * _HIGHEST * spectrum.size)]
    beside = np.searchsorted(bins, bins + half, side="right") - np.searchsorted(bins, bins - half)
    return bins[beside >= 2 * (ORDER + 1)]


def sound_lines(lines: LineResponse) -> LineResponse:
    """Leave out lines without a value, and give those without noise that of rounding."""
    gain = np.abs(lines.value)
    variance = np.maximum(lines.variance, (_ROUNDING * gain) ** 2)
    sound = np.isfinite(gain) & np.isfinite(variance) & (variance > 0) & (lines.freedom > 0)
    return LineResponse(
        lines.frequency_hz[sound], lines.value[sound], variance[sound], lines.freedom[sound]
    )


def _log_spaced(low: float, high: float, count: int) -> FloatArray:
    return np.asarray(np.geomspace(low, high, count), dtype=np.float64)


def _unbroken(series: Sequence[Series]) -> list[Series]:
    """Return the longest stretch that all have without a long gap; short ones are bridged."""
    start = max(channel.t_s[0] for channel in series)
    stop = min(channel.t_s[-1] for channel in series)
    breaks = [(stop, start)] if start > stop else []
    for record in series:
        step = np.diff(record.t_s)
        long = np.flatnonzero(step > _LONG_GAP * (stop - start))
        breaks.extend(zip(record.t_s[long].tolist(), record.t_s[long + 1].tolist(), strict=True))
    starts = [start, *(after for _, after in breaks)]
    stops = [min([stop, *(before for before, _ in breaks if before >= start)]) for start in starts]
    k = int(np.argmax(np.subtract(stops, starts)))
    limits = starts[k], stops[k] + 1e-9
    return [channel.between(*limits) for channel in series]


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
    clear = gain > lines.radius()
    model = fit_delay(
        lines.frequency_hz, lines.value, lines.variance, float(np.median(lines.freedom))
    )
    lag = -np.angle(lines.value)
    delay = Estimate()
    if np.isfinite(model.delay_s):
        delay = Estimate(max(model.delay_s, 0.0), model.interval_s)
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
            for interval, sure in zip(_intervals(lag, reach / gain), clear, strict=True)
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
    u, y = (np.fft.rfft(resampled(series, t_s).reshape(shape)) for series in (command, response))
    lines = excited_lines(u.mean(axis=0)[None])
    power = line_power(y)
    free = np.setdiff1d(np.arange(int(lines[0]), int(lines[-1])), lines, assume_unique=True)
    if not free.size:
        return None
    share = float(power[free].mean() / power[lines].mean())
    return max(share, 0.0) ** 0.5


def _agreement(first: LineResponse | None, second: LineResponse | None) -> tuple[int, int] | None:
    """Count the lines of both halves of a record that agree, and those compared.

    They agree if they differ by no more than the root of the sum of their squared 95 % radii.
    """
    if first is None or second is None:
        return None
    if first.frequency_hz.size != second.frequency_hz.size:
        return None
    differ = np.abs(first.value - second.value)
    both = np.isfinite(differ)
    if not both.any():
        return None
    agree = differ[both] <= np.hypot(first.radius(), second.radius())[both]
    return int(agree.sum()), int(agree.size)
