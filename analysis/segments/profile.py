"""The profile of one quantity along a chain: deviations of its joints, and its shape.

The profile of log gain or lag over the driven joints of one plane is a common value, a shape along
the body, and single joints that depart from both. A joint's departure is its deviation from the
prediction of all others (leave-one-out residual of weighted least squares), a shape's size is its
coefficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

from .family import Member, Scatter

MIN_JOINTS = 4
"""Fewer sound joints can't say which of them differs."""

NOISIER = 3.0
"""Variance, in medians of all joints', from which a joint counts less."""

ENDS, MIDDLE = 2, 5


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


def family_of(profile: Profile) -> Member:
    """All contrasts that a profile adds to the family of an answer.

    Args:
        profile: The profile.

    Returns:
        The deviation of each joint from the others, and the shapes.
    """
    weights = [*deviation_weights(profile, everyone(profile), [])]
    weights += [row for _, row in shape_weights(profile, everyone(profile))]
    return Member(np.asarray(weights).reshape(-1, profile.values.size), profile.scatter)


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
            row = coefficient_weights(column, basis, weight)
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
        rows = deviation_weights(profile, active, [])
        index = np.flatnonzero(active)
        value = rows[index] @ profile.values
        error = np.sqrt(profile.scatter.variance(rows[index]))
        k = int(np.argmax(np.abs(value) / np.maximum(error, 1e-300)))
        found.append(Contrast("each", float(value[k]), float(error[k]), int(index[k])))
    return found


def everyone(profile: Profile) -> BoolArray:
    """All joints of a profile, shape (m,)."""
    return np.ones(profile.values.size, dtype=np.bool_)


def _design(shapes: Sequence[FloatArray], size: int) -> FloatArray:
    return np.stack([np.ones(size), *shapes], axis=1)


def deviation_weights(
    profile: Profile, active: BoolArray, shapes: Sequence[FloatArray]
) -> FloatArray:
    """Weights of the joints' deviations from the prediction of the others.

    Args:
        profile: The profile.
        active: Joints that predict, shape (m,).
        shapes: Columns of the model beside a common value, shape (m,) each.

    Returns:
        A row for each joint, whose sum over the values is its deviation, shape (m, m).
    """
    size = profile.values.size
    design = _design(shapes, size)
    weight = np.where(active, profile.precision, 0.0)
    hat = design @ np.linalg.pinv(design.T @ (weight[:, None] * design)) @ (design.T * weight)
    # Of a joint that takes part, the leave-one-out residual: (1 - h_ii)^-1 of the residual.
    lever = np.where(active, np.diag(hat), 0.0)
    rows = (np.eye(size) - hat) / np.maximum(1 - lever, 1e-9)[:, None]
    return np.asarray(rows, dtype=np.float64)


def coefficient_weights(
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
