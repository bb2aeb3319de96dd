"""The mean cycle of a joint by gait phase, the phase that the commands define.

Phase 0 is the crest of the fundamental of the first compared joint's command, in every session, so
cycles are laid over each other by what the controller meant and not by the clock.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..estimators.harmonic import HarmonicFit
from ..estimators.series import GAP_FACTOR, Series

PHASES = 72
"""Phases at which a mean cycle is told, every 5 degrees."""


def phases_rad() -> FloatArray:
    """The phases of a mean cycle.

    Returns:
        From 0 up to 2 pi, not included [rad], shape (``PHASES``,).
    """
    return 2 * np.pi * np.arange(PHASES) / PHASES


def cycles_by_phase(
    one: Series, fit: HarmonicFit, channel: int, *, zero_rad: float, start_s: float, stop_s: float
) -> FloatArray:
    """A response cut into its whole cycles.

    What the harmonic fit leaves is interpolated linearly between samples, and the fit added again:
    so nothing of the gait itself is lost between samples.

    Args:
        one: The response.
        fit: The fit that holds it.
        channel: Its index in the fit.
        zero_rad: Phase of the reference command's fundamental at t = 0 [rad].
        start_s: Cycles begin here or later [s].
        stop_s: And end here or earlier [s].

    Returns:
        Values [rad] of c whole cycles without gaps, shape (c, ``PHASES``).
    """
    cycle_s = 2 * np.pi / fit.omega
    first = -zero_rad / fit.omega
    first += np.ceil((start_s - first) / cycle_s - 1e-6) * cycle_s
    count = max(0, int(np.floor((stop_s - first) / cycle_s + 1e-6)))
    starts = first + cycle_s * np.arange(count)
    times = starts[:, None] + cycle_s * np.arange(PHASES) / PHASES
    rest = one.values - fit.predict(channel, one.t_s)
    left = Series(one.name, one.t_s, rest).at(times.ravel()).reshape(times.shape)
    cut = fit.predict(channel, times) + left
    return cut[[_whole(one, start, start + cycle_s) for start in starts.tolist()]]


def _whole(one: Series, start_s: float, stop_s: float) -> bool:
    """Whether samples reach through a cycle without a gap."""
    longest = GAP_FACTOR * one.period_s
    inside = one.between(start_s, stop_s).t_s
    edges = np.concatenate([[start_s], inside, [stop_s]])
    return inside.size > 1 and bool(np.max(np.diff(edges)) <= longest)
