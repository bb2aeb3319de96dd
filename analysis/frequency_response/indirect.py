"""The indirect method: frequency responses in a closed loop, from an external reference.

Where commands u depend on the measured positions y = G u + v, u and v are correlated, and a direct
estimate of G is biased by S_vu / S_uu (cross and power spectra). An external reference r that does
not depend on v gives

    G = G_yr / G_ur                                                                          (1)

of the responses of y and u to r, which has no such bias (Forssell & Ljung, Automatica 35, 1999, doi
10.1016/S0005-1098(99)00022-9; joint input-output: Pintelon & Schoukens, System Identification, 2nd
ed. 2012, 2.6.4). With the errors e of both, that of G is (e_y - G e_u) / G_ur to first order.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from .local_polynomial import local_response

CLEAR = 2.0
"""Equation (1) is first order: the command's response to the reference is so many times the radius
of its 95 % disc, or the line is left out."""


def indirect_response(
    output: ComplexArray,
    command: ComplexArray,
    reference: ComplexArray,
    bins: IntArray,
    half: int,
) -> tuple[ComplexArray, FloatArray, int]:
    """Estimate G of equation (1) with the local polynomial method.

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
