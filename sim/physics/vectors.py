"""Vectors with the component first: shape (3, n) for n links."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen

_NEXT, _LAST = frozen(np.array([1, 2, 0])), frozen(np.array([2, 0, 1]))


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products; ``numpy.cross`` costs six times as much on short arrays.

    Args:
        a: Vectors, shape (3, n).
        b: Vectors, shape (3, n).

    Returns:
        a x b, shape (3, n).
    """
    return a.take(_NEXT, 0) * b.take(_LAST, 0) - a.take(_LAST, 0) * b.take(_NEXT, 0)


def into_frames(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """World vectors in frames of their own: v - 2 w (u x v) + 2 u x (u x v).

    Args:
        quaternion: Orientations of the frames, u and w, shape (4, n).
        vector: In the world, shape (3, n).

    Returns:
        The same vectors in the frames, shape (3, n).
    """
    u, w = quaternion[:3], quaternion[3]
    turned = cross(u, vector)
    return vector - 2.0 * w * turned + 2.0 * cross(u, turned)


def out_of_frames(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """Vectors in frames of their own in the world; undoes :func:`into_frames`.

    Args:
        quaternion: Orientations of the frames, u and w, shape (4, n).
        vector: In the frames, shape (3, n).

    Returns:
        The same vectors in the world, shape (3, n).
    """
    u, w = quaternion[:3], quaternion[3]
    turned = cross(u, vector)
    return vector + 2.0 * w * turned + 2.0 * cross(u, turned)
