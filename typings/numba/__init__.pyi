"""The one function of numba that undulog uses (the package's own types are incomplete)."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")

def njit(
    *, cache: bool = ..., error_model: str = ..., forceinline: bool = ...
) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]: ...
