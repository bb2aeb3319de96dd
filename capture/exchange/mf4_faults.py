"""What asammdf raises, logs and leaves behind where a file is damaged, in an orderly way."""

from __future__ import annotations

import gc
import logging
import sys
import traceback
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from ..common.errors import ImportFormatError


@contextmanager
def readable(path: Path, what: str) -> Generator[None]:
    """Turn whatever asammdf raises for a damaged file into our error with the file.

    Args:
        path: The file.
        what: How the error begins, e.g. ``can't be read``.

    Yields:
        Nothing: a ``with`` block around calls of asammdf.

    Raises:
        ImportFormatError: If any of them fails.
    """
    try:
        yield
    except ImportFormatError:
        raise
    except Exception as error:  # a damaged file raises anything, from IndexError to IsalError
        _let_go(error)
        raise ImportFormatError(path, f"{what}: {error}") from error


def _let_go(error: Exception) -> None:
    """Free what asammdf half opened: it fails once more when it goes, and would say so."""
    before = sys.unraisablehook

    def quiet(fault: sys.UnraisableHookArgs) -> None:
        if not getattr(fault.object, "__qualname__", "").startswith("MDF"):
            before(fault)

    sys.unraisablehook = quiet
    try:
        traceback.clear_frames(error.__traceback__)
        gc.collect()
    finally:
        sys.unraisablehook = before


class _Saying(logging.Filter):
    """Keeps what a logger would print, in one line each, and lets none of it through."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__()
        self._problems = problems

    def filter(self, record: logging.LogRecord) -> bool:
        lines = record.getMessage().strip().splitlines()
        text = lines[0] if len(lines) == 1 else f"{lines[0].partition(':')[0]}: {lines[-1]}"
        if record.levelno >= logging.WARNING:
            self._problems.append(f"asammdf: {text}")
        return False


@contextmanager
def said(problems: list[str]) -> Generator[None]:
    """Note what asammdf logs; it prints to the terminal of its own accord.

    Args:
        problems: Gets a sentence for each.

    Yields:
        Nothing: a ``with`` block around calls of asammdf.
    """
    logger, saying = logging.getLogger("asammdf"), _Saying(problems)
    logger.addFilter(saying)
    try:
        yield
    finally:
        logger.removeFilter(saying)
