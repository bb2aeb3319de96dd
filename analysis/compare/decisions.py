"""From two sides' estimates to decisions: one family, ranked, and what is the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..estimators.intervals import EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD, around, equivalence_p
from ..results.comparison import BODY, Difference, Equivalence, NamedJoint
from ..results.estimate import Estimate
from .differences import Differences, Quantities, from_runs, holm, independent, paired
from .side import Key, Seen

SIGNIFICANT = 0.05
"""Family-wise level of the decisions, and level of each equivalence."""

UNITS = {"gain": "1", "lag": "rad", "energy_abs": "J", "speed": "m/s", "cost_of_transport": "1"}
"""What is compared, in this order: of each joint, then of the body."""


@dataclass(frozen=True)
class Margins:
    """Differences below which two sides count as the same.

    Attributes:
        gain: Of ln gain.
        lag_rad: [rad].
        relative: Of energies (as a share of side A's mean over the joints), speed and cost of
            transport.
    """

    gain: float = EQUIVALENT_GAIN
    lag_rad: float = EQUIVALENT_LAG_RAD
    relative: float = 0.05


@dataclass(frozen=True)
class Decided:
    """What was decided.

    Attributes:
        differences: Beyond doubt first, by size, then the others by p.
        named: Joints that answer differently, the largest difference first.
        equivalence: One a quantity.
    """

    differences: tuple[Difference, ...]
    named: tuple[NamedJoint, ...]
    equivalence: tuple[Equivalence, ...]


def family(a: Sequence[Seen], b: Sequence[Seen], joints: Sequence[str]) -> list[Key]:
    """What every session of both sides knows.

    Args:
        a: Sessions of side A.
        b: Sessions of side B.
        joints: Joints in common, head to tail.

    Returns:
        Quantities and where, in the order of ``UNITS``.
    """
    every = [one.estimates for one in (*a, *b)]
    places = (*joints, BODY)
    keys = [(quantity, place) for quantity in UNITS for place in places]
    return [key for key in keys if all(key in known for known in every)]


def differ(
    a: FloatArray, b: FloatArray, *, paired_runs: bool
) -> tuple[Quantities, Quantities, Differences]:
    """Both sides and their difference, from runs.

    Args:
        a: Values of side A, shape (r1, k).
        b: Of side B, shape (r2, k).
        paired_runs: Whether run i of B belongs to run i of A.

    Returns:
        Side A, side B, B minus A.

    Raises:
        UsageError: If there are too few runs.
    """
    first, second = from_runs(a), from_runs(b)
    return first, second, paired(a, b) if paired_runs else independent(first, second)


def estimates_of(side: Sequence[Seen], keys: Sequence[Key], lags_about: FloatArray) -> FloatArray:
    """Estimates of a side as arrays.

    Args:
        side: Its sessions.
        keys: What to take, k.
        lags_about: Lags are taken within pi of these, shape (k,).

    Returns:
        Values, variances and degrees of freedom, shape (3, sessions, k).
    """
    stack = np.array([[one.estimates[key] for key in keys] for one in side]).transpose(2, 0, 1)
    lag = np.array([quantity == "lag" for quantity, _ in keys])
    about = lags_about[lag]
    stack[0][:, lag] = about + np.angle(np.exp(1j * (stack[0][:, lag] - about)))
    return stack


def decide(
    keys: Sequence[Key], a: Quantities, b: Quantities, found: Differences, margins: Margins
) -> Decided:
    """Decide on a family of differences.

    Args:
        keys: What each is, k.
        a: Side A.
        b: Side B.
        found: B minus A.
        margins: What counts as the same.

    Returns:
        The decisions.
    """
    p, adjusted, half = found.p, holm(found.p), found.half
    kinds = np.array([quantity for quantity, _ in keys])
    margin = _margins(kinds, a.value, margins)
    size = np.abs(found.value) / margin
    decisions: list[Difference] = []
    for k, (quantity, place) in enumerate(keys):
        log = quantity == "gain"
        ends = around(float(found.value[k]), float(half[k]))
        decisions.append(
            Difference(
                quantity=quantity,
                place=place,
                unit=UNITS[quantity],
                a=_plain(a.value[k], log=log),
                b=_plain(b.value[k], log=log),
                difference=Estimate(
                    float(np.expm1(found.value[k]) if log else found.value[k]),
                    (float(np.expm1(ends[0])), float(np.expm1(ends[1]))) if log else ends,
                ),
                p=float(p[k]),
                p_holm=float(adjusted[k]),
                size=float(size[k]),
            )
        )
    decisions.sort(key=_rank)
    return Decided(tuple(decisions), _named(decisions), _equivalence(kinds, found, margin))


def _rank(one: Difference) -> tuple[bool, float]:
    beyond_doubt = one.p_holm < SIGNIFICANT
    return (not beyond_doubt, -one.size if beyond_doubt else one.p)


def _plain(value: float, *, log: bool) -> float:
    return float(np.exp(value)) if log else float(value)


def _margins(kinds: np.ndarray, a: FloatArray, margins: Margins) -> FloatArray:
    fixed = {"gain": margins.gain, "lag": margins.lag_rad}
    margin = np.empty(a.size)
    for kind in dict.fromkeys(kinds.tolist()):
        one = kinds == kind
        about = float(np.mean(np.abs(a[one])))
        margin[one] = fixed.get(kind, margins.relative * about) or np.finfo(np.float64).tiny
    return margin


def _named(decisions: Sequence[Difference]) -> tuple[NamedJoint, ...]:
    """A weak module changes what its neighbours do, but less: the largest comes first."""
    parts: dict[str, list[Difference]] = {}
    for one in decisions:
        if one.quantity in ("gain", "lag"):
            parts.setdefault(one.place, []).append(one)
    named = [
        NamedJoint(
            name,
            float(np.hypot.reduce([one.size for one in both])),
            min(one.p_holm for one in both),
        )
        for name, both in parts.items()
        if min(one.p_holm for one in both) < SIGNIFICANT
    ]
    return tuple(sorted(named, key=lambda one: -one.size))


def _equivalence(
    kinds: np.ndarray, found: Differences, margin: FloatArray
) -> tuple[Equivalence, ...]:
    results: list[Equivalence] = []
    for kind in dict.fromkeys(kinds.tolist()):
        one = kinds == kind
        largest = float(np.max(np.abs(found.value[one])))
        within = float(margin[one][0])
        p = equivalence_p(found.value[one], found.error[one], found.dof[one], within)
        results.append(Equivalence(kind, within, UNITS[kind], largest, p))
    return tuple(results)
