"""One part's file: bytes are queued by the MCAP writer and written by the disk's own thread."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from ...common.errors import LogWriteError, OutputExistsError
from ..wal.wal_segment import sync_folder
from .mcap_sink import write_error


class FileDeletedError(LogWriteError):
    """Somebody deleted the file that is being written."""


class PartStream:
    """A file whose writing is put off: the MCAP writer never waits for the disk.

    Attributes:
        path: The file.
        number: The part, from 1.
        size: Bytes of the part so far, written or not.
    """

    def __init__(self, path: Path, number: int, *, force: bool) -> None:
        """Create the file.

        Args:
            path: The file to create.
            number: The part, from 1.
            force: Put it in the place of an existing one, which whoever reads it goes on reading.

        Raises:
            OutputExistsError: If it is there and ``force`` is not given.
            LogWriteError: If it can't be created.
        """
        self.path = path
        self.number = number
        self.size = 0
        self._pieces: list[bytes] = []
        self._hash = hashlib.sha256()
        self._named = False
        try:
            if force:
                path.unlink(missing_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._file = os.open(path, flags, 0o666)
        except FileExistsError as error:
            raise OutputExistsError(path) from error
        except OSError as error:
            raise write_error(path, error) from error

    # -- for the MCAP writer ---------------------------------------------------------------

    def write(self, data: bytes) -> int:
        """Queue bytes.

        Args:
            data: The bytes.

        Returns:
            How many.
        """
        if data:
            self._pieces.append(data)
            self.size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes so far, written or not."""
        return self.size

    def flush(self) -> None:
        """Nothing to do: the disk's thread writes."""

    def take(self) -> list[bytes]:
        """What was queued since the last call."""
        pieces, self._pieces = self._pieces, []
        return pieces

    # -- for the disk's thread -------------------------------------------------------------

    def put(self, data: memoryview) -> int:
        """Write bytes to the file.

        Args:
            data: The bytes.

        Returns:
            How many were written.

        Raises:
            OSError: If none were.
        """
        written = os.write(self._file, data)
        self._hash.update(data[:written])
        return written

    def sync(self) -> None:
        """Bring what was written to the disk.

        Raises:
            FileDeletedError: If the file has no name any more: all that is in it will be gone.
            OSError: If the disk fails.
        """
        try:
            if self._named:
                os.fdatasync(self._file)
            else:
                os.fsync(self._file)
                sync_folder(self.path.parent)
                self._named = True
        finally:
            if os.fstat(self._file).st_nlink == 0:
                raise FileDeletedError(self.path, "was deleted while it was being written")

    def close(self) -> str:
        """Close the file.

        Returns:
            SHA-256 of all that was written.
        """
        with suppress(OSError):  # it was synced before; what close could say comes too late
            os.close(self._file)
        return self._hash.hexdigest()

    def discard(self) -> None:
        """Close and delete the file: nothing of worth is in it."""
        self.close()
        with suppress(OSError):
            self.path.unlink()
