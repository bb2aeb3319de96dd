"""Closest points of straight segments to circles and rectangles in plan view, in closed form.

A segment is given by its middle and half of its length as a vector: its points are middle + s half,
s from -1 to 1. All arrays are over p pairs of a segment and a shape, the component first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray

_TINY = 1e-300
"""Makes 0/0 a zero."""


class Closest(NamedTuple):
    """Where a segment and a shape are nearest.

    Attributes:
        s: Place on the segment, -1 to 1, shape (p,).
        distance: From the shape's outline [m], negative inside, shape (p,).
        normal: Unit vector from the shape towards the segment, x and y, shape (2, p); zero where a
            segment goes exactly through a circle's centre.
    """

    s: FloatArray
    distance: FloatArray
    normal: FloatArray


def to_circles(
    middle: FloatArray, half: FloatArray, centre: FloatArray, radius: FloatArray
) -> Closest:
    """Closest points to circles.

    Args:
        middle: Of the segments [m], shape (2, p).
        half: Half of the segments [m], shape (2, p).
        centre: Of the circles [m], shape (2, p).
        radius: Of the circles [m], shape (p,).

    Returns:
        The closest points.
    """
    s = _place(middle, half, centre)
    away = middle + s * half - centre
    distance = _length(away)
    return Closest(s, distance - radius, away / np.maximum(distance, _TINY))


def to_rectangles(middle: FloatArray, half: FloatArray, size: FloatArray) -> Closest:
    """Closest points to rectangles, each about the origin along its own axes.

    Apart, the nearest point of the segment is one of its ends, or the foot of a corner. Where they
    meet, the way out is the shortest translation that parts them, along one of the rectangle's
    axes or across the segment (the separating axes), so that depth and normal go on smoothly from
    a touch at an end or at a corner.

    Args:
        middle: Of the segments, in the rectangles' axes [m], shape (2, p).
        half: Half of the segments, in these axes [m], shape (2, p).
        size: Half of the rectangles' lengths [m], shape (2, p).

    Returns:
        The closest points, normals in the rectangles' axes.
    """
    gaps = rectangle_gaps(middle, half, size)
    meet = gaps.max(axis=0) < 0.0
    apart = _apart(middle, half, size)
    if not meet.any():
        return apart
    inside = _overlapping(middle, half, size, gaps)
    return Closest(*(np.where(meet, b, a) for a, b in zip(apart, inside, strict=True)))


def rectangle_gaps(middle: FloatArray, half: FloatArray, size: FloatArray) -> FloatArray:
    """Gaps between segments and rectangles along the axes that may separate them.

    Args:
        middle: As in :func:`to_rectangles`.
        half: Likewise.
        size: Likewise.

    Returns:
        Along the rectangle's axes and across the segment [m], negative where they overlap, shape
        (3, p): the greatest one is never more than the distance, and negative where they meet.
    """
    along_axes = np.abs(middle) - np.abs(half) - size
    length = _length(half)
    reach = np.abs(half[1]) * size[0] + np.abs(half[0]) * size[1]
    offset = np.abs(half[0] * middle[1] - half[1] * middle[0])
    across = np.where(length > 0.0, (offset - reach) / np.maximum(length, _TINY), -np.inf)
    return np.concatenate([along_axes, across[None]])  # a point has no side


def _apart(middle: FloatArray, half: FloatArray, size: FloatArray) -> Closest:
    """Closest points where segment and rectangle do not meet."""
    ends = np.array([-1.0, 1.0])[:, None] * np.ones(middle.shape[1])
    signs = np.array([[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])
    corners = signs[:, :, None] * size[:, None]  # (2, 4, p)
    feet = _place(middle[:, None], half[:, None], corners)
    s = np.concatenate([ends, feet])  # (6, p)
    point = middle[:, None] + s * half[:, None]
    limit = size[:, None]
    # The rectangle's nearest point to any point is found by clipping; for a corner's foot that is
    # never farther than the corner itself.
    away = point - np.minimum(np.maximum(point, -limit), limit)
    distance = _length(away)
    nearest = np.argmin(distance, axis=0)
    pair = np.arange(len(nearest))
    shortest = distance[nearest, pair]
    return Closest(s[nearest, pair], shortest, away[:, nearest, pair] / np.maximum(shortest, _TINY))


def _overlapping(
    middle: FloatArray, half: FloatArray, size: FloatArray, gaps: FloatArray
) -> Closest:
    """The shortest way out where segment and rectangle meet."""
    across = np.array([-half[1], half[0]]) / np.maximum(_length(half), _TINY)
    axis = np.argmax(gaps, axis=0)
    pair = np.arange(len(axis))
    zero = np.zeros(len(axis))
    normals = np.array(
        [
            [_side(middle[0]), zero],
            [zero, _side(middle[1])],
            across * _side((across * middle).sum(axis=0)),
        ]
    )  # (3, 2, p)
    normal = normals[axis, :, pair].T
    deepest_end = -_side((half * normal).sum(axis=0))
    corner = np.copysign(size, normal)
    s = np.where(axis == 2, _place(middle, half, corner), deepest_end)
    return Closest(s, gaps[axis, pair], normal)


def _place(middle: FloatArray, half: FloatArray, point: FloatArray) -> FloatArray:
    """Place on a segment that is nearest to a point."""
    square = (half * half).sum(axis=0)
    s = ((point - middle) * half).sum(axis=0) / np.maximum(square, _TINY)
    return np.minimum(np.maximum(s, -1.0), 1.0)


def _side(value: FloatArray) -> FloatArray:
    """The sign, 1 for zero."""
    return np.where(value < 0.0, -1.0, 1.0)


def _length(vector: FloatArray) -> FloatArray:
    """Length of vectors, component first."""
    return np.sqrt((vector * vector).sum(axis=0))
