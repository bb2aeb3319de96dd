"""Cycle by cycle: sums of samples, and gain and lag by the phase that the controller logged.

An adaptive gait changes its frequency, amplitude and offset as it goes, so one harmonic fit over
all of it describes nothing. But the controller says what it meant: its phase Phi(t), integrated
from omega. Taken over Phi instead of time every cycle is 2 pi long, whatever omega does, and in
each one command and response are fitted by least squares::

    x - <x> = b + Re(a exp(j Phi) + a_2 exp(2 j Phi)),    H = a_response / a_command

where <x> is the mean of x over one cycle around each sample: it follows the offset that steers the
robot, and has no part of a steady oscillation (a comb filter).

The noise of H shows in its scatter from cycle to cycle: what truly changes slowly drops out of
the second differences H[k-1] - 2 H[k] + H[k+1] (von Neumann, Ann. Math. Stat. 12, 1941, for the
first ones). What changes fast counts as noise, so the intervals are conservative then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from .harmonic import cos_sin
from .series import Series, sample_weights

_Number = TypeVar("_Number", np.float64, np.complex128)

_EDGE = 1e-6
"""Of a cycle: a sample at its edge but for rounding is the first of the one that begins there."""

_LEAST_SAMPLES = 6
"""Samples that a cycle's amplitude needs."""

MIN_SAMPLES = 12
"""Samples that a cycle needs."""

MOST_CYCLES = 100
"""Cycles for each sample of the phase, at most: a phase that runs faster is no phase."""

MIN_EXPLAINED = 0.8
"""Share of a command's variance in a cycle that the phase must explain."""

DRIVEN_SHARE = 0.05
"""A cycle whose command is smaller than this share of the joint's largest is not driven."""

MIN_DIFFERENCES = 3
"""Second differences that the noise is estimated from, at least."""

_TURN = 2 * np.pi
_TOGETHER = 8192
"""Samples of the cycles that are summed in one go."""


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


def cycle_sums(values: NDArray[_Number], starts: IntArray) -> NDArray[_Number]:
    """Return the sums over the samples of each cycle.

    Args:
        values: Samples in their last axis, shape (..., n).
        starts: Where the cycles begin and the last one ends, not decreasing, shape (c + 1,).

    Returns:
        Shape (..., c); 0 where a cycle has no samples.
    """
    filled = np.diff(starts) > 0
    sums = np.zeros((*values.shape[:-1], filled.size), values.dtype)
    if np.any(filled):
        inner = values[..., : int(starts[-1])]
        sums[..., filled] = np.add.reduceat(inner, starts[:-1][filled], axis=-1)
    return sums


def amplitudes(t_s: FloatArray, values: FloatArray, starts: IntArray, omega: float) -> ComplexArray:
    """Complex amplitude of each cycle, from its samples alone.

    Args:
        t_s: Times [s], shape (n,).
        values: Of channels that share them, shape (..., n).
        starts: Where c cycles begin among them and the last one ends, shape (c + 1,).
        omega: Angular frequency [rad/s].

    Returns:
        Amplitudes at t = 0, shape (..., c); NaN where a cycle has too few samples.
    """
    cosine, sine = cos_sin(omega * t_s)
    filled = np.diff(starts)
    along, across = (cycle_sums(wave, starts) for wave in (cosine, sine))
    square, mixed = (cycle_sums(cosine * wave, starts) for wave in (cosine, sine))
    other = cycle_sums(sine * sine, starts)  # not the rest of the count: 0 would be singular
    gram = np.array(  # of 1, cos and -sin
        [[filled, along, -across], [along, square, -mixed], [-across, -mixed, other]]
    )
    right = np.stack(
        [
            cycle_sums(values, starts),
            cycle_sums(values * cosine, starts),
            -cycle_sums(values * sine, starts),
        ]
    )
    enough: BoolArray = filled >= _LEAST_SAMPLES
    result = np.full(right.shape[1:], np.nan, dtype=np.complex128)
    channels = int(np.prod(right.shape[1:-1]))
    sums = right[..., enough].reshape(3, channels, np.count_nonzero(enough))
    solved = np.linalg.solve(gram.T[enough], sums.transpose(2, 0, 1))
    result[..., enough] = (solved[:, 1] + 1j * solved[:, 2]).T.reshape(result[..., enough].shape)
    return result


