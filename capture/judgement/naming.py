"""Do the names of the joints fit, or does a permutation of them explain the positions better?

For each delay of :mod:`.pairs` the best permutation is a linear assignment (Crouse, IEEE Trans.
Aerosp. Electron. Syst. 52, 2016, doi 10.1109/TAES.2016.140952, in SciPy).

What one uniform gait can't tell. With c_j(t) = A sin(w t - j psi) the command of joint j + 1 is
that of joint j, later by psi / w: names that are shifted by one joint, and a lag of psi for all,
give the same positions but for the joint at the end, and for it as well if whole waves are on the
body. Both are stated then, but for lags as small as those of sound servos. Where all commands are
in phase or in antiphase, as in a standing wave, two joints swapped and two joints inverted are
stated, unless their amplitudes differ.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations

import numpy as np

from ..common.arrays import FloatArray
from ..common.errors import some_names
from .levels import (
    ENOUGH_LIKE,
    FOLLOWS,
    GAIN_MARGIN,
    HALF,
    QUARTER,
    WHOLE,
)
from .pairs import Pairs, explained_pairs, moving

DECIDES = 1 - FOLLOWS
"""Loss of explained share by which one joint decides between two explanations: that from all of it
to :data:`.levels.FOLLOWS`."""

AS_GOOD = GAIN_MARGIN
"""Mean loss up to which two explanations are alike, and the favour that names have over any other
order: 8 degrees of phase or 12 % of gain, by which healthy joints of one kind may differ."""

SUGGESTS = 2 * AS_GOOD
"""Mean loss of the joints that a permutation moves from which it is stated beside what else they
may be."""

TELLING = QUARTER
"""Share of the joints moved by an order that is no shift and no reversal which must tell it from
the names: whole waves of close joints can be moved up by a little to explain one that is late."""

MOST_PAIRED = ENOUGH_LIKE
"""Joints of which each two are tried as swapped, where so many tell a permutation from the names:
two would do, and two more may be disturbed."""

NAMED = 4
"""Joints that a clause names at most, as a sentence of the answer does."""


class NamingVerdict(StrEnum):
    """What commands and positions say of the names."""

    FITS = "fits"
    PERMUTED = "permuted"
    EITHER = "either"
    UNKNOWN = "unknown"


class ExplanationKind(StrEnum):
    """Kinds of explanation."""

    AS_NAMED = "as named"
    PERMUTED = "permuted"
    INVERTED = "as named, some inverted"
    OWN_LAGS = "as named, with lags or gains of their own"


@dataclass(frozen=True)
class Explanation:
    """One way in which m joints may follow m commands.

    Attributes:
        permutation: Joint k carries out the command of joint ``permutation[k]``, m of them.
        delay_s: Common delay [s].
        explained: Share of each joint's variance that it explains, 0 to 1, shape (m,).
    """

    kind: ExplanationKind
    permutation: tuple[int, ...]
    delay_s: float
    explained: FloatArray

    @property
    def moved(self) -> tuple[int, ...]:
        """Joints that carry out the command of another one."""
        return tuple(k for k, j in enumerate(self.permutation) if k != j)


@dataclass(frozen=True)
class Naming:
    """What commands and positions say of the names of m joints.

    Attributes:
        alternatives: The explanations that stand: one where it is decided, none where nothing can
            be told; that of the least delay comes first.
        decided_by: Joints that tell the permutation from the names as they are.
        interchangeable: Sets of joints whose commands are alike: among them nothing can be told.
    """

    verdict: NamingVerdict
    alternatives: tuple[Explanation, ...] = ()
    decided_by: tuple[int, ...] = ()
    interchangeable: tuple[tuple[int, ...], ...] = ()

    @property
    def permutation(self) -> tuple[int, ...] | None:
        """Joint k carries out the command of joint ``permutation[k]``; None where it is open."""
        return self.alternatives[0].permutation if len(self.alternatives) == 1 else None


def permutation_of(commands: FloatArray, positions: FloatArray, step_s: float) -> Naming:
    """Decide whether a permutation of the joints explains the positions better than their names.

    Args:
        commands: Of m joints at even times [rad], shape (n, m).
        positions: At the same times [rad], shape (n, m).
        step_s: Sampling interval [s].

    Returns:
        The explanations that stand. Names that explain as much as any permutation fit.

    Raises:
        DataError: If the shapes differ, a value isn't finite, or the interval isn't positive.
    """
    pairs = explained_pairs(commands, positions, step_s)
    if pairs is None:
        return Naming(NamingVerdict.UNKNOWN)
    alike = _interchangeable(commands)
    named, *others = _candidates(pairs)
    best = _simplest(pairs, named, others)
    if np.count_nonzero(best.explained >= FOLLOWS) < HALF * np.count_nonzero(pairs.judged):
        return Naming(NamingVerdict.UNKNOWN, interchangeable=alike)
    turned = _inverted(pairs, named, range(pairs.judged.size))
    if turned.delay_s <= best.delay_s and _as_good(turned, best):
        return Naming(NamingVerdict.FITS, (turned,), (), alike)  # one sign for all is simpler
    if best is not named:
        return _permuted(pairs, named, best, alike)
    at_once = np.diagonal(pairs.explained[0])[pairs.judged]
    if np.median(at_once) >= FOLLOWS:
        return Naming(NamingVerdict.FITS, (named,), (), alike)
    # The lag as named is large: names that are shifted would leave a smaller one.
    shifted = [shift for shift in _shifts(pairs) if shift.delay_s < named.delay_s]
    earlier = sorted(
        (shift for shift in shifted if _as_good(shift, named)), key=lambda shift: shift.delay_s
    )
    verdict = NamingVerdict.EITHER if earlier else NamingVerdict.FITS
    return Naming(verdict, (*earlier, named), (), alike)


def _permuted(
    pairs: Pairs, named: Explanation, best: Explanation, alike: tuple[tuple[int, ...], ...]
) -> Naming:
    """Weigh the best permutation against the names as they are."""
    loss = best.explained - named.explained
    moved = np.array(best.moved)
    follow = moved[best.explained[moved] >= FOLLOWS]
    fits = Naming(NamingVerdict.FITS, (named,), (), alike)
    if follow.size < max(2, WHOLE * moved.size) or np.any(loss <= -DECIDES):
        return fits
    decided_by = _deciding(best, named)
    regular = _shifts(pairs)
    along = best.permutation in [shift.permutation for shift in regular]
    # One joint of another lag can be had by moving many that are next to each other in phase.
    gained = best.explained - np.diagonal(pairs.explained[pairs.delay_s == best.delay_s][0])
    few = decided_by and len(decided_by) < max(2, TELLING * moved.size)
    if not along and (few or np.mean(gained[moved] > AS_GOOD) < WHOLE):
        return fits
    rivals = [shift for shift in regular if _as_good(shift, best)]
    rivals = [rival for rival in rivals if rival.permutation != best.permutation]
    if decided_by:
        inverted = _inverted(pairs, named, decided_by)
        lost = best.explained - inverted.explained
        worse = max(float(np.mean(lost)), float(np.mean(lost[list(decided_by)]))) > AS_GOOD
        rivals += [] if worse or _deciding(best, inverted) else [inverted]
        alone = len(decided_by) == 1 and not _fits_in(best, decided_by[0])
    elif float(np.mean(loss[follow])) < SUGGESTS:
        return fits
    else:
        alone = True
    if alone:
        rivals.append(replace(named, kind=ExplanationKind.OWN_LAGS))
    standing = sorted((best, *rivals), key=lambda explanation: explanation.delay_s)
    verdict = NamingVerdict.EITHER if rivals else NamingVerdict.PERMUTED
    return Naming(verdict, tuple(standing), decided_by, alike)


def _fits_in(explanation: Explanation, joint: int) -> bool:
    """Whether a joint is explained as well as the others: alone it has to be to decide."""
    return float(np.median(explanation.explained) - explanation.explained[joint]) <= 2 * AS_GOOD


def _simplest(pairs: Pairs, named: Explanation, others: Sequence[Explanation]) -> Explanation:
    """Return the simplest explanation that is as good as the best one.

    The names as they are come first, then two joints swapped, a shift or the reversal of all, then
    the best order without those of its cycles that explain nothing: joints whose commands are
    nearly alike may change places for nothing but noise.
    """
    best = max((named, *others), key=_total)
    if _as_good(named, best):
        return named
    pairs_of = combinations(_deciding(best, named)[:MOST_PAIRED], 2)
    swaps = [_swapped(pairs, named.permutation, *pair) for pair in pairs_of]
    for simple in (*swaps, *_shifts(pairs)):
        if _as_good(simple, best):
            return simple
    for cycle in _cycles(best.permutation):
        order = list(best.permutation)
        for joint in cycle:
            order[joint] = joint
        simpler = _explanation(pairs, order)
        if _as_good(simpler, best):
            best = simpler
    return best


def _cycles(permutation: Sequence[int]) -> Iterator[list[int]]:
    """Yield the cycles of a permutation that move joints."""
    left = {k for k, j in enumerate(permutation) if k != j}
    while left:
        joint = min(left)
        cycle: list[int] = []
        while joint in left:
            left.remove(joint)
            cycle.append(joint)
            joint = permutation[joint]
        yield cycle


def _total(explanation: Explanation) -> float:
    return float(explanation.explained.sum())


def _deciding(better: Explanation, other: Explanation) -> tuple[int, ...]:
    """Joints that follow by one explanation, and clearly less by the other."""
    clear = (better.explained >= FOLLOWS) & (better.explained - other.explained > DECIDES)
    return tuple(np.flatnonzero(clear).tolist())


def _as_good(explanation: Explanation, best: Explanation) -> bool:
    """Whether no joint decides against an explanation, nor do those that differ together."""
    differs = np.array(explanation.permutation) != np.array(best.permutation)
    loss = best.explained - explanation.explained
    return (
        not _deciding(best, explanation) and float(loss[differs].sum()) <= AS_GOOD * differs.sum()
    )


def _candidates(pairs: Pairs) -> list[Explanation]:
    """Return the names as they are, then the best order of each delay, each at its best delay.

    Where the names explain as much of each joint as any order can, no other is asked for.
    """
    named = _explanation(pairs, range(pairs.judged.size))
    if np.all(named.explained >= 1 - AS_GOOD):
        return [named]
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, when it is needed

    count = pairs.judged.size
    favoured = pairs.explained + AS_GOOD * np.eye(count)
    orders: dict[tuple[int, ...], None] = {tuple(range(count)): None}
    for table in favoured:
        order = linear_sum_assignment(table, maximize=True)[1].astype(np.int64)
        orders.setdefault(tuple(map(int, order)))
    return [_explanation(pairs, order) for order in orders]


def _shifts(pairs: Pairs) -> list[Explanation]:
    """Return the orders that a chain may be read in: shifted along it, nearest first; reversed."""
    joints = list(range(pairs.judged.size))
    steps = sorted(joints[1:], key=lambda step: min(step, len(joints) - step))
    orders = [joints[step:] + joints[:step] for step in steps]
    return [_explanation(pairs, order) for order in (*orders, joints[::-1])]


def _swapped(pairs: Pairs, names: Sequence[int], first: int, second: int) -> Explanation:
    """Return the names with two joints swapped."""
    order = list(names)
    order[first], order[second] = order[second], order[first]
    return _explanation(pairs, order)


def _explanation(pairs: Pairs, order: Sequence[int]) -> Explanation:
    """Return an order of the joints at the delay at which it explains most."""
    joints = list(range(pairs.judged.size))
    shares: FloatArray = pairs.explained[:, joints, list(order)]
    best = int(np.argmax(shares.sum(axis=1)))
    kind = ExplanationKind.AS_NAMED if list(order) == joints else ExplanationKind.PERMUTED
    return Explanation(kind, tuple(order), float(pairs.delay_s[best]), shares[best])


def _inverted(pairs: Pairs, named: Explanation, which: Iterable[int]) -> Explanation:
    """Return the names as they are, with some joints inverted."""
    joints, turned = list(named.permutation), list(which)
    shares: FloatArray = pairs.explained[:, joints, joints]
    shares[:, turned] = pairs.opposite[:, turned, turned]
    at = int(np.argmax(shares.sum(axis=1)))
    return Explanation(
        ExplanationKind.INVERTED, named.permutation, float(pairs.delay_s[at]), shares[at]
    )


def _interchangeable(commands: FloatArray) -> tuple[tuple[int, ...], ...]:
    """Return the sets of joints whose commands are alike within :data:`AS_GOOD`, by the first."""
    centred = commands - commands.mean(axis=0)
    power = np.sum(centred**2, axis=0)
    moves = moving(commands)
    sets: list[tuple[int, ...]] = []
    free = moves.copy()
    for k in np.flatnonzero(moves).tolist():
        if not free[k]:
            continue
        apart = np.sum((centred - centred[:, k : k + 1]) ** 2, axis=0)
        alike = free & (apart <= AS_GOOD * power[k])
        free &= ~alike
        if np.count_nonzero(alike) > 1:
            sets.append(tuple(np.flatnonzero(alike).tolist()))
    return tuple(sets)


def in_words(naming: Naming, names: Sequence[str]) -> str:
    """Say which explanations of the names stand.

    Args:
        names: Of the m joints.

    Returns:
        Clauses with "or" between them; empty where the names fit or nothing can be told.
    """
    if naming.verdict not in (NamingVerdict.PERMUTED, NamingVerdict.EITHER):
        return ""
    decided = naming.decided_by or next((a.moved for a in naming.alternatives if a.moved), ())
    several = some_names([names[k] for k in decided], NAMED)
    clauses: list[str] = []
    for alternative in naming.alternatives:
        if alternative.kind is ExplanationKind.AS_NAMED:
            clauses.append(f"all joints lag by {alternative.delay_s:.3g} s")
        elif alternative.kind is ExplanationKind.INVERTED:
            clauses.append(f"inverted: {several}")
        elif alternative.kind is ExplanationKind.OWN_LAGS:
            clauses.append(f"another lag or gain than the other joints have: {several}")
        else:
            clauses.append(_order_in_words(alternative.permutation, names))
    return ", or ".join(clauses)


def _order_in_words(permutation: Sequence[int], names: Sequence[str]) -> str:
    count, moved = len(permutation), [k for k, j in enumerate(permutation) if k != j]
    if len(moved) == 2:
        return f"{' and '.join(names[k] for k in moved)} carry out each other's command"
    step = permutation[0]
    if list(permutation) == [(k + step) % count for k in range(count)]:
        step = step if 2 * step <= count else step - count
        far = f"{abs(step)} joint{'s' if abs(step) > 1 else ''}"
        return f"the names are shifted by {far}: {names[0]} carries out {names[permutation[0]]}'s"
    if list(permutation) == list(range(count))[::-1]:
        return "the names are in reverse order"
    pairs = [f"{names[k]} carries out {names[permutation[k]]}'s" for k in moved]
    return f"{len(moved)} joints carry out another's command: {some_names(pairs, NAMED)}"
