"""Space kept in reserve, so that a session can be finalised on a full disk."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from ...common.errors import LogWriteError
from .wal_segment import require_space

BALLAST_NAME = "ballast"

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers that more free space would mend."""


class Ballast:
    """A file that is there only to be deleted."""

    def __init__(self, folder: Path, size: int) -> None:
        """Reserve the space.

        Args:
            folder: Where to; an old one is replaced.
            size: How much [byte]; nothing is reserved for 0.

        Raises:
            LogWriteError: If there is no room; no file is left then.
        """
        self.path = folder / BALLAST_NAME
        self._there = size > 0
        if not size:
            return
        require_space(self.path, size)
        try:
            opened = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
            try:
                os.posix_fallocate(opened, 0, size)
            finally:
                os.close(opened)
        except OSError as error:
            self.free()
            raise LogWriteError(
                self.path, f"{size} bytes can't be reserved: {error.strerror}"
            ) from error

    def free(self) -> bool:
        """Give the space back.

        Returns:
            Whether there was any.
        """
        there, self._there = self._there, False
        if there:
            with suppress(OSError):  # someone else may have tidied up
                self.path.unlink()
        return there
