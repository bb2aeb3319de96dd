"""Is there a gait, and at which frequency?

A session has a gait when one rhythm, common to all joints, explains the commands: at least
``MIN_CYCLES`` cycles of it, and at least ``MIN_EXPLAINED`` of the commands' variance by that
frequency and its harmonics. A sine with a fifth of its power in noise passes (0.83), and so does
a square wave (0.90); a ramp, whose best fit with three cycles is a saw-tooth, reaches
(6 / pi^2)(1/9 + 1/36 + 1/81) = 0.09.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray
from undulog.capture.common.errors import DataError

from ..estimators.harmonic import HarmonicFit, HarmonicModel, fit_at, fit_shared
from ..estimators.series import Series, moves

MIN_CYCLES = 3.0
MIN_EXPLAINED = 0.8
MIN_SAMPLES = 16
"""A channel needs more than these."""

HARMONICS = 3
NYQUIST_SHARE = 0.45
"""Highest harmonic as a share of the sampling rate; half would be the limit."""

DRIVEN_SHARE = 0.01
"""A joint whose command moves less than this share of the liveliest is held still."""

_SCOUTS = 4
"""Channels that the first search looks at: the livelier ones."""

_PADDING = 4

_SPARSEST = 16
"""Mean sampling interval, in median ones, beyond which channels are mostly gaps."""


@dataclass(frozen=True)
class Rhythm:
    """A rhythm common to several channels.

    Attributes:
        names: Channels that move, in their order.
        fit: Of these, with the basis that the sampling rate allows.
    """

    names: tuple[str, ...]
    fit: HarmonicFit

    @property
    def omega(self) -> float:
        """Angular frequency [rad/s]."""
        return self.fit.omega

    @property
    def explained(self) -> float:
        """Share of all these channels' variance that it explains, 0 to 1."""
        return 1.0 - float(self.fit.rss.sum() / self.fit.total.sum())


def find_rhythm(series: Sequence[Series], duration_s: float) -> Rhythm | None:
    """Look for the rhythm that explains the channels best.

    Args:
        series: Channels; those that never move are ignored.
        duration_s: Length of the stretch [s].

    Returns:
        The best rhythm with at least ``MIN_CYCLES`` cycles, however little it explains; None
        where nothing moves or the samples are too few.
    """
    moving = [
        channel for channel in series if channel.count > MIN_SAMPLES and moves(channel.values)
    ]
    if not moving or duration_s <= 0:
        return None
    scouts = liveliest(moving)
    peak = _periodogram_peak(scouts, duration_s)
    best: Rhythm | None = None
    # A second harmonic that is stronger than the fundamental makes the peak an octave too high.
    for omega in () if peak is None else (peak, peak / 2):
        rhythm = _refined(scouts, moving, omega)
        if rhythm is None or rhythm.omega * duration_s < 2 * np.pi * MIN_CYCLES:
            continue
        if best is None or rhythm.explained > best.explained:
            best = rhythm
        if best.explained >= MIN_EXPLAINED:
            break
    return best


def allowed_model(series: Sequence[Series], omega: float, trend: int = 0) -> HarmonicModel:
    """Return the basis that the slowest channel's sampling rate allows.

    Args:
        omega: Angular frequency [rad/s].

    Returns:
        One to ``HARMONICS`` harmonics.
    """
    slowest = max(channel.period_s for channel in series)
    highest = int(NYQUIST_SHARE * 2 * np.pi / (slowest * omega)) if slowest > 0 else 1
    return HarmonicModel(harmonics=int(np.clip(highest, 1, HARMONICS)), trend=trend)


def driven(fit: HarmonicFit) -> tuple[BoolArray, BoolArray]:
    """Which joints the gait drives.

    Args:
        fit: Of the m commands at the gait's frequency.

    Returns:
        Joints that are driven, and joints that are commanded something else than the common
        rhythm, each of shape (m,); the others are held still.
    """
    # Amplitude of a sine of the same variance.
    size = np.sqrt(2 * fit.total / fit.count)
    lively = size > DRIVEN_SHARE * np.max(size, initial=0.0)
    follows = fit.explained >= MIN_EXPLAINED
    return lively & follows, lively & ~follows


def phase_step(fundamentals: ComplexArray) -> float:
    """Return the mean phase step from joint to joint, signed as in Eq. 2.

    Args:
        fundamentals: Complex amplitudes of one plane's commands, head to tail, shape (k,), k > 1.

    Returns:
        In (-pi, pi] [rad]; negative when the wave runs from head to tail.
    """
    return float(np.angle(np.sum(fundamentals[1:] * fundamentals[:-1].conj())))


def wave_name(step_rad: float) -> str:
    """Which way a wave runs.

    Args:
        step_rad: Phase step from joint to joint [rad].

    Returns:
        ``head-to-tail``, ``tail-to-head``, or ``standing`` where the step is 0 or pi.
    """
    if abs(np.sin(step_rad)) < 1e-3:
        return "standing"
    return "head-to-tail" if step_rad < 0 else "tail-to-head"


def refine(series: Sequence[Series], omega: float) -> Rhythm | None:
    """Fit a rhythm to channels that share it.

    Args:
        omega: Where to start [rad/s].

    Returns:
        The rhythm; None where the samples are too few or no frequency fits.
    """
    return _refined(liveliest(series), series, omega)


def liveliest(series: Sequence[Series]) -> list[Series]:
    """Return the few channels that move most, from which a frequency is found."""
    return sorted(series, key=lambda channel: float(np.var(channel.values)), reverse=True)[:_SCOUTS]


def _refined(scouts: Sequence[Series], series: Sequence[Series], omega: float) -> Rhythm | None:
    """Return the rhythm of the scouts near a frequency, and what it explains of all channels."""
    model = allowed_model(series, omega)
    if any(channel.count <= model.size + 1 for channel in series):
        return None
    try:
        fit = fit_at(scouts, omega, model)
        if not np.any(fit.total):
            return None
        if np.max(fit.explained) >= MIN_EXPLAINED / 2:  # else no step makes it a gait
            fit = fit_shared(scouts, omega, model)
        if len(series) > 1:
            fit = fit_at(series, fit.omega, model)
    except DataError:
        return None
    return Rhythm(tuple(channel.name for channel in series), fit)


def _periodogram_peak(scouts: Sequence[Series], duration_s: float) -> float | None:
    """Return the peak of the channels' summed periodogram [rad/s].

    Only a starting point: the channels are interpolated to an even grid and tapered, and the
    Gauss-Newton fit does the rest on the true times.
    """
    step = max(scout.period_s for scout in scouts)
    start = max(scout.t_s[0] for scout in scouts)
    stop = min(scout.t_s[-1] for scout in scouts)
    count = int((stop - start) / step) + 1 if stop > start and step > 0 else 0
    if not 16 <= count <= _SPARSEST * max(scout.count for scout in scouts):
        return None
    grid = start + step * np.arange(count)
    length = 1 << int(np.ceil(np.log2(_PADDING * count)))
    power = np.zeros(length // 2 + 1)
    taper = np.hanning(count)
    for scout in scouts:
        values = scout.at(grid)
        power += np.abs(np.fft.rfft((values - values.mean()) * taper, length)) ** 2
    frequency = np.fft.rfftfreq(length, step)
    # Half a cycle below the limit: the peak of a rhythm of just three cycles must be found.
    inside = (frequency >= (MIN_CYCLES - 0.5) / duration_s) & (frequency <= NYQUIST_SHARE / step)
    if not np.any(inside) or np.max(power[inside]) == 0:
        return None
    return float(2 * np.pi * frequency[inside][np.argmax(power[inside])])
