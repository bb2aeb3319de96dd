"""The response of a joint to its command, fitted so that a third of the record may be faulty.

A healthy joint follows its command c by a gain, a delay and at most two poles,

    y(t) = b + g x(t) + e(t),    X(w) = exp(-i w d) C(w) / (1 + 2 z i w T - (w T)^2),        (1)

with the terms in T left out for no poles, and that in T^2 for one. Delay, time constant T and
damping z are searched on a grid that is refined; g and b are those of least trimmed squares over
blocks of equal travel of the command (Rousseeuw, J. Am. Stat. Assoc. 79, 1984, doi
10.1080/01621459.1984.10477105): the two thirds of the blocks with the least squares, found by
concentration steps (Rousseeuw & Van Driessen, Data Min. Knowl. Disc. 12, 2006, doi
10.1007/s10618-005-0024-4) from starts that leave out each contiguous third.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray

LATEST_S = 0.3
"""Longest delay [s]: that of the independent fit by which accusations are checked."""

SLOWEST_S = 0.4
"""Longest time constant [s]: with it a servo has a bandwidth of 0.4 Hz; slower ones are no servos
for undulation."""

BLOCKS = 30
"""Blocks of the trimmed squares: multiples of three, of which a third is ten."""

DELAYS = 7
"""Delays of the first grid, 0 to :data:`LATEST_S`; halved steps refine it."""

CONSTANTS = 5
"""Time constants of the first grid, each half of the one before."""

ROUNDS = 5
"""Refinements: a step of 50 ms becomes 1.6 ms, in which 60 degrees/s are 0.1 degrees."""

DAMPINGS = (1.0, 0.5)
"""Two equal poles, and the overshoot of a tenth that servos are tuned to at most."""

SETTLED = 5
"""Time constants after which a pole has settled, to exp(-5) = 0.7 %."""

FIT_STEPS = 8192
"""Steps that are fitted; of a longer course eight parts of a thousand, evenly spread."""

PARTS = 8
"""Of a course that is longer than :data:`FIT_STEPS`."""

STEPS_OF_C = 4
"""Concentration steps: they converge in three to five (2006, section 3)."""


@dataclass(frozen=True)
class Response:
    """Equation (1) for one joint.

    Attributes:
        gain: g.
        offset_rad: b [rad].
        delay_s: d [s].
        constant_s: T [s]; 0 without poles.
        order: Number of poles: 0, 1 or 2.
        damping: z, of two poles.
        explained: Share of the position's variance in the kept blocks that it explains, 0 to 1.
    """

    gain: float = 1.0
    offset_rad: float = 0.0
    delay_s: float = 0.0
    constant_s: float = 0.0
    order: int = 0
    damping: float = 1.0
    explained: float = 0.0

    @property
    def lag_s(self) -> float:
        """Lag of slow motion [s]: the delay and the time constants."""
        return self.delay_s + self.constant_s * (0, 1, 2 * self.damping)[self.order]


class Filtered:
    """A command that delays and poles are applied to."""

    def __init__(self, command: FloatArray, step_s: float) -> None:
        """Transform it; before its beginning it was as at its beginning.

        Args:
            command: Parts of a command, shape (p, n).
            step_s: [s].
        """
        memory = int(np.ceil((LATEST_S + SETTLED * SLOWEST_S) / step_s)) + 1
        self._steps = command.shape[1]
        self._pad = memory
        size = 1 << int(np.ceil(np.log2(self._steps + 2 * memory)))
        after = size - self._steps - memory
        self._size = size
        self._spectrum = np.fft.rfft(np.pad(command, ((0, 0), (memory, after)), mode="edge"))
        self._turn = 2j * np.pi * np.fft.rfftfreq(size, step_s)

    def output(self, response: Response) -> FloatArray:
        """Return x of equation (1), shape (p, n)."""
        factor = np.exp(-self._turn * response.delay_s)
        turn = self._turn * response.constant_s
        if response.order == 1:
            factor = factor / (1 + turn)
        elif response.order == 2:
            factor = factor / (1 + 2 * response.damping * turn + turn**2)
        whole = np.fft.irfft(self._spectrum * factor, self._size)
        return whole[:, self._pad : self._pad + self._steps]


def fit_response(
    command: FloatArray, position: FloatArray, present: BoolArray, step_s: float
) -> Response:
    """Fit equation (1).

    Args:
        command: [rad], shape (n,).
        position: [rad], shape (n,).
        present: Steps at which the position was sampled, shape (n,).
        step_s: [s].

    Returns:
        The response; a gain of 0 where the command or the position doesn't move.
    """
    parts = _parts(command.size)
    c, y, there = command[parts], position[parts], present[parts].astype(np.float64)
    trimmed = _Trimmed(c, y, there)
    filtered = Filtered(c, step_s)
    tried = [Response(delay_s=float(d)) for d in np.linspace(0, LATEST_S, DELAYS)]
    constants = [SLOWEST_S / 2**k for k in range(CONSTANTS)]
    tried += [Response(constant_s=constant, order=1) for constant in constants]
    tried += [
        Response(constant_s=constant / 2, order=2, damping=damping)
        for constant in constants
        for damping in DAMPINGS
    ]
    fits = [trimmed.fit(filtered.output(response), response) for response in tried]
    best = [min((fits[k] for k in ks), key=_merit) for ks in _by_order(tried)]
    step = LATEST_S / (DELAYS - 1)
    squares, response, _ = min((_refined(f, trimmed, filtered, step) for f in best), key=_merit)
    return response if squares < trimmed.least_variance else replace(response, gain=0.0)


_Fit = tuple[float, Response, FloatArray]
"""Trimmed squares, the response, and the blocks that were kept, shape (1, b)."""


def _merit(fit: _Fit) -> tuple[float, int, float]:
    """Order by the squares; among equals, e.g. of a joint that stands, the simplest is first."""
    squares, response, _ = fit
    return squares, response.order, response.delay_s


def _by_order(tried: list[Response]) -> list[list[int]]:
    return [[k for k, response in enumerate(tried) if response.order == n] for n in range(3)]


def _refined(start: _Fit, trimmed: _Trimmed, filtered: Filtered, step_s: float) -> _Fit:
    """Halve the steps of delay and time constant about the best, again and again."""
    best = start
    for _ in range(ROUNDS):
        step_s /= 2
        _, centre, keep = best
        constants = (-1, 0, 1) if centre.order else (0,)
        for k in (-1, 0, 1):
            for j in constants:
                delay = min(max(centre.delay_s + k * step_s, 0.0), LATEST_S)
                constant = min(max(centre.constant_s + j * step_s, 0.0), SLOWEST_S)
                if k or j:
                    moved = replace(centre, delay_s=delay, constant_s=constant)
                    best = min(best, trimmed.fit(filtered.output(moved), moved, keep), key=_merit)
    return best


def _parts(size: int) -> IntArray:
    """Return indices of the steps that are fitted, shape (p, n)."""
    if size <= FIT_STEPS:
        return np.arange(size, dtype=np.int64)[None, :]
    length = FIT_STEPS // PARTS
    starts = np.linspace(0, size - length, PARTS).astype(np.int64)
    return starts[:, None] + np.arange(length, dtype=np.int64)


class _Trimmed:
    """Least trimmed squares of one position over blocks."""

    def __init__(self, command: FloatArray, position: FloatArray, weight: FloatArray) -> None:
        travel = np.abs(np.diff(command, axis=1, prepend=command[:, :1])) * weight
        total = float(travel.sum())
        # A hundredth by time alone: blocks don't end where a command rests.
        share = np.cumsum((travel / total if total > 0 else 0.0) + 0.01 * weight / weight.sum())
        targets = share[-1] * np.arange(BLOCKS, dtype=np.float64) / BLOCKS
        edges: IntArray = np.searchsorted(share.ravel(), targets).astype(np.int64)
        self._edges: IntArray = np.unique(np.minimum(edges, share.size - 1))
        self._weight = weight.ravel()
        self._middle = float(np.median(position))
        self._y = (position - self._middle).ravel()
        self._of_y = self._sums(self._weight, self._y, self._y**2)
        blocks = self._edges.size
        self._keep = max(1, int(np.ceil(blocks * 2 / 3)))
        third = blocks - self._keep
        starts = np.ones((1 + (BLOCKS // 5 if third else 0), blocks))
        for row, first in enumerate(np.linspace(0, self._keep, len(starts) - 1, dtype=int), 1):
            starts[row, first : first + third] = 0
        self._starts = starts
        n, y, yy = self._of_y
        variances = np.sort(np.maximum(yy - y**2 / np.maximum(n, 1), 0))
        self.least_variance = float(variances[: self._keep].sum())

    def _sums(self, *columns: FloatArray) -> FloatArray:
        rows = np.stack([columns[0], *(self._weight * column for column in columns[1:])])
        return np.add.reduceat(rows, self._edges, axis=1)

    def fit(self, output: FloatArray, response: Response, keep: FloatArray | None = None) -> _Fit:
        """Fit gain and offset, from all starts or from the blocks of a neighbour's fit."""
        middle = float(output.mean())
        x = output.ravel() - middle
        sums = self._sums(self._weight, x, x**2, x * self._y)
        kept = self._starts if keep is None else keep
        step = self._concentrated(sums, kept)
        for _ in range(STEPS_OF_C - 1 if keep is None else 0):
            step = self._concentrated(sums, step.keep)
        left = np.sum(step.keep * step.squares, axis=1)
        k = int(np.argmin(left))
        count, mean, square = (float(step.keep[k] @ column) for column in self._of_y)
        variance = square - mean**2 / max(count, 1.0)
        least = max(float(left[k]), 0.0)
        gain = float(step.gain[k])
        offset_rad = float(step.offset[k]) + self._middle - gain * middle
        explained = max(1 - least / variance, 0.0) if variance > 0 else 0.0
        full = replace(response, gain=gain, offset_rad=offset_rad, explained=explained)
        return least, full, step.keep[k : k + 1]

    def _concentrated(self, sums: FloatArray, keep: FloatArray) -> _Step:
        """Fit the kept blocks; return the blocks with the least squares of that fit."""
        n, y, yy = self._of_y
        _, sx, xx, xy = sums
        count, mx, my, mxx, mxy = (keep @ np.stack([n, sx, y, xx, xy], axis=1)).T
        spread = mxx - mx**2 / count
        moves = spread > 0
        gain = np.where(moves, (mxy - mx * my / count) / np.where(moves, spread, 1), 0)
        offset = (my - gain * mx) / count
        g, b = gain[:, None], offset[:, None]
        squares = yy - 2 * g * xy - 2 * b * y + g**2 * xx + 2 * g * b * sx + b**2 * n
        least = np.argsort(squares, axis=1)[:, : self._keep]
        chosen = np.zeros_like(squares)
        np.put_along_axis(chosen, least, 1.0, axis=1)
        return _Step(gain, offset, squares, chosen)


@dataclass(frozen=True)
class _Step:
    """One concentration step from s starts over b blocks.

    Attributes:
        gain: Shape (s,).
        offset: Shape (s,).
        squares: Of each block, shape (s, b).
        keep: Blocks with the least, shape (s, b).
    """

    gain: FloatArray
    offset: FloatArray
    squares: FloatArray
    keep: FloatArray
