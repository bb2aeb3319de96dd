"""Ids of recordings that have none of their own: from their bytes, the same for every copy.

Size and four pieces of a file count: the first and the last bytes, which are fetched anyway when a
log on a server is opened, and two from between, since runs of one program may begin and end alike.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TypeAlias

from ...common.files import check_regular
from ...common.part_files import finished_path

_PIECE = 4 << 10  # few bytes, because a server has to be asked for them
_PIECES = 4

_PREFIX = "log-"

Read: TypeAlias = Callable[[int, int], bytes]
"""Returns the bytes of a file from a first offset up to a second one."""


def content_id(files: Sequence[tuple[int, Read]]) -> str:
    """Return the id of a recording.

    Args:
        files: Size of each of its files [byte], and what reads it.
    """
    digest = hashlib.sha256()
    for size, read in files:
        digest.update(size.to_bytes(8, "little"))
        last = max(0, size - _PIECE)
        for at in dict.fromkeys(last * k // (_PIECES - 1) for k in range(_PIECES)):
            digest.update(read(at, min(at + _PIECE, size)))
    return f"{_PREFIX}{digest.hexdigest()[:16]}"


def content_id_of(paths: Sequence[Path]) -> str:
    """Return the id of a recording by its files, in order.

    Raises:
        OSError: If one can't be read.
    """
    with ExitStack() as stack:
        files: list[tuple[int, Read]] = []
        for path in paths:
            check_regular(path)
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            stack.callback(os.close, descriptor)
            files.append((os.fstat(descriptor).st_size, partial(_read, descriptor)))
        return content_id(files)


def sha256_of(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of the contents of files, one after the other."""
    total = hashlib.sha256()
    for path in paths:
        # A part file may have got its final name since it was opened.
        with (path if path.exists() else finished_path(path)).open("rb") as stream:
            hashlib.file_digest(stream, lambda: total)
    return total.hexdigest()


def session_label(session_id: str, path: Path | str) -> str:
    """Return how text names a session: by its own id, or else by its file."""
    return Path(path).stem if session_id.startswith(_PREFIX) else session_id


def _read(descriptor: int, start: int, stop: int) -> bytes:
    return os.pread(descriptor, stop - start, start)
