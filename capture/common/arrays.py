"""Array types shared by all packages, and the freezing of derived arrays."""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]

_Array = TypeVar("_Array", bound=NDArray[Any])


NS = 1_000_000_000
"""Nanoseconds in a second."""


def frozen(array: _Array) -> _Array:
    """Mark an array read-only, in place, and return it."""
    array.setflags(write=False)
    return array
