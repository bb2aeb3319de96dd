"""Fits of a gain, a delay and up to two poles to a joint's samples.

    y(t_i) = b + g x(t_i) + e_i,    X(s) = exp(-d s) C(s) / (1 + a s + q s^2)               (1)

The best offset and gain of each (d, a, q) are those of a straight line, and (d, a, q) are found by
steps of Gauss and Newton (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973, doi
10.1137/0710036).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray

from ...estimators.series import Series
from .command import Command
from .errors import TINY, Errors, errors_of

LATEST_S = 1.0
"""Longest delay, and largest a [s]."""

EARLIEST_S = -0.1
"""Earliest response [s]: feed-forward and clocks of two computers make some seem earlier than their
command, and a gain is wrong that has to make up for it."""

DELAYS = 41
"""Delays of the first search: 25 ms apart, a quarter of a period at 10 Hz."""

STEPS, HALVINGS = 12, 6
"""Steps of Gauss and Newton, and halvings of a step that goes too far, at most."""

SHARES = (0.25, 0.5, 0.75)
"""Of the lag that is a pole's, from which the steps begin."""

DAMPINGS = (0.25, 0.5, 1.0)
"""Of q in a^2 likewise; 0.25 is the critical damping."""

DIFFERENCE = 1e-6
"""Step of the derivatives [s]."""

LEAST_DAMPING = 50.0
"""Largest a over the root of q: beyond it there is one pole."""

CONVERGED = 1e-6
"""Part of the squares' expected error by which the last step reduces them."""

PLACES = 16
"""Of a staircase's delay in a sampling interval of the command."""

OFFSET, GAIN, D, A, Q = range(5)
"""Parameters in their order."""


@dataclass(frozen=True)
class Fit:
    """A fit of equation (1).

    Attributes:
        order: Number of poles.
        held: Whether the command is held between its samples.
        theta: Offset (the mean of y less that of x) [rad], g, d [s], a [s], q [s^2], shape (5,).
        squares: Sum of squares that is left [rad^2].
        errors: Of offset, g, d + a, a and q; None where they aren't known.
    """

    order: int
    held: bool
    theta: FloatArray
    squares: float
    errors: Errors | None = None

    @property
    def lag_s(self) -> float:
        """Lag of slow motion, d + a [s]."""
        return float(self.theta[D] + self.theta[A])


class Data:
    """Command and position of one joint."""

    def __init__(self, command: Series, position: Series, used: IntArray) -> None:
        """Take the samples of the position with these indices, shape (n,)."""
        self.t_s, self.y = position.t_s[used], position.values[used]
        self.period_s = command.period_s
        self._commands = [Command(command, position, held=held) for held in (False, True)]

    def x(self, held: bool, d: float, a: float, q: float) -> FloatArray:
        """Return x of equation (1), shape (n,)."""
        return self._commands[held].filtered(self.t_s, d, a, q)

    def solved(self, held: bool, d: float, a: float, q: float) -> tuple[FloatArray, float]:
        """Return all parameters and the squares, with the best offset and gain."""
        x = self.x(held, d, a, q)
        middle, level = float(x.mean()), float(self.y.mean())
        moved, y = x - middle, self.y - level
        power = float(moved @ moved)
        gain = float(moved @ y) / power if power > 0 else 0.0
        left = y - gain * moved
        return np.array([level - middle, gain, d, a, q]), float(left @ left)

    def unit(self, fit: Fit) -> float:
        """Return the variance of a residual, times what correlation makes of the lag's [rad^2]."""
        inflation = 1.0 if fit.errors is None else float(fit.errors.inflation[D])
        return max(fit.squares / self.y.size, TINY) * inflation


def first_fit(data: Data) -> Fit:
    """Fit gain, offset and delay, from the delay of a grid that explains most with a gain > 0."""
    grid = np.linspace(0.0, LATEST_S, DELAYS).tolist()
    tried = [data.solved(False, d, 0.0, 0.0) for d in grid]
    forward = [pair for pair in tried if pair[0][GAIN] > 0] or tried
    return _improved(data, Fit(0, False, *min(forward, key=lambda pair: pair[1])))