@dataclass(frozen=True)
class LoggedPhase:
    """The logged phase of a plane or joint over one run, always increasing.

    Attributes:
        t_s: Times [s], shape (n,).
        value: Phase [rad], shape (n,).
    """

    t_s: FloatArray
    value: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return the phase at other times.

        Args:
            t_s: Times [s], any shape.

        Returns:
            [rad], interpolated linearly; NaN outside.
        """
        return np.interp(t_s, self.t_s, self.value, left=np.nan, right=np.nan)

    def edges_s(self) -> FloatArray:
        """Return the times of the ends of its whole cycles.

        Returns:
            Half a cycle from its beginning to half a cycle from its end [s], so that each cycle
            has its surroundings; shape (c + 1,), or empty, also for a phase beyond all reason.
        """
        first, last = float(self.value[0]) + np.pi, float(self.value[-1]) - np.pi
        count = int(np.floor((last - first) / _TURN + 1e-6))
        if not 1 <= count <= MOST_CYCLES * self.t_s.size:
            return np.zeros(0)
        return np.interp(first + _TURN * np.arange(count + 1), self.value, self.t_s)


@dataclass(frozen=True)
class CycleResponses:
    """Response to the command in each cycle of one joint.

    Attributes:
        start_s: Start of each cycle [s], shape (c,).
        stop_s: Its end [s], shape (c,).
        ratio: H; NaN where the cycle tells nothing, shape (c,).
        variance: Variance of ln|H| and of arg H [rad^2], each, shape (c,); NaN where unknown.
        dof: Degrees of freedom of the variance; 0 where unknown.
    """

    start_s: FloatArray
    stop_s: FloatArray
    ratio: ComplexArray
    variance: FloatArray
    dof: float


def demodulate(
    command: Series, response: Series, phase: LoggedPhase, edges_s: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Complex amplitudes of command and response in each cycle of a run.

    Args:
        response: Its responses, on their own times.
        phase: Its phase over the run.
        edges_s: Edges of the cycles [s], shape (c + 1,), from :meth:`LoggedPhase.edges_s` of its
            plane.

    Returns:
        Amplitudes relative to exp(j Phi), NaN where a cycle has too few samples or a gap, or where
        the phase does not explain the command; each of shape (c,).
    """
    asked, explained = _amplitudes(command, phase, edges_s)
    given, _ = _amplitudes(response, phase, edges_s)
    asked[explained < MIN_EXPLAINED] = np.nan
    return asked, given


def cycles_of(
    edges: Sequence[FloatArray],
    asked: Sequence[ComplexArray],
    given: Sequence[ComplexArray],
    *,
    settled_s: float = -np.inf,
) -> CycleResponses:
    """Return the response in each cycle of all runs, with its noise.

    Args:
        edges: Edges of the cycles of each run [s], shapes (c + 1,).
        asked: Amplitudes of the command in each run, shapes (c,).
        given: Amplitudes of the response, likewise.
        settled_s: Time from which on scatter is taken for noise [s]; before it a start decays.

    Returns:
        All cycles in order.
    """
    size = np.abs(np.concatenate(asked))
    least = DRIVEN_SHARE * float(np.nanmax(size)) if np.isfinite(size).any() else 0.0
    ratios: list[ComplexArray] = []
    squares: list[FloatArray] = []
    late: list[BoolArray] = []
    for times, command, response in zip(edges, asked, given, strict=True):
        late.append(times[: max(command.size - 2, 0)] >= settled_s)
        driven = np.abs(command) > least
        ratio = np.divide(response, command, out=np.full_like(command, np.nan), where=driven)
        ratios.append(ratio)
        # Of a_response: each H has 1 / |command|^2 of its noise.
        power = np.abs(command) ** 2
        share = np.divide(1.0, power, out=np.full(power.size, np.nan), where=power > 0)
        second = np.abs(ratio[:-2] - 2 * ratio[1:-1] + ratio[2:]) ** 2
        squares.append(second / (share[:-2] + 4 * share[1:-1] + share[2:]))
    ratio = np.concatenate(ratios)
    scatter = np.concatenate(squares)
    usable, after = np.isfinite(scatter), np.concatenate(late)
    if np.count_nonzero(usable & after) >= MIN_DIFFERENCES:
        usable &= after
    scatter = scatter[usable]
    answer = np.abs(np.concatenate(given)) ** 2
    variance = np.full(ratio.size, np.nan)
    dof = 0.0
    if scatter.size >= MIN_DIFFERENCES:
        variance = np.divide(scatter.mean() / 2, answer, out=variance, where=answer > 0)
        dof = _difference_dof(scatter.size)
    starts, stops = ([edge[:-1] for edge in edges], [edge[1:] for edge in edges])
    return CycleResponses(np.concatenate(starts), np.concatenate(stops), ratio, variance, dof)


def _difference_dof(count: int) -> float:
    """Degrees of freedom of the mean square of second differences of complex white noise.

    Neighbouring differences have covariances 6, -4, 1 of the noise's variance, so the sum Q of m
    squares has E Q = 6 m and var Q = 2 (36 m + 2 16 (m - 1) + 2 (m - 2)) for each of the two parts.
    """
    variance = 36.0 * count + 32.0 * (count - 1) + 2.0 * max(count - 2, 0)
    return 2 * (6.0 * count) ** 2 / variance


