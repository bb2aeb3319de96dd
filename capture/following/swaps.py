"""Pairs of joints that carry out each other's command, or report each other's position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .motion import windowed_response

if TYPE_CHECKING:
    from .windows import Judged

OFF = 0.3
"""Relative deviation of H from the common response that makes a joint a candidate."""

NEAR = 0.2
"""Relative deviation below which the other joint's command explains it."""


def swapped_pairs(judged: Sequence[Judged], common: complex) -> dict[str, str]:
    """Find pairs of joints that answer each other's command.

    Args:
        judged: The driven joints.
        common: Their common response.

    Returns:
        Joint name to its partner's, both ways.
    """
    candidates = [
        each
        for each in judged
        if (each.follows.any() or each.opposite.any()) and abs(each.ratio / common - 1) > OFF
    ]
    partner: dict[str, str] = {}
    for k, first in enumerate(candidates):
        for second in candidates[k + 1 :]:
            if first.motion.name in partner or second.motion.name in partner:
                continue
            if _explains(second, first, common) and _explains(first, second, common):
                partner[first.motion.name] = second.motion.name
                partner[second.motion.name] = first.motion.name
    return partner


def _explains(commanded: Judged, measured: Judged, common: complex) -> bool:
    """Whether one joint's command gives the other's position by the common response."""
    r = windowed_response(
        commanded.motion.command, measured.motion.position, commanded.response.period_s
    )
    if not r.valid.any():
        return False
    ratio = complex(np.median(r.ratio[r.valid].real), np.median(r.ratio[r.valid].imag))
    return abs(ratio / common - 1) < NEAR and float(np.median(r.explained[r.valid])) > 0.8
