"""Why commands or motions hold no gait: still, too short, sampled too seldom, or not periodic.

A sine of one to three cycles, which is too short for a rhythm, is told from other motion by how
much it explains: 98 % of all channels' variance with one frequency. A triangle of as many cycles
reaches 96/pi^4 = 0.986 and counts as one; a square wave (8/pi^2 = 0.81) and a ramp, a saw-tooth of
one cycle (6/pi^2 = 0.61), don't.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError

from ..common.answer import percent
from ..common.remarks import Lacking, Refusal
from ..estimators.harmonic import HarmonicModel, fit_at, fit_shared
from ..estimators.series import Series, moves
from .groups import Groups
from .rhythm import MIN_CYCLES, MIN_EXPLAINED, MIN_SAMPLES, NYQUIST_SHARE, liveliest

SINE_EXPLAINED = 0.98
"""Share of the variance above which one sine is all that is commanded: the square of the
correlation 0.99; a triangle has 0.986."""

MOSTLY = 0.5
"""Share of the power beyond the usable band above which a channel is sampled too seldom: most of
what it does isn't seen as it is."""

_LEAST_CYCLES = 0.9
"""Of a sine; with less of it nothing has come back to where it was, and a ramp may look like it."""

_GUESSES = (1.0, 1.5, 2.0, 2.5, 3.0)
"""Cycles from which the fit starts: half a cycle apart, so that one is within a quarter of any."""

_NULLS = "gain, lag and frequency are null"


@dataclass(frozen=True)
class FewCycles:
    """A sine of too few cycles.

    Attributes:
        frequency_hz: Frequency [Hz].
        cycles: How many of them there are.
    """

    frequency_hz: float
    cycles: float


@dataclass(frozen=True)
class TooSeldom:
    """Motion too fast for its samples.

    Attributes:
        frequency_hz: Of the strongest line as it is seen; it may be an alias [Hz].
        rate_hz: Sampling rate [Hz].
    """

    frequency_hz: float
    rate_hz: float


def few_cycles(series: Sequence[Series], duration_s: float) -> FewCycles | None:
    """Look for a sine of fewer cycles than a rhythm takes.

    Args:
        series: Channels.
        duration_s: Length of the stretch [s].

    Returns:
        The sine, if one frequency explains :data:`SINE_EXPLAINED` of what moves; else None.
    """
    moving = _moving(series)
    if not moving or duration_s <= 0:
        return None
    model = HarmonicModel(harmonics=1)
    for cycles in _GUESSES:
        try:
            omega = fit_shared(liveliest(moving), 2 * np.pi * cycles / duration_s, model).omega
            fit = fit_at(moving, omega, model)
        except DataError:
            continue
        seen = omega * duration_s / (2 * np.pi)
        explained = 1 - float(fit.rss.sum() / fit.total.sum())
        if explained >= SINE_EXPLAINED and _LEAST_CYCLES <= seen < MIN_CYCLES:
            return FewCycles(omega / (2 * np.pi), seen)
    return None


def too_seldom(series: Sequence[Series]) -> TooSeldom | None:
    """Find whether the channels move faster than their samples show.

    Args:
        series: Channels.

    Returns:
        What is seen of them, if more than :data:`MOSTLY` of the power of all is at more than
        ``NYQUIST_SHARE`` of the sampling rate; else None.
    """
    strongest = beyond = total = 0.0
    result: TooSeldom | None = None
    for channel in _moving(series):
        count = round((channel.t_s[-1] - channel.t_s[0]) / channel.period_s) + 1
        if count > 2 * channel.count:  # mostly gaps: what is interpolated there is no motion
            continue
        t_s: FloatArray = channel.t_s[0] + channel.period_s * np.arange(float(count))
        even = channel.at(t_s)
        power = np.abs(np.fft.rfft((even - even.mean()) * np.hanning(count))) ** 2
        share = np.fft.rfftfreq(count)  # of the sampling rate
        fastest = int(np.argmax(power))
        total += float(power.sum())
        beyond += float(power[share > NYQUIST_SHARE].sum())
        if power[fastest] > strongest and share[fastest] > NYQUIST_SHARE:
            strongest = float(power[fastest])
            result = TooSeldom(float(share[fastest]) / channel.period_s, 1 / channel.period_s)
    return result if beyond > MOSTLY * total else None


