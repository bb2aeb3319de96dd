"""Do the names of the joints fit, or does a permutation of them explain the positions better?

Joint i follows the command of joint j by a delay d and a gain g that all joints share,

    p_i(t) = b_i + g c_j(t - d) + e_i(t),

and the share of its variance that this explains is

    E_ij(d) = 1 - |p_i - g c_j(. - d)|^2 / |p_i|^2 = 1 - (P_i - 2 g X_ij(d) + g^2 C_j) / P_i,

with the powers P and C of positions and commands about their means and their cross power X; below 0
it counts as 0. One gain for all keeps what amplitudes tell. It is the median ratio of the sorted
amplitudes, which no permutation changes and a few faulty joints hardly. For each delay the best
permutation is a linear assignment (Crouse, IEEE Trans. Aerosp. Electron. Syst. 52, 2016, doi
10.1109/TAES.2016.140952, in SciPy). Delays go up to half a period of the commands, as a servo of
two poles lags by 180 degrees at most, or to the longest dead time of a bus.

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
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import DataError, some_names
from .levels import (
    ENOUGH_LIKE,
    FOLLOWS,
    GAIN_MARGIN,
    HALF,
    NEGLIGIBLE,
    QUARTER,
    WHOLE,
)
from .response import LATEST_S

MOVES = NEGLIGIBLE
"""A joint whose standard deviation is below this share of the largest stands still: the share by
which the analysis tells driven joints (``DRIVEN_SHARE``)."""

PER_PERIOD = 16
"""Samples a period that are looked at, at least; finer records are thinned out. Any number above
the two of the sampling theorem will do: 16 leave room for what is faster than the median."""

DELAYS = 2 * PER_PERIOD + 1
"""Delays that are tried in half a period: 5.6 degrees of phase apart, so that the nearest
is within 2.8 degrees, which costs sin^2 = 0.24 % of the explained share."""

LEAST_PERIODS = 2.0
"""Periods that a record must have: over less than two, any two smooth motions are alike."""


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


class Verdict(StrEnum):
    """What commands and positions say of the names."""

    FITS = "fits"
    PERMUTED = "permuted"
    EITHER = "either"
    UNKNOWN = "unknown"


class Kind(StrEnum):
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

    kind: Kind
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

    verdict: Verdict
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
    _check(commands, positions, step_s)
    pairs = _explained_pairs(commands, positions, step_s)
    if pairs is None:
        return Naming(Verdict.UNKNOWN)
    alike = _interchangeable(commands)
    named, *others = _candidates(pairs)
    best = _simplest(pairs, named, others)
    if np.count_nonzero(best.explained >= FOLLOWS) < HALF * np.count_nonzero(pairs.judged):
        return Naming(Verdict.UNKNOWN, interchangeable=alike)
    turned = _inverted(pairs, named, range(pairs.judged.size))
    if turned.delay_s <= best.delay_s and _as_good(turned, best):
        return Naming(Verdict.FITS, (turned,), (), alike)  # one sign for all is simpler
    if best is not named:
        return _permuted(pairs, named, best, alike)
    at_once = np.diagonal(pairs.explained[0])[pairs.judged]
    if np.median(at_once) >= FOLLOWS:
        return Naming(Verdict.FITS, (named,), (), alike)
    # The lag as named is large: names that are shifted would leave a smaller one.
    shifted = [one for one in _shifts(pairs) if one.delay_s < named.delay_s]
    earlier = sorted((one for one in shifted if _as_good(one, named)), key=lambda one: one.delay_s)
    verdict = Verdict.EITHER if earlier else Verdict.FITS
    return Naming(verdict, (*earlier, named), (), alike)


def _permuted(
    pairs: _Pairs, named: Explanation, best: Explanation, alike: tuple[tuple[int, ...], ...]
) -> Naming:
    """Weigh the best permutation against the names as they are."""
    loss = best.explained - named.explained
    moved = np.array(best.moved)
    follow = moved[best.explained[moved] >= FOLLOWS]
    fits = Naming(Verdict.FITS, (named,), (), alike)
    if follow.size < max(2, WHOLE * moved.size) or np.any(loss <= -DECIDES):
        return fits
    decided_by = _deciding(best, named)
    regular = _shifts(pairs)
    along = best.permutation in [one.permutation for one in regular]
    # One joint of another lag can be had by moving many that are next to each other in phase.
    gained = best.explained - np.diagonal(pairs.explained[pairs.delay_s == best.delay_s][0])
    few = decided_by and len(decided_by) < max(2, TELLING * moved.size)
    if not along and (few or np.mean(gained[moved] > AS_GOOD) < WHOLE):
        return fits
    rivals = [one for one in regular if _as_good(one, best)]
    rivals = [one for one in rivals if one.permutation != best.permutation]
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
        rivals.append(replace(named, kind=Kind.OWN_LAGS))
    standing = sorted((best, *rivals), key=lambda one: one.delay_s)
    verdict = Verdict.EITHER if rivals else Verdict.PERMUTED
    return Naming(verdict, tuple(standing), decided_by, alike)


def _fits_in(one: Explanation, joint: int) -> bool:
    """Whether a joint is explained as well as the others: alone it has to be to decide."""
    return float(np.median(one.explained) - one.explained[joint]) <= 2 * AS_GOOD


def _simplest(pairs: _Pairs, named: Explanation, others: Sequence[Explanation]) -> Explanation:
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


def _total(one: Explanation) -> float:
    return float(one.explained.sum())


def _deciding(better: Explanation, other: Explanation) -> tuple[int, ...]:
    """Joints that follow by one explanation, and clearly less by the other."""
    clear = (better.explained >= FOLLOWS) & (better.explained - other.explained > DECIDES)
    return tuple(np.flatnonzero(clear).tolist())


def _as_good(one: Explanation, best: Explanation) -> bool:
    """Whether no joint decides against an explanation, nor do those that differ together."""
    differs = np.array(one.permutation) != np.array(best.permutation)
    loss = best.explained - one.explained
    return not _deciding(best, one) and float(loss[differs].sum()) <= AS_GOOD * differs.sum()


@dataclass(frozen=True)
class _Pairs:
    """What each command explains of each joint.

    Attributes:
        delay_s: Delays [s], shape (k,).
        explained: By delay, joint and command, shape (k, m, m).
        opposite: The same with the opposite gain.
        judged: Joints that move, or are commanded to, shape (m,).
    """

    delay_s: FloatArray
    explained: FloatArray
    opposite: FloatArray
    judged: BoolArray


def _check(commands: FloatArray, positions: FloatArray, step_s: float) -> None:
    if commands.ndim != 2 or commands.shape != positions.shape:
        raise DataError(
            f"commands of shape {commands.shape} and positions of shape {positions.shape}: both "
            "take samples times joints"
        )
    if not (np.isfinite(commands).all() and np.isfinite(positions).all()):
        raise DataError("commands and positions must be finite")
    if not 0 < step_s < np.inf:
        raise DataError(f"a sampling interval of {step_s:g} s is none")


def _explained_pairs(commands: FloatArray, positions: FloatArray, step_s: float) -> _Pairs | None:
    """Return what each command explains of each joint; None where too little moves."""
    count, joints = commands.shape
    if joints < 2 or count < 2 * LEAST_PERIODS * PER_PERIOD:
        return None
    asked, given = _moving(commands), _moving(positions)
    period_s = _median_period_s(commands, step_s)
    if np.count_nonzero(asked) < 2 or not given.any():
        return None
    if not 2 * step_s < period_s <= count * step_s / LEAST_PERIODS:
        return None
    longest_s = max(period_s / 2, min(period_s, LATEST_S))
    tried = int(np.ceil(DELAYS * longest_s / (period_s / 2)))
    delay_s = np.linspace(0.0, longest_s, tried)
    skipped = int(np.ceil(delay_s[-1] / step_s))
    stride = max(1, int(period_s / (PER_PERIOD * step_s)))
    rows: IntArray = np.arange(skipped, count, stride, dtype=np.int64)
    time_s: FloatArray = step_s * np.arange(float(count))
    curve = CubicSpline(time_s, commands)
    given_values = positions[rows] - positions[rows].mean(axis=0)
    power = np.sum(given_values**2, axis=0)
    gain = _common_gain(commands[:, asked], positions[:, given])
    explained = np.empty((delay_s.size, joints, joints))
    opposite = np.empty_like(explained)
    for k, delay in enumerate(delay_s):
        late = curve(time_s[rows] - delay)
        late -= late.mean(axis=0)
        both = gain * (given_values.T @ late)
        left = power[:, None] + gain**2 * np.sum(late**2, axis=0)
        explained[k] = _share(left - 2 * both, power)
        opposite[k] = _share(left + 2 * both, power)
    for table in (explained, opposite):
        table[:, ~given[:, None] | ~asked] = 0.0
        table[:, ~given[:, None] & ~asked] = 1.0
    return _Pairs(delay_s, explained, opposite, asked | given)


def _share(left: FloatArray, power: FloatArray) -> FloatArray:
    """Explained share of each row, at least 0."""
    whole = np.maximum(power, np.finfo(float).tiny)[:, None]
    return 1 - np.minimum(left, whole) / whole


def _moving(values: FloatArray) -> BoolArray:
    size = values.std(axis=0)
    return size > max(MOVES * float(size.max(initial=0.0)), np.finfo(float).eps)


def _common_gain(commands: FloatArray, positions: FloatArray) -> float:
    """Return the median ratio of the sorted amplitudes of what is asked and what is given."""
    asked, given = np.sort(commands.std(axis=0)), np.sort(positions.std(axis=0))
    few = min(asked.size, given.size)  # the largest ones of both
    return float(np.median(given[-few:] / asked[-few:]))


def _median_period_s(commands: FloatArray, step_s: float) -> float:
    """Return one over the frequency below which half of the commands' power is [s]."""
    count = len(commands)
    taper: FloatArray = np.hanning(count)[:, None]
    centred: FloatArray = commands - commands.mean(axis=0)
    power: FloatArray = np.sum(np.abs(np.fft.rfft(taper * centred, axis=0)) ** 2, axis=1)
    half = int(np.count_nonzero(np.cumsum(power) < power.sum() / 2))
    return count * step_s / max(half, 1)


