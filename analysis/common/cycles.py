"""Records of values, one a cycle."""

from __future__ import annotations

from typing import cast


def check_cycles(owner: str, record: object, cycles: int) -> None:
    """Refuse per-cycle arrays of unequal length, which a damaged result file can hold."""
    for name, value in vars(record).items():
        if not isinstance(value, tuple) or name == "joints":
            continue
        values = len(cast("tuple[object, ...]", value))
        if values != cycles:
            raise ValueError(f"{owner}: {name} has {values} values for {cycles} cycles")
