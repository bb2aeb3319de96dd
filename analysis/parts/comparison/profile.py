"""The profile of one quantity along a chain: deviations of its joints, and its shape.

The profile of log gain or lag over the driven joints of one plane is a common value, a shape along
the body, and single joints that depart from both. A joint's departure is its deviation from the
prediction of all others (leave-one-out residual of weighted least squares), a shape's size is its
coefficient.

Critical value for many contrasts at once: simultaneous intervals of the max-t type.

All statements of one answer share one family-wise level: the largest studentised contrast of all
of them is compared with the distribution that it has without any difference. That distribution
is simulated from the estimated covariance of the joints' errors, with the covariance estimated
anew in each draw, so that noise which joints share, and how few bins estimate it, are both in it
(max-t: Westfall & Young, Resampling-Based Multiple Testing, 1993; Hothorn, Bretz & Westfall,
Biometrical J. 50, 2008). Bins are fewer than joints, so their covariance is shrunk towards its
diagonal (Ledoit & Wolf, J. Multivariate Analysis 88, 2004).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.judgement.levels import COVERAGE, ENOUGH_LIKE, REST_ERRORS, TINY

from ...estimators.intervals import ResponseErrors

LEVEL = 1 - COVERAGE
"""Family-wise level of all statements together."""

MIN_JOINTS = ENOUGH_LIKE
"""Fewer sound joints can't say which of them differs."""

NOISIER = REST_ERRORS
"""Variance, in medians of all joints', from which a joint counts less."""

ENDS, MIDDLE = 2, 5
"""Joints that are the ends of a chain, and those that are its middle."""

DRAWS = 2000
"""Of the simulation: the standard error of a level of 5 % is then a tenth of it."""

SEED = 20110901
"""Of the simulation, fixed: the same data give the same intervals."""

EPS = float(np.finfo(np.float64).eps)

_BLOCK = 1 << 21
"""Normal numbers that are drawn at a time, at most: 16 MB."""

_KEPT = 2 * 2 * _BLOCK
"""Normal numbers that are kept for the next session, at most."""


@dataclass(frozen=True)
class Scatter:
    """Errors of one quantity of m joints.

    Attributes:
        columns: Realisations whose mean square is the variance of the estimates, of any weighted
            sum of joints too, shape (m, K); K is the number of degrees of freedom.
        unshared: Variance that is not in the columns and that no two joints share, shape (m,).
        turn: Error that all joints have in common up to this factor, shape (m,).
    """

    columns: FloatArray
    unshared: FloatArray
    turn: FloatArray

    def variance(self, weights: FloatArray) -> FloatArray:
        """Return the variance of weighted sums of the joints.

        Args:
            weights: Shape (c, m).

        Returns:
            Shape (c,).
        """
        shared = np.mean((weights @ self.columns) ** 2, axis=-1)
        return shared + weights**2 @ self.unshared + (weights @ self.turn) ** 2

    def select(self, chosen: Sequence[int]) -> Scatter:
        """Some of the joints."""
        index = np.asarray(chosen, dtype=np.int64)
        return Scatter(self.columns[index], self.unshared[index], self.turn[index])


def scatter_of(errors: ResponseErrors) -> tuple[Scatter, Scatter]:
    """Scatter of log gain and of lag, from the bins beside the gait frequency.

    Args:
        errors: Errors of ln H of m joints.

    Returns:
        Of log gain and of lag [rad]. Their columns are the real and imaginary parts of the bins:
        near the gait frequency the noise of both is the same.
    """
    columns = np.concatenate([errors.bins.real, errors.bins.imag], axis=1)
    return (
        Scatter(columns, errors.rounding[:, 0, 0], np.zeros_like(errors.turn)),
        Scatter(columns, errors.rounding[:, 1, 1], errors.turn),
    )


@dataclass(frozen=True)
class Member:
    """The contrasts of one quantity that belong to a family.

    Attributes:
        weights: Shape (c, m).
        scatter: Of the m joints.
    """

    weights: FloatArray
    scatter: Scatter


def critical_value(members: Sequence[Member], level: float = LEVEL, draws: int = DRAWS) -> float:
    """Factor on the standard error of simultaneous intervals.

    Args:
        members: All contrasts of the family; members are drawn independently.

    Returns:
        The (1 - level) quantile of the largest studentised contrast; infinity for no contrasts.
    """
    some = [member for member in members if member.weights.size]
    if not some:
        return float("inf")
    shapes = tuple(member.scatter.columns.shape for member in some)
    size = draws * sum((m + n) * (n + 1) for m, n in shapes)
    normals = _kept_normals(draws, shapes) if size <= _KEPT else _normals(draws, shapes)
    largest = [_largest(*pair) for pair in zip(some, normals, strict=True)]
    return float(np.quantile(np.max(largest, axis=0), 1 - level))


