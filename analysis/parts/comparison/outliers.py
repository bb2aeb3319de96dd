"""Joints that stand out of their chain's profile.

Two searches find which joints belong to the profile: forward selection of joints and shapes, the
largest studentised one first, and least trimmed squares (Rousseeuw, J. Am. Stat. Assoc. 79, 1984)
about a parabola, since two joints that stand out hide each other from the first and a profile of
another shape hides its joints from the second. A joint that stands out leaves the profile, so it
moves no reference of the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import HALF, LEVEL, ROBUST, TINY, WHOLE, reaches

from .profile import (
    ENDS,
    MIDDLE,
    MIN_JOINTS,
    Profile,
    coefficient_weights,
    deviation_weights,
    everyone,
)

FAR = 3.5
"""Robust standard deviations of the others' residuals beyond which a joint stands out."""

MIRRORED = HALF
"""Share of a joint's deviation, or its inverse, that its mirror joint shows, too, in a shape."""

LOCAL = HALF
"""Share of a deviation that a joint shows beside its neighbours at least, out of a profile."""

CHANCE = LEVEL
"""Chance that of joints of equal scatter one is taken to stand out, before the searches choose the
rest that it is held against: with that it is 3 to 5 % for 6 to 13 joints (250 chains each)."""

ROUGH = 2.0
"""Residuals of the rest so many times their standard error are a profile of its own."""

MAX_DEGREE = 4
"""Degree of the polynomials that a sound chain's profile may have."""

SUBSETS = 400
"""Subsets of joints that the trimmed search begins from at most."""


@dataclass(frozen=True)
class Deviation:
    """One joint's deviation from the prediction of the others.

    Attributes:
        value: In the unit of the profile.
    """

    joint: int
    value: float
    error: float


@dataclass
class State:
    """The model while it grows.

    Attributes:
        active: Joints that take part, shape (m,).
        shapes: Columns of the smooth shapes in it, shape (m,) each.
        outside: Joints that stand out, as found.
    """

    active: BoolArray
    shapes: list[FloatArray] = field(default_factory=list[FloatArray])
    outside: list[int] = field(default_factory=list[int])


def standing_out(profile: Profile, critical: float) -> list[Deviation]:
    """Find the joints that stand out.

    Args:
        profile: The profile, of ``MIN_JOINTS`` joints or more.
        critical: Factor on the standard error of simultaneous intervals.

    Returns:
        Their deviations from the prediction of the rest, the largest first.
    """
    trimmed, grown = (
        [
            deviation
            for joint in state.outside
            if (deviation := _kept(profile, state, joint, critical))
        ]
        for state in (_trimmed(profile, critical), _grown(profile, critical))
    )
    # Two that stand out hide each other from the one search, a profile its joints from the other.
    # Where both agree, the shapes that the data ask for predict more closely than a parabola.
    agree = {deviation.joint for deviation in trimmed} == {deviation.joint for deviation in grown}
    deviations = grown if agree or len(grown) > len(trimmed) else trimmed
    return sorted(deviations, key=lambda deviation: -abs(deviation.value))


def _kept(profile: Profile, state: State, joint: int, critical: float) -> Deviation | None:
    deviation = _deviation_of(profile, state, joint)
    return deviation if _stands_out(profile, state, deviation, critical) else None


