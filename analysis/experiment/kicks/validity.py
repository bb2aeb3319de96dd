"""How far from the gait the local matrices hold: patterns that were not used to measure them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

BETTER = 2.0
"""P holds where it predicts so many times better than 'each joint keeps its H_i'."""


@dataclass(frozen=True)
class Prediction:
    """One held-out run.

    Attributes:
        size: Largest deviation of a command from the base, in phase [rad] or log amplitude.
        error: ||a - predicted|| / ||a|| of the matrices.
        error_kept: The same of 'each joint keeps its H_i'.
        noise: What the run's own noise alone makes of either.
    """

    size: float
    error: float
    error_kept: float
    noise: float


def predict(
    deviation: ComplexArray,
    answered: ComplexArray,
    variance: FloatArray,
    response: ComplexArray,
    matrices: tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None],
) -> Prediction:
    """Predict a run from its commands, and compare.

    Args:
        deviation: Of its commands, d ln|c| + j d psi_c, shape (m,).
        answered: d ln|a| + j d psi as measured, shape (m,).
        variance: Of ln|a| plus that of psi, shape (m,).
        response: Complex amplitudes of the base's responses, shape (m,).
        matrices: P, R, G, S; without G and S changes of amplitude are taken as G = P, S = -R.

    Returns:
        The prediction's error.
    """
    P, R, gain, cross = matrices
    G, S = P if gain is None else gain, -R if cross is None else cross
    phase = P @ deviation.imag + S @ deviation.real
    log_amplitude = R @ deviation.imag + G @ deviation.real
    measured = response * np.exp(answered)
    whole = float(np.linalg.norm(measured))
    return Prediction(
        size=float(max(np.abs(deviation.real).max(), np.abs(deviation.imag).max())),
        error=float(np.linalg.norm(response * np.exp(log_amplitude + 1j * phase) - measured))
        / whole,
        error_kept=float(np.linalg.norm(response * np.exp(deviation) - measured)) / whole,
        noise=float(np.sum(np.abs(measured) ** 2 * variance)) ** 0.5 / whole,
    )


def valid_to(predictions: Sequence[Prediction]) -> float | None:
    """Largest deviation up to which every held-out run is predicted at least ``BETTER`` better.

    Args:
        predictions: In any order.

    Returns:
        The size of the last good run before the first bad one; None where the smallest is bad, or
        there is none.
    """
    reached: float | None = None
    for one in sorted(predictions, key=lambda p: p.size):
        if one.error * BETTER > one.error_kept:
            break
        reached = one.size
    return reached
