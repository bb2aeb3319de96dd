"""Names that stand for two things."""

from __future__ import annotations

from collections.abc import Sequence

from ..common.strict_table import Faults


def note_repeated(faults: Faults, what: str, names: Sequence[str]) -> None:
    """Note names that occur more than once; empty ones are faults already.

    Args:
        faults: Where they are noted.
        what: What has these names, e.g. ``links``.
        names: The names.
    """
    for name in sorted({name for name in names if name and names.count(name) > 1}):
        faults.add(what, f"{names.count(name)} times {name}", "every name once")
