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

from ...estimators.series import GAP_FACTOR, Series

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
        step_s: Time since the sample before, the same for all rows [s], shape (k, n).
        parameters: As :data:`PARAMETERS` (the delay is in u already), shape (r, 5).

    Returns:
        z [rad], and where it rests, each of shape (r, k, n).
    """
    rows, stretches, samples = command.shape
    lag, width, top, bottom = np.repeat(parameters[:, 1:].T, stretches, axis=1)
    half = width / 2
    limits = np.stack((half + top, half + bottom))  # of the error, downwards and upwards
    u = np.ascontiguousarray(command.reshape(-1, samples).T)
    dt = np.tile(step_s.T, rows)
    keeps, adds = _low_pass(u, step_s, parameters[:, LAG])
    # In motion v = z + pull is a low pass of u, pull = mode w/2; at rest v is z. A joint starts
    # where u - v is below the least or above the most that its mode bears.
    none, never = np.zeros_like(half), np.full_like(half, np.inf)
    down, rest = (-half, -never, half + limits[1]), (none, -limits[0], limits[1])
    modes = np.stack((down, rest, (half, -half - limits[0], never)))
    present = modes[1].copy()
    pull, least, most = present
    follower, moves = np.empty_like(u), np.zeros(u.shape, dtype=np.bool_)
    follower[0] = v = u[0].copy()
    mode, after, change = np.zeros_like(half), np.empty_like(half), np.empty_like(half)
    above, goes = np.empty_like(moves[0]), np.zeros_like(moves[0])
    for k in range(1, samples):
        now, moved = u[k], moves[k]
        np.subtract(now, v, out=change)
        np.greater(change, most, out=above)
        np.less(change, least, out=moved)
        moved |= above
        np.multiply(v, keeps[k], out=after)
        after += adds[k]
        if np.count_nonzero(moved):  # some start
            i = moved.nonzero()[0]
            way = above[i].astype(np.int64)
            sign, z, to, step = 2.0 * way - 1.0, follower[k - 1][i], now[i], dt[k][i]
            mode[i], goes[i], present[:, i] = sign, True, modes[2 * way, :, i].T
            slope, past = (to - u[k - 1][i]) / step, sign * (to - z) - limits[way, i]
            moves_s = np.minimum(past / np.maximum(np.abs(slope), _TINY), step)
            behind, v[i] = slope * lag[i], z + pull[i]
            off = v[i] - (to - slope * moves_s) + behind
            after[i] = to - behind + off * np.exp(-moves_s / lag[i])
        np.subtract(after, v, out=change)
        change *= mode
        np.greater(change, 0.0, out=moved)
        np.copyto(v, after, where=moved)
        if np.count_nonzero(moved) < np.count_nonzero(goes):  # some stop
            i = np.greater(goes, moved).nonzero()[0]
            v[i], mode[i], goes[i], present[:, i] = follower[k - 1][i], 0.0, False, modes[1][:, i]
        np.subtract(v, pull, out=follower[k])
    shape = (samples, rows, stretches)
    return np.moveaxis(follower.reshape(shape), 0, 2), np.moveaxis(~moves.reshape(shape), 0, 2)


def _low_pass(u: FloatArray, step_s: FloatArray, lag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a and b of ``v[k] = a v[k - 1] + b``, T v' = u - v, each of shape (n, r k).

    Args:
        u: Linear between samples, shape (n, r k).
        step_s: As in :func:`follow`.
        lag: T of the rows [s], shape (r,).
    """
    lags, row = np.unique(lag, return_inverse=True)  # many rows share it
    ratio = lags[:, np.newaxis] / step_s.T[:, np.newaxis]
    keeps = np.exp(-1 / ratio)
    a, behind = (x[:, row].reshape(u.shape) for x in (keeps, ratio * (1 - keeps)))
    before = np.concatenate((u[:1], u[:-1]))
    return a, u - a * before - behind * (u - before)


@dataclass(frozen=True)
class WholeCycles:
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

    def some(self, count: int) -> WholeCycles:
        """Fewer of the windows, evenly spread."""
        kept = _spread(np.arange(len(self.t_s)), count)
        return WholeCycles(self.commands, self.t_s[kept], self.first, self.measured[:, kept])

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
) -> WholeCycles | None:
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
    measured = np.stack([response.values[index] for response in responses])
    return WholeCycles(tuple(commands), t_s[index], -(-first // stride), measured)


@dataclass(frozen=True)
class BandMisfit:
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

    def row(self, index: int) -> BandMisfit:
        """Return one of the rows, alone."""
        rows = slice(index, index + 1)
        return BandMisfit(
            self.residual[rows], self.gain[rows], self.follower[rows], self.rests[rows]
        )


def misfit(cycles: WholeCycles, joint: IntArray, parameters: FloatArray) -> BandMisfit:
    """Hold the model against what was measured; gain and offset are fitted.

    Args:
        joint: Index of each row's joint, shape (r,).
        parameters: Shape (r, 5).

    Returns:
        One row a set of parameters.
    """
    pairs, row = np.unique(np.stack((joint, parameters[:, DELAY])), axis=1, return_inverse=True)
    commands = np.stack([cycles.commanded(int(j), float(d)) for j, d in pairs.T])
    u = commands[row]
    z, rests = follow(u, cycles.step_s, parameters)
    fitted, measured = z[:, :, cycles.first :], cycles.measured[joint, :, cycles.first :]
    centred = fitted - fitted.mean(axis=(1, 2), keepdims=True)
    seen = measured - measured.mean(axis=(1, 2), keepdims=True)
    square = np.square(centred).sum(axis=(1, 2))
    product = (centred * seen).sum(axis=(1, 2))
    gain = np.divide(product, square, out=np.zeros_like(square), where=square > 0)
    return BandMisfit(seen - gain[:, np.newaxis, np.newaxis] * centred, gain, z, rests)


def _spread(index: IntArray, most: int) -> IntArray:
    if index.size <= most:
        return index
    return index[np.linspace(0, index.size - 1, most).astype(np.int64)]
