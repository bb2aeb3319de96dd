"""Checks of an export before it begins."""

from __future__ import annotations

from pathlib import Path

from ..common.console import refuse_existing
from ..common.errors import UsageError


def refuse_session(source: Path, output: Path, *, force: bool) -> None:
    """Refuse an output that is the session itself, or is there already.

    Raises:
        UsageError: If it is the session.
        OutputExistsError: If it is there and ``force`` is not given.
    """
    if output.exists() and source.exists() and output.samefile(source):
        raise UsageError(f"{output} is the session itself; choose another name")
    refuse_existing(output, force=force)
