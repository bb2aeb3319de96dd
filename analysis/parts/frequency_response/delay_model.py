"""A delay and a rational transfer function fitted to a measured frequency response.

    G(s) = exp(-s tau) B(s) / A(s),    A(0) = 1,    s = j w / w_0                         (1)

is fitted by weighted least squares, each line by its own variance; w_0 is the geometric mean of the
frequencies. For each delay of a grid B and A are linear after Sanathanan and Koerner's iteration
(IEEE Trans. Automatic Control 8 (1963) 56-58); the best of them starts Levenberg and Marquardt's.
Orders grow until the residual is what the variances say it is, and the delay's interval holds what
the next orders say; if none passes, there is no model, and the delay is the group delay: the slope
of the phase.

Source: Pintelon & Schoukens, System Identification, 2nd ed. (Wiley 2012), chapters 9 and 11.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import fdtrc

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.judgement.levels import WIDTH

ORDERS = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (1, 3), (2, 3))
"""Degrees of B and A, in the order in which they are tried."""

LEVEL = 0.01
"""A model is refused where its residual is larger with a probability below this."""

OPEN = 3
"""Orders that pass, from the lowest on, over which the delay's interval is taken: poles that the
data leave open share its phase."""

_DELAYS = 21
_REFINEMENTS, _FINER = 2, 5  # of the grid of delays, each by so much
_ITERATIONS = 4
_EPSILON = float(np.finfo(np.float64).eps)
_HOPELESS = 30.0  # mean square of the residual, in variances, from which no step makes it pass


@dataclass(frozen=True)
class DelayModel:
    """The fitted delay, and the model if one passed.

    Attributes:
        delay_s: tau, or the group delay where ``orders`` is None [s].
        interval_s: Its 95 % interval over all orders that pass [s], at least 0.
        orders: Degrees of B and A; None where no model passed the residual test.
        numerator: Coefficients of B from s^0 on.
        denominator: Coefficients of A from s^0 on.
        scale: w_0 [rad/s].
        p: Probability of a residual at least as large, of the model that passed; of the best one
            where none did.
    """

    delay_s: float
    interval_s: tuple[float, float]
    orders: tuple[int, int] | None
    numerator: FloatArray
    denominator: FloatArray
    scale: float
    p: float

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return G of equation (1) at some frequencies."""
        omega = 2 * np.pi * frequency_hz
        s = np.asarray(1j * omega / self.scale, dtype=np.complex128)
        top = _polynomial(s, self.numerator)
        return np.exp(-1j * omega * self.delay_s) * top / _polynomial(s, self.denominator)


def _polynomial(s: ComplexArray, coefficients: FloatArray) -> ComplexArray:
    return s[:, None] ** np.arange(coefficients.size) @ coefficients.astype(np.complex128)


@dataclass(frozen=True)
class _Lines:
    """The measured lines: s, G, one over the deviation of its parts, powers of s."""

    s: ComplexArray
    value: ComplexArray
    weight: FloatArray
    powers: ComplexArray

    def residual(self, parameters: FloatArray, order: int) -> FloatArray:
        """Return the weighted residual of parameters (..., p), shape (..., 2 k)."""
        delayed, top, bottom = self._parts(parameters, order)
        return _stacked((delayed * top / bottom - self.value) * self.weight)

    def jacobian(self, parameters: FloatArray, order: int) -> FloatArray:
        """Return its derivative by the parameters (p,), shape (2 k, p)."""
        delayed, top, bottom = self._parts(parameters, order)
        model, count = delayed * top / bottom, parameters.size - order - 2
        columns = [
            -self.s * model,
            *(delayed / bottom * self.powers[:, : order + 1].T),
            *(-model / bottom * self.powers[:, 1 : count + 1].T),
        ]
        return _stacked(np.stack(columns) * self.weight).T

    def _parts(self, parameters: FloatArray, order: int) -> tuple[ComplexArray, ...]:
        """Return exp(-s tau), B and A at the lines."""
        tau, b = parameters[..., :1], parameters[..., 1 : order + 2]
        a = parameters[..., order + 2 :]
        count = a.shape[-1]
        bottom = 1.0 + a @ self.powers[:, 1 : count + 1].T
        return np.exp(-self.s * tau), b @ self.powers[:, : order + 1].T, bottom


def _stacked(values: ComplexArray) -> FloatArray:
    return np.concatenate([values.real, values.imag], axis=-1)


