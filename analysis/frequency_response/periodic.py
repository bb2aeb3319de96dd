"""The best linear approximation from periodic multisines: noise and nonlinear distortion apart.

Of a nonlinear system driven by a random-phase multisine,

    Y(k) / U(k) = G_BLA(k) + S(k) / U(k) + V(k) / U(k),                                  (1)

where V, the noise, differs from period to period, and S, the stochastic nonlinear distortion, only
from one realisation of the phases to the next. The scatter over periods therefore gives the noise,
and what the scatter over realisations is above it the distortion (the robust method). A multisine
of odd lines, some of them left out, shows the kind of distortion already in one realisation: a
nonlinearity of even order puts power into even lines, one of odd order into the odd ones that
were left out.

With m inputs, U(k) is a matrix of at least m experiments of one realisation, and Y(k) / U(k) is
Y(k) U(k)^+.

Source: Pintelon & Schoukens, System Identification, 2nd ed. (Wiley 2012), sections 4.3 and 7.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

from ..results.estimate import Estimate

EXCITED_SHARE = 1e-3
"""A line is excited if it has more than this share of the strongest line's power."""


@dataclass(frozen=True)
class BestLinearApproximation:
    """Response at k excited lines, from M realisations of P periods.

    Attributes:
        value: G_BLA, shape (k,).
        noise: E|e|^2 of ``value`` made by noise, shape (k,); NaN from one period.
        total: E|e|^2 of ``value`` made by noise and distortion, shape (k,); NaN from one
            realisation.
        distortion: E|S / U|^2 of one realisation, unbiased, so that it may be below zero, shape
            (k,); NaN from one realisation or period, where it can't be separated from noise.
        relative_distortion: Root mean square of the distortion over that of G_BLA, over the lines;
            0 where the unbiased square is below zero. Its interval is from the scatter of the
            realisations; empty where the distortion is NaN.
        realisations: M.
    """

    value: ComplexArray
    noise: FloatArray
    total: FloatArray
    distortion: FloatArray
    relative_distortion: Estimate
    realisations: int


def best_linear_approximation(
    inputs: FloatArray, outputs: FloatArray, lines: IntArray
) -> BestLinearApproximation:
    """Estimate equation (1) of one input and one output by the robust method.

    Args:
        inputs: Samples of whole steady periods, shape (M, P, n).
        outputs: Samples of the same times, shape (M, P, n).
        lines: Excited lines, shape (k,).
    """
    length = inputs.shape[2]
    u, y = (np.fft.rfft(values, axis=2)[:, :, lines] / length for values in (inputs, outputs))
    each = [
        realisation_response(input_inverse(one.mean(axis=0)[None, None]), out[None])
        for one, out in zip(u, y, strict=True)
    ]
    return over_realisations(
        np.stack([value[0] for value, _ in each]), np.stack([noise[0] for _, noise in each])
    )


def input_inverse(inputs: ComplexArray) -> ComplexArray:
    """Return U^+ at each line.

    Args:
        inputs: U of E experiments of one realisation, mean of the periods, shape (m, E, k), E at
            least m.

    Returns:
        Shape (k, E, m).
    """
    return np.asarray(np.linalg.pinv(np.moveaxis(inputs, 2, 0)), dtype=np.complex128)


def realisation_response(
    inverse: ComplexArray, output: ComplexArray
) -> tuple[ComplexArray, FloatArray]:
    """Estimate the response of one output to m inputs from one realisation.

    Args:
        inverse: Of :func:`input_inverse`, shape (k, E, m).
        output: Y of each period, shape (E, P, k).

    Returns:
        Y U^+, and E|e|^2 of it made by noise, NaN from one period; both of shape (m, k).
    """
    value = np.einsum("ek,kem->mk", output.mean(axis=1), inverse)
    noise = np.einsum("ek,kem->mk", noise_power(output), np.abs(inverse) ** 2)
    return value, noise