def _grown(profile: Profile, critical: float) -> State:
    """Forward selection of joints and shapes, the largest studentised one first."""
    state = State(everyone(profile))
    columns = _smooth_columns(profile)
    most_shapes = min(len(columns), max(0, (profile.values.size - MIN_JOINTS) // 2))
    while True:
        joint, score = _worst(profile, state, critical)
        column, shape_score = _steepest(profile, state, columns)
        if joint is not None and score >= shape_score:
            state.active[joint] = False
            state.outside.append(joint)
        elif column is not None and shape_score > critical and len(state.shapes) < most_shapes:
            state.shapes.append(column)
            state.active[state.outside] = True  # judged again beside the shape
            state.outside.clear()
        elif joint is not None:
            state.active[joint] = False
            state.outside.append(joint)
        else:
            break
        if np.count_nonzero(state.active) < max(MIN_JOINTS - 1, profile.values.size // 2):
            break
    return state


def _trimmed(profile: Profile, critical: float) -> State:
    """Least trimmed squares, then all joints that its scatter allows, the nearest first."""
    m = profile.values.size
    columns = _smooth_columns(profile)[: 2 if m >= ENDS + MIDDLE else 1 if m >= MIDDLE else 0]
    state = State(_core(profile, columns), columns)
    while not state.active.all():
        ratio = np.where(state.active, np.inf, _excess(profile, state, critical))
        nearest = int(np.argmin(ratio))
        if ratio[nearest] > 1:
            break
        state.active[nearest] = True
    if np.count_nonzero(~state.active) <= max(1, int((1 - WHOLE) * m)):
        state.outside.extend(np.flatnonzero(~state.active).tolist())
    return state


def _core(profile: Profile, columns: Sequence[FloatArray]) -> BoolArray:
    """Return the half of the joints whose squared residuals from one fit have the least sum."""
    m, p = profile.values.size, 1 + len(columns)
    half = (m + p + 1) // 2
    design = np.stack([np.ones(m), *columns], axis=1)
    subsets = _subsets(m, p)
    for _ in range(2 + 1):  # concentration (Rousseeuw and Van Driessen, 2006)
        square = _squares(design, profile.values, subsets)
        subsets = np.argpartition(square, half - 1)[:, :half]
    square = np.take_along_axis(_squares(design, profile.values, subsets), subsets, axis=1)
    return np.isin(np.arange(m), subsets[int(np.argmin(square.sum(axis=1)))])


@cache
def _subsets(joints: int, size: int) -> IntArray:
    """All subsets, or as many random ones as are tried at most, shape (s, size)."""
    if math.comb(joints, size) <= SUBSETS:
        return np.array(list(combinations(range(joints), size)))
    return np.stack([np.random.default_rng(k).permutation(joints)[:size] for k in range(SUBSETS)])


def _squares(design: FloatArray, values: FloatArray, subsets: IntArray) -> FloatArray:
    """Return the squared residuals of all joints from the fit to each subset, shape (s, m)."""
    some: FloatArray = design[subsets]
    inverse = np.linalg.pinv(some, rtol=max(some.shape[1:]) * float(np.finfo(np.float64).eps))
    fit = (inverse @ values[subsets][..., np.newaxis])[..., 0]
    return np.asarray((values - fit @ design.T) ** 2, dtype=np.float64)


def _excess(profile: Profile, state: State, critical: float) -> FloatArray:
    """Return the deviations of all joints by what noise and scatter of the present rest explain."""
    rows = deviation_weights(profile, state.active, state.shapes)
    index = np.flatnonzero(state.active)
    spare = index.size - 1 - len(state.shapes)
    if spare < 1:
        return np.zeros(len(rows))
    deviation = rows @ profile.values
    reach = np.maximum(np.sqrt(np.sum(rows**2, axis=1)), TINY)
    scatter = _limit(profile, spare) * _scatter((deviation / reach)[index], rows, index, spare)
    explained = np.maximum(critical * np.sqrt(profile.scatter.variance(rows)), scatter * reach)
    return np.abs(deviation) / np.maximum(explained, TINY)


def _deviation_of(profile: Profile, state: State, joint: int) -> Deviation:
    """A joint's deviation from the prediction of those that are left."""
    row = deviation_weights(profile, state.active, state.shapes)[joint]
    variance = float(profile.scatter.variance(row[None, :])[0])
    return Deviation(joint, float(row @ profile.values), math.sqrt(variance))


def _worst(profile: Profile, state: State, critical: float) -> tuple[int | None, float]:
    """The joint that stands out most beside the present model, and its studentised deviation."""
    rows = deviation_weights(profile, state.active, state.shapes)
    value = rows @ profile.values
    error = np.sqrt(profile.scatter.variance(rows))
    score = np.where(state.active, np.abs(value) / np.maximum(error, TINY), 0.0)
    for joint in np.argsort(-score).tolist():
        if score[joint] <= critical:
            break
        deviation = Deviation(joint, float(value[joint]), float(error[joint]))
        if _stands_out(profile, state, deviation, critical):
            return joint, float(score[joint])
    return None, 0.0


def _steepest(
    profile: Profile, state: State, columns: Sequence[FloatArray]
) -> tuple[FloatArray | None, float]:
    """Return the shape that the present model lacks most, and its studentised coefficient."""
    best: FloatArray | None = None
    largest = 0.0
    basis = [np.ones(profile.values.size), *state.shapes]
    weight = np.where(state.active, profile.precision, 0.0)
    for column in columns:
        if any(column is shape for shape in state.shapes):
            continue
        row = coefficient_weights(column, basis, weight)
        if row is None:
            continue
        error = math.sqrt(float(profile.scatter.variance(row[None, :])[0]))
        score = abs(float(row @ profile.values)) / max(error, TINY)
        if score > largest:
            best, largest = column, score
    return best, largest


def _smooth_columns(profile: Profile) -> list[FloatArray]:
    """Polynomials along the chain, and the two ends: shapes that a sound chain may have."""
    x = profile.along
    columns = [np.asarray(x**degree) for degree in range(1, MAX_DEGREE + 1)]
    if profile.count >= ENDS + MIDDLE:
        columns.append(np.isclose(np.abs(x), 1).astype(np.float64))
    return columns


def _stands_out(profile: Profile, state: State, deviation: Deviation, critical: float) -> bool:
    """Return whether a deviation reaches the margin and exceeds the others' residuals."""
    if not reaches(abs(deviation.value), critical * deviation.error, profile.margin):
        return False
    others = state.active.copy()
    others[deviation.joint] = False
    index = np.flatnonzero(others)
    rows = deviation_weights(profile, others, state.shapes)
    # Of equal scatter, a deviation has that of its weights: more at an end, where a shape leads on.
    reach = np.maximum(np.sqrt(np.sum(rows**2, axis=1)), TINY)
    residual = (rows @ profile.values / reach)[index]
    spare = index.size - 1 - len(state.shapes)
    centred = np.abs(residual - np.median(residual))
    robust = ROBUST * float(np.median(centred)) * np.sqrt(index.size / max(spare, 1))
    size = abs(deviation.value) / float(reach[deviation.joint])
    if spare < 1 or size <= FAR * robust:
        return False
    typical = float(np.median(np.sqrt(profile.scatter.variance(rows[index]))))
    scatter = _scatter(residual, rows, index, spare)
    smooth = scatter <= ROUGH * typical  # the model explains the rest down to its noise
    if smooth and not state.shapes:
        return True
    limit = _limit(profile, spare) * scatter
    return size > limit and _out_of_profile(profile, index, deviation, rows, smooth=smooth)


def _scatter(residual: FloatArray, rows: FloatArray, others: IntArray, spare: int) -> float:
    """Return the standard deviation of the joints that take part, from studentised residuals.

    The leave-one-out residuals are e / (1 - h) with weights of norm (1 - h)^-1/2.
    """
    norm = np.maximum(np.sqrt(np.sum(rows[others] ** 2, axis=1)), TINY)
    return float(np.sqrt(np.sum((residual / norm) ** 2) / spare))


def _limit(profile: Profile, spare: int) -> float:
    """Standard deviations that few of equally scattered joints exceed, by Student's t."""
    return -float(stdtrit(spare, CHANCE / (2 * profile.values.size)))


def _out_of_profile(
    profile: Profile, others: IntArray, deviation: Deviation, rows: FloatArray, *, smooth: bool
) -> bool:
    """Return whether a joint stands out of a rest that has a profile of its own.

    It stands out beside its neighbours, too; at an end of a rest that is not smooth, where its
    prediction is an extrapolation, it leaves the others' range; and its mirror joint does not show
    about the same.
    """
    reach = float(np.ptp(profile.values[others]))
    beside = _beside_neighbours(profile, others, deviation.joint)
    place = profile.place
    first, last = place[others].min(), place[others].max()
    extrapolated = not first <= place[deviation.joint] <= last and abs(deviation.value) <= reach
    if (extrapolated and not smooth) or min(value / deviation.value for value in beside) < LOCAL:
        return False
    mirror = np.flatnonzero(profile.place == profile.count - 1 - profile.place[deviation.joint])
    if not mirror.size or mirror[0] == deviation.joint:
        return True
    partner = int(mirror[0])
    by_model = float(rows[partner] @ profile.values)
    rest = others[others != partner]
    beside = _beside_neighbours(profile, rest, partner)
    shown = [value / deviation.value for value in (by_model, *beside)]
    if not any(MIRRORED <= abs(share) <= 1 / MIRRORED for share in shown):
        return True
    # A shape of the body has its flanks: inside of the ends, a pair that the joints on both sides
    # don't follow is two joints.
    inner = first < place[deviation.joint] < last and first < place[partner] < last
    away = (*_beside_neighbours(profile, rest, deviation.joint), *beside)
    return bool(inner) and min(value / deviation.value for value in away) > 1 - LOCAL


def _beside_neighbours(profile: Profile, others: IntArray, joint: int) -> tuple[float, ...]:
    """A joint's deviation from the line of its neighbours; at an end also from the nearest."""
    place, values = profile.place, profile.values
    position = float(place[joint])
    below = others[place[others] < position]
    above = others[place[others] > position]
    if below.size and above.size:
        left, right = int(below[-1]), int(above[0])
        share = (position - place[left]) / (place[right] - place[left])
        return (float(values[joint] - (1 - share) * values[left] - share * values[right]),)
    near = (above if above.size else below[::-1])[:2]
    flat = float(values[joint] - values[near[0]])
    if near.size < 2:
        return (flat,)
    slope = (values[near[0]] - values[near[1]]) / (place[near[0]] - place[near[1]])
    return flat, flat - float(slope * (position - place[near[0]]))
