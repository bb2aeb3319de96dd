"""What a command excites: sines, a periodic multisine, a sweep, steps, or a band of noise."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray

from ..estimators.series import Series
from .tones import find_tones, resampled

LEAST_SAMPLES = 128
REPEATED = 1e-3
"""Two periods are one if they differ by less than this share of the variance."""

LEVELS = 8
"""A command with at most so many values is one of steps."""

_SWEPT = 0.97  # rank correlation of a sweep's instantaneous frequency with time
_POWER = 1e-4  # of the strongest bin, smoothed: below it a bin isn't excited
_SMOOTHING = 5  # bins


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
        None where it doesn't move or has fewer than :data:`LEAST_SAMPLES` samples.
    """
    if command.count < LEAST_SAMPLES or np.ptp(command.values) == 0:
        return None
    t_s = np.arange(command.t_s[0], command.t_s[-1], command.period_s)
    values = resampled(command, t_s) - np.mean(command.values)
    tones = find_tones(command)
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


def _period(values: FloatArray) -> int | None:
    """Return the period in samples, where the command repeats at least twice."""
    n = values.size
    padded = np.fft.rfft(values, 2 * n)
    correlation = np.fft.irfft(np.abs(padded) ** 2)[:n]
    energy = np.concatenate([[0.0], np.cumsum(values**2)])
    lags = np.arange(1, n // 2 + 1)
    # sum (u(t + L) - u(t))^2 over its mean square, by lag L.
    both = energy[n] - energy[lags] + energy[n - lags]
    differ = (both - 2 * correlation[lags]) / np.maximum(both, np.finfo(float).tiny)
    good = np.flatnonzero(differ < REPEATED)
    # The first run of small lags is smoothness, not repetition.
    far = good[good > np.argmax(differ > 0.5)] if (differ > 0.5).any() else good[:0]
    if not far.size:
        return None
    run = far[: np.argmax(np.diff(far, append=far[-1] + 2) > 1) + 1]
    return int(lags[run[np.argmin(differ[run])]])


def _is_chirp(values: FloatArray) -> bool:
    """Whether the instantaneous frequency rises or falls all the time."""
    from scipy.stats import spearmanr

    crossings = np.flatnonzero(np.diff(np.signbit(values)))
    if crossings.size < 8:
        return False
    found = spearmanr(np.arange(crossings.size - 1), np.diff(crossings))
    return abs(float(found.statistic)) > _SWEPT
