"""The coupling of a chain, read from kicks as if it were linear and time-invariant.

Then a = H c with H_ij = (a_i / c_j)(P_ij - j R_ij), and X = H^-1 is, up to the servos on its
diagonal and a scaling of its rows, the impedance that couples the joints. Asymmetry of P is not
directed coupling: a reciprocal H (H = H') has an asymmetric P, too. Hence asymmetry and reach are
told of X. Where the nonlinearity index isn't small, this is a reading and not a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ...estimators.intervals import noise_draws, norm_ratio
from ...results.estimate import Estimate
from .local import Measured, stacked

BANDS = (1, 2, 3)

SINGULAR = 1e10
"""Condition number beyond which H isn't inverted."""


@dataclass(frozen=True)
class LtiReading:
    """H and what its inverse says.

    Attributes:
        H: Response per command, shape (m, m).
        condition_number: Of H, 2-norm: what its inversion may multiply relative errors by.
        asymmetry: ||X - X'|| / ||X|| off the diagonal; 0 = reciprocal.
        band_energy: Share of X's off-diagonal energy within |i - j| <= each of ``BANDS``.
    """

    H: ComplexArray
    condition_number: float
    asymmetry: Estimate
    band_energy: tuple[Estimate, ...]


def lti_reading(
    P: Measured,
    R: Measured,
    response: ComplexArray,
    command: ComplexArray,
    seed: int = 11,
    *,
    correlation: FloatArray | None = None,
) -> LtiReading:
    """Read P and R as a linear time-invariant system.

    Args:
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c.
        response: Complex amplitudes a of the base gait, shape (m,).
        command: Complex amplitudes c of the base gait, shape (m,).
        seed: Of the noise draws.
        correlation: Of one run's errors, psi of all joints and then ln|a|, or None.

    Returns:
        The reading; asymmetry and bands are empty where H is singular.
    """
    scale = response[:, None] / command[None, :]
    H = (scale * (P.value - 1j * R.value)).astype(np.complex128)
    condition = float(np.linalg.cond(H))
    if not condition < SINGULAR:
        return LtiReading(H, condition, Estimate(), tuple(Estimate() for _ in BANDS))
    X: ComplexArray = np.linalg.inv(H).astype(np.complex128)
    draws = noise_draws(stacked(((P,), (R,)), correlation), seed)
    noise = scale * (draws[:, : len(H)] - 1j * draws[:, len(H) :])
    error: ComplexArray = np.linalg.inv(H + noise).astype(np.complex128) - X
    return LtiReading(H, condition, *reciprocity(X, error))


def reciprocity(X: ComplexArray, error: ComplexArray) -> tuple[Estimate, tuple[Estimate, ...]]:
    """Asymmetry and reach of a matrix off its diagonal.

    Args:
        X: An impedance, or what stands for one, shape (m, m).
        error: Errors that it may have, shape (DRAWS, m, m).

    Returns:
        ||X - X'|| / ||X||, and the share of the energy within each of ``BANDS``.
    """
    place = np.arange(len(X))
    distance = np.abs(place[:, None] - place[None, :])
    outside: FloatArray = (distance > 0).astype(np.float64)
    off: ComplexArray = X * outside
    off_error: ComplexArray = error * outside
    asymmetry = norm_ratio(off - off.T, off_error - off_error.swapaxes(1, 2), off, off_error)
    bands = (
        norm_ratio(off * (distance <= b), off_error * (distance <= b), off, off_error)
        for b in BANDS
    )
    return asymmetry, tuple(squared(one) for one in bands)


def squared(share: Estimate) -> Estimate:
    """Energy from a ratio of norms.

    Args:
        share: Of a norm in the whole's.

    Returns:
        Share of the energy, at most 1.
    """
    if share.value is None:
        return share
    ci95 = share.ci95
    return Estimate(
        min(1.0, share.value**2),
        None if ci95 is None else (min(1.0, ci95[0] ** 2), min(1.0, ci95[1] ** 2)),
    )
