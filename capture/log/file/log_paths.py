"""The logs in a folder and its folders, found without opening one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

from .bag_metadata import METADATA, is_rosbag2

_FILES = (".mcap", ".db3", ".bag")
_WAL = ".mcap.wal"


def walk(folder: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Yield folders with the names of their folders and files, as ``os.walk``, in order of name.

    Links are followed, and a folder that several lead to is visited once. What is removed from a
    list of folders is not entered.

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
        folders: list[str] = []
        files: list[str] = []
        for entry in entries:
            # pathlib takes a link to itself as broken, where a DirEntry raises an error.
            kind = Path(entry) if entry.is_symlink() else entry
            if kind.is_dir():
                folders.append(entry.name)
            elif kind.is_file():
                files.append(entry.name)
        yield here, folders, files
        left += [here / name for name in reversed(folders)]


def log_paths(folder: Path, is_recording: Callable[[Path], bool] = is_rosbag2) -> Iterator[Path]:
    """Yield the logs in a folder and, behind them, in its folders, each in order of name.

    A log is a file ``.mcap``, ``.bag`` or ``.db3``, a rosbag2 folder, whose files are not yielded,
    or the file that a write-ahead log belongs to, which need not exist and may be yielded twice.
    Hidden folders are left out.

    Args:
        is_recording: Whether a folder with a metadata.yaml is one of rosbag2.

    Raises:
        OSError: If a folder can't be listed.
    """
    for here, folders, files in walk(folder):
        if METADATA in files and is_recording(here):
            folders.clear()
            yield here
            continue
        logs = [name for name in files if PurePath(name).suffix in _FILES]
        logs += [name.removesuffix(".wal") for name in folders if name.endswith(_WAL)]
        yield from (here / name for name in sorted(logs))
        folders[:] = [n for n in folders if not n.startswith(".") and not n.endswith(".wal")]
