"""What a sweep shows of nonlinearity: energy where nothing is commanded.

A linear chain answers at the commanded frequencies only. What stands at the free lines between and
beside the tones is noise or a nonlinearity; and what a nonlinearity puts on the free lines near a
tone, it puts on the tone, too (Pintelon & Schoukens, System Identification, 2nd ed. 2012, ch. 4:
detection lines of a multisine).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ...estimators.intervals import norm_ratio
from ...results.estimate import Estimate
from ..kicks.lti_reading import squared
from .chain import Phasors

_NEAREST = 6


@dataclass(frozen=True)
class Beside:
    """S free lines of m joints in r runs.

    Attributes:
        omega: Angular frequencies [rad/s], shape (S,).
        lines: Amplitudes, one entry a line, each of shape (m, r).
    """

    omega: FloatArray
    lines: tuple[Phasors, ...]


def sideband_energy(tones: tuple[Phasors, ...], beside: Beside) -> Estimate:
    """Energy at the free lines over that at the tones.

    Args:
        tones: Amplitudes at the tones.
        beside: At the free lines.

    Returns:
        The ratio, noise taken off, with an interval of at least 95 %.
    """
    above, below = _joined(beside.lines), _joined(tones)
    return squared(norm_ratio(above.value, above.draws(31), below.value, below.draws(32)))


def distortion(omega: float, tone: Phasors, beside: Beside) -> float:
    """How much of a tone a nonlinearity may have made.

    Args:
        omega: Of the tone [rad/s].
        tone: Its amplitudes.
        beside: Those of the free lines.

    Returns:
        Root mean square of a free line, of the nearest ones, over that of the tone; noise taken
        off.
    """
    apart: FloatArray = np.abs(beside.omega - omega)
    nearest: list[int] = np.argsort(apart)[:_NEAREST].tolist()
    near = _joined(tuple(beside.lines[k] for k in nearest))
    energy = float(np.sum(np.abs(near.value) ** 2 - 2 * near.variance)) / len(nearest)
    return float(np.sqrt(max(0.0, energy)) / np.linalg.norm(tone.value))


def _joined(parts: tuple[Phasors, ...]) -> Phasors:
    return Phasors(
        np.concatenate([one.value for one in parts], axis=1),
        np.concatenate([one.variance for one in parts], axis=1),
        np.concatenate([one.dof for one in parts], axis=1),
    )
