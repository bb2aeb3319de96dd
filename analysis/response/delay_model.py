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
    """The measured lines, scaled: s, G over its standard deviation, the weight, w / w_0."""

    s: ComplexArray
    value: ComplexArray
    weight: FloatArray

    def model(self, parameters: FloatArray, order: int) -> ComplexArray:
        tau, b = parameters[0], parameters[1 : order + 2]
        a = np.concatenate([[1.0], parameters[order + 2 :]])
        top = _polynomial(self.s, b)
        return np.exp(-self.s * tau) * top / _polynomial(self.s, a)

    def residual(self, parameters: FloatArray, order: int) -> FloatArray:
        error = (self.model(parameters, order) - self.value) * self.weight
        return np.concatenate([error.real, error.imag])


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
    lines = _Lines(
        np.asarray(1j * omega / scale, dtype=np.complex128), value, np.sqrt(2.0 / variance)
    )
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
    known = np.abs(value) ** 2 > 4 * variance
    if known.sum() < 3:
        return float("nan"), float("nan")
    phase = np.unwrap(np.angle(value[known]))
    weight = np.abs(value[known]) / np.sqrt(variance[known] / 2)
    design = np.stack([-omega[known], np.ones(phase.size)], axis=1) * weight[:, None]
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

    best = None
    step = 2 * np.pi / highest / (_DELAYS - 1)
    delays = step * np.arange(_DELAYS)
    for _ in range(_REFINEMENTS + 1):
        for tau in delays:
            start = _linear(lines, tau, top, bottom)
            cost = float(np.sum(lines.residual(start, top) ** 2))
            if np.isfinite(cost) and (best is None or cost < best[0]):
                best = cost, start
        if best is None:
            return None
        if best[0] <= _HOPELESS * 2 * lines.s.size:
            break
        # Precise lines take a start within what their noise allows.
        delays = best[1][0] + step * np.arange(1 - _FINER, _FINER) / _FINER
        step /= _FINER
    if best is None or best[0] > _HOPELESS * 2 * lines.s.size:
        return None
    found: Any = least_squares(lines.residual, best[1], args=(top,), method="lm", max_nfev=400)
    poles = np.roots(np.append(found.x[: top + 1 : -1], 1.0))
    return found if (poles.real < 0).all() else None


def _linear(lines: _Lines, tau: Any, top: int, bottom: int) -> FloatArray:
    """Return the parameters of Sanathanan and Koerner's iteration at one delay."""
    undelayed = lines.value * np.exp(lines.s * tau)
    powers = lines.s[:, None] ** np.arange(max(top, bottom) + 1)
    weight, found = lines.weight, np.zeros(1 + top + bottom)
    for _ in range(_ITERATIONS if bottom else 1):
        left = np.hstack([powers[:, : top + 1], -undelayed[:, None] * powers[:, 1 : bottom + 1]])
        left, right = left * weight[:, None], undelayed * weight
        found = np.linalg.lstsq(
            np.vstack([left.real, left.imag]), np.concatenate([right.real, right.imag]), rcond=None
        )[0]
        below = _polynomial(lines.s, np.append(1.0, found[top + 1 :]))
        weight = lines.weight / np.maximum(np.abs(below), 1e-9)
    return np.append(tau, found)
