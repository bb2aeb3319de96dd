"""Joints that stand out of their chain's profile, and the shape that the rest of it has.

The profile of one quantity (log gain or lag) over the driven joints of one plane is a common
value, a shape along the body, and single joints that depart from both. They are found together,
the largest studentised one first (forward selection): a joint's departure is its deviation from
the prediction of all others (leave-one-out residual of weighted least squares), a shape's size is
its coefficient. A joint that stands out leaves the profile, so it moves no reference of the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from capture.arrays import BoolArray, FloatArray, IntArray

from .family import Member, Scatter

ROBUST = 3.5
"""Robust standard deviations of the others' residuals beyond which a joint stands out."""

MIRRORED = 1 / 3
"""Share of a joint's deviation that its mirror joint shows, too, where both belong to a shape."""

LOCAL = 0.5
"""Share of a deviation that a joint shows beside its neighbours at least, out of a profile."""

ROUGH = 2.0
"""Residuals of the rest so many times their standard error are a profile of its own."""

MIN_JOINTS = 4
"""Fewer sound joints can't say which of them differs."""

NOISIER = 3.0
"""Variance, in medians of all joints', from which a joint counts less."""

ENDS, MIDDLE = 2, 5
MAX_DEGREE = 4


@dataclass(frozen=True)
class Profile:
    """One quantity over the sound joints of one plane.

    Attributes:
        place: Index of each joint among the plane's commanded joints, head to tail, shape (m,).
        count: Commanded joints of the plane.
        values: Log gain, or lag [rad], shape (m,).
        scatter: Errors of the values.
        margin: Deviations below this are of no interest, in the unit of the values.
    """

    place: FloatArray
    count: int
    values: FloatArray
    scatter: Scatter
    margin: float

    @property
    def along(self) -> FloatArray:
        """Place along the chain from -1 (head) to 1 (tail), shape (m,)."""
        return 2 * self.place / max(self.count - 1, 1) - 1

    @property
    def precision(self) -> FloatArray:
        """Weights of least squares: a joint much noisier than most counts less, shape (m,).

        Weights that follow the estimated variances closely would favour those that happen to be
        estimated too small, and make intervals too narrow.
        """
        own = self.scatter.variance(np.eye(self.values.size))
        return 1 / np.maximum(own, max(NOISIER * float(np.median(own)), 1e-300))


@dataclass(frozen=True)
class Deviation:
    """One joint's deviation from the prediction of the others.

    Attributes:
        joint: Index into the profile.
        value: In the unit of the profile.
        error: Its standard error.
    """

    joint: int
    value: float
    error: float


@dataclass(frozen=True)
class Contrast:
    """One number about the shape of the rest.

    Attributes:
        kind: ``ends`` (end joints minus middle joints), ``trend`` (tail minus head, by the
            regression line), ``mirror`` (outer minus inner half, symmetric to the middle) or
            ``each`` (largest deviation of a joint from the common value).
        value: In the unit of the profile.
        error: Its standard error.
        joint: For ``each``: index into the profile.
    """

    kind: str
    value: float
    error: float
    joint: int | None = None


@dataclass
class _State:
    """The model while it grows."""

    active: BoolArray
    shapes: list[FloatArray] = field(default_factory=list[FloatArray])
    outside: list[int] = field(default_factory=list[int])


def family_of(profile: Profile) -> Member:
    """All contrasts that a profile adds to the family of an answer.

    Args:
        profile: The profile.

    Returns:
        The deviation of each joint from the others, and the shapes.
    """
    weights = [*_deviation_weights(profile, _all(profile), [])]
    weights += [row for _, row in shape_weights(profile, _all(profile))]
    return Member(np.asarray(weights).reshape(-1, profile.values.size), profile.scatter)


def standing_out(profile: Profile, critical: float) -> list[Deviation]:
    """Find the joints that stand out.

    Args:
        profile: The profile, of ``MIN_JOINTS`` joints or more.
        critical: Factor on the standard error of simultaneous intervals.

    Returns:
        Their deviations from the prediction of the rest, the largest first.
    """
    state = _State(_all(profile))
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
    found = [_deviation(profile, state, joint) for joint in state.outside]
    kept = [each for each in found if _stands_out(profile, state, each, critical)]
    return sorted(kept, key=lambda each: -abs(each.value))


