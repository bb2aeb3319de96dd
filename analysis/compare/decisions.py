"""From two sides' estimates to decisions: one family, ranked, and what is the same."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..common.estimate import Estimate
from ..estimators.intervals import EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD, around, equivalence_p, holm
from ..results.comparison import Difference, Equivalence, NamedJoint, of_body
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

BY_RATIO = ("gain", "amplitude", "frequency")
_CYCLIC = ("lag", "phase_lag")

MOST = 4
"""Broken or differing joints that the sentence lists at most."""

RESPONSE = ("gain", "lag", "delay", "amplitude", "phase_lag", "rest_amplitude")
"""Quantities of a joint that make it a different one."""

SAME = ("gain", "lag", "delay", "amplitude", "phase_lag", "frequency")
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
        log = quantity in BY_RATIO
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
        unit = "1" if kind in BY_RATIO else UNITS[kind]
        results.append(Equivalence(kind, within, unit, float(np.abs(value).max()), p))
    return tuple(results)