def over_realisations(values: ComplexArray, noises: FloatArray) -> BestLinearApproximation:
    """Combine the responses of the realisations.

    Args:
        values: Response to one input in each, shape (M, k).
        noises: E|e|^2 of each, made by noise, shape (M, k).
    """
    realisations = len(values)
    value = values.mean(axis=0)
    noise = noises.mean(axis=0) / realisations
    if realisations < 2:
        nothing = np.full(value.size, np.nan)
        return BestLinearApproximation(value, noise, nothing, nothing, Estimate(), realisations)
    # Each term has the expectation of the scatter, its deviations being from their own mean.
    squares = np.abs(values - value) ** 2 * realisations / (realisations - 1)
    excess = squares - noises
    scatter = squares.mean(axis=0)
    power = float(np.sum(np.abs(value) ** 2) - np.sum(scatter) / realisations)
    # Of few realisations the squares depend on one another by their mean: circular normal errors
    # have at least this variance.
    variance = np.sum(scatter**2 + np.nan_to_num(noises.var(axis=0))) / realisations
    return BestLinearApproximation(
        value,
        noise,
        scatter / realisations,
        excess.mean(axis=0),
        root_of_mean(excess.sum(axis=1) / power, float(variance) ** 0.5 / power)
        if power > 0
        else Estimate(),
        realisations,
    )


def root_of_mean(squares: FloatArray, least_sd: float = 0.0) -> Estimate:
    """Return the root of a mean square with its interval, by Student's t.

    Args:
        squares: Unbiased estimates of the square, some of which may be below zero, shape (n,).
        least_sd: Least standard deviation of their mean.

    Returns:
        0 where the mean is below zero; empty where some square is NaN; without interval of one.
    """
    mean = float(np.mean(squares))
    if not np.isfinite(mean):
        return Estimate()
    if squares.size < 2:
        return Estimate(max(mean, 0.0) ** 0.5)
    reach = float(stats.t.ppf(0.975, squares.size - 1) * np.std(squares, ddof=1))
    reach = max(reach / squares.size**0.5, 1.96 * least_sd)
    low, high = (max(end, 0.0) ** 0.5 for end in (mean - reach, mean + reach))
    return Estimate(max(mean, 0.0) ** 0.5, (low, high))


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
    """Root mean square of the output at lines that aren't excited, over that at those that are.

    Without the noise. Both are empty where there are no such lines, or one period.

    Attributes:
        odd: Of odd lines: what nonlinearities of odd order make there.
        even: The same of even lines.
    """

    odd: Estimate
    even: Estimate


def detection_lines(powers: Sequence[FloatArray], lines: IntArray) -> DetectionLines:
    """Measure what an odd multisine leaves at the lines within its band that it doesn't excite.

    Args:
        powers: :func:`line_power` of each realisation, from line 0 on, shape (n,).
        lines: Excited lines, all odd.

    Returns:
        With intervals from the scatter of the realisations; of one from that of the lines.
    """
    power = np.stack(powers)
    excited = float(power[:, lines].mean())
    free = np.setdiff1d(np.arange(int(lines[0]), int(lines[-1])), lines)

    def level(parity: int) -> Estimate:
        chosen = power[:, free[free % 2 == parity]]
        if not chosen.size or not excited > 0:
            return Estimate()
        return root_of_mean((chosen[0] if len(chosen) == 1 else chosen.mean(axis=1)) / excited)

    return DetectionLines(level(1), level(0))


def noise_power(spectra: ComplexArray) -> FloatArray:
    """Return E|e|^2 of the mean over the periods, by their scatter.

    Args:
        spectra: Of each of P periods, shape (..., P, n).

    Returns:
        Shape (..., n); NaN from one period.
    """
    periods = spectra.shape[-2]
    if periods < 2:
        return np.full((*spectra.shape[:-2], spectra.shape[-1]), np.nan)
    mean = spectra.mean(axis=-2, keepdims=True)
    return np.sum(np.abs(spectra - mean) ** 2, axis=-2) / (periods - 1) / periods


def line_power(spectra: ComplexArray) -> FloatArray:
    """Return the power of each line without that of the noise, which may leave less than zero.

    Args:
        spectra: Of each of P periods, shape (..., P, n), P at least 2.

    Returns:
        Shape (..., n).
    """
    return np.abs(spectra.mean(axis=-2)) ** 2 - noise_power(spectra)
