"""Variance of contrasts between joints whose noise is not independent.

Noise that joints share (of a clock, a bus, a body that rocks) cancels in one contrast of their
responses and adds up in another, and no sum of the joints' own variances shows which. But each
joint's residual is there in the same bins beside omega, so a contrast has bins of its own: the
weighted sum of the joints' bins. Their mean power is the contrast's variance, with two degrees
of freedom a bin, whatever is shared by whom.

The error of ln H = ln a - ln c is, to first order, e = da / a - dc / c: a complex number whose
real part is the error of log gain and whose imaginary part is that of arg H, minus the lag. The
noise near omega is taken to be stationary, so the two parts have the same variance, half of
E|e|^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

from .spectrum import ResidualBins


@dataclass(frozen=True)
class ResponseErrors:
    """What the errors of ln H of m joints would be in each of L bins beside omega.

    Attributes:
        bins: Complex, shape (m, L), scaled so that E[e_i conj(e_j)] of the errors e of ln H of
            joints i and j is the mean over l of ``bins[i, l] * conj(bins[j, l])``. The real part
            of that is twice the covariance of their log gains and twice that of their lags.
        rounding: Covariance of (ln|H|, arg H) that rounding to steps adds to what the bins show
            and that no two joints share, shape (m, 2, 2).
        turn: Lag error that one standard error of the shared frequency makes [rad], shape (m,);
            it is the same error in all joints.
    """

    bins: ComplexArray
    rounding: FloatArray
    turn: FloatArray

    def select(self, chosen: Sequence[int] | IntArray) -> ResponseErrors:
        """Some of the joints.

        Args:
            chosen: Indices, k of them.

        Returns:
            Their errors.
        """
        index = np.asarray(chosen, dtype=np.int64)
        return ResponseErrors(self.bins[index], self.rounding[index], self.turn[index])


def response_errors(
    command: ComplexArray,
    command_bins: ResidualBins,
    response: ComplexArray,
    response_bins: ResidualBins,
    *,
    omega_variance: float = 0.0,
    delay_between_s: FloatArray | float = 0.0,
) -> ResponseErrors:
    """Errors of ln H in each bin: response_bins / a - command_bins / c, scaled to the estimate.

    Args:
        command: Fundamentals c of the commands, shape (m,).
        command_bins: Their residuals.
        response: Fundamentals a of the responses, shape (m,).
        response_bins: Their residuals, in the same bins.
        omega_variance: Variance of the shared frequency [(rad/s)^2].
        delay_between_s: Mean sampling time of the response minus that of the command [s], (m,).

    Returns:
        The errors; NaN for a joint whose command or response is zero.
    """
    parts: list[ComplexArray] = []
    rounding = np.zeros((response.size, 2, 2))
    for amplitude, found in ((response, response_bins), (command, command_bins)):
        known = np.abs(amplitude) > 0
        inverse = np.full(amplitude.shape, np.nan, dtype=np.complex128)
        np.divide(1.0, amplitude, out=inverse, where=known)
        parts.append((inverse * np.sqrt(found.spread))[:, None] * found.values)
        # Multiplied by 1/a, errors of (Re a, Im a) become those of (ln|a|, arg a).
        turned = np.stack([inverse, 1j * inverse], axis=-1)
        turned = np.stack([turned.real, turned.imag], axis=-2)
        rounding += turned @ found.rounding @ turned.transpose(0, 2, 1)
    turn = np.zeros(response.size) + omega_variance**0.5 * np.asarray(delay_between_s)
    return ResponseErrors(parts[0] - parts[1], rounding, turn)


def contrast_variance(errors: ResponseErrors, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variance of weighted sums of the joints' log gains.

    Args:
        errors: Of m joints.
        weights: Real, shape (..., m).

    Returns:
        Variance of sum_i w_i ln|H_i| and its degrees of freedom, each of shape (...). Bins have
        two degrees of freedom each; rounding is known without error.
    """
    return _variance(errors, weights, weights**2 @ errors.rounding[:, 0, 0])


def lag_contrast_variance(
    errors: ResponseErrors, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Variance of weighted sums of the joints' lags.

    But for rounding it is that of the log gains, and what the error of the shared frequency adds
    where commands and responses were sampled at different times.

    Args:
        errors: Of m joints.
        weights: Real, shape (..., m).

    Returns:
        Variance [rad^2] and its degrees of freedom, each of shape (...).
    """
    known = weights**2 @ errors.rounding[:, 1, 1] + (weights @ errors.turn) ** 2
    return _variance(errors, weights, known)


def _variance(
    errors: ResponseErrors, weights: FloatArray, known: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The variance in the bins plus a known one, and the degrees of freedom of the sum (Welch)."""
    found = np.mean(np.abs(weights @ errors.bins) ** 2, axis=-1) / 2
    total = np.maximum(found + known, 0.0)
    share = np.divide(found, total, out=np.ones_like(found), where=total > 0)
    return total, 2.0 * errors.bins.shape[1] / np.clip(share, 1e-6, 1.0) ** 2
