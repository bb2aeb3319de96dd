"""What a comparison says, in the units that people use."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence

from undulog.capture.common.console import plain

from ..common import formats
from ..common.estimate import Estimate, leaves_out_zero
from ..results.comparison import BODY, BrokenJoint, Difference, Equivalence, of_body
from .decisions import BY_RATIO, MOST, MOVED, RESPONSE, SAME, SIGNIFICANT_DIFFERENCE, WORDS, Decided


def answer_of(
    decided: Decided, partial: bool, broken: Sequence[BrokenJoint] = (), verb: str = MOVED
) -> tuple[str, str]:
    """Return verdict and answer.

    Args:
        partial: Whether something could not be compared.
        broken: Joints that do not follow their command on one side only: the first difference.
        verb: :data:`MOVED` or :data:`DIFFERS`.

    Returns:
        ``different``, ``same``, ``small`` or ``open``, and one sentence without its full stop.
    """
    if broken:
        rest = answer_of(_without(decided, broken), partial, verb=verb)[1]
        listed = "; ".join(joint.text for joint in broken[:MOST])
        more = len(broken) - MOST
        listed += f"; and {more} more joints" if more > 0 else ""
        return "different", f"{listed}; of the others: {rest}"
    beyond_doubt = _beyond_doubt(decided)
    tests = {test.quantity: test for test in decided.equivalence}
    # Of a gait's joints means are compared, and not shown to be the same.
    required = (*SAME, "offset") if "delay" in tests else SAME
    main = [tests[quantity] for quantity in required if quantity in tests]
    at_rest = [difference for difference in beyond_doubt if difference.quantity == "rest_amplitude"]
    same = not at_rest and all(test.p < SIGNIFICANT_DIFFERENCE for test in main)
    of_joints = [test for test in main if test.quantity != "frequency"]
    margins = _listed(margin_text(test) for test in of_joints)
    whole = " (partial comparison)" if partial else ""
    joints = len(
        {difference.place for difference in decided.differences if not of_body(difference.place)}
    )
    which = "the joint" if joints == 1 else f"all {joints} joints"
    words = _listed(dict.fromkeys(WORDS[test.quantity] for test in of_joints))
    are = "are" if len(of_joints) > 1 else "is"
    alike = f"{words} of {which} {are} equivalent within {margins}"
    if "frequency" in tests:
        alike += f", the frequency within {margin_text(tests['frequency'])}"
    if not beyond_doubt:
        if same:
            return "same", f"no difference found; {alike}{whole}"
        return "open", f"no difference found, but {_not_shown(decided, main)}{whole}"
    if moved := offsets_moved(decided, verb):
        rest = _largest(decided) if _large(decided) else alike if same else ""
        return "different", f"B differs from A: {'; '.join(filter(None, (moved, rest)))}{whole}"
    if same:
        return "small", f"{alike}; beyond doubt, if small: {_largest(decided)}{whole}"
    return "different", f"B differs from A: {_largest(decided)}{whole}"


def _beyond_doubt(decided: Decided) -> list[Difference]:
    """Return differences that are significant and whose interval leaves out zero."""
    return [
        difference
        for difference in decided.differences
        if difference.p_holm < SIGNIFICANT_DIFFERENCE
        and leaves_out_zero(difference.difference.ci95)
    ]


def moved_offsets(decided: Decided) -> list[Difference]:
    """Return the offsets that differ beyond doubt, by a margin or more, the largest first."""
    return [
        difference
        for difference in _beyond_doubt(decided)
        if difference.quantity == "offset" and difference.size >= 1
    ]


def offsets_moved(decided: Decided, verb: str) -> str:
    """Return which joints' offsets moved, as a clause; empty where none did.

    Args:
        verb: :data:`MOVED` or :data:`DIFFERS`.
    """
    moved = moved_offsets(decided)
    parts = [
        f"the offset of {plain(difference.place)} {verb} by {signed_difference(difference)} "
        "between A and B"
        for difference in moved[:MOST]
    ]
    if (more := len(moved) - MOST) > 0:
        parts.append(f"and those of {more} more joints")
    return ", ".join(parts)


def _large(decided: Decided) -> list[str]:
    """Return the joints whose response differs by a margin or more, the largest first."""
    beyond_doubt = _beyond_doubt(decided)
    large = {
        difference.place
        for difference in beyond_doubt
        if difference.quantity in RESPONSE and difference.size >= 1
    }
    return [joint.name for joint in decided.named if joint.name in large]


def _listed(words: Iterable[str]) -> str:
    """Join words, the last one with "and"."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _without(decided: Decided, broken: Sequence[BrokenJoint]) -> Decided:
    """Return the decisions without the broken joints."""
    names = {joint.name for joint in broken}
    return dataclasses.replace(
        decided,
        differences=tuple(
            difference for difference in decided.differences if difference.place not in names
        ),
        named=tuple(joint for joint in decided.named if joint.name not in names),
    )


