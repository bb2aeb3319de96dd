"""The local polynomial method: frequency responses without leakage, with their noise.

Over a few neighbouring bins k + r of a record's discrete Fourier transform the response G and the
leakage T of a transient are smooth, so that

    Y(k + r) = sum_i G_i(k + r) U_i(k + r) + T(k + r) + V(k + r),    |r| <= n            (1)

with G_i and T polynomials of order R in r is a linear least-squares problem in (R + 1)(m + 1)
unknowns. Its solution at r = 0 is the response, and its residual the power of the noise V, of
which nonlinear distortion is a part where the excitation isn't periodic.

Source: Pintelon, Schoukens, Vandersteen & Barbe, Mechanical Systems and Signal Processing 24
(2010) 573-595, doi 10.1016/j.ymssp.2009.08.003.

In a closed loop, where commands u depend on the measured positions y = G u + v, u and v are
correlated, and a direct estimate of G is biased by S_vu / S_uu (cross and power spectra). With an
external reference r that does not depend on v the indirect method gives

    G = G_yr / G_ur                                                                          (2)

of the responses of y and u to r, which has no such bias (Forssell & Ljung, Automatica 35, 1999, doi
10.1016/S0005-1098(99)00022-9; joint input-output: Pintelon & Schoukens, System Identification, 2nd
ed. 2012, 2.6.4). With the errors e of both, that of G is (e_y - G e_u) / G_ur to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

ORDER = 2
"""Of the polynomials: the lowest that follows a curved response and an odd transient alike."""

LEAST_FREEDOM = 6
"""Complex residuals at least left over: their power is known to 40 %."""

_SMALLEST_PIVOT = 1e-6
"""Relative; below it the inputs of a window can't be separated."""


@dataclass(frozen=True)
class LocalResponse:
    """Responses at c bins from m inputs to one output.

    Attributes:
        bins: The bins, shape (c,).
        value: G, output over input, shape (c, m); NaN where the inputs can't be separated.
        covariance: E[e e^H] of the error e of ``value``, shape (c, m, m); circular.
        noise: E|V|^2 at the output, in the DFT's scale, shape (c,).
        freedom: Complex degrees of freedom of ``noise``.
    """

    bins: IntArray
    value: ComplexArray
    covariance: ComplexArray
    noise: FloatArray
    freedom: int

    @property
    def variance(self) -> FloatArray:
        """E|e|^2 of each response, shape (c, m)."""
        return np.einsum("cmm->cm", self.covariance).real

    def radius(self, level: float = 0.95) -> FloatArray:
        """Return the radius of the disc that holds each response, shape (c, m).

        |e|^2 / variance is distributed as F with 2 and 2 q degrees of freedom.
        """
        quantile = float(stats.f.ppf(level, 2, 2 * self.freedom))
        return np.sqrt(self.variance * quantile)


def window(inputs: int, order: int = ORDER, freedom: int = LEAST_FREEDOM) -> int:
    """Return the least half width n of the window that leaves so many degrees of freedom."""
    return (freedom + (order + 1) * (inputs + 1)) // 2


def local_response(
    output: ComplexArray,
    inputs: ComplexArray,
    bins: IntArray,
    half: int,
    *,
    order: int = ORDER,
) -> LocalResponse:
    """Fit equation (1) around each of some bins.

    Args:
        output: Spectrum Y from bin 0 on, shape (n,).
        inputs: Spectra U, shape (m, n).
        bins: Centres k, shape (c,). Near the ends the window is moved inwards.
        half: Half width n of the window.

    Returns:
        The responses.

    Raises:
        ValueError: If the window leaves no degree of freedom or the spectrum is shorter.
    """
    m, length = inputs.shape
    width, unknowns = 2 * half + 1, (order + 1) * (m + 1)
    if width <= unknowns or length <= width:
        raise ValueError(f"a window of {width} bins of {length} for {unknowns} unknowns")
    first = np.clip(bins - half, 1, length - width)
    index = first[:, None] + np.arange(width)  # (c, w)
    powers = ((index - bins[:, None]) / half)[:, :, None] ** np.arange(order + 1)  # (c, w, R+1)
    local = inputs[:, index]  # (m, c, w)
    scale = np.sqrt(np.mean(np.abs(local) ** 2, axis=2)) + np.finfo(float).tiny  # (m, c)
    columns = [local[i, :, :, None] / scale[i, :, None, None] * powers for i in range(m)]
    design = np.concatenate([*columns, powers.astype(np.complex128)], axis=2)
    q, r = np.linalg.qr(design)
    pivots = np.abs(np.einsum("cii->ci", r))
    sound = pivots.min(axis=1) > _SMALLEST_PIVOT * pivots.max(axis=1)
    r[~sound] = np.eye(unknowns)
    data = output[index]
    projected = np.einsum("cwp,cw->cp", q.conj(), data)
    residual = data - np.einsum("cwp,cp->cw", q, projected)
    freedom = width - unknowns
    noise = np.sum(np.abs(residual) ** 2, axis=1) / freedom
    inverse = np.asarray(np.linalg.inv(r), dtype=np.complex128)
    solution: ComplexArray = np.einsum("cpq,cq->cp", inverse, projected)
    at: IntArray = np.arange(m, dtype=np.int64) * (order + 1)  # the constants of the G_i
    rows = inverse[:, at, :] / scale.T[:, :, None]
    value: ComplexArray = solution[:, at] / scale.T
    value[~sound] = np.nan
    covariance = noise[:, None, None] * (rows @ rows.conj().transpose(0, 2, 1))
    return LocalResponse(bins, value, covariance, noise, freedom)


CLEAR = 2.0
"""Equation (2) is first order: the command's response to the reference is so many times the radius
of its 95 % disc, or the line is left out."""


def indirect_response(
    output: ComplexArray,
    command: ComplexArray,
    reference: ComplexArray,
    bins: IntArray,
    half: int,
) -> tuple[ComplexArray, FloatArray, int]:
    """Estimate G of equation (2) with the local polynomial method.

    Args:
        output: Spectrum of y, shape (n,).
        command: Spectrum of u, shape (n,).
        reference: Spectrum of r, shape (n,).
        bins: Centres, shape (c,).
        half: Half width of the windows.

    Returns:
        G, shape (c,); E|e|^2 of its error, NaN where the reference hardly moves the command, shape
        (c,); complex degrees of freedom of that.
    """
    # Variances are quadratic forms of the output: those of sums give the covariance of e_y and e_u.
    y, u, in_phase, turned = (
        local_response(one, reference[None], bins, half)
        for one in (output, command, output + command, output + 1j * command)
    )
    power_y, power_u = y.variance[:, 0], u.variance[:, 0]
    real = (in_phase.variance[:, 0] - power_y - power_u) / 2
    imaginary = (turned.variance[:, 0] - power_y - power_u) / 2
    driven = u.value[:, 0]
    clear: BoolArray = np.abs(driven) > CLEAR * u.radius()[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        value: ComplexArray = np.asarray(y.value[:, 0] / driven, dtype=np.complex128)
        shared = 2 * np.real(np.conj(value) * (real + 1j * imaginary))
        variance = (power_y + np.abs(value) ** 2 * power_u - shared) / np.abs(driven) ** 2
    return value, np.where(clear, np.maximum(variance, 0.0), np.nan), y.freedom
