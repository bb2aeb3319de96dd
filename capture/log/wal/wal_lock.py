"""Who writes a write-ahead log: a lock that ends with its process, however that ends."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

from ...common.errors import LogWriteError

LOCK_NAME = "recorder.lock"


class WalLock:
    """Held by a recorder from the creation of its log to the end."""

    def __init__(self, folder: Path) -> None:
        """Take the lock.

        Args:
            folder: The log.

        Raises:
            LogWriteError: If another recorder holds it, or the folder can't be written.
        """
        self._path = folder / LOCK_NAME
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise LogWriteError(folder, f"can't be written: {error.strerror}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._file)
            if isinstance(error, BlockingIOError):
                raise LogWriteError(folder, "another recorder is writing it") from error
            raise LogWriteError(folder, f"can't be locked: {error.strerror}") from error

    def release(self) -> None:
        """Give the lock back."""
        with suppress(OSError):  # someone else may have tidied up
            self._path.unlink()
        os.close(self._file)


def is_live(folder: Path) -> bool:
    """Whether a recorder is writing a log at the moment.

    Args:
        folder: The log.

    Returns:
        True while the recorder lives; on a file system without locks, False.
    """
    try:
        opened = os.open(folder / LOCK_NAME, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(opened)
    return False
