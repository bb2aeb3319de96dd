"""A small file that is read whole: a description, a map of columns, a model, a result."""

from __future__ import annotations

from pathlib import Path

from .errors import InputFileError


def is_file(path: Path) -> bool:
    """Whether a name, which a file may have given, is that of a file.

    Args:
        path: The file.

    Returns:
        False also for a name that no file system takes.
    """
    try:
        return path.is_file()
    except OSError:  # too long
        return False


def read_input(path: Path) -> bytes:
    """Read a file that the user named.

    Args:
        path: The file.

    Returns:
        Its content.

    Raises:
        InputFileError: If it isn't there or can't be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputFileError(path, "no such file") from error
    except OSError as error:
        raise InputFileError(path, f"can't be read: {error.strerror or error}") from error