def _candidates(pairs: _Pairs) -> list[Explanation]:
    """Return the names as they are, then the best order of each delay, each at its best delay."""
    count = pairs.judged.size
    favoured = pairs.explained + AS_GOOD * np.eye(count)
    orders: dict[tuple[int, ...], None] = {tuple(range(count)): None}
    for table in favoured:
        order = linear_sum_assignment(table, maximize=True)[1].astype(np.int64)
        orders.setdefault(tuple(map(int, order)))
    return [_explanation(pairs, order) for order in orders]


def _shifts(pairs: _Pairs) -> list[Explanation]:
    """Return the orders that a chain may be read in: shifted along it, nearest first; reversed."""
    joints = list(range(pairs.judged.size))
    steps = sorted(joints[1:], key=lambda step: min(step, len(joints) - step))
    orders = [joints[step:] + joints[:step] for step in steps]
    return [_explanation(pairs, order) for order in (*orders, joints[::-1])]


def _swapped(pairs: _Pairs, names: Sequence[int], first: int, second: int) -> Explanation:
    """Return the names with two joints swapped."""
    order = list(names)
    order[first], order[second] = order[second], order[first]
    return _explanation(pairs, order)


def _explanation(pairs: _Pairs, order: Sequence[int]) -> Explanation:
    """Return an order of the joints at the delay at which it explains most."""
    joints = list(range(pairs.judged.size))
    shares: FloatArray = pairs.explained[:, joints, list(order)]
    best = int(np.argmax(shares.sum(axis=1)))
    kind = Kind.AS_NAMED if list(order) == joints else Kind.PERMUTED
    return Explanation(kind, tuple(order), float(pairs.delay_s[best]), shares[best])


