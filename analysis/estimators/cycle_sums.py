"""Sums of samples over cycles, all cycles at once, and the time that each sample counts for.

Has the motion settled? The drift of log gain and lag from cycle to cycle.

A lightly damped bending mode rings for seconds after the start, and least squares over its tail
gives a wrong gain with a small residual. The drift shows it: what the joint fit leaves of each
cycle at the gait frequency, regressed on the cycle's number. A body mode shows in all joints, so
one test is made over all of them; no single joint has cycles enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

from .harmonic import HarmonicFit
from .series import Series, sample_weights
from .spectrum import residuals

_EDGE = 1e-6
"""Of a cycle: a sample at its edge but for rounding is the first of the one that begins there."""


@dataclass(frozen=True)
class Weighed:
    """What samples count in a window of c cycles.

    Attributes:
        t_s: Their times, shape (n,).
        weights: Time that each stands for, gaps not bridged [s], shape (n,).
        starts: Where the cycles begin and the last one ends, shape (c + 1,).
        covered: Fraction of each cycle that has samples, shape (c,).
    """

    t_s: FloatArray
    weights: FloatArray
    starts: IntArray
    covered: FloatArray
    coverage: float


def weigh(t_s: FloatArray, start_s: float, stop_s: float, cycles: int) -> Weighed:
    """Weigh samples and tell them apart by cycles.

    Args:
        t_s: Times within the window, strictly increasing [s], shape (n,).
        start_s: Start of the window [s].
        stop_s: End of the window, not included [s].
        cycles: Parts of equal length that it is cut into, c.

    Returns:
        The weights and what they cover.
    """
    weights = sample_weights(t_s, start_s, stop_s)
    period_s = (stop_s - start_s) / cycles
    inner = start_s + (np.arange(1.0, cycles) - _EDGE) * period_s
    starts = starts_of(t_s, np.concatenate(([-np.inf], inner, [np.inf])))
    filled = cycle_sums(weights, starts)
    share = min(1.0, float(filled.sum()) / (stop_s - start_s))
    return Weighed(t_s, weights, starts, np.minimum(filled / period_s, 1.0), share)


def starts_of(t_s: FloatArray, edges_s: FloatArray) -> IntArray:
    """Where cycles begin among samples.

    Args:
        t_s: Sampling times, increasing [s], shape (n,).
        edges_s: Edges of the cycles, increasing [s], shape (c + 1,).

    Returns:
        Index of the first sample at or after each edge, shape (c + 1,).
    """
    return np.searchsorted(t_s, edges_s).astype(np.int64)


def cycle_sums(values: FloatArray, starts: IntArray) -> FloatArray:
    """Return the sums over the samples of each cycle.

    Args:
        values: Samples in their last axis, shape (..., n).
        starts: Where the cycles begin and the last one ends, not decreasing, shape (c + 1,).

    Returns:
        Shape (..., c); 0 where a cycle has no samples.
    """
    filled = np.diff(starts) > 0
    sums = np.zeros((*values.shape[:-1], filled.size))
    if np.any(filled):
        inner = values[..., : int(starts[-1])]
        sums[..., filled] = np.add.reduceat(inner, starts[:-1][filled], axis=-1)
    return sums


DRIFT_PER_CYCLE = 1e-4
"""Drift of ln H per cycle below which a motion counts as settled."""

SIGNIFICANT = 5e-3
"""Chance of a warning about a settled motion."""

_MIN_CYCLES = 4


@dataclass(frozen=True)
class Drift:
    """Drift of one joint's response.

    Attributes:
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
    """Return the joint that drifts most, if they drift beyond doubt.

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
    """Return the deviation of ln a from the fit in each whole cycle, shape (c,)."""
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
    real, imaginary = cycle_sums(np.concatenate(parts, axis=1), starts)
    return 2 * (real + 1j * imaginary) / filled / amplitude
