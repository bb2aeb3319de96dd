"""Vectors with the component first: shape (3, n) for n links."""

from __future__ import annotations

from capture.arrays import FloatArray

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products; ``numpy.cross`` costs more than twice as much on short arrays.

    Args:
        a: Vectors, shape (3, n).
        b: Vectors, shape (3, n).

    Returns:
        a x b, shape (3, n).
    """
    return a[_NEXT] * b[_LAST] - a[_LAST] * b[_NEXT]
