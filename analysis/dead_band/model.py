"""The model of a joint with a dead band: a delay, then a follower that rests within a band.

With the command c, the delay d, the follower z and its time constant T::

    u(t) = c(t - d)
    moving up:    T z' = u - z - w/2,  until u - z < w/2
    moving down:  T z' = u - z + w/2,  until u - z > -w/2
    at rest:      z' = 0,  until u - z > w/2 + b_bottom or u - z < -w/2 - b_top

w is the width of the loop that z goes through. A gear's play is the play operator (Krasnosel'skii
and Pokrovskii 1989; Visintin, Differential Models of Hysteresis, 1994), b = 0; a servo that its dry
friction holds is the same with the friction torques, over the servo's stiffness, for w/2 (moving)
and w/2 + b (at rest). After a reversal at the top of the command z rests while the command travels
by W = w + b_top, and then catches up by b_top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..estimators.series import GAP_FACTOR, Series

PARAMETERS = 5
"""d [s], T [s], w, b_top, b_bottom [rad of the command], in this order."""

DELAY, LAG, WIDTH, TOP, BOTTOM = range(PARAMETERS)

_WARM_UP = 0.55
"""Part of a cycle before each window over which the model finds its state."""

_MOST_SAMPLES = 240
"""Samples of a cycle that are fitted at most, evenly spread."""

_TINY = 1e-300


def follow(
    command: FloatArray, step_s: FloatArray, parameters: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the follower z, exact for a command that is linear between samples.

    Args:
        command: u, r rows of k stretches of n samples [rad], shape (r, k, n).
        step_s: Time since the sample before [s], same shape.
        parameters: As :data:`PARAMETERS` (the delay is in u already), shape (r, 5).

    Returns:
        z [rad], and where it rests, each of shape (r, k, n).
    """
    lag, width, top, bottom = parameters.T[1:, :, np.newaxis]
    half = width / 2
    up, down = half + bottom, half + top
    u = np.ascontiguousarray(np.moveaxis(command, 2, 0))
    dt = np.ascontiguousarray(np.moveaxis(step_s, 2, 0))
    found, rests = np.empty_like(u), np.ones(u.shape, dtype=np.bool_)
    z: FloatArray = u[0].copy()
    mode: FloatArray = np.zeros(u.shape[1:])
    before: FloatArray = u[0]
    found[0] = z
    for k in range(1, len(u)):
        now: FloatArray = u[k]
        error, slope = now - z, (now - before) / dt[k]
        starts_up, starts_down = (error > up) & (mode <= 0), (error < -down) & (mode >= 0)
        mode = np.where(starts_up, 1.0, np.where(starts_down, -1.0, mode))
        past = np.where(starts_up, error - up, np.where(starts_down, -error - down, np.inf))
        moves_s = np.minimum(past / np.maximum(np.abs(slope), _TINY), dt[k])
        behind = slope * lag
        off = z - (now - slope * moves_s - mode * half)
        after = now - mode * half - behind + (off + behind) * np.exp(-moves_s / lag)
        stops = mode * (after - z) <= 0
        z, mode = np.where(stops, z, after), np.where(stops, 0.0, mode)
        found[k], rests[k], before = z, stops, now
    return np.moveaxis(found, 0, 2), np.moveaxis(rests, 0, 2)