class _Normals(NamedTuple):
    """Standard normal draws for one member of m joints and n columns, in blocks of d draws.

    Attributes:
        shared: Of the columns, shape (n, d, n + 1) each.
        single: Of each joint alone, shape (m, d, n + 1) each.
        rounding: Of each joint's rounding, shape (m, d) each.
        turn: Of the common turn, shape (1, d) each.
    """

    shared: Iterable[FloatArray]
    single: Iterable[FloatArray]
    rounding: Iterable[FloatArray]
    turn: Iterable[FloatArray]


def _normals(draws: int, shapes: tuple[tuple[int, int], ...]) -> Iterator[_Normals]:
    """Yield what a family of members needs, always the same; to be used up in this order."""
    rng = np.random.default_rng(SEED)

    def drawn(*shape: int) -> Iterator[FloatArray]:
        most = max(1, _BLOCK // math.prod(shape))
        for first in range(0, draws, most):
            count = min(most, draws - first)
            yield np.ascontiguousarray(rng.standard_normal((count, *shape)).swapaxes(0, 1))

    for m, n in shapes:
        yield _Normals(drawn(n, n + 1), drawn(m, n + 1), drawn(m), drawn(1))


@lru_cache(maxsize=1)  # one session after the other has the same joints
def _kept_normals(draws: int, shapes: tuple[tuple[int, int], ...]) -> tuple[_Normals, ...]:
    return tuple(
        _Normals(*(tuple(blocks) for blocks in normal)) for normal in _normals(draws, shapes)
    )


def _product(weights: FloatArray, normals: Iterable[FloatArray]) -> FloatArray:
    """Return weighted sums over the first axis of all draws, shape (c, draws, ...)."""
    parts = [
        (weights @ normal.reshape(len(normal), -1)).reshape(-1, *normal.shape[1:])
        for normal in normals
    ]
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _largest(member: Member, normals: _Normals) -> FloatArray:
    """Return the largest studentised contrast of each draw, shape (draws,)."""
    scatter, weights = member.scatter, member.weights
    columns = scatter.columns
    count = columns.shape[1]
    shrink = _shrinkage(columns)
    sigma = np.sqrt(np.mean(columns**2, axis=1))
    shared, single = np.sqrt((1 - shrink) / count), np.sqrt(shrink)
    blocks = _product(shared * weights @ columns, normals.shared)
    blocks += _product(single * weights * sigma, normals.single)
    error = blocks[..., -1] + _product(weights * np.sqrt(scatter.unshared), normals.rounding)
    error += _product((weights @ scatter.turn)[:, np.newaxis], normals.turn)
    variance = np.mean(blocks[..., :-1] ** 2, axis=-1)
    variance += (weights**2 @ scatter.unshared + (weights @ scatter.turn) ** 2)[:, np.newaxis]
    return np.max(np.abs(error) / np.sqrt(np.maximum(variance, TINY)), axis=0)


def _shrinkage(columns: FloatArray) -> float:
    """Return the share of the diagonal in the shrunk covariance, 0 to 1."""
    joints, count = columns.shape
    sigma = np.sqrt(np.maximum(np.mean(columns**2, axis=1), TINY))
    correlation = (columns / sigma[:, None]) @ (columns / sigma[:, None]).T / count
    off = ~np.eye(joints, dtype=np.bool_)
    squares = float(np.sum(correlation[off] ** 2))
    if squares == 0:
        return 1.0
    return float(np.clip(float(np.sum((1 + correlation[off] ** 2) / count)) / squares, 0.0, 1.0))


@dataclass(frozen=True)
class Profile:
    """One quantity over the sound joints of one plane.

    Attributes:
        place: Index of each joint among the plane's commanded joints, head to tail, shape (m,).
        count: Commanded joints of the plane.
        values: Log gain, or lag [rad], shape (m,).
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
        variance = self.scatter.variance(np.eye(self.values.size))
        return 1 / np.maximum(variance, max(NOISIER * float(np.median(variance)), TINY))


@dataclass(frozen=True)
class Contrast:
    """One number about the shape of the rest.

    Attributes:
        kind: ``ends`` (end joints minus middle joints), ``trend`` (tail minus head, by the
            regression line), ``mirror`` (outer minus inner half, symmetric to the middle) or
            ``each`` (largest deviation of a joint from the common value).
        value: In the unit of the profile.
        spread: Root mean square over the joints of what it explains of them, likewise.
        joint: For ``each``: index into the profile.
    """

    kind: str
    value: float
    error: float
    spread: float
    joint: int | None = None


def family_of(profile: Profile) -> Member:
    """All contrasts that a profile adds to the family of an answer.

    Returns:
        The deviation of each joint from the others, and the shapes.
    """
    weights = [*deviation_weights(profile, everyone(profile), [])]
    weights += [row for _, row in shape_weights(profile, everyone(profile))]
    return Member(np.asarray(weights).reshape(-1, profile.values.size), profile.scatter)


def shape_weights(profile: Profile, active: BoolArray) -> list[tuple[str, FloatArray]]:
    """Return the weights of the shapes' contrasts on the joints that take part.

    Args:
        active: Joints that take part, shape (m,).

    Returns:
        Kind and weights, shape (m,); those for which there are joints enough.
    """
    size = profile.values.size
    weights: list[tuple[str, FloatArray]] = []
    x = profile.along
    index = np.flatnonzero(active)
    if index.size <= 2:
        return weights
    if profile.count >= ENDS + MIDDLE and index.size >= ENDS + 2:
        distance = np.abs(x)
        outer = active & np.isclose(distance, 1)
        limit = (MIDDLE + 1) / max(profile.count - 1, 1)
        inner = active & (distance < limit) & ~np.isclose(distance, limit)
        if np.count_nonzero(outer) == ENDS and inner.any():
            row = outer / np.count_nonzero(outer) - inner / np.count_nonzero(inner)
            weights.append(("ends", row.astype(np.float64)))
    weight = np.where(active, profile.precision, 0.0)
    for kind, column, span in (("trend", x, 2.0), ("mirror", np.abs(x), 1 / 2)):
        basis = [np.ones(size)] if kind == "trend" else [np.ones(size), x]
        if index.size > len(basis) + 1:
            row = coefficient_weights(column, basis, weight)
            if row is not None:
                weights.append((kind, span * row))
    return weights


def contrasts(profile: Profile, active: BoolArray) -> list[Contrast]:
    """Return the shape of the joints that take part.

    Args:
        active: Joints that take part, shape (m,).

    Returns:
        Each shape's contrast, then the largest studentised deviation of one joint.
    """
    shapes: list[Contrast] = []
    for kind, row in shape_weights(profile, active):
        variance = float(profile.scatter.variance(row[None, :])[0])
        value = float(row @ profile.values)
        # A contrast c^T y of unit weights explains (c^T y)^2 / c^T c of the sum of squares.
        spread = abs(value) / float(np.sqrt(row @ row * np.count_nonzero(active)))
        shapes.append(Contrast(kind, value, math.sqrt(variance), spread))
    if np.count_nonzero(active) > 1:
        rows = deviation_weights(profile, active, [])
        index = np.flatnonzero(active)
        value = rows[index] @ profile.values
        error = np.sqrt(profile.scatter.variance(rows[index]))
        k = int(np.argmax(np.abs(value) / np.maximum(error, TINY)))
        spread = abs(float(value[k])) / math.sqrt(index.size)
        shapes.append(Contrast("each", float(value[k]), float(error[k]), spread, int(index[k])))
    return shapes


def everyone(profile: Profile) -> BoolArray:
    """All joints of a profile, shape (m,)."""
    return np.ones(profile.values.size, dtype=np.bool_)


def deviation_weights(
    profile: Profile, active: BoolArray, shapes: Sequence[FloatArray]
) -> FloatArray:
    """Return the weights of the joints' deviations from the prediction of the others.

    Args:
        active: Joints that predict, shape (m,).
        shapes: Columns of the model beside a common value, shape (m,) each.

    Returns:
        A row for each joint, whose sum over the values is its deviation, shape (m, m).
    """
    size = profile.values.size
    design = np.stack([np.ones(size), *shapes], axis=1)
    weight = np.where(active, profile.precision, 0.0)
    hat = design @ np.linalg.pinv(design.T @ (weight[:, None] * design)) @ (design.T * weight)
    # Of a joint that takes part, the leave-one-out residual: (1 - h_ii)^-1 of the residual.
    lever = np.where(active, np.diag(hat), 0.0)
    return np.asarray((np.eye(size) - hat) / np.maximum(1 - lever, EPS)[:, None], dtype=np.float64)


def coefficient_weights(
    column: FloatArray, basis: Sequence[FloatArray], weight: FloatArray
) -> FloatArray | None:
    """Weights of a column's coefficient beside a basis, by weighted least squares, shape (m,)."""
    design = np.stack(basis, axis=1)
    solve = np.linalg.pinv(design.T @ (weight[:, None] * design)) @ (design.T * weight)
    rest = column - design @ (solve @ column)
    power = float(rest @ (weight * rest))
    if power <= EPS * float(weight.sum()):
        return None
    return np.asarray(weight * rest / power, dtype=np.float64)
