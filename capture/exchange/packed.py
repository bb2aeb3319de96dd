"""Logs that may be compressed, with ``.gz`` behind the suffix of their format."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import TextIO, cast

_GZ = ".gz"


def is_packed(path: Path) -> bool:
    """Return whether a file's last suffix is ``.gz``."""
    return path.suffix.lower() == _GZ


def format_suffix(path: Path) -> str:
    """Return the suffix of the format in lower case, that before ``.gz``, e.g. ``.asc``."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return next((suffix for suffix in reversed(suffixes) if suffix != _GZ), "")


def open_packed_text(path: Path, **options: str) -> TextIO:
    """Open a text, compressed or not.

    Args:
        options: ``encoding`` and ``errors`` as of :func:`open`.
    """
    opener = gzip.open if is_packed(path) else open
    return cast("TextIO", opener(path, "rt", **options))  # pyright: ignore[reportCallIssue, reportArgumentType]
