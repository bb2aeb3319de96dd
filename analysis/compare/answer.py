"""The answer of a comparison in one sentence."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from undulog.capture.common.console import plain

from ..results import formats
from ..results.comparison import BODY, BrokenJoint, Difference
from ..results.estimate import Estimate, leaves_out_zero
from .decisions import SIGNIFICANT, Decided

MOST = 4
"""Broken or differing joints that the sentence lists at most."""

WORDS = {
    "gain": "gain",
    "lag": "lag",
    "energy_abs": "E_abs per cycle",
    "speed": "speed",
    "cost_of_transport": "cost of transport",
}
"""What people call the quantities."""

_RESPONSE = ("gain", "lag")


def answer_of(
    decided: Decided, partial: bool, broken: Sequence[BrokenJoint] = ()
) -> tuple[str, str]:
    """Verdict and answer.

    Args:
        decided: The decisions.
        partial: Whether something could not be compared.
        broken: Joints that do not follow their command on one side only: the first difference.

    Returns:
        ``different``, ``same``, ``small`` or ``open``, and one sentence without its full stop.
    """
    if broken:
        rest = answer_of(_without(decided, broken), partial)[1]
        listed = "; ".join(each.text for each in broken[:MOST])
        more = len(broken) - MOST
        listed += f"; and {more} more joints" if more > 0 else ""
        return "different", f"{listed}; of the others: {rest}"
    beyond_doubt = _beyond_doubt(decided)
    tests = {one.quantity: one for one in decided.equivalence}
    same = all(tests[quantity].p < SIGNIFICANT for quantity in ("gain", "lag"))
    margins = (
        f"{_short(100 * tests['gain'].margin)} % and {_short(math.degrees(tests['lag'].margin))}°"
    )
    whole = " (partial comparison)" if partial else ""
    joints = len({one.place for one in decided.differences if one.place != BODY})
    alike = f"gain and lag of {_all(joints)} are equivalent within {margins}"
    if not beyond_doubt:
        if same:
            return "same", f"no difference found; {alike}{whole}"
        return "open", f"no difference found, but {_not_shown(decided)}{whole}"
    if same:
        return "small", f"{alike}; beyond doubt, if small: {_largest(decided)}{whole}"
    return "different", f"B differs from A: {_largest(decided)}{whole}"


def _beyond_doubt(decided: Decided) -> list[Difference]:
    """Differences that are significant and whose interval leaves out zero."""
    return [
        one
        for one in decided.differences
        if one.p_holm < SIGNIFICANT and leaves_out_zero(one.difference.ci95)
    ]


def _without(decided: Decided, broken: Sequence[BrokenJoint]) -> Decided:
    """The decisions without the broken joints."""
    names = {each.name for each in broken}
    return dataclasses.replace(
        decided,
        differences=tuple(one for one in decided.differences if one.place not in names),
        named=tuple(one for one in decided.named if one.name not in names),
    )


def told(one: Difference) -> str:
    """A difference with its interval.

    Args:
        one: The difference.

    Returns:
        For example ``gain −8.1 % [−8.6, −7.6]``.
    """
    return f"{WORDS[one.quantity]} {signed(*in_people_units(one))}"


def in_people_units(one: Difference) -> tuple[Estimate, str]:
    """A difference in the unit people read.

    Args:
        one: The difference.

    Returns:
        Percent for gains, degrees for lags, and for the others percent of side A.
    """
    if one.quantity == "lag":
        return formats.degrees(one.difference), "°"
    if one.quantity == "gain":
        return formats.scaled(one.difference, 100.0), " %"
    if one.a > 0:
        return formats.scaled(one.difference, 100.0 / one.a), " %"
    return one.difference, f" {one.unit}"


def signed(quantity: Estimate, unit: str) -> str:
    """A difference that always has a sign.

    Args:
        quantity: In ``unit``.
        unit: With its own space.

    Returns:
        For example ``+1.9° [1.7, 2.1]``.
    """
    text = formats.estimate(quantity, unit, most=2)
    return text if text.startswith(formats.MINUS) else f"+{text}"


def _largest(decided: Decided) -> str:
    """The joint that differs most, with all that is beyond doubt of it; else energy or body.

    A joint is named if it differs by a margin or more: of many joints one differs by less in five
    comparisons of a hundred that differ in nothing.
    """
    beyond_doubt = _beyond_doubt(decided)
    large = {one.place for one in beyond_doubt if one.quantity in _RESPONSE and one.size >= 1}
    named = [one.name for one in decided.named if one.name in large]
    if not named:
        first = beyond_doubt[0]
        others = len(beyond_doubt) - 1
        more = f"; and {others} more" if others else ""
        where = f"{plain(first.place)}:" if first.size >= 1 else "one joint's"
        where = "the body's" if first.place == BODY else where
        return f"{where} {told(first)} ({formats.told_p(first.p_holm)}){more}"
    own = [one for one in beyond_doubt if one.place == named[0] and one.quantity != "energy_abs"]
    parts = ", ".join(told(one) for one in sorted(own, key=lambda one: one.quantity))
    smallest = min(one.p_holm for one in own)
    others = [plain(name) for name in named[1:]]
    listed = ", ".join(others[:MOST])
    listed += f" and {len(others) - MOST} more" if len(others) > MOST else ""
    more = f"; {listed} by less" if others else ""
    return f"{plain(named[0])} most, {parts} ({formats.told_p(smallest)}){more}"


def _not_shown(decided: Decided) -> str:
    """How large a difference might be hidden, from the intervals that hold together."""
    worst: dict[str, float] = {"gain": 0.0, "lag": 0.0}
    for one in decided.differences:
        ends = one.difference.ci95
        if one.quantity in worst and ends is not None:
            worst[one.quantity] = max(worst[one.quantity], abs(ends[0]), abs(ends[1]))
    return (
        f"up to {_short(100 * worst['gain'])} % in gain and {_short(math.degrees(worst['lag']))}° "
        "in lag could hide in the noise; record more"
    )


def _all(joints: int) -> str:
    return "the joint" if joints == 1 else f"all {joints} joints"


def _short(value: float) -> str:
    return f"{value:.2g}"