@dataclass(frozen=True)
class Cycles:
    """Whole cycles of some joints that share their sampling times.

    Attributes:
        t_s: Times of k windows, each with its warm-up, shape (k, n).
        first: First sample of a window after its warm-up.
        measured: Positions [rad], shape (j, k, n).
    """

    commands: tuple[Series, ...]
    t_s: FloatArray
    first: int
    measured: FloatArray

    @property
    def period_s(self) -> float:
        """Usual sampling interval [s]."""
        return float(np.median(np.diff(self.t_s, axis=1)))

    @property
    def step_s(self) -> FloatArray:
        """Time since the sample before [s], shape (k, n)."""
        return np.diff(self.t_s, axis=1, prepend=2 * self.t_s[:, :1] - self.t_s[:, 1:2])

    def some(self, count: int) -> Cycles:
        """Fewer of the windows, evenly spread."""
        kept = _spread(np.arange(len(self.t_s)), count)
        return Cycles(self.commands, self.t_s[kept], self.first, self.measured[:, kept])

    def commanded(self, joint: int, delay_s: float = 0.0) -> FloatArray:
        """A joint's command at all times.

        Args:
            delay_s: How much earlier [s].

        Returns:
            [rad], shape (k, n).
        """
        return self.commands[joint].at((self.t_s - delay_s).ravel()).reshape(self.t_s.shape)


def whole_cycles(
    commands: Sequence[Series], responses: Sequence[Series], omega: float, most: int
) -> Cycles | None:
    """Cut the motion of some joints into cycles.

    Args:
        responses: One a joint, all of the same times.
        omega: Of the gait [rad/s].
        most: So many cycles, evenly spread.

    Returns:
        Cycles without gaps; None if there are fewer than two.
    """
    t_s, period_s = responses[0].t_s, responses[0].period_s
    count = round(2 * np.pi / (omega * period_s))
    first = int(np.ceil(_WARM_UP * count))
    starts = np.arange(0, t_s.size - count - first + 1, count)
    gaps = np.flatnonzero(np.diff(t_s) > GAP_FACTOR * period_s)
    whole = np.searchsorted(gaps, starts) == np.searchsorted(gaps, starts + first + count - 1)
    starts = _spread(starts[whole], most)
    if starts.size < 2:
        return None
    stride = -(-count // _MOST_SAMPLES)
    index = starts[:, np.newaxis] + np.arange(0, first + count, stride)
    measured = np.stack([one.values[index] for one in responses])
    return Cycles(tuple(commands), t_s[index], -(-first // stride), measured)


@dataclass(frozen=True)
class Misfit:
    """What the model leaves over.

    Attributes:
        residual: Measured less modelled positions [rad], shape (r, k, n).
        gain: Of the position over z, shape (r,).
        follower: z [rad], its warm-up included, shape (r, k, first + n).
        rests: Where z rests, the same.
    """

    residual: FloatArray
    gain: FloatArray
    follower: FloatArray
    rests: BoolArray

    @property
    def cost(self) -> FloatArray:
        """Sum of squares [rad^2], shape (r,)."""
        return np.square(self.residual).sum(axis=(1, 2))

    def row(self, index: int) -> Misfit:
        """Return one of the rows, alone."""
        own = slice(index, index + 1)
        return Misfit(self.residual[own], self.gain[own], self.follower[own], self.rests[own])


def misfit(cycles: Cycles, joint: IntArray, parameters: FloatArray) -> Misfit:
    """Hold the model against what was measured; gain and offset are fitted.

    Args:
        joint: Index of each row's joint, shape (r,).
        parameters: Shape (r, 5).

    Returns:
        One row a set of parameters.
    """
    u = np.stack([cycles.commanded(j, d) for j, d in zip(joint, parameters[:, DELAY], strict=True)])
    z, rests = follow(u, np.broadcast_to(cycles.step_s, u.shape), parameters)
    fitted, measured = z[:, :, cycles.first :], cycles.measured[joint, :, cycles.first :]
    own = fitted - fitted.mean(axis=(1, 2), keepdims=True)
    seen = measured - measured.mean(axis=(1, 2), keepdims=True)
    square = np.square(own).sum(axis=(1, 2))
    product = (own * seen).sum(axis=(1, 2))
    gain = np.divide(product, square, out=np.zeros_like(square), where=square > 0)
    return Misfit(seen - gain[:, np.newaxis, np.newaxis] * own, gain, z, rests)


def _spread(index: IntArray, most: int) -> IntArray:
    if index.size <= most:
        return index
    return index[np.linspace(0, index.size - 1, most).astype(np.int64)]
