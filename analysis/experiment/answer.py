"""The answer of an experiment in one sentence: boundary or module?"""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..results.experiment import Reversal
from ..reversal.modules import SIGNIFICANT
from ..text import formats
from .runs import Role


def experiment_answer(reversal: Reversal | None, roles: Mapping[int, Role]) -> str:
    """Answer from the reversal.

    Args:
        reversal: Its result, or None.
        roles: Of the runs that have one.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not roles:
        return "no gait with a travelling wave in these sessions: nothing to compare"
    if len(set(roles.values())) == 1:
        return "boundary or module is open: one direction only; record the reverse"
    if reversal is None:
        return "both directions, but not separable from these sessions"
    return _different(reversal) if reversal.p < SIGNIFICANT else _bounded(reversal)


def _different(reversal: Reversal) -> str:
    told = formats.told_p(reversal.p)
    if not reversal.weak:
        return (
            f"the two directions differ ({told}), but not as a module would make them: check that "
            "ground and body are alike fore and aft"
        )
    others = len(reversal.weak) - 1
    also = f"; {others} more pair{'s differ' if others > 1 else ' differs'}, by less"
    return f"the modules differ: {reversal.weak[0].name} is weak ({told}){also if others else ''}"


def _bounded(reversal: Reversal) -> str:
    bound = (
        "no module differs from its mirror by more than "
        f"{_at_most(100 * reversal.gain_bound)} % in gain and "
        f"{_at_most(math.degrees(reversal.lag_bound_rad))}° in lag"
    )
    share = reversal.boundary_share
    if share.value is None:
        return f"{bound}: the joints' spread is no more than noise"
    told = f"share {formats.percent(share)}"
    if share.ci95 is not None and share.ci95[0] > 0.5:
        return f"{bound}: the pattern is boundary ({told})"
    return f"{bound}: boundary or module is still open (boundary {told}); record more runs"


def _at_most(bound: float) -> str:
    """A bound with two digits, rounded up."""
    digits = formats.decimals_for_values([bound], 2)
    return formats.number(math.ceil(bound * 10**digits) / 10**digits, digits)
