"""The best linear approximation from periodic multisines: noise and nonlinear distortion apart.

Of a nonlinear system driven by a random-phase multisine,

    Y(k) / U(k) = G_BLA(k) + S(k) / U(k) + V(k) / U(k),                                  (1)

where V, the noise, differs from period to period, and S, the stochastic nonlinear distortion, only
from one realisation of the phases to the next. The scatter over periods therefore gives the noise,
and what the scatter over realisations is above it the distortion (the robust method). A multisine
of odd lines, some of them left out, shows the kind of distortion already in one realisation: a
nonlinearity of even order puts power into even lines, one of odd order into the odd ones that
were left out.

Source: Pintelon & Schoukens, System Identification, 2nd ed. (Wiley 2012), section 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

EXCITED_SHARE = 1e-3
"""A line is excited if it has more than this share of the strongest line's power."""


@dataclass(frozen=True)
class BestLinearApproximation:
    """Response at k excited lines, from M realisations of P periods.

    Attributes:
        lines: Multiples of the reciprocal period, shape (k,).
        value: G_BLA, shape (k,).
        noise: E|e|^2 of ``value`` made by noise, shape (k,); NaN from one period.
        total: E|e|^2 of ``value`` made by noise and distortion, shape (k,); NaN from one
            realisation.
        distortion: E|S / U|^2 of one realisation, shape (k,); NaN from one realisation or period,
            where it can't be separated from noise.
        realisations: M.
        periods: P.
    """

    lines: IntArray
    value: ComplexArray
    noise: FloatArray
    total: FloatArray
    distortion: FloatArray
    realisations: int
    periods: int

    @property
    def relative_distortion(self) -> float:
        """Standard deviation of the distortion over |G_BLA|, root mean square over the lines.

        Unbiased in the square: where the true value is zero the mean of squares may be below zero,
        and 0 is returned.
        """
        share = np.mean(self.distortion / np.abs(self.value) ** 2)
        return float(np.sqrt(np.maximum(share, 0.0)))


def best_linear_approximation(
    inputs: FloatArray, outputs: FloatArray, lines: IntArray | None = None
) -> BestLinearApproximation:
    """Estimate equation (1) by the robust method.

    Args:
        inputs: Samples of whole steady periods, shape (M, P, n).
        outputs: Samples of the same times, shape (M, P, n).
        lines: Excited lines; those with power by default.
    """
    realisations, periods, length = inputs.shape
    u, y = (np.fft.rfft(values, axis=2) / length for values in (inputs, outputs))
    if lines is None:
        lines = excited_lines(u.mean(axis=1))
    u, y = u[:, :, lines].mean(axis=1), y[:, :, lines]
    each = y.mean(axis=1) / u  # (M, k)
    value = each.mean(axis=0)
    nothing = np.full(len(lines), np.nan)
    noise_each = nothing[None]
    if periods > 1:
        scatter = np.sum(np.abs(y - y.mean(axis=1, keepdims=True)) ** 2, axis=1) / (periods - 1)
        noise_each = scatter / periods / np.abs(u) ** 2  # of the mean over periods
    noise = noise_each.mean(axis=0) / realisations
    total = distortion = nothing
    if realisations > 1:
        scatter = np.sum(np.abs(each - value) ** 2, axis=0) / (realisations - 1)
        total, distortion = scatter / realisations, scatter - noise_each.mean(axis=0)
    return BestLinearApproximation(lines, value, noise, total, distortion, realisations, periods)


def excited_lines(spectra: ComplexArray) -> IntArray:
    """Return the lines that a multisine excites.

    Args:
        spectra: Of one period of each realisation, from line 0 on, shape (M, n).
    """
    power = np.mean(np.abs(spectra) ** 2, axis=0)
    power[0] = 0.0
    return np.flatnonzero(power > EXCITED_SHARE * power.max())


@dataclass(frozen=True)
class DetectionLines:
    """Power at lines that aren't excited, per line, without the noise.

    Attributes:
        odd: E|S|^2 at odd lines, in the output's unit squared; NaN where there are none.
        even: The same of even lines.
    """

    odd: float
    even: float


def detection_lines(outputs: FloatArray, lines: IntArray) -> DetectionLines:
    """Measure what an odd multisine leaves at the lines that it doesn't excite.

    Args:
        outputs: Samples of whole steady periods, shape (M, P, n), P at least 2.
        lines: Excited lines, all odd; lines up to the highest are looked at.
    """
    length = outputs.shape[2]
    y = np.fft.rfft(outputs, axis=2)[:, :, : int(lines.max()) + 1] / length
    power = line_power(y)
    unexcited = np.ones(power.size, dtype=bool)
    unexcited[[0, *lines]] = False
    free = np.flatnonzero(unexcited)

    def level(parity: int) -> float:
        chosen = free[free % 2 == parity]
        return float(power[chosen].mean()) if chosen.size else float("nan")

    return DetectionLines(level(1), level(0))


def line_power(spectra: ComplexArray) -> FloatArray:
    """Return the power of each line without that of the noise, which may leave less than zero.

    Args:
        spectra: Of each of P periods of M realisations, shape (M, P, n), P at least 2.

    Returns:
        Mean over the realisations, shape (n,).
    """
    periods = spectra.shape[1]
    mean = spectra.mean(axis=1)
    scatter = np.sum(np.abs(spectra - mean[:, None]) ** 2, axis=1) / (periods - 1) / periods
    return np.mean(np.abs(mean) ** 2 - scatter, axis=0)