def _amplitudes(
    series: Series, phase: LoggedPhase, edges_s: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Return the fundamental in each cycle, and its power as a share of all; each (c,)."""
    count = edges_s.size - 1
    amplitude = np.full(count, np.nan, dtype=np.complex128)
    explained = np.zeros(count)
    part = series.between(float(phase.t_s[0]), float(phase.t_s[-1]))
    if part.count < MIN_SAMPLES:
        return amplitude, explained
    turned = phase.at(part.t_s)
    swing = part.values - _comb(turned, part.values)
    starts = starts_of(part.t_s, edges_s)
    usable = (np.diff(starts) >= MIN_SAMPLES) & ~_holes(part, edges_s)
    if not np.any(usable):
        return amplitude, explained
    filled = np.diff(starts).astype(np.float64)
    waves, cross, power = _moments(turned, swing, starts)
    usable &= np.isfinite(power) & (power > 0)
    chosen = np.flatnonzero(usable)
    fitted = np.linalg.solve(_normal(filled, waves)[chosen], cross.T[chosen, :, None])[..., 0]
    amplitude[chosen] = fitted[:, 1] - 1j * fitted[:, 2]
    explained[chosen] = filled[chosen] * np.abs(amplitude[chosen]) ** 2 / 2 / power[chosen]
    return amplitude, explained


def _moments(
    phase: FloatArray, values: FloatArray, starts: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the sums over each cycle, all that the fit needs."""
    count = starts.size - 1
    sums = np.empty((14, count))
    # So many cycles at a time that their rows stay in the processor's cache.
    many = max(1, _TOGETHER * count // max(int(starts[-1] - starts[0]), 1))
    for first in range(0, count, many):
        edges = starts[first : first + many + 1]
        part = slice(int(edges[0]), int(edges[-1]))
        rows = np.empty((14, part.stop - part.start))
        turns = rows[:8].reshape(4, 2, rows.shape[1])
        turns[0, 0], turns[0, 1] = cos_sin(phase[part])
        double = 2 * turns[0, 0]
        np.multiply(double, turns[0], out=turns[1])
        turns[1, 0] -= 1.0
        for m in (2, 3):
            np.multiply(double, turns[m - 1], out=turns[m])
            turns[m] -= turns[m - 2]
        rows[8] = values[part]
        np.multiply(rows[:4], rows[8], out=rows[9:13])
        np.multiply(rows[8], rows[8], out=rows[13])
        sums[:, first : first + many] = cycle_sums(rows, edges - edges[0])
    return sums[:8].reshape(4, 2, count), sums[8:13], sums[13]


def _normal(filled: FloatArray, waves: FloatArray) -> FloatArray:
    """Normal equations of 1, cos Phi, sin Phi, cos 2 Phi, sin 2 Phi in each cycle, (c, 5, 5).

    A product of two of them is half the sum and half the difference of waves of Phi, 2 Phi, 3 Phi
    and 4 Phi, whose sums are known.
    """
    (c1, s1), (c2, s2), (c3, s3), (c4, s4) = waves / 2
    half = filled / 2
    rows = (
        (filled, 2 * c1, 2 * s1, 2 * c2, 2 * s2),
        (2 * c1, half + c2, s2, c1 + c3, s1 + s3),
        (2 * s1, s2, half - c2, s3 - s1, c1 - c3),
        (2 * c2, c1 + c3, s3 - s1, half + c4, s4),
        (2 * s2, s1 + s3, c1 - c3, s4, half - c4),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def _comb(phase: FloatArray, values: FloatArray) -> FloatArray:
    """Mean over one cycle around each sample, NaN where that reaches beyond the samples; (n,)."""
    step = np.diff(phase)
    area = np.concatenate(([0.0], np.cumsum((values[1:] + values[:-1]) / 2 * step)))
    slack = 1e-9 + float(step.mean())
    inside = (phase - np.pi >= phase[0] - slack) & (phase + np.pi <= phase[-1] + slack)
    mean = (np.interp(phase + np.pi, phase, area) - np.interp(phase - np.pi, phase, area)) / _TURN
    return np.where(inside, mean, np.nan)


def _holes(series: Series, edges_s: FloatArray) -> BoolArray:
    """Cycles that a gap reaches into, or that begin or end outside the samples; shape (c,)."""
    begun = np.searchsorted(series.t_s[series.gaps + 1], edges_s[:-1], "right")
    ended = np.searchsorted(series.t_s[series.gaps], edges_s[1:], "left")
    early, late = series.t_s[0] - edges_s[:-1], edges_s[1:] - series.t_s[-1]
    outside: BoolArray = np.maximum(early, late) > 0
    if np.any(outside):
        outside = np.maximum(early, late) > series.period_s
    return (begun < ended) | outside
