"""What generators that feel their own servos will do, predicted from open-loop kicks.

    phi_i' = omega + eps (2 (q_i/A) cos phi_i - b_i) + explicit coupling

Of q_i = g_i A sin(phi_i + Delta_i) a cycle leaves eps (g_i sin Delta_i - b_i). With the bias
b_i = g_i sin Delta_i the gait goes on as it is; a small deviation d phi of the commands turns the
responses by P d phi and changes their log amplitude by R d phi, so

    d phi' = eps (diag(g cos Delta) (P - I) + diag(g sin Delta) R) d phi,

which has no parameter to fit. It holds for eps well below the rates at which the body settles.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from undulog.capture.common.arrays import ComplexArray, FloatArray


def felt_response(ratio: ComplexArray, omega: float, age_s: float) -> ComplexArray:
    """The response as the generator hears of it.

    Args:
        ratio: H = a/c as measured, shape (m,).
        omega: Of the gait [rad/s].
        age_s: How old an angle is on average when it is used [s].

    Returns:
        g exp(j Delta), the age part of Delta, shape (m,).
    """
    return (ratio * np.exp(-1j * omega * age_s)).astype(np.complex128)


def steady_bias(felt: ComplexArray) -> FloatArray:
    """b_i = g_i sin Delta_i, which takes the steady part of the feedback away.

    Args:
        felt: g exp(j Delta), shape (m,).

    Returns:
        Shape (m,).
    """
    return felt.imag.copy()


def relaxation(P: FloatArray, R: FloatArray, felt: ComplexArray) -> FloatArray:
    """J / eps of d phi' = J d phi.

    Args:
        P: d psi / d psi_c of the open loop, shape (m, m).
        R: d ln|a| / d psi_c of the open loop, shape (m, m).
        felt: g exp(j Delta) of the open loop, shape (m,).

    Returns:
        Shape (m, m); P - I where there is no lag and a gain of 1.
    """
    return felt.real[:, None] * (P - np.eye(len(P))) + felt.imag[:, None] * R


def relax(J: FloatArray, kick: FloatArray, times_s: FloatArray) -> FloatArray:
    """Deviations after a kick, d phi(t) = exp(J t) d phi(0).

    Args:
        J: Rates [1/s], shape (m, m).
        kick: d phi(0) [rad], shape (m,).
        times_s: After the kick [s], shape (k,).

    Returns:
        Shape (k, m).
    """
    return np.array([expm(J * float(t)) @ kick for t in times_s])