def _inverted(pairs: _Pairs, named: Explanation, which: Iterable[int]) -> Explanation:
    """Return the names as they are, with some joints inverted."""
    joints, turned = list(named.permutation), list(which)
    shares: FloatArray = pairs.explained[:, joints, joints]
    shares[:, turned] = pairs.opposite[:, turned, turned]
    at = int(np.argmax(shares.sum(axis=1)))
    return Explanation(Kind.INVERTED, named.permutation, float(pairs.delay_s[at]), shares[at])


def _interchangeable(commands: FloatArray) -> tuple[tuple[int, ...], ...]:
    """Return the sets of joints whose commands are alike within :data:`AS_GOOD`, by the first."""
    centred = commands - commands.mean(axis=0)
    power = np.sum(centred**2, axis=0)
    moving = _moving(commands)
    sets: list[tuple[int, ...]] = []
    free = moving.copy()
    for k in np.flatnonzero(moving).tolist():
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
    if naming.verdict not in (Verdict.PERMUTED, Verdict.EITHER):
        return ""
    decided = naming.decided_by or next((a.moved for a in naming.alternatives if a.moved), ())
    several = some_names([names[k] for k in decided], NAMED)
    clauses: list[str] = []
    for one in naming.alternatives:
        if one.kind is Kind.AS_NAMED:
            clauses.append(f"all joints lag by {one.delay_s:.3g} s")
        elif one.kind is Kind.INVERTED:
            clauses.append(f"inverted: {several}")
        elif one.kind is Kind.OWN_LAGS:
            clauses.append(f"another lag or gain than the other joints have: {several}")
        else:
            clauses.append(_order_in_words(one.permutation, names))
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
