"""Names of the parts of a split session: ``run.mcap``, ``run_0002.mcap``, ``run_0003.mcap``, ...

The first part has the name that was asked for, so that a session need not know beforehand whether
it will be split.
"""

from __future__ import annotations

import re
from pathlib import Path

PART_RECORD = "undulog.part"
"""Metadata record of a part: ``part`` (its number), ``previous`` and ``previous_sha256`` (file
name and hash of the one before), ``next`` (file name of the one after) or, in the last one,
``parts`` (their number). A session that was never split has none."""

_NUMBERED = re.compile(r"(.+)_(\d{4,})")


def part_path(first: Path, number: int) -> Path:
    """The file of a part.

    Args:
        first: The first part, e.g. ``run.mcap``.
        number: The part, from 1.

    Returns:
        E.g. ``run_0002.mcap``.
    """
    if number == 1:
        return first
    return first.with_name(f"{first.stem}_{number:04d}{first.suffix}")


def split_part_path(path: Path) -> tuple[Path, int]:
    """What the name of a file says of its place, if it is a part.

    Args:
        path: E.g. ``run_0002.mcap``.

    Returns:
        The first part and the number, e.g. ``run.mcap`` and 2; the path itself and 1 where the
        name has no number. Only the file's own record tells whether it is a part at all.
    """
    match = _NUMBERED.fullmatch(path.stem)
    if match is None or int(match[2]) < 2:
        return path, 1
    return path.with_name(match[1] + path.suffix), int(match[2])


def later_parts(first: Path) -> list[Path]:
    """Files that have the name of a later part.

    Args:
        first: The first part; it need not be there.

    Returns:
        Those beside it, by number.

    Raises:
        OSError: If the folder can't be listed.
    """
    found: list[tuple[int, Path]] = []
    for path in first.parent.iterdir():
        head, number = split_part_path(path)
        if number > 1 and head == first:
            found.append((number, path))
    return [path for _, path in sorted(found)]