def fit_delay(
    frequency_hz: FloatArray, value: ComplexArray, variance: FloatArray, freedom: float
) -> DelayModel:
    """Fit equation (1).

    Args:
        frequency_hz: Lines, shape (k,), ascending.
        value: Responses, shape (k,).
        variance: E|e|^2 of each, above 0, shape (k,).
        freedom: Complex degrees of freedom of each variance.

    Returns:
        The model of the lowest order that passes, or the group delay.
    """
    omega = 2 * np.pi * frequency_hz
    scale = float(np.exp(np.mean(np.log(omega))))
    # E|e|^2 is shared by real and imaginary part.
    variable = np.asarray(1j * omega / scale, dtype=np.complex128)
    powers = variable[:, None] ** np.arange(max(max(orders) for orders in ORDERS) + 1)
    lines = _Lines(variable, value, np.sqrt(2.0 / variance), powers)
    best = 0.0
    passed: list[DelayModel] = []
    for orders in ORDERS:
        unknowns = 2 + sum(orders)
        left = 2 * omega.size - unknowns
        if left < unknowns:  # at least two numbers for each
            break
        fit = _fit(lines, *orders)
        if fit is None:
            continue
        # The variances are estimates: a ratio of chi-squares rather than a chi-square.
        ratio = 2 * fit.cost / left
        p = float(fdtrc(left, 2 * freedom * omega.size, float(ratio)))
        best = max(best, p)
        sd = _delay_sd(fit.jac)
        if sd is None or sd * abs(lines.s[-1]) > np.pi:  # not determined
            continue
        if fit.x[0] < -2 * sd:  # an effect before its cause
            continue
        if p >= LEVEL:
            x = np.asarray(fit.x, dtype=np.float64)
            b, a = x[1 : orders[0] + 2], np.append(1.0, x[orders[0] + 2 :])
            ends = _interval(x[0] / scale, sd / scale)
            passed.append(DelayModel(x[0] / scale, ends, orders, b, a, scale, p))
            if len(passed) == OPEN:
                break
    if passed:
        low = min(model.interval_s[0] for model in passed)
        high = max(model.interval_s[1] for model in passed)
        return replace(passed[0], interval_s=(low, high))
    delay_s, sd_s = group_delay(omega, value, variance)
    ends = _interval(delay_s, sd_s)
    return DelayModel(delay_s, ends, None, np.zeros(0), np.ones(1), scale, best)


def _interval(delay_s: float, sd_s: float) -> tuple[float, float]:
    """Return the 95 % interval of a delay, which isn't before its cause [s]."""
    return max(delay_s - WIDTH * sd_s, 0.0), max(delay_s + WIDTH * sd_s, 0.0)


def group_delay(
    omega: FloatArray, value: ComplexArray, variance: FloatArray
) -> tuple[float, float]:
    """Return minus the slope of the phase over w, and its standard deviation [s].

    Lines whose response isn't distinct from zero are left out. The slope's standard deviation is
    that of the scatter about the line where this is larger than what the variances explain.
    """
    clear = np.abs(value) ** 2 > 4 * variance
    if clear.sum() < 3:
        return float("nan"), float("nan")
    phase = np.unwrap(np.angle(value[clear]))
    weight = np.abs(value[clear]) / np.sqrt(variance[clear] / 2)
    design = np.stack([-omega[clear], np.ones(phase.size)], axis=1) * weight[:, None]
    solution, *_ = np.linalg.lstsq(design, phase * weight, rcond=None)
    residual = design @ solution - phase * weight
    spread = max(1.0, float(residual @ residual) / (phase.size - 2))
    covariance = np.linalg.inv(design.T @ design) * spread
    return float(solution[0]), float(np.sqrt(covariance[0, 0]))


def _delay_sd(jacobian: Any) -> float | None:
    """Return the standard deviation of the first parameter, None where it isn't determined."""
    information: FloatArray = np.asarray(jacobian.T @ jacobian, dtype=np.float64)
    if np.linalg.cond(information) > 1e14:
        return None
    return float(np.linalg.inv(information)[0, 0]) ** 0.5


def _fit(lines: _Lines, top: int, bottom: int) -> Any:
    """Fit one pair of orders from the best start over a grid of delays; None if none may pass."""
    highest = np.abs(lines.s[-1])
    from scipy.optimize import least_squares

    best: tuple[float, FloatArray] | None = None
    step = 2 * np.pi / highest / (_DELAYS - 1)
    delays: FloatArray = step * np.arange(_DELAYS)
    for _ in range(_REFINEMENTS + 1):
        starts = _linear(lines, delays, top, bottom)
        costs = np.sum(lines.residual(starts, top) ** 2, axis=1)
        lowest = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if best is None or costs[lowest] < best[0]:
            best = float(costs[lowest]), starts[lowest]
        if not best[0] > _HOPELESS * 2 * lines.s.size:
            break
        # Precise lines take a start within what their noise allows.
        delays = best[1][0] + step * np.arange(1 - _FINER, _FINER) / _FINER
        step /= _FINER
    if best is None or not best[0] <= _HOPELESS * 2 * lines.s.size:
        return None
    solution: Any = least_squares(
        lines.residual, best[1], jac=lines.jacobian, args=(top,), method="lm", max_nfev=400
    )
    poles = np.roots(np.append(solution.x[: top + 1 : -1], 1.0))
    return solution if (poles.real < 0).all() else None


def _linear(lines: _Lines, delays: FloatArray, top: int, bottom: int) -> FloatArray:
    """Return the parameters of Sanathanan and Koerner's iteration at each delay, shape (d, p)."""
    undelayed = lines.value * np.exp(lines.s * delays[:, None])
    numerator = np.broadcast_to(lines.powers[:, : top + 1], (delays.size, lines.s.size, top + 1))
    left = np.concatenate(
        [numerator, -undelayed[..., None] * lines.powers[:, 1 : bottom + 1]], axis=2
    )
    weight = np.broadcast_to(lines.weight, undelayed.shape)
    solution = np.zeros((delays.size, 1 + top + bottom))
    for _ in range(_ITERATIONS if bottom else 1):
        rows = _stacked(np.swapaxes(left * weight[..., None], 1, 2))
        right = _stacked(undelayed * weight)
        inverse = np.linalg.pinv(np.swapaxes(rows, 1, 2), rcond=right.shape[1] * _EPSILON)
        solution = (inverse @ right[..., None])[..., 0]
        below = 1.0 + solution[:, top + 1 :] @ lines.powers[:, 1 : bottom + 1].T
        weight = lines.weight / np.maximum(np.abs(below), 1e-9)
    return np.concatenate([delays[:, None], solution], axis=1)
