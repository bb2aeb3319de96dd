"""A command between its samples, held or in lines, and what up to two poles make of it."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtbtrs

from undulog.capture.common.arrays import FloatArray

from ...estimators.series import Series

SETTLING_S = 2.0
"""Before the first sample a joint stood at its command for as long: poles have settled then."""

MOST_NODES = 1 << 17
"""Of the grid on which poles are applied: three quarters of an hour at 50 Hz."""

CRITICAL = 1e-6
"""Distance of two poles, in their mean, below which they are one."""

PER_SAMPLE = 2
"""Nodes in the shorter of both sampling intervals."""


class Command:
    """A command as a function of time."""

    def __init__(self, command: Series, position: Series, *, held: bool) -> None:
        """Prepare the grid on which poles are applied.

        Args:
            command: Its samples; it stays at the first and last beyond them.
            position: Samples at whose times it is asked for.
            held: Whether each sample is held until the next; otherwise lines join them.
        """
        self._t_s, self._values, self.held = command.t_s, command.values, held
        step_s = min(command.period_s, position.period_s) / PER_SAMPLE
        first = min(float(command.t_s[0]), float(position.t_s[0])) - SETTLING_S
        last = float(position.t_s[-1])
        count = min(int((last - first) / step_s) + 2, MOST_NODES)
        self._nodes: FloatArray = np.linspace(first, last, count)
        self._step_s = (last - first) / (count - 1)
        # Means over the steps keep the time of each change exact between two nodes.
        self._means: FloatArray = np.diff(self._integral(self._nodes)) / self._step_s
        rises = np.diff(self.at(self._nodes))
        self._rises: FloatArray = np.zeros_like(rises) if held else rises

    def _integral(self, t_s: FloatArray) -> FloatArray:
        """Return the integral from the first sample on."""
        t, c = self._t_s, self._values
        parts = np.diff(t) * (c[:-1] if self.held else (c[1:] + c[:-1]) / 2)
        whole = np.concatenate([[0.0], np.cumsum(parts)])
        k = np.clip(np.searchsorted(t, t_s, side="right") - 1, 0, t.size - 1)
        since = t_s - t[k]
        integral = whole[k] + c[k] * since
        if not self.held:
            slope = np.append(np.diff(c) / np.diff(t), 0.0)
            integral += np.where(since > 0, slope[k], 0.0) * since**2 / 2
        return np.asarray(integral, dtype=np.float64)

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return the command at some times [rad]."""
        if not self.held:
            return np.interp(t_s, self._t_s, self._values).astype(np.float64, copy=False)
        k = np.searchsorted(self._t_s, t_s, side="right") - 1
        return self._values[np.clip(k, 0, self._values.size - 1)]

    def filtered(self, t_s: FloatArray, d: float, a: float, q: float) -> FloatArray:
        """Return the command through exp(-d s) / (1 + a s + q s^2) at some times [rad].

        Args:
            t_s: Times [s].
            d: Delay [s].
            a: [s]; with 0 there is only the delay.
            q: [s^2]; with 0 there is one pole.
        """
        if a <= 0:
            return self.at(t_s - d)
        of_mean, of_rise, denominator = _discrete(a, q, self._step_s)
        inputs = np.zeros(self._nodes.size)
        for k in range(1, of_mean.size):
            inputs[k:] += of_mean[k] * self._means[: inputs.size - k]
            inputs[k:] += of_rise[k] * self._rises[: inputs.size - k]
        # Before the first node all was at rest at the first command.
        inputs[: of_mean.size] += self._means[0] * (of_mean.sum() - np.cumsum(of_mean))
        output = _recursion(denominator, inputs, rest=float(self._means[0]))
        return _between((t_s - d - self._nodes[0]) / self._step_s, output)


def _recursion(denominator: FloatArray, inputs: FloatArray, rest: float) -> FloatArray:
    """Return y_n = x_n - a_1 y_(n-1) - ... - a_k y_(n-k), as LAPACK solves a banded triangle.

    ``scipy.signal.lfilter`` does the same; its package takes most of a second to import.

    Args:
        denominator: 1, a_1, ..., a_k, shape (k + 1,).
        inputs: x, shape (n,).
        rest: y before the first.
    """
    right_side = inputs.copy()
    for k in range(1, denominator.size):
        right_side[:k] -= rest * denominator[k]
    bands = np.repeat(denominator[:, np.newaxis], inputs.size, axis=1)
    solution, _ = dtbtrs(bands, right_side, uplo="L", diag="U")  # never singular
    return np.asarray(solution, dtype=np.float64).ravel()


def _between(index: FloatArray, values: FloatArray) -> FloatArray:
    """Return values between equal steps by the cubic through the four that are next."""
    first = np.clip(index.astype(np.int64) - 1, 0, values.size - 4)
    u = np.clip(index - first, 0.0, 3.0)  # 1 to 2, but at the ends
    v = u - 1, u - 2, u - 3
    return (
        -values[first] * v[0] * v[1] * v[2] / 6
        + values[first + 1] * u * v[1] * v[2] / 2
        - values[first + 2] * u * v[0] * v[2] / 2
        + values[first + 3] * u * v[0] * v[1] / 6
    )


def _discrete(a: float, q: float, step_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return 1 / (1 + a s + q s^2) from the steps of a grid to the node after each.

    The exact solution for an input that is a line within a step (Åström & Wittenmark,
    Computer-Controlled Systems, 3rd ed. 1997, 2.3): x' = A x + b u with the matrix exponential of
    A, which of two poles is

        exp(A h) = exp(-m h) (cosh(r h) + sinh(r h) / r (A + m)),  m = a / 2 q,  r^2 = m^2 - 1 / q.

    Returns:
        Numerators of the input's mean over a step and of its rise in it, and the denominator.
    """
    if q <= 0:
        decay = float(np.exp(-step_s / a))
        rise = 1 - (a / step_s + 0.5) * (1 - decay)
        return np.array([0.0, 1 - decay]), np.array([0.0, rise]), np.array([1.0, -decay])
    m = a / (2 * q)
    r = complex(m * m - 1 / q) ** 0.5
    even, odd = (np.exp((r - m) * step_s) + way * np.exp((-r - m) * step_s) for way in (1, -1))
    system = np.array([[0.0, 1.0], [-1 / q, -a / q]])
    part = (odd / (2 * r)).real if abs(r) > CRITICAL * m else step_s * np.exp(-m * step_s)
    phi = (even / 2).real * np.eye(2) + part * (system + m * np.eye(2))
    # A constant input of 1 is at rest at (1, 0); A^-1 b = -(1, 0), A^-1 (1, 0) = -(a, -1).
    of_mean = np.array([1.0, 0.0]) - phi[:, 0]
    of_rise = np.array([1.0, 0.0]) + (phi - np.eye(2)) @ np.array([a, -1.0]) / step_s - of_mean / 2
    determinant = float(np.exp(-2 * m * step_s))
    numerators = [
        np.array([0.0, way[0], phi[0, 1] * way[1] - phi[1, 1] * way[0]])
        for way in (of_mean, of_rise)
    ]
    return numerators[0], numerators[1], np.array([1.0, -float(np.trace(phi)), determinant])