def with_poles(data: Data, simpler: Fit, order: int) -> Fit:
    """Fit more poles than a simpler model has, to a command of lines."""
    d, a, q = simpler.theta[D:].tolist()
    lag = max(d + a, data.period_s / 2)
    poles = [lag * share for share in SHARES]
    if simpler.order:
        poles = [a, lag]
    starts = [(lag - part, part, 0.0) for part in poles]
    if order > 1:
        starts = [(lag - part, part, part**2 * z) for part in poles for z in DAMPINGS]
    tried = [data.solved(False, *start) for start in (*starts, (d, a, q))]
    return _improved(data, Fit(order, False, *min(tried, key=lambda pair: pair[1])))


def with_steps(data: Data, line: Fit) -> Fit:
    """Fit the same model to a command that is held, which is earlier by half of its interval."""
    d, a, q = line.theta[D:].tolist()
    start = data.solved(True, max(d - data.period_s / 2, EARLIEST_S), a, q)
    fit = _improved(data, Fit(line.order, True, *start))
    return fit if fit.order else _searched(data, fit)


def with_errors(data: Data, fit: Fit) -> Fit:
    """Add the standard errors."""
    if fit.errors is not None:
        return fit
    design, left = slopes(data, fit)
    chosen = np.zeros((5, design.shape[1]))
    np.fill_diagonal(chosen, 1.0)
    if fit.order:
        chosen[D, A] = 1.0
    return replace(fit, errors=errors_of(data.t_s, design, left, chosen))


def slopes(data: Data, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of equation (1) by offset, g, d, and a and q as far as it has poles.

    Returns:
        Derivatives, shape (n, 3 + order), and what the fit leaves [rad], shape (n,).
    """
    _, gain, d, a, q = fit.theta.tolist()
    x = data.x(fit.held, d, a, q)
    # A staircase has the slope that it has over its steps.
    if fit.held and not fit.order:
        step = data.period_s
        rate = data.x(True, d + step / 2, 0.0, 0.0) - data.x(True, d - step / 2, 0.0, 0.0)
    else:
        step = DIFFERENCE
        rate = data.x(fit.held, d + step, a, q) - x
    moved = x - x.mean()
    columns = [np.ones(x.size), moved, gain * rate / step]
    if fit.order:
        columns.append(gain * (data.x(fit.held, d, a + DIFFERENCE, q) - x) / DIFFERENCE)
    if fit.order > 1:
        step = max(q, DIFFERENCE) * DIFFERENCE**0.5
        columns.append(gain * (data.x(fit.held, d, a, q + step) - x) / step)
    return np.stack(columns, axis=1), data.y - data.y.mean() - gain * moved


def _improved(data: Data, fit: Fit) -> Fit:
    """Take steps of Gauss and Newton until they reduce the squares no more."""
    for _ in range(STEPS):
        design, left = slopes(data, fit)
        step = np.zeros(5)
        step[: design.shape[1]] = np.linalg.lstsq(design, left, rcond=None)[0]
        better = _moved(data, fit, step)
        if better is None:
            break
        gained, fit = fit.squares - better.squares, better
        if gained < CONVERGED * fit.squares / data.y.size:
            break
    return fit


def _moved(data: Data, fit: Fit, step: FloatArray) -> Fit | None:
    """Return the fit a step ahead, or half of it, and so on; None where none is better."""
    for k in range(HALVINGS):
        d, a, q = (fit.theta + step / 2**k)[D:].tolist()
        d = min(max(d, EARLIEST_S), LATEST_S)
        a = min(max(a, DIFFERENCE), LATEST_S) if fit.order else 0.0
        q = min(max(q, (a / LEAST_DAMPING) ** 2), LATEST_S**2) if fit.order > 1 else 0.0
        theta, squares = data.solved(fit.held, d, a, q)
        if squares < fit.squares:
            return replace(fit, theta=theta, squares=squares)
    return None


def _searched(data: Data, fit: Fit) -> Fit:
    """Search the delay of a staircase place by place: it has no slope of its own."""
    width = data.period_s
    for _ in range(2):
        near = fit.theta[D] + width * np.arange(-PLACES, PLACES + 1) / PLACES
        tried = [data.solved(True, d, 0.0, 0.0) for d in near.tolist()]
        theta, squares = min(tried, key=lambda pair: pair[1])
        if squares <= fit.squares:
            fit = replace(fit, theta=theta, squares=squares)
        width /= PLACES
    return fit
