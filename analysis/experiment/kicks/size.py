"""Are the kicks too small for the noise, or too large for a derivative?

Small ones leave P open: an element off the diagonal must exceed its interval, all elements
together, to be shown. Large ones leave its third order in a central difference. With y+ and y- what
a kick up and a kick down changed, (y+ + y-)/2 is of second order and (y+ - y-)/2 of first; where
their ratio is q, the third order is some q^2 of the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...results.coupling import KickSize
from .local import Answers
from .matrices import LocalMatrices
from .runs import MOST_KICK, Kick, Kind
from .scatter import sides

RESOLVED = 0.1
"""Coupling between joints that kicks should be able to show: what the robot's body brings back with
more counts as strong (:data:`.analysis.oscillators.laplacian.STRONG`)."""

CURVED = 0.3
"""Second order over first order, from which the third may be a tenth of the first."""


def kick_size(kicks: Sequence[Kick | None], answers: Answers, matrices: LocalMatrices) -> KickSize:
    """Judge the size of the kicks.

    Args:
        kicks: Of r runs, None of one of the base gait.
        answers: Of the same runs.
        matrices: What came of them.

    Returns:
        The verdict.
    """
    sizes = {
        kind: [abs(one.size) for one in kicks if one is not None and one.kind is kind]
        for kind in Kind
    }
    phase = float(np.mean(sizes[Kind.PHASE]))
    amplitude = float(np.mean(sizes[Kind.AMPLITUDE])) if sizes[Kind.AMPLITUDE] else None
    m = len(matrices.P.value)
    resolved = float(np.median(matrices.P.half_together[~np.eye(m, dtype=bool)]))
    curvature = _curvature(kicks, answers, matrices)
    verdict, why = "fits", None
    largest = max(phase, amplitude or 0.0)
    if largest > MOST_KICK:
        verdict = "too large"
        why = (
            f"kicks of {largest:.2g} are too large for a derivative (at most {MOST_KICK:g} rad or "
            "log amplitude): record kicks of 0.05"
        )
    elif curvature > CURVED:
        verdict = "too large"
        why = (
            f"kicks of {phase:.2g} rad are too large: what they do is "
            f"{100 * curvature:.0f} % of second order; record kicks of "
            f"{_rounded_down(phase * CURVED / (2 * curvature)):.2g} rad"
        )
    elif resolved > RESOLVED:
        verdict = "too small"
        why = (
            f"kicks of {phase:.2g} rad are too small for the noise and the scatter between runs: "
            f"they show couplings of {resolved:.2g} and more; to show {RESOLVED:g}, record "
            f"{_larger(phase, resolved / RESOLVED)}"
        )
    return KickSize(phase, amplitude, resolved, curvature, verdict, why)


def _larger(size: float, factor: float) -> str:
    """What to record so that intervals are narrower by a factor."""
    if size * factor <= MOST_KICK:
        return f"kicks of {math.ceil(100 * size * factor) / 100:.2g} rad"
    largest = max(size, 0.1)
    repeats = math.ceil((factor * size / largest) ** 2)
    return f"kicks of {largest:.2g} rad, each {repeats} times"


def _rounded_down(size: float) -> float:
    digits = 1 - math.floor(math.log10(size))
    return math.floor(size * 10**digits) / 10**digits


def _curvature(kicks: Sequence[Kick | None], answers: Answers, matrices: LocalMatrices) -> float:
    """Second order over first order of the kicks of phase, Frobenius norms over all joints."""
    errors = matrices.steady_errors
    variance = float(np.maximum(errors.variance, errors.within).sum())
    base = [k for k, one in enumerate(kicks) if one is None]
    middle = answers.log[base].mean(axis=0)
    even = odd = noise = 0.0
    for up, down in sides(kicks, Kind.PHASE):
        high, low = answers.log[up].mean(axis=0), answers.log[down].mean(axis=0)
        even += float(np.sum(np.abs((high + low) / 2 - middle) ** 2))
        odd += float(np.sum(np.abs(high - low) ** 2)) / 4
        noise += variance * (0.25 / len(up) + 0.25 / len(down) + 1 / len(base))
    return (max(0.0, even - noise) / odd) ** 0.5 if odd > 0 else 0.0
