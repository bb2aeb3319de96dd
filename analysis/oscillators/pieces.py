"""Kicks in a record of phases, and the pieces between them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

from .weak_form import Piece

LEAST_KICK = 0.1
"""A phase that jumps by less between two samples, against those beside them, isn't kicked [rad]."""

BEYOND_NOISE = 8.0
"""A jump must stand out of the noise of the steps by this many standard deviations, too."""

_SIGMA_OF_MAD = 1.4826


def kicked_steps(phases: FloatArray) -> BoolArray:
    """Which steps from sample to sample hold a kick.

    Args:
        phases: Of n oscillators, without wrap-around [rad], shape (k, n).

    Returns:
        Shape (k - 1,).
    """
    steps = np.diff(phases, axis=0)
    if len(steps) < 3:
        return np.zeros(len(steps), dtype=np.bool_)
    # Against the smaller of the two differences, so that the step after a kick isn't one, too.
    change = np.abs(np.diff(steps, axis=0))
    edge = np.zeros((1, phases.shape[1]))  # the first step and the last have one side only
    lone = np.minimum(np.concatenate([edge, change]), np.concatenate([change, edge]))
    usual = _SIGMA_OF_MAD * np.median(lone, axis=0)
    return np.any(lone > np.maximum(LEAST_KICK, BEYOND_NOISE * usual), axis=1)


def between_kicks(
    phases: FloatArray, whole: BoolArray, inputs: FloatArray | None = None
) -> tuple[Piece, ...]:
    """Cut a record where a phase jumps or a sample is missing.

    Args:
        phases: [rad], shape (k, n).
        whole: Whether each step from sample to sample lasts one period, shape (k - 1,).
        inputs: What else turns the oscillators, shape (k, n).

    Returns:
        The pieces, in order; those of a single sample are left out.
    """
    cut = np.flatnonzero(kicked_steps(phases) | ~whole) + 1
    bounds = [0, *cut.tolist(), len(phases)]
    return tuple(
        Piece(phases[i:j], None if inputs is None else inputs[i:j])
        for i, j in pairwise(bounds)
        if j - i > 1
    )
