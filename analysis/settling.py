"""Has the motion settled? The drift of log gain and lag from cycle to cycle.

A lightly damped bending mode rings for seconds after the start, and least squares over its tail
gives a wrong gain with a small residual. The drift shows it: what the joint fit leaves of each
cycle at the gait frequency, regressed on the cycle's number. A body mode shows in all joints, so
one test is made over all of them; no single joint has cycles enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import ComplexArray

from .harmonic import HarmonicFit
from .series import Series

DRIFT_PER_CYCLE = 1e-4
"""Drift of ln H per cycle below which a motion counts as settled."""

SIGNIFICANT = 5e-3
"""Chance of a warning about a settled motion."""

_MIN_CYCLES = 4


@dataclass(frozen=True)
class Drift:
    """Drift of one joint's response.

    Attributes:
        name: Joint name.
        log_gain: Per cycle.
        phase_rad: Per cycle [rad].
    """

    name: str
    log_gain: float
    phase_rad: float

    @property
    def size(self) -> float:
        """|drift of ln H| per cycle."""
        return abs(complex(self.log_gain, self.phase_rad))


def worst_drift(series: list[Series], fit: HarmonicFit, channels: list[int]) -> Drift | None:
    """The joint that drifts most, if they drift beyond doubt.

    Args:
        series: The responses, in the order of ``channels``.
        fit: The fit that holds them.
        channels: Index of each response in the fit.

    Returns:
        The worst drift, if it is above ``DRIFT_PER_CYCLE`` and noise doesn't explain the drift of
        all joints together (F test of the slopes against the scatter about them); else None.
    """
    from scipy.stats import f

    found: list[Drift] = []
    explained = scatter = 0.0
    slopes = rests = 0
    for one, channel in zip(series, channels, strict=True):
        cycle = _each_cycle(one, fit, channel)
        if cycle.size < _MIN_CYCLES:
            continue
        place = np.arange(cycle.size) - (cycle.size - 1) / 2
        power = float(place @ place)
        slope = complex(place @ cycle) / power
        rest = cycle - cycle.mean() - slope * place
        found.append(Drift(one.name, slope.real, slope.imag))
        # Each complex number counts as two: log gain and phase.
        explained, slopes = explained + abs(slope) ** 2 * power, slopes + 2
        scatter, rests = scatter + float(np.sum(np.abs(rest) ** 2)), rests + 2 * (cycle.size - 2)
    worst = max(found, key=lambda drift: drift.size, default=None)
    if worst is None or worst.size <= DRIFT_PER_CYCLE:
        return None
    if scatter > 0 and f.sf(explained / slopes / (scatter / rests), slopes, rests) > SIGNIFICANT:
        return None
    return worst


def _each_cycle(one: Series, fit: HarmonicFit, channel: int) -> ComplexArray:
    """Deviation of ln a from the fit in each whole cycle, shape (c,)."""
    amplitude = complex(fit.amplitudes[channel, 0])
    if amplitude == 0 or one.count < 2:
        return np.zeros(0, dtype=np.complex128)
    place = (one.t_s - one.t_s[0]) * fit.omega / (2 * np.pi)
    cycles = int(place[-1] + fit.omega * one.period_s / (2 * np.pi) + 0.01)
    if cycles < 1:
        return np.zeros(0, dtype=np.complex128)
    turned = (one.values - fit.predict(channel, one.t_s)) * np.exp(-1j * fit.omega * one.t_s)
    edges = np.searchsorted(place, np.arange(cycles + 1))
    filled = np.diff(edges)
    if np.min(filled) < 2:
        return np.zeros(0, dtype=np.complex128)
    sums = np.add.reduceat(turned, edges[:-1])
    if edges[-1] < one.count:
        sums[-1] = np.sum(turned[edges[-2] : edges[-1]])
    return np.asarray(2 * sums / filled / amplitude, dtype=np.complex128)
