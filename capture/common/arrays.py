"""Array types shared by all packages, and the freezing of derived arrays."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]

_Number = TypeVar("_Number", int, float)
_Array = TypeVar("_Array", bound=NDArray[Any])


NS = 1_000_000_000
"""Nanoseconds in a second."""


def frozen(array: _Array) -> _Array:
    """Mark an array read-only, in place, and return it."""
    array.setflags(write=False)
    return array


def merged_ranges(
    ranges: Iterable[tuple[_Number, _Number]], gap: float
) -> list[tuple[_Number, _Number]]:
    """Join ranges, in order of their starts, that are no further apart than a gap."""
    numbers: list[tuple[_Number, _Number]] = []
    for start, stop in ranges:
        if numbers and start - numbers[-1][1] <= gap:
            numbers[-1] = numbers[-1][0], max(numbers[-1][1], stop)
        else:
            numbers.append((start, stop))
    return numbers
