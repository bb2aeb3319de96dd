"""Has the motion settled? The drift of log gain and lag from cycle to cycle.

A lightly damped bending mode rings for seconds after the start, and least squares over its tail
gives a wrong gain with a small residual. The drift shows it: what the joint fit leaves of each
cycle at the gait frequency, regressed on the cycle's number. A body mode shows in all joints, so
one test is made over all of them; no single joint has cycles enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from undulog.capture.common.arrays import ComplexArray

from .cycle_sums import cycle_sums, starts_of
from .harmonic import HarmonicFit
from .series import Series
from .spectrum import residuals

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
    if scatter > 0 and fdtrc(slopes, rests, explained / slopes / (scatter / rests)) > SIGNIFICANT:
        return None
    return worst


def _each_cycle(one: Series, fit: HarmonicFit, channel: int) -> ComplexArray:
    """Deviation of ln a from the fit in each whole cycle, shape (c,)."""
    amplitude = complex(fit.amplitudes[channel, 0])
    nothing = np.zeros(0, dtype=np.complex128)
    if amplitude == 0 or one.count < 2:
        return nothing
    turn_s = 2 * np.pi / fit.omega
    cycles = int((one.t_s[-1] - one.t_s[0] + one.period_s) / turn_s + 0.01)
    starts = starts_of(one.t_s, one.t_s[0] + turn_s * np.arange(cycles + 1))
    filled = np.diff(starts)
    if cycles < 1 or filled.min() < 2:
        return nothing
    parts = [part.turned[:, 0] for part in residuals([one], fit, [channel])]
    turned = np.concatenate(parts, axis=1)
    real, imaginary = cycle_sums(turned, starts)
    return 2 * (real + 1j * imaginary) / filled / amplitude
