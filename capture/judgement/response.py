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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len

from ..common.arrays import BoolArray, FloatArray, IntArray
from .levels import COVERAGE, FEWEST, HALF, NEGLIGIBLE, QUARTER, TINY, WHOLE
from .motion import cycle_s

LATEST_S = 0.3
"""Longest delay [s]: that of the independent fit by which accusations are checked."""

SLOWEST_S = 0.4
"""Longest time constant [s]: with it a servo has a bandwidth of 0.4 Hz; slower ones are no servos
for undulation."""

FIRST_POLISHES = 2
"""Steps of Gauss and Newton after which the orders are compared, and one of them goes on."""

DAMPINGS = (1.0, HALF)
"""Two equal poles, and the overshoot of a tenth that servos are tuned to at most."""

BLOCKS = 30
"""Blocks of the trimmed squares: multiples of three, of which a third is ten."""

SEARCH = 5
"""Of the first grid the delays, and the time constants, each half of the one before; refinements of
it, which come from a grid of 75 ms within the 10 ms in which steps of Gauss and Newton converge;
such steps, each of which doubles the digits; concentration steps, which converge in three to five
(2006, section 3)."""

DIFFERENCE_S = float(np.sqrt(np.finfo(np.float64).eps))
"""Difference by which slopes are taken [s]."""

SETTLED = float(-np.log(NEGLIGIBLE))
"""Time constants after which a pole has settled, to 1 %."""

PARTS = FEWEST
"""Of a course that is longer than :data:`FIT_STEPS`."""

FIT_STEP_S = 0.02
"""Steps of the fit [s], or the course's where they are longer: ten samples of a period at 5 Hz."""

FIT_STEPS = 1 << 13
"""Steps that are fitted; of a longer course eight parts of a thousand, evenly spread."""


@dataclass(frozen=True)
class JointResponse:
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


USUAL = JointResponse(constant_s=QUARTER * SLOWEST_S, order=1)
"""What a servo of a bandwidth of 1.6 Hz makes of a command: what is faster hardly moves it, and
doesn't make blocks."""


class Filtered:
    """A command that delays and poles are applied to."""

    def __init__(self, command: FloatArray, step_s: float) -> None:
        """Transform it; before its beginning it was as at its beginning.

        Args:
            command: Parts of a command, shape (p, n).
            step_s: [s].
        """
        self._steps = command.shape[1]
        self._pad = int(np.ceil((LATEST_S + SETTLED * SLOWEST_S) / step_s)) + 1
        self._size = next_fast_len(self._steps + 2 * self._pad, real=True)
        after = self._size - self._steps - self._pad
        self._spectrum = np.fft.rfft(np.pad(command, ((0, 0), (self._pad, after)), mode="edge"))
        self._turn = 2j * np.pi * np.fft.rfftfreq(self._size, step_s)

    def output(self, response: JointResponse) -> FloatArray:
        """Return x of equation (1), shape (p, n)."""
        return self.outputs([response])[0]

    def outputs(self, responses: Sequence[JointResponse]) -> FloatArray:
        """Return x of equation (1) for r responses, shape (r, p, n)."""
        delay = np.array([[r.delay_s] for r in responses])
        first = np.array([[r.constant_s * (0, 1, 2 * r.damping)[r.order]] for r in responses])
        second = np.array([[r.constant_s**2 if r.order == 2 else 0.0] for r in responses])
        turn = self._turn[None, :]
        factor = np.exp(-turn * delay)
        if first.any():
            factor /= 1 + turn * first + turn**2 * second
        whole = np.fft.irfft(self._spectrum[None] * factor[:, None], self._size)
        return np.asarray(whole[:, :, self._pad : self._pad + self._steps], dtype=np.float64)