def shape_weights(profile: Profile, active: BoolArray) -> list[tuple[str, FloatArray]]:
    """Weights of the shapes' contrasts on the joints that take part.

    Args:
        profile: The profile.
        active: Joints that take part, shape (m,).

    Returns:
        Kind and weights, shape (m,); those for which there are joints enough.
    """
    size = profile.values.size
    found: list[tuple[str, FloatArray]] = []
    x = profile.along
    index = np.flatnonzero(active)
    if index.size < 3:
        return found
    if profile.count >= ENDS + MIDDLE and index.size >= ENDS + 2:
        distance = np.abs(x)
        outer = active & (distance > 1 - 1e-9)
        inner = active & (distance < (MIDDLE + 1) / max(profile.count - 1, 1) - 1e-9)
        if np.count_nonzero(outer) == ENDS and inner.any():
            row = outer / np.count_nonzero(outer) - inner / np.count_nonzero(inner)
            found.append(("ends", row.astype(np.float64)))
    weight = np.where(active, profile.precision, 0.0)
    for kind, column, span in (("trend", x, 2.0), ("mirror", np.abs(x), 0.5)):
        basis = [np.ones(size)] if kind == "trend" else [np.ones(size), x]
        if index.size > len(basis) + 1:
            row = _coefficient(column, basis, weight)
            if row is not None:
                found.append((kind, span * row))
    return found


def contrasts(profile: Profile, active: BoolArray) -> list[Contrast]:
    """The shape of the joints that take part.

    Args:
        profile: The profile.
        active: Joints that take part, shape (m,).

    Returns:
        Each shape's contrast, then the largest studentised deviation of one joint.
    """
    found: list[Contrast] = []
    for kind, row in shape_weights(profile, active):
        variance = float(profile.scatter.variance(row[None, :])[0])
        found.append(Contrast(kind, float(row @ profile.values), variance**0.5))
    if np.count_nonzero(active) > 1:
        rows = _deviation_weights(profile, active, [])
        index = np.flatnonzero(active)
        value = rows[index] @ profile.values
        error = np.sqrt(profile.scatter.variance(rows[index]))
        k = int(np.argmax(np.abs(value) / np.maximum(error, 1e-300)))
        found.append(Contrast("each", float(value[k]), float(error[k]), int(index[k])))
    return found


def _all(profile: Profile) -> BoolArray:
    return np.ones(profile.values.size, dtype=np.bool_)


def _design(shapes: Sequence[FloatArray], size: int) -> FloatArray:
    return np.stack([np.ones(size), *shapes], axis=1)


def _deviation_weights(
    profile: Profile, active: BoolArray, shapes: Sequence[FloatArray]
) -> FloatArray:
    """Weights whose sum over the values is each joint minus the others' prediction, (m, m)."""
    size = profile.values.size
    design = _design(shapes, size)
    weight = np.where(active, profile.precision, 0.0)
    hat = design @ np.linalg.pinv(design.T @ (weight[:, None] * design)) @ (design.T * weight)
    # Of a joint that takes part, the leave-one-out residual: (1 - h_ii)^-1 of the residual.
    lever = np.where(active, np.diag(hat), 0.0)
    rows = (np.eye(size) - hat) / np.maximum(1 - lever, 1e-9)[:, None]
    return np.asarray(rows, dtype=np.float64)


def _coefficient(
    column: FloatArray, basis: Sequence[FloatArray], weight: FloatArray
) -> FloatArray | None:
    """Weights of a column's coefficient beside a basis, by weighted least squares, shape (m,)."""
    design = np.stack(basis, axis=1)
    solve = np.linalg.pinv(design.T @ (weight[:, None] * design)) @ (design.T * weight)
    rest = column - design @ (solve @ column)
    power = float(rest @ (weight * rest))
    if power <= 1e-12 * float(weight.sum()):
        return None
    return np.asarray(weight * rest / power, dtype=np.float64)


def _smooth_columns(profile: Profile) -> list[FloatArray]:
    """Polynomials along the chain, and the two ends: shapes that a sound chain may have."""
    x = profile.along
    columns = [np.asarray(x**degree) for degree in range(1, MAX_DEGREE + 1)]
    if profile.count >= ENDS + MIDDLE:
        columns.append((np.abs(x) > 1 - 1e-9).astype(np.float64))
    return columns


def _deviation(profile: Profile, state: _State, joint: int) -> Deviation:
    """A joint's deviation from the prediction of those that are left."""
    row = _deviation_weights(profile, state.active, state.shapes)[joint]
    variance = float(profile.scatter.variance(row[None, :])[0])
    return Deviation(joint, float(row @ profile.values), variance**0.5)


