"""The file of a session or of one of its parts, while it is written.

Its descriptor has everything, whatever becomes of its name: of a file that was deleted the bytes
are copied to a rescue file, which takes the rest, and one that was moved gets its final name where
it is now.
"""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ...common.errors import LogWriteError, OutputExistsError
from ...common.part_files import (
    NEW_FILE,
    present_path,
    publish,
    rescue_folders,
    sync_folder,
    unfinished_path,
)
from ..wal.segment import free_bytes
from .mcap_sink import write_error

RESCUE_ROOM = 8 << 20
"""Free space for a rescue file beyond what is to be written: what else may come, and the file
system's own needs [byte]."""

_COPIED = 1 << 20  # bytes at once


class FileDeletedError(LogWriteError):
    """The file that is being written was deleted."""


class NameTakenError(LogWriteError):
    """Another program took the final name of the file that is being written."""


class PartStream:
    """A file that is written later, so that the MCAP writer never waits for the disk.

    It is a part file until it is whole.

    Attributes:
        path: Its final name.
        number: The part, from 1.
        size: Bytes of the part so far, written or not.
        rescued: Whether it is a rescue file by now.
    """

    def __init__(self, path: Path, number: int, *, force: bool) -> None:
        """Create the file.

        Args:
            number: The part, from 1.
            force: Replace an existing file; processes that have it open keep the old one.

        Raises:
            OutputExistsError: If it exists and ``force`` is not given.
            LogWriteError: If it can't be created.
        """
        self.path = path
        self.number = number
        self.size = 0
        self.rescued = False
        self._unfinished = unfinished_path(path)
        self._force = force
        self._pieces: list[bytes] = []
        self._hash = hashlib.sha256()
        self._named = False
        self._written = 0
        self._left: list[int] = []  # descriptors of files that were deleted
        try:
            # Absolute, since the working folder may be what is deleted.
            self._folder = path.absolute().parent
            self._home = self._folder.stat()
            if force:
                for earlier in (path, self._unfinished):
                    earlier.unlink(missing_ok=True)
            elif os.path.lexists(path):
                raise OutputExistsError(path)
            self._file = os.open(self._unfinished, os.O_RDWR | NEW_FILE, 0o666)
        except FileExistsError as error:
            if isinstance(error, OutputExistsError):
                raise
            raise OutputExistsError(self._unfinished) from error
        except OSError as error:
            raise write_error(path, error) from error

    # -- for the MCAP writer ---------------------------------------------------------------

    def write(self, data: bytes) -> int:
        """Queue bytes."""
        if data:
            self._pieces.append(data)
            self.size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes so far, written or not."""
        return self.size

    def flush(self) -> None:
        """Do nothing: the disk thread writes."""

    def take(self) -> list[bytes]:
        """Return the bytes queued since the last call."""
        pieces, self._pieces = self._pieces, []
        return pieces

    # -- for any thread --------------------------------------------------------------------

    @property
    def place(self) -> Path | None:
        """Where the file is now; None if it has no name any more."""
        return present_path(self._file, self._unfinished)

    @property
    def misplaced(self) -> str:
        """How the file was deleted or moved, in a few words; empty if it is where it was made."""
        where = self.place
        if where == self._unfinished:
            return ""
        if where is not None:
            return f"was moved to {where} while it was being written"
        if self._folder_is_there():
            return "was deleted while it was being written"
        return f"its folder, {self._folder}, was deleted while it was being written"

    # -- for the disk's thread -------------------------------------------------------------

    def put(self, data: memoryview) -> int:
        """Write bytes to the file.

        Raises:
            OSError: If no byte was written.
        """
        written = os.write(self._file, data)
        self._hash.update(data[:written])
        self._written += written
        return written

    def sync(self) -> None:
        """Sync the written bytes to the disk.

        Raises:
            FileDeletedError: If the file has no name any more, so that its contents will be lost.
            OSError: If the disk fails.
        """
        if self._named:
            os.fdatasync(self._file)
        else:
            os.fsync(self._file)
        self._present()
        if not self._named:
            self._where_it_is(lambda where: sync_folder(where.parent))
            self._named = True

    def rescue(self, more: int) -> None:
        """Copy what was written to a rescue file, which takes all that follows.

        It is made in the file's folder if that is still there, else in the nearest folder above
        that is, else among the temporary files; only this user can read it.

        Args:
            more: Bytes that are still to come.

        Raises:
            LogWriteError: If it can't be made anywhere; nothing is changed then.
        """
        needed = self._written + more + RESCUE_ROOM
        output = f"{self.path.stem}.rescued-{os.urandom(4).hex()}{self.path.suffix}"
        here = [self._folder] if self._folder_is_there() else []
        reasons: list[str] = []
        for folder in (*here, *rescue_folders(self._folder)):
            try:
                if (free := free_bytes(folder)) < needed:
                    reasons.append(f"{folder} has {free} bytes free")
                    continue
                self._move_to(folder / output)
            except OSError as error:
                reasons.append(f"{folder}: {error.strerror or error}")
                continue
            return
        listed = "; ".join(reasons)
        raise LogWriteError(
            self.path, f"no rescue file of {needed} bytes can be made: {listed or 'no folder'}"
        )

    def publish(self) -> None:
        """Give the file its final name, where it is now, after the last sync.

        Raises:
            FileDeletedError: If the file has no name any more.
            NameTakenError: If there is a file of its final name meanwhile.
            OSError: If the disk fails.
        """

        def give_name(where: Path) -> None:
            output = self.path if where == self._unfinished else where.with_name(self.path.name)
            try:
                if where == output:  # it has got its name, and was moved, or is looked at again
                    sync_folder(where.parent)
                else:
                    publish(where, output, replace=self._force)
            except FileExistsError as error:
                raise NameTakenError(
                    output,
                    f"another program made a file of this name; the recording is in {where}, "
                    "whole: rename it",
                ) from error
            self.path = output

        self._where_it_is(give_name)

    def close(self) -> str:
        """Close the file and return the SHA-256 of its contents."""
        for opened in (self._file, *self._left):
            with suppress(OSError):  # it was synced before; an error of close comes too late
                os.close(opened)
        return self._hash.hexdigest()

    def discard(self) -> None:
        """Close and delete the file."""
        where = self.place
        self.close()
        if where is not None:
            with suppress(OSError):
                where.unlink()

    # -- inside ----------------------------------------------------------------------------

    def _present(self) -> Path:
        """Where the file is now; FileDeletedError if it has no name any more."""
        if (where := self.place) is None:
            raise FileDeletedError(self.path, self.misplaced)
        return where

    def _where_it_is(self, act: Callable[[Path], None]) -> None:
        """Do something to the file by its name; again if it was moved since that was read."""
        where = self._present()
        while True:
            failure = None
            try:
                act(where)
            except FileNotFoundError as error:
                failure = error
            before, where = where, self._present()
            if where == before:
                if failure is not None:
                    raise failure
                return

    def _folder_is_there(self) -> bool:
        try:
            return os.path.samestat(self._folder.stat(), self._home)
        except OSError:
            return False

    def _move_to(self, output: Path) -> None:
        """Copy what was written to a new part file, and write there from now on."""
        unfinished = unfinished_path(output)
        opened = os.open(unfinished, os.O_RDWR | NEW_FILE, 0o600)
        try:
            at = 0
            while at < self._written:
                data = os.pread(self._file, min(_COPIED, self._written - at), at)
                at += _write_all(opened, data, self.path)
            os.fsync(opened)
            sync_folder(output.parent)
        except OSError:
            os.close(opened)
            unfinished.unlink(missing_ok=True)
            raise
        self._left.append(self._file)  # closed at the end: another thread may look at it
        self._unfinished, self._file = unfinished, opened
        self.path, self._folder, self._home = output, output.parent, output.parent.stat()
        self._force, self.rescued, self._named = False, True, True


def _write_all(opened: int, data: bytes, path: Path) -> int:
    """Write bytes that were read of a file, at least one; return their number."""
    if not data:
        raise OSError(errno.EIO, f"{path} can't be read to its end")
    left = memoryview(data)
    while left:
        left = left[os.write(opened, left) :]
    return len(data)
