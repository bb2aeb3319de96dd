"""What a session tells, and what it doesn't.

In units of the prior's deviations, x = P^1/2 z, the fit's covariance has eigenvalues between 0 (the
session tells all about that direction) and 1 (nothing). A direction whose deviation is still more
than half of the prior's is a ridge: along it the parameters can be changed together, and the twin
answers alike. A single parameter is determined if its own 95 % interval is narrow enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

from .parameters import DELAY, Unknown

Z95 = 1.959963984540054

_RIDGE = 0.5
_MOVED = 0.01

_TELLS = {
    "stall_torque": "commands that bring the servos to full voltage: a larger amplitude, a higher "
    "frequency, or a stronger load",
    "proportional_gain": "commands that bring the servos to full voltage: a larger amplitude, a "
    "higher frequency, or a stronger load",
    "coulomb_friction": "slow motion without contact",
    "viscous_friction": "fast motion without contact, up to full voltage",
    "gear_stiffness": "a stronger load, or frequencies near the gear's resonance",
    "gear_damping": "frequencies near the gear's resonance",
    "mu_tangential": "a longer stretch in contact, with another lag or amplitude",
    "mu_normal": "a longer stretch in contact, with a larger amplitude or stronger servos",
    "drag_tangential": "a longer stretch in contact, with another lag or amplitude",
    "drag_normal": "a longer stretch in contact, with a larger amplitude or stronger servos",
    DELAY: "another frequency",
}


@dataclass(frozen=True)
class Ridge:
    """A direction that a session doesn't tell.

    Attributes:
        left: Standard deviation along it, as a share of the prior's: 1 where nothing is told.
        factors: Parameter to the factor (of a dead time: the change in seconds) by which it goes
            along, one prior deviation up the ridge; those that hardly move are left out.
    """

    left: float
    factors: dict[str, float]


def half_widths(covariance: FloatArray) -> FloatArray:
    """Half the 95 % intervals of x, shape (K,)."""
    return Z95 * np.sqrt(np.diag(covariance))


def ridges(unknowns: Sequence[Unknown], covariance: FloatArray) -> tuple[Ridge, ...]:
    """The directions that are left open.

    Args:
        unknowns: K of them.
        covariance: Of x, shape (K, K).

    Returns:
        The most open one first.
    """
    spread = np.array([one.spread for one in unknowns])
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    found: list[Ridge] = []
    for k in np.argsort(values)[::-1].tolist():
        left = float(np.sqrt(max(values[k], 0.0)))
        if left <= _RIDGE:
            break
        way = vectors[:, k] * spread
        way = way * np.sign(way[np.argmax(np.abs(way))])
        order: list[int] = np.argsort(-np.abs(way)).tolist()
        moved = [i for i in order if abs(way[i]) > _MOVED]
        factors = {
            unknowns[i].label: unknowns[i].value(float(way[i])) / (unknowns[i].start or 1.0)
            for i in moved
        }
        found.append(Ridge(left, factors))
    return tuple(found)


def what_would_tell(unknowns: Sequence[Unknown], open_ones: Sequence[int]) -> tuple[str, ...]:
    """What else to record.

    Args:
        unknowns: K of them.
        open_ones: Indices of those that aren't determined.

    Returns:
        ``parameters: experiment``, one a kind of experiment.
    """
    by_experiment: dict[str, list[str]] = {}
    for i in open_ones:
        by_experiment.setdefault(_TELLS[unknowns[i].name], []).append(unknowns[i].label)
    return tuple(f"{', '.join(names)}: {what}" for what, names in by_experiment.items())