def fit_response(
    command: FloatArray, position: FloatArray, present: BoolArray, step_s: float
) -> JointResponse:
    """Fit equation (1).

    Args:
        command: [rad], shape (n,).
        position: [rad], shape (n,).
        present: Steps at which the position was sampled, shape (n,).
        step_s: [s].

    Returns:
        The response; a gain of 0 where the command or the position doesn't move.
    """
    stride = max(1, int(FIT_STEP_S / step_s))
    parts = _parts(command[::stride].size)
    c, y = command[::stride][parts], position[::stride][parts]
    there = present[::stride][parts]
    filtered = Filtered(c, stride * step_s)
    weight, bounds = there.astype(np.float64), _bounds(command, step_s)
    fitted = _fitted(filtered, y, weight, bounds)
    # A zero that drifts looks like gain and poles, the more so the slower the command is.
    left = y - fitted[1].gain * filtered.output(fitted[1])
    drift = _line(left, parts - parts.mean(), weight)
    if np.var(left - drift) < HALF * np.var(left):
        level = _fitted(filtered, y - drift, weight, bounds)
        if level[0] < HALF * fitted[0]:
            return level[1]
    return fitted[1]


def _line(values: FloatArray, along: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the line through values, less its middle."""
    power = float(np.sum(weight * along**2))
    centred = weight * (values - np.average(values, weights=weight))
    return along * (float(np.sum(centred * along)) / max(power, TINY))


def _fitted(
    filtered: Filtered, y: FloatArray, weight: FloatArray, bounds: tuple[float, float]
) -> _Fit:
    """Fit the three orders and choose one of them."""
    trimmed = _Trimmed(filtered.output(USUAL), y, weight)
    best = [trimmed.best(filtered.outputs(tried), tried) for tried in _grids(*bounds)]
    steps = [bounds[0] / (SEARCH - 1) / 2] * len(best)
    for _ in range(SEARCH):
        moved = [_moved(best[k][1], steps[k], *bounds) for k in range(len(best))]
        outputs = filtered.outputs([response for some in moved for response in some])
        ends = np.cumsum([len(some) for some in moved])
        for k, some in enumerate(moved):
            part = outputs[ends[k] - len(some) : ends[k]]
            better = trimmed.best(part, some, best[k][2])
            if _merit(better) < _merit(best[k]):
                best[k] = better
            else:
                steps[k] /= 2
    chosen, *others = (_polished(fit, trimmed, filtered, bounds, FIRST_POLISHES) for fit in best)
    for fit in others:
        # A pole more takes off a twentieth of the squares, or the simpler response stands.
        if fit[0] < COVERAGE * chosen[0]:
            chosen = fit
    return _polished(chosen, trimmed, filtered, bounds, SEARCH)


def _polished(
    fit: _Fit, trimmed: _Trimmed, filtered: Filtered, bounds: tuple[float, float], most: int
) -> _Fit:
    """Take steps of Gauss and Newton in gain, offset, delay and time constant."""
    for _ in range(most):
        _, centre, keep = fit
        aside = [replace(centre, delay_s=centre.delay_s + DIFFERENCE_S)]
        if centre.order:
            aside.append(replace(centre, constant_s=centre.constant_s + DIFFERENCE_S))
        outputs = filtered.outputs([centre, *aside])
        slopes = centre.gain * (outputs[1:] - outputs[0]) / DIFFERENCE_S
        delay, constant, *_ = (*trimmed.step(outputs[0], slopes, centre, keep), 0.0)
        moved = [
            replace(
                centre,
                delay_s=min(max(centre.delay_s + delay / 2**k, 0.0), bounds[0]),
                constant_s=min(max(centre.constant_s + constant / 2**k, 0.0), bounds[1]),
            )
            for k in range(SEARCH)  # where the whole step goes too far
        ]
        better = trimmed.best(filtered.outputs(moved), moved, keep)
        if _merit(better) >= _merit(fit):
            break
        fit = better
    return fit


def _bounds(command: FloatArray, step_s: float) -> tuple[float, float]:
    """Return the longest delay and time constant [s].

    Of a rhythm a quarter of a cycle and 1/(2 w): with more, a joint that moves the opposite way
    would be one that is late by half a cycle.
    """
    cycle = cycle_s(command, step_s)
    return min(LATEST_S, QUARTER * cycle), min(SLOWEST_S, cycle / (2 * np.pi))


def _grids(latest_s: float, slowest_s: float) -> tuple[list[JointResponse], ...]:
    """Return the responses that the search begins with, by their order."""
    delays = np.linspace(0, latest_s, SEARCH).tolist()
    constants = [slowest_s / 2**k for k in range(SEARCH)]
    few = delays[:: SEARCH // 2]
    return (
        [JointResponse(delay_s=delay) for delay in delays],
        [JointResponse(1.0, 0.0, delay, constant, 1) for delay in few for constant in constants],
        [
            JointResponse(1.0, 0.0, delay, constant / 2, 2, damping)
            for delay in few
            for constant in constants
            for damping in DAMPINGS
        ],
    )


_Fit = tuple[float, JointResponse, FloatArray]
"""Trimmed squares, the response, and the blocks that were kept, shape (b,)."""


def _merit(fit: _Fit) -> tuple[float, int, float]:
    """Order by the squares; among equals, e.g. of a joint that stands, the simplest is first."""
    squares, response, _ = fit
    return squares, response.order, response.delay_s


def _moved(
    centre: JointResponse, step_s: float, latest_s: float, slowest_s: float
) -> list[JointResponse]:
    """Return the neighbours of a response, a step of delay or time constant away."""
    responses: list[JointResponse] = []
    for k in (-1, 0, 1):
        for j in (-1, 0, 1) if centre.order else (0,):
            delay = min(max(centre.delay_s + k * step_s, 0.0), latest_s)
            slowest = slowest_s / max(centre.order, 1)
            constant = min(max(centre.constant_s + j * step_s, 0.0), slowest)
            if k or j:
                responses.append(replace(centre, delay_s=delay, constant_s=constant))
    return responses


def _parts(size: int) -> IntArray:
    """Return indices of the steps that are fitted, shape (p, n)."""
    if size <= FIT_STEPS:
        return np.arange(size, dtype=np.int64)[None, :]
    length = FIT_STEPS // PARTS
    starts = np.linspace(0, size - length, PARTS).astype(np.int64)
    return starts[:, None] + np.arange(length, dtype=np.int64)


class _Trimmed:
    """Least trimmed squares of one position over blocks."""

    def __init__(self, motion: FloatArray, position: FloatArray, weight: FloatArray) -> None:
        travel = np.abs(np.diff(motion, axis=1, prepend=motion[:, :1])) * weight
        total = float(travel.sum())
        parts = (travel / total if total > 0 else 0.0) + NEGLIGIBLE * weight / weight.sum()
        share: FloatArray = np.cumsum(parts.ravel())
        targets: FloatArray = share[-1] * np.arange(BLOCKS, dtype=np.float64) / BLOCKS
        edges = np.searchsorted(share, targets).astype(np.int64)
        self._edges: IntArray = np.unique(np.minimum(edges, share.size - 1))
        self._weight = weight.ravel()
        self._middle = float(np.median(position))
        self._y = (position - self._middle).ravel()
        rows = self._weight * np.stack([np.ones_like(self._y), self._y, self._y**2])
        self._of_y = np.add.reduceat(rows, self._edges, axis=1)
        blocks = self._edges.size
        self._keep = max(1, int(np.ceil(WHOLE * blocks - NEGLIGIBLE)))
        third = blocks - self._keep
        starts = np.ones((1 + (SEARCH + 1 if third else 0), blocks))
        for row, first in enumerate(np.linspace(0, self._keep, len(starts) - 1, dtype=int), 1):
            starts[row, first : first + third] = 0
        self._starts = starts

    def best(
        self,
        outputs: FloatArray,
        responses: Sequence[JointResponse],
        keep: FloatArray | None = None,
    ) -> _Fit:
        """Fit gain and offset of r responses, from all starts or from a neighbour's blocks.

        Args:
            outputs: x of equation (1), shape (r, p, n).
            responses: r.
            keep: Blocks that a neighbour's fit has kept, shape (b,).

        Returns:
            The one with the least squares.
        """
        flat = outputs.reshape(len(responses), -1)
        middle = flat.mean(axis=1)
        x = flat - middle[:, None]
        weighted = self._weight * x
        sums = np.add.reduceat(
            np.stack([weighted, weighted * x, weighted * self._y]), self._edges, axis=2
        )
        starts = self._starts if keep is None else keep[None, :]
        kept = np.broadcast_to(starts, (len(responses), *starts.shape))
        gain, offset, squares, kept = self._concentrated(sums, kept)
        for _ in range(SEARCH - 1 if keep is None else 0):
            gain, offset, squares, kept = self._concentrated(sums, kept)
        left = np.sum(kept * squares, axis=2)
        r, k = (int(index) for index in np.unravel_index(np.argmin(left), left.shape))
        least, chosen = max(float(left[r, k]), 0.0), kept[r, k]
        count, mean, square = self._of_y @ chosen
        variance = float(square - mean**2 / max(count, 1.0))
        explained = max(1 - least / variance, 0.0) if variance > 0 else 0.0
        offset_rad = float(offset[r, k]) + self._middle - float(gain[r, k]) * float(middle[r])
        full = replace(
            responses[r], gain=float(gain[r, k]), offset_rad=offset_rad, explained=explained
        )
        return least, full, chosen

    def step(
        self, output: FloatArray, slopes: FloatArray, centre: JointResponse, keep: FloatArray
    ) -> list[float]:
        """Return the step of Gauss and Newton over the kept blocks.

        Args:
            output: x, shape (p, n).
            slopes: Derivatives of g x with respect to each of q parameters, shape (q, p, n).

        Returns:
            The step of each parameter, q.
        """
        sizes = np.diff(np.append(self._edges, self._weight.size))
        kept = np.repeat(keep, sizes) * self._weight
        x = output.ravel()
        columns = [np.ones_like(x), x, *(slope.ravel() for slope in slopes)]
        design = np.stack(columns, axis=1)
        left = self._y + self._middle - centre.offset_rad - centre.gain * x
        weighted = design * kept[:, None]
        gram = weighted.T @ design
        scale = np.sqrt(np.maximum(np.diagonal(gram), TINY))
        solution = np.linalg.pinv(gram / np.outer(scale, scale)) @ ((weighted.T @ left) / scale)
        return [float(value) for value in (solution / scale)[2:]]

    def _concentrated(
        self, sums: FloatArray, keep: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Fit the kept blocks from s starts; return the blocks with the least squares of that fit.

        Returns:
            Gain and offset, shape (r, s), and the squares and kept blocks, shape (r, s, b).
        """
        n, y, yy = self._of_y
        sx, xx, xy = sums
        count, my = keep @ n, keep @ y
        mx, mxx, mxy = (np.einsum("rsb,rb->rs", keep, column) for column in (sx, xx, xy))
        spread = mxx - mx**2 / count
        moves = spread > 0
        gain = np.where(moves, (mxy - mx * my / count) / np.where(moves, spread, 1), 0)
        offset = (my - gain * mx) / count
        g, b = gain[..., None], offset[..., None]
        sx, xx, xy = (column[:, None, :] for column in (sx, xx, xy))
        squares = yy - 2 * g * xy - 2 * b * y + g**2 * xx + 2 * g * b * sx + b**2 * n
        limit = np.partition(squares, self._keep - 1, axis=2)[:, :, self._keep - 1]
        kept = (squares <= limit[..., None]).astype(np.float64)
        return gain, offset, squares, kept