def difference_text(difference: Difference) -> str:
    """Format a difference with its interval.

    Returns:
        For example ``gain −8.1 % [−8.6, −7.6]``.
    """
    return f"{WORDS[difference.quantity]} {signed_difference(difference)}"


def people_unit(unit: str) -> tuple[float, str]:
    """Return how many of a readable unit make one of a unit, and its text behind a number."""
    units = {
        "rad": (math.degrees(1), "°"),
        "rad/joint": (math.degrees(1), "°/joint"),
        "1": (1.0, ""),
        "s": (1e3, " ms"),
    }
    return units.get(unit, (1.0, f" {unit}"))


def in_people_units(difference: Difference) -> tuple[Estimate, str]:
    """Convert a difference to percent or degrees.

    Returns:
        Percent for gains, amplitudes and frequencies, degrees for lags (of wave numbers a joint),
        the travelling index as it is, and for the others percent of side A.
    """
    if difference.quantity in BY_RATIO:
        return formats.scaled(difference.difference, 100.0), " %"
    factor, unit = people_unit(difference.unit)
    if factor != 1:
        return formats.scaled(difference.difference, factor), unit
    if difference.quantity == "travelling_index":
        return difference.difference, ""
    if difference.a > 0:
        return formats.scaled(difference.difference, 100.0 / difference.a), " %"
    return difference.difference, f" {difference.unit}"


def decimals_of(difference: Difference) -> int:
    """Return the most decimals that a difference is shown with."""
    return 4 if difference.quantity in ("frequency", "travelling_index") else 2


def signed_difference(difference: Difference) -> str:
    """Format a difference in readable units with its sign."""
    return signed(*in_people_units(difference), most=decimals_of(difference))


def signed(quantity: Estimate, unit: str, most: int = 2) -> str:
    """Format a difference with its sign.

    Args:
        quantity: In ``unit``.

    Returns:
        For example ``+1.9° [1.7, 2.1]``.
    """
    text = formats.estimate(quantity, unit, most=most)
    return text if text.startswith(formats.MINUS) else f"+{text}"


def _largest(decided: Decided) -> str:
    """Describe the joint that differs most; else energy or body.

    A joint is named if it differs by a margin or more: of many joints one differs by less in five
    comparisons of a hundred that differ in nothing.
    """
    beyond_doubt = _beyond_doubt(decided)
    if not (named := _large(decided)):
        first = beyond_doubt[0]
        others = len(beyond_doubt) - 1
        more = f"; and {others} more" if others else ""
        where = f"{plain(first.place)}:" if first.size >= 1 else "one joint's"
        where = f"the body's{first.place[len(BODY) + 1 :]}" if of_body(first.place) else where
        return f"{where} {difference_text(first)} ({formats.p_value_text(first.p_holm)}){more}"
    differences = [
        difference
        for difference in beyond_doubt
        if difference.place == named[0] and difference.quantity in RESPONSE
    ]
    parts = ", ".join(
        difference_text(difference)
        for difference in sorted(differences, key=lambda difference: difference.quantity)
    )
    smallest = min(difference.p_holm for difference in differences)
    others = [plain(name) for name in named[1:]]
    listed = ", ".join(others[:MOST])
    listed += f" and {len(others) - MOST} more" if len(others) > MOST else ""
    more = f"; {listed} by less" if others else ""
    return f"{plain(named[0])} most, {parts} ({formats.p_value_text(smallest)}){more}"


def _not_shown(decided: Decided, tests: Sequence[Equivalence]) -> str:
    """Describe how large a hidden difference might be, from the simultaneous intervals.

    Args:
        tests: Those that are to be shown the same; of the body's only what is not is described.
    """
    shown: list[str] = []
    for test in tests:
        if test.quantity not in RESPONSE and test.p < SIGNIFICANT_DIFFERENCE:
            continue
        worst = 0.0
        for difference in decided.differences:
            ends = difference.difference.ci95
            if difference.quantity == test.quantity and ends is not None:
                worst = max(worst, abs(ends[0]), abs(ends[1]))
        shown.append(f"{margin_text(test, worst)} in {WORDS[test.quantity]}")
    return f"up to {' and '.join(shown)} could hide in the noise; record more"


def margin_text(equivalence: Equivalence, value: float | None = None) -> str:
    """Return a difference in readable units, e.g. ``2 %``, ``0.35°`` or ``0.01 J``.

    Args:
        value: In the test's unit; its margin if None.
    """
    factor, unit = people_unit(equivalence.unit)
    if equivalence.quantity in BY_RATIO:
        factor, unit = 100.0, " %"
    return f"{(equivalence.margin if value is None else value) * factor:.2g}{unit}"
