"""What a command excites: sines, a periodic multisine, a sweep, steps, or a band of noise."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import next_fast_len

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.judgement.shifts import rank_correlation

from ...estimators.series import Series, moves
from .nonparametric import find_tones, resampled

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
ENERGY = 0.99
"""Share of a command's energy that makes its band; the rest is leakage and what its ends make."""

_SMOOTHING = 5  # bins
_ENDS = 2  # half cycles whose mean frequency is that of a sweep's beginning or end
_LONGEST = 16  # times the samples at the median interval: rates may change within a record


class ExcitationKind(StrEnum):
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

    kind: ExcitationKind
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
        kind = ExcitationKind.PERIODIC
    elif tones is not None:
        kind = ExcitationKind.TONES
    elif np.unique(command.values).size <= LEVELS:
        kind = ExcitationKind.STEPS
    else:
        kind = ExcitationKind.CHIRP if _is_chirp(values) else ExcitationKind.NOISE
    return Excitation(kind, np.zeros(0) if tones is None else tones, period_s)


def excited_bins(spectrum: FloatArray) -> IntArray:
    """Return the bins of a power spectrum that hold the command's energy, without the constant.

    Args:
        spectrum: |U|^2 from bin 0 on, shape (n,).

    Returns:
        Of the powers, each the mean over five bins, the largest that together have the share
        :data:`ENERGY`; ascending.
    """
    smooth: FloatArray = np.convolve(spectrum, np.ones(_SMOOTHING) / _SMOOTHING, mode="same")
    smooth[:1] = 0.0
    order: IntArray = np.argsort(smooth)[::-1].astype(np.int64)
    share: FloatArray = np.cumsum(smooth[order])
    total = float(share[-1])
    count = int(np.searchsorted(share, ENERGY * total)) + 1
    return np.sort(order[:count]) if total > 0 else order[:0]


def swept_band(values: FloatArray, step_s: float) -> tuple[float, float] | None:
    """Return the frequencies between which a command sweeps [Hz], or None if it is no sweep.

    Args:
        values: About their mean, at equal steps, shape (n,).
        step_s: [s].
    """
    if not _is_chirp(values):
        return None
    before: IntArray = np.flatnonzero(np.diff(np.signbit(values))).astype(np.int64)
    level: FloatArray = values[before]
    part = level / (level - values[before + 1])
    times: FloatArray = step_s * (before.astype(np.float64) + part)
    first, last = (
        _ENDS / 2 / float(part[-1] - part[0]) for part in (times[: _ENDS + 1], times[-_ENDS - 1 :])
    )
    return min(first, last), max(first, last)


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
    for whole, part, coarse in zip(lags[least[likely]], beside[likely], at[likely], strict=True):
        lag, left = _exact_lag(curve, float(whole + part))
        if min(coarse, left) < REPEATED:
            return lag if left <= coarse else float(whole)
    return None


def _minima(values: FloatArray, first: int) -> IntArray:
    """Return the local minima behind an index, without both ends."""
    inner = values[1:-1]
    minima = 1 + np.flatnonzero((inner <= values[:-2]) & (inner <= values[2:]))
    return minima[minima > first]


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
    crossings = np.flatnonzero(np.diff(np.signbit(values)))
    if crossings.size < 8:
        return False
    return abs(rank_correlation(np.diff(crossings).astype(np.float64))) > _SWEPT
