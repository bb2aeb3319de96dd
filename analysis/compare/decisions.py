"""From two sides' estimates to decisions: one family, ranked, and what is the same."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import plain

from ..common import formats
from ..common.estimate import Estimate, leaves_out_zero
from ..estimators.intervals import EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD, around, equivalence_p, holm
from ..results.comparison import BODY, BrokenJoint, Difference, Equivalence, NamedJoint, of_body
from .quantities import Differences, Key, Quantities, from_runs, independent, paired
from .side import ComparedSession

SIGNIFICANT_DIFFERENCE = 0.05
"""Family-wise level of the decisions, and level of each equivalence."""

_COMPARED = {
    "gain": ("gain", "1"),
    "lag": ("lag", "rad"),
    "delay": ("lag", "s"),
    "offset": ("offset", "rad"),
    "amplitude": ("amplitude", "rad"),
    "phase_lag": ("phase lag", "rad"),
    "rest_amplitude": ("amplitude near rest", "rad"),
    "energy_abs": ("E_abs per cycle", "J"),
    "speed": ("speed", "m/s"),
    "cost_of_transport": ("cost of transport", "1"),
    "frequency": ("frequency", "Hz"),
    "wave_number": ("wave number", "rad/joint"),
    "travelling_index": ("travelling index", "1"),
}
"""Name and unit of what is compared, in this order: of each joint, then of the body."""

WORDS = {quantity: name for quantity, (name, _) in _COMPARED.items()}
UNITS = {quantity: unit for quantity, (_, unit) in _COMPARED.items()}

_BY_RATIO = ("gain", "amplitude", "frequency")
_CYCLIC = ("lag", "phase_lag")

MOST = 4
"""Broken or differing joints that the sentence lists at most."""

RESPONSE = ("gain", "lag", "delay", "amplitude", "phase_lag", "rest_amplitude")
"""Quantities of a joint that make it a different one."""

_SAME = ("gain", "lag", "delay", "amplitude", "phase_lag", "frequency")
"""Quantities that two sides have in common if they are the same; other waves follow from them."""

MOVED, DIFFERS = "moved", "differs"
"""What an offset does between two sessions of one robot with the same commands, and of others."""


@dataclass(frozen=True)
class Margins:
    """Differences below which two sides count as the same.

    Attributes:
        gain: Of amplitudes, too.
        lag_rad: Of phase lags, offsets and wave numbers (a joint), too [rad]; of lags in seconds
            the time in which the fastest command moves by it.
        relative: Of energies (as a share of side A's mean over the joints), speed, cost of
            transport and frequency; of the travelling index itself.
    """

    gain: float = EQUIVALENT_GAIN
    lag_rad: float = EQUIVALENT_LAG_RAD
    relative: float = 0.05


@dataclass(frozen=True)
class Decided:
    """Decisions on a family of differences.

    Attributes:
        differences: Beyond doubt first, by size, then the others by p.
        named: Joints that answer differently, the largest difference first.
    """

    differences: tuple[Difference, ...]
    named: tuple[NamedJoint, ...]
    equivalence: tuple[Equivalence, ...]


def family(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession], joints: Sequence[str]
) -> list[Key]:
    """List the quantities that every session of both sides has.

    Args:
        joints: Joints in common, head to tail.

    Returns:
        Quantities and where, in the order of ``UNITS``; those of joints near rest, too.
    """
    every = [session.estimates for session in (*a, *b)]
    others = [
        place for quantity, place in every[0] if quantity == "rest_amplitude" or of_body(place)
    ]
    keys = itertools.product(UNITS, dict.fromkeys((*joints, *others)))
    return [key for key in keys if all(key in estimates for estimates in every)]


def differ(
    a: Sequence[Quantities], b: Sequence[Quantities], design: str
) -> tuple[Quantities, Quantities, Differences]:
    """Return both sides and their difference.

    Args:
        a: k quantities of each session of side A.
        b: Of each session of side B.
        design: ``sessions``, ``groups`` or ``pairs``; see :class:`Comparison`.

    Returns:
        Side A, side B, B minus A.

    Raises:
        UsageError: If there are too few runs.
    """
    if design == "sessions":
        return a[0], b[0], independent(a[0], b[0])
    runs = [np.stack([quantities.value for quantities in side]) for side in (a, b)]
    first, second = (from_runs(run) for run in runs)
    return first, second, paired(*runs) if design == "pairs" else independent(first, second)


def estimates_of(
    side: Sequence[ComparedSession], keys: Sequence[Key], lags_about: FloatArray
) -> list[Quantities]:
    """Return the estimates of each session of a side.

    Args:
        keys: Quantities to take, k.
        lags_about: Lags are taken within pi of these, shape (k,).
    """
    stack = np.array([[session.estimates[key] for key in keys] for session in side]).transpose(
        2, 0, 1
    )
    lag = np.array([quantity in _CYCLIC for quantity, _ in keys])
    about = lags_about[lag]
    stack[0][:, lag] = about + np.angle(np.exp(1j * (stack[0][:, lag] - about)))
    return [Quantities(*stack[:, k]) for k in range(len(side))]


def decide(
    keys: Sequence[Key],
    a: Quantities,
    b: Quantities,
    differences: Differences,
    margins: Margins,
    *,
    before: Mapping[str, str] | None = None,
    rate_rad_s: float = 1.0,
) -> Decided:
    """Decide on a family of differences.

    Args:
        keys: What each is, k.
        margins: What counts as the same.
        before: The joint that each joint's phase lag is taken to.
        rate_rad_s: Rate of the fastest command whose lag is in seconds [rad/s].
    """
    p, adjusted, half = differences.p, holm(differences.p), differences.half
    kinds = np.array([quantity for quantity, _ in keys])
    margin = _margins(kinds, a.value, margins, rate_rad_s)
    size = np.abs(differences.value) / margin
    decisions: list[Difference] = []
    for k, (quantity, place) in enumerate(keys):
        log = quantity in _BY_RATIO
        ends = around(float(differences.value[k]), float(half[k]))
        decisions.append(
            Difference(
                quantity=quantity,
                place=place,
                unit=UNITS[quantity],
                a=_plain(a.value[k], log=log),
                b=_plain(b.value[k], log=log),
                difference=Estimate(
                    float(np.expm1(differences.value[k]) if log else differences.value[k]),
                    (float(np.expm1(ends[0])), float(np.expm1(ends[1]))) if log else ends,
                ),
                p=float(p[k]),
                p_holm=float(adjusted[k]),
                size=float(size[k]),
            )
        )
    decisions.sort(key=_rank)
    named = _named(decisions, before or {})
    return Decided(tuple(decisions), named, _equivalence(kinds, differences, margin))


def _rank(difference: Difference) -> tuple[bool, float]:
    beyond_doubt = difference.p_holm < SIGNIFICANT_DIFFERENCE
    return (not beyond_doubt, -difference.size if beyond_doubt else difference.p)


def _plain(value: float, *, log: bool) -> float:
    return float(np.exp(value)) if log else float(value)


def _margins(kinds: np.ndarray, a: FloatArray, margins: Margins, rate_rad_s: float) -> FloatArray:
    fixed = {"gain": margins.gain, "amplitude": margins.gain, "frequency": margins.relative}
    fixed |= dict.fromkeys((*_CYCLIC, "offset", "wave_number"), margins.lag_rad)
    fixed["delay"] = margins.lag_rad / rate_rad_s
    fixed |= {"travelling_index": margins.relative, "rest_amplitude": margins.lag_rad}
    margin = np.empty(a.size)
    for kind in dict.fromkeys(kinds.tolist()):
        mask = kinds == kind
        about = float(np.mean(np.abs(a[mask])))
        margin[mask] = fixed.get(kind, margins.relative * about) or np.finfo(np.float64).tiny
    return margin


def _named(decisions: Sequence[Difference], before: Mapping[str, str]) -> tuple[NamedJoint, ...]:
    """List the joints that differ, the largest first: a weak module changes its neighbours less."""
    parts: dict[str, list[Difference]] = {}
    follows = _follow(decisions, before)
    for decision in decisions:
        if decision.quantity in RESPONSE and (
            decision.quantity != "phase_lag" or decision.place not in follows
        ):
            parts.setdefault(decision.place, []).append(decision)
    named = [
        NamedJoint(name, float(np.hypot.reduce([decision.size for decision in both])), least)
        for name, both in parts.items()
        if (least := min(decision.p_holm for decision in both)) < SIGNIFICANT_DIFFERENCE
    ]
    return tuple(sorted(named, key=lambda joint: -joint.size))


def _follow(decisions: Sequence[Difference], before: Mapping[str, str]) -> set[str]:
    """Find the joints whose phase lag differs only because that of the joint before it does.

    A joint that is late by itself adds to its own lag what it takes off that of the next one.
    """
    lags = {
        decision.place: decision.difference.value or 0.0
        for decision in decisions
        if decision.quantity == "phase_lag" and decision.p_holm < SIGNIFICANT_DIFFERENCE
    }
    following: set[str] = set()
    for joint, last in before.items():  # in chain order
        if joint in lags and last in lags and last not in following:
            lag, other = lags[joint], lags[last]
            if lag * other < 0 and abs(lag + other) < min(abs(lag), abs(other)) / 2:
                following.add(joint)
    return following


def _equivalence(
    kinds: np.ndarray, differences: Differences, margin: FloatArray
) -> tuple[Equivalence, ...]:
    results: list[Equivalence] = []
    for kind in dict.fromkeys(kinds.tolist()):
        mask = kinds == kind
        value, within = differences.value[mask], float(margin[mask][0])
        p = equivalence_p(value, differences.error[mask], differences.dof[mask], within)
        unit = "1" if kind in _BY_RATIO else UNITS[kind]
        results.append(Equivalence(kind, within, unit, float(np.abs(value).max()), p))
    return tuple(results)


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
    required = (*_SAME, "offset") if "delay" in tests else _SAME
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
    if difference.quantity in _BY_RATIO:
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
    if equivalence.quantity in _BY_RATIO:
        factor, unit = 100.0, " %"
    return f"{(equivalence.margin if value is None else value) * factor:.2g}{unit}"