def too_short_in_words(sine: FewCycles) -> str:
    """Why so few cycles are no gait, and how long a record would be one."""
    need_s = MIN_CYCLES / sine.frequency_hz
    return (
        f"too short for a gait: {sine.cycles:.2g} of at least {MIN_CYCLES:g} cycles of "
        f"{sine.frequency_hz:.3g} Hz (record {need_s:.3g} s or more)"
    )


def too_seldom_in_words(seen: TooSeldom, kind: str) -> str:
    """Why so fast a motion has no response, and what would be fast enough."""
    least_hz = seen.frequency_hz / NYQUIST_SHARE
    return (
        f"sampled too seldom: most of the {kind} is at {seen.frequency_hz:.3g} Hz or above, beyond "
        f"{100 * NYQUIST_SHARE:.0f} % of the sampling rate of {seen.rate_hz:.3g} Hz (log at more "
        f"than {least_hz:.3g} Hz)"
    )


def why_no_gait(
    series: Sequence[Series],
    rhythms: Groups | None,
    kind: str,
    duration_s: float,
    unusable: FewCycles | TooSeldom | None = None,
) -> str:
    """Say why channels hold no gait.

    Args:
        series: All channels.
        rhythms: The best rhythms; None without any.
        kind: ``commands`` or ``responses``.
        duration_s: Length of the stretch [s].
        unusable: What :func:`few_cycles` or :func:`too_seldom` has found.

    Returns:
        A sentence without its full stop.
    """
    if not any(moves(channel.values) for channel in series):
        return f"no gait: the {kind} never move; {_NULLS}"
    if isinstance(unusable, TooSeldom):
        return f"no gait: {too_seldom_in_words(unusable, kind)}; {_NULLS}"
    if unusable is not None:
        return f"no gait: {too_short_in_words(unusable)}; {_NULLS}"
    if rhythms is None:
        return (
            f"no gait: not periodic: no rhythm of at least {MIN_CYCLES:g} cycles can be told from "
            f"the {kind} in {duration_s:.3g} s; {_NULLS}"
        )
    frequencies = ", ".join(f"{rhythm.omega / (2 * np.pi):.3g} Hz" for rhythm in rhythms.rhythms)
    single = len(rhythms.rhythms) == 1
    best = f"rhythm ({frequencies}) explains" if single else f"rhythms ({frequencies}) explain"
    share = percent(max(rhythms.explained, 0.0), MIN_EXPLAINED)
    return (
        f"no gait: the best {best} {share} of the {kind}' variance, a gait at least "
        f"{100 * MIN_EXPLAINED:.0f} %; {_NULLS} (if only part of the session is a gait, choose it "
        "with --start and --stop)"
    )


def _moving(series: Sequence[Series]) -> list[Series]:
    return [channel for channel in series if channel.count > MIN_SAMPLES and moves(channel.values)]


def warn_no_gait(
    series: Sequence[Series], groups: Groups | None, kind: str, duration_s: float, warn: Warn
) -> None:
    """Warn why there is no gait; the answer begins with it where the record is to blame.

    Args:
        series: Channels in which no gait was found.
        groups: Their best rhythms, however little these explain, or None.
        kind: ``commands`` or ``responses``.
        duration_s: Length of the window [s].
    """
    unusable = too_seldom(series) or few_cycles(series, duration_s)
    text = why_no_gait(series, groups, kind, duration_s, unusable)
    warn(Lacking(text) if unusable is None else Refusal(text))
