"""Free space of the disk that a recording is on."""

from __future__ import annotations

import os
from pathlib import Path

from ..common.errors import LogWriteError


class FreeSpace:
    """The free space of the disk of a file, also after its folder was deleted or moved."""

    def __init__(self, path: Path) -> None:
        """Open the folder of a file, which need not exist yet.

        Raises:
            LogWriteError: If its folder can't be used.
        """
        self._path = path
        try:
            flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
            self._folder = os.open(path.parent, flags)
        except OSError as error:
            raise self._error(error) from error

    def __call__(self) -> int:
        """Return the free bytes [B].

        Raises:
            LogWriteError: If the disk doesn't answer.
        """
        try:
            facts = os.fstatvfs(self._folder)
        except OSError as error:
            raise self._error(error) from error
        return facts.f_bavail * facts.f_frsize

    def close(self) -> None:
        """Close the folder."""
        os.close(self._folder)

    def _error(self, error: OSError) -> LogWriteError:
        reason = os.strerror(error.errno or 0)
        return LogWriteError(self._path, f"its folder can't be used: {reason}")