def _worst(profile: Profile, state: _State, critical: float) -> tuple[int | None, float]:
    """The joint that stands out most beside the present model, and its studentised deviation."""
    rows = _deviation_weights(profile, state.active, state.shapes)
    value = rows @ profile.values
    error = np.sqrt(profile.scatter.variance(rows))
    score = np.where(state.active, np.abs(value) / np.maximum(error, 1e-300), 0.0)
    for joint in np.argsort(-score).tolist():
        if score[joint] <= critical:
            break
        one = Deviation(joint, float(value[joint]), float(error[joint]))
        if _stands_out(profile, state, one, critical):
            return joint, float(score[joint])
    return None, 0.0


def _steepest(
    profile: Profile, state: _State, columns: Sequence[FloatArray]
) -> tuple[FloatArray | None, float]:
    """The shape that the present model lacks most, and its studentised coefficient."""
    best: FloatArray | None = None
    largest = 0.0
    basis = [np.ones(profile.values.size), *state.shapes]
    weight = np.where(state.active, profile.precision, 0.0)
    for column in columns:
        if any(column is shape for shape in state.shapes):
            continue
        row = _coefficient(column, basis, weight)
        if row is None:
            continue
        error = float(profile.scatter.variance(row[None, :])[0]) ** 0.5
        score = abs(float(row @ profile.values)) / max(error, 1e-300)
        if score > largest:
            best, largest = column, score
    return best, largest


def _stands_out(profile: Profile, state: _State, one: Deviation, critical: float) -> bool:
    """Whether a deviation exceeds its interval, the margin and the others' residuals."""
    if abs(one.value) <= max(critical * one.error, profile.margin):
        return False
    others = state.active.copy()
    others[one.joint] = False
    index = np.flatnonzero(others)
    rows = _deviation_weights(profile, others, state.shapes)
    # Of equal scatter, a deviation has that of its weights: more at an end, where a shape leads on.
    reach = np.sqrt(np.sum(rows**2, axis=1))
    residual = (rows @ profile.values / reach)[index]
    parameters = 1 + len(state.shapes)
    spare = max(index.size - parameters, 1)
    centred = np.abs(residual - np.median(residual))
    robust = 1.4826 * float(np.median(centred)) * (index.size / spare) ** 0.5
    if abs(one.value) <= ROBUST * robust * reach[one.joint]:
        return False
    typical = float(np.median(np.sqrt(profile.scatter.variance(rows[index]))))
    if robust <= ROUGH * typical and not state.shapes:
        return True
    return _out_of_profile(profile, index, one, rows)


def _out_of_profile(profile: Profile, others: IntArray, one: Deviation, rows: FloatArray) -> bool:
    """Whether a joint stands out of a rest that has a profile of its own.

    It stands out beside its neighbours, too; at an end, where its prediction is an extrapolation,
    it leaves the others' range; and its mirror joint does not show a third of the same.
    """
    reach = float(np.ptp(profile.values[others]))
    beside = _beside_neighbours(profile, others, one.joint)
    extrapolated = _at_an_end(profile, others, one.joint) and abs(one.value) <= reach
    if extrapolated or min(each / one.value for each in beside) < LOCAL:
        return False
    mirror = np.flatnonzero(profile.place == profile.count - 1 - profile.place[one.joint])
    if not mirror.size or mirror[0] == one.joint:
        return True
    partner = int(mirror[0])
    by_model = float(rows[partner] @ profile.values)
    beside = _beside_neighbours(profile, others[others != partner], partner)
    return max(abs(each / one.value) for each in (by_model, *beside)) < MIRRORED


def _at_an_end(profile: Profile, others: IntArray, joint: int) -> bool:
    """Whether all other joints are on one side of a joint."""
    place = profile.place
    return bool(place[joint] < place[others].min() or place[joint] > place[others].max())


def _beside_neighbours(profile: Profile, others: IntArray, joint: int) -> tuple[float, ...]:
    """A joint's deviation from the line of its neighbours; at an end also from the nearest."""
    place, values = profile.place, profile.values
    own = float(place[joint])
    below = others[place[others] < own]
    above = others[place[others] > own]
    if below.size and above.size:
        left, right = int(below[-1]), int(above[0])
        share = (own - place[left]) / (place[right] - place[left])
        return (float(values[joint] - (1 - share) * values[left] - share * values[right]),)
    near = (above if above.size else below[::-1])[:2]
    flat = float(values[joint] - values[near[0]])
    if near.size < 2:
        return (flat,)
    slope = (values[near[0]] - values[near[1]]) / (place[near[0]] - place[near[1]])
    line = flat - float(slope * (own - place[near[0]]))
    return flat, line
