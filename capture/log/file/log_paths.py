"""The logs in a folder and its folders, found without opening one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

from .bag_metadata import METADATA, is_rosbag2

_FILES = (".mcap", ".db3", ".bag")
_WAL = ".mcap.wal"


def log_paths(folder: Path, is_recording: Callable[[Path], bool] = is_rosbag2) -> Iterator[Path]:
    """Yield the logs in a folder and, behind them, in its folders, each in order of name.

    A log is a file ``.mcap``, ``.bag`` or ``.db3``, a rosbag2 folder, whose files are not yielded,
    or the file that a write-ahead log belongs to, which need not exist and may be yielded twice.
    Hidden folders are left out; a folder that several links lead to counts once.

    Args:
        is_recording: Whether a folder with a metadata.yaml is one of rosbag2.

    Raises:
        OSError: If a folder can't be listed.
    """
    left, visited = [folder], set[tuple[int, int]]()
    while left:
        here = left.pop()
        facts = here.stat()
        if (facts.st_dev, facts.st_ino) in visited:
            continue
        visited.add((facts.st_dev, facts.st_ino))
        with os.scandir(here) as listed:
            entries = sorted(listed, key=lambda entry: entry.name)
        if any(entry.name == METADATA for entry in entries) and is_recording(here):
            yield here
            continue
        folders: list[Path] = []
        for entry in entries:
            # pathlib takes a link to itself as broken, where a DirEntry raises an error.
            kind = Path(entry) if entry.is_symlink() else entry
            if kind.is_dir():
                if entry.name.endswith(_WAL):
                    yield here / entry.name.removesuffix(".wal")
                elif not entry.name.startswith(".") and not entry.name.endswith(".wal"):
                    folders.append(here / entry.name)
            elif PurePath(entry.name).suffix in _FILES and kind.is_file():
                yield here / entry.name
        left += reversed(folders)
