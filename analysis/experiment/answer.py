"""The answer of an experiment in one sentence: boundary or module?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..results import formats
from ..results.analysis import Analysis
from ..results.answer import Answer, NotFollowing
from ..results.experiment import OrderedPair, Reversal
from ..segments.answer import NAMED, fault_in_words
from ..session.runs import Role
from .pooling import PooledResponse
from .reversal.modules import SIGNIFICANT

OR_TILT = "or the floor is tilted"


def experiment_answer(
    reversal: Reversal | None,
    roles: Mapping[int, Role],
    pooled: PooledResponse | None = None,
    joints: Answer | None = None,
) -> str:
    """Answer from the reversal, or from the pooled runs of one direction.

    Args:
        reversal: Its result, or None.
        roles: Of the runs that have one.
        pooled: The response over the runs of one direction, None where both were recorded.
        joints: Its answer on the joints.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not roles:
        return "no gait with a travelling wave in these sessions: nothing to compare"
    if len(set(roles.values())) == 1:
        return _one_direction(pooled, joints)
    if reversal is None:
        return "both directions, but not separable from these sessions"
    return _different(reversal) if reversal.p < SIGNIFICANT else _bounded(reversal)


def broken_first(sessions: Sequence[Analysis], answer: str) -> str:
    """Put the joints that do not follow their command before what an experiment shows.

    Args:
        sessions: Its sessions.
        answer: What it shows.

    Returns:
        The answer, with a clause for each of these joints and where it was so.
    """
    found: dict[str, list[tuple[NotFollowing, str]]] = {}
    for one in sessions:
        for fault in one.answer.not_following:
            if fault.kinds != ("lost_samples",):
                found.setdefault(fault.joint, []).append((fault, Path(one.session.path).name))
    clauses = [
        f"{fault_in_words(where[0][0])} ({_sessions([name for _, name in where], len(sessions))})"
        for where in list(found.values())[:NAMED]
    ]
    if len(found) > NAMED:
        clauses.append(f"{len(found) - NAMED} more joints do not follow either")
    return "; ".join([*clauses, answer])


def _sessions(names: Sequence[str], count: int) -> str:
    if len(names) == count:
        return "all sessions"
    return f"in {names[0]}" if len(names) == 1 else f"in {len(names)} of {count} sessions"


def pair_order(pair: OrderedPair) -> str:
    """Which joint of a pair answers less.

    Args:
        pair: The pair.

    Returns:
        A clause; joints as they are named.
    """
    return f"{pair.name} answers less than its mirror {pair.mirror}"


def blind_spots(reversal: Reversal) -> str:
    """What a reversal of these joints can't see.

    Args:
        reversal: Its result.

    Returns:
        A clause.
    """
    middle = "" if reversal.middle is None else f" or of the middle joint, {reversal.middle}"
    return f"blind to what is alike at both joints of a pair{middle}"


def _one_direction(pooled: PooledResponse | None, joints: Answer | None) -> str:
    remains = "boundary or module is open: one direction only; record the reverse"
    if pooled is None or joints is None or not pooled.names:
        return remains
    runs = "1 run" if pooled.runs == 1 else f"{pooled.runs} runs pooled"
    return f"{runs}: {joints.sentence.rstrip('.')}; {remains}"


def _different(reversal: Reversal) -> str:
    reported = formats.told_p(reversal.p)
    if not reversal.pairs:
        cause = "check that ground and body are alike fore and aft"
        if not reversal.tilt.excluded:
            cause = "the floor may be tilted, or ground or body differ fore and aft"
        return (
            f"the two directions differ ({reported}), but not as a module would make them: {cause}"
        )
    first = reversal.pairs[0]
    either = f"{first.name} weaker or {first.mirror} stronger"
    either += "" if reversal.tilt.excluded else f", {OR_TILT}"
    others = len(reversal.pairs) - 1
    also = f"; {others} more pair{'s differ' if others > 1 else ' differs'}, by less"
    lead = "the modules differ: " if reversal.tilt.excluded else ""
    return (
        f"{lead}{pair_order(first)} ({formats.told_p(first.p)}): {either}{also if others else ''}"
    )


def _bounded(reversal: Reversal) -> str:
    bound = (
        "no module differs from its mirror by more than "
        f"{_at_most(100 * reversal.gain_bound)} % in gain and "
        f"{_at_most(math.degrees(reversal.lag_bound_rad))}° in lag"
    )
    blind = blind_spots(reversal)
    share = reversal.boundary_share
    if share.value is None:
        return f"{bound}: the joints' spread is no more than noise; {blind}"
    stated = f"share {formats.percent(share)}"
    if share.ci95 is not None and share.ci95[0] > 0.5:
        return f"{bound}: the pattern is boundary ({stated}); {blind}"
    return (
        f"{bound}: boundary or module is still open (boundary {stated}); record more runs; {blind}"
    )


def _at_most(bound: float) -> str:
    """A bound with two digits, rounded up."""
    digits = formats.decimals_for_values([bound], 2)
    return formats.number(math.ceil(bound * 10**digits) / 10**digits, digits)
