"""The thread that writes finished chunks to the disk and then releases the write-ahead log."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from mcap.records import Metadata

from ...common.errors import LogWriteError, OutputExistsError
from ...common.part_files import NEW_FILE, publish, sync_folder, unfinished_path
from ..file.parts import PART_RECORD
from ..mcap.writer import McapWriter
from ..wal.segment import FULL, ReservedSpace
from ..wal.writer import WriteAheadLog
from .mcap_sink import write_description, write_error


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
        self._unfinished = unfinished_path(path)
        self._force = force
        self._pieces: list[bytes] = []
        self._hash = hashlib.sha256()
        self._named = False
        try:
            if force:
                for earlier in (path, self._unfinished):
                    earlier.unlink(missing_ok=True)
            elif path.exists():
                raise OutputExistsError(path)
            self._file = os.open(self._unfinished, os.O_WRONLY | NEW_FILE, 0o666)
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

    # -- for the disk's thread -------------------------------------------------------------

    def put(self, data: memoryview) -> int:
        """Write bytes to the file.

        Raises:
            OSError: If no byte was written.
        """
        written = os.write(self._file, data)
        self._hash.update(data[:written])
        return written

    def sync(self) -> None:
        """Sync the written bytes to the disk.

        Raises:
            FileDeletedError: If the file has no name any more, so that its contents will be lost.
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

    def publish(self) -> None:
        """Give the file its final name, after the last sync.

        Raises:
            NameTakenError: If there is a file of that name meanwhile.
            OSError: If the disk fails.
        """
        try:
            publish(self._unfinished, self.path, replace=self._force)
        except FileExistsError as error:
            raise NameTakenError(
                self.path,
                f"another program made a file of this name; all is in {self._unfinished.name}",
            ) from error

    def close(self) -> str:
        """Close the file and return the SHA-256 of its contents."""
        with suppress(OSError):  # it was synced before; an error of close comes too late
            os.close(self._file)
        return self._hash.hexdigest()

    def discard(self) -> None:
        """Close and delete the file."""
        self.close()
        with suppress(OSError):
            self._unfinished.unlink()


_PATIENCE_S = 2.0  # file systems free deleted space with a delay
_PAUSE_S = 0.1
_MOST_UNSYNCED = 32 << 20


@dataclass(frozen=True)
class _Bytes:
    """Bytes of a part, and the position of the last message that they complete."""

    part: PartStream
    pieces: list[bytes]
    covered: int


@dataclass(frozen=True)
class _Finish:
    """The end of a part; from here on the thread uses its writer."""

    part: PartStream
    writer: McapWriter
    last: tuple[Metadata, ...]
    covered: int


class DiskThread:
    """Writes, hashes and syncs parts, in order."""

    def __init__(self, wal: WriteAheadLog, ballast: ReservedSpace) -> None:
        """Start the thread.

        Args:
            wal: Released up to the last message in the files.
            ballast: Freed when the disk is full.
        """
        self._wal, self._ballast = wal, ballast
        self._queue: SimpleQueue[_Bytes | _Finish | None] = SimpleQueue()
        self._failure: LogWriteError | None = None
        self._shortage: LogWriteError | None = None
        self._queued = 0  # counted by the recorder's thread,
        self._ends = 0  # and by this one
        self._written = 0
        self._hash = ""
        self._unsynced = self._covered = 0
        self._thread = threading.Thread(target=self._work, name=f"disk {wal.folder}", daemon=True)
        self._thread.start()

    @property
    def failure(self) -> LogWriteError | None:
        """Why nothing is written any more; the remaining messages are in the write-ahead log."""
        return self._failure

    @property
    def trouble(self) -> LogWriteError | None:
        """Why recording must end: the failure, or a disk so full that the ballast was freed."""
        return self._failure or self._shortage

    @property
    def backlog(self) -> int:
        """Bytes queued and not yet written."""
        return self.bytes_given - self._written

    @property
    def bytes_given(self) -> int:
        """Bytes of all parts so far, written or not."""
        return self._queued + self._ends

    def write(self, part: PartStream, covered: int) -> None:
        """Queue the bytes of a part.

        Args:
            covered: Position of the last message that they complete.
        """
        pieces = part.take()
        self._queued += sum(map(len, pieces))
        self._queue.put(_Bytes(part, pieces, covered))

    def finish(
        self, part: PartStream, writer: McapWriter, last: tuple[Metadata, ...], covered: int
    ) -> None:
        """Queue a part for finalising.

        Args:
            writer: Its writer, which must not be used any more.
            last: Metadata for its end.
            covered: Position of its last message.
        """
        self.write(part, 0)
        self._queue.put(_Finish(part, writer, last, covered))

    def close(self) -> None:
        """Finish the queue and end the thread; safe to call twice."""
        self._queue.put(None)
        self._thread.join()

    # -- in the thread ---------------------------------------------------------------------

    def _work(self) -> None:
        path = self._wal.folder
        try:
            while (item := self._queue.get()) is not None:
                path = item.part.path
                if self._failure is not None:
                    continue  # not a byte behind a gap
                if isinstance(item, _Bytes):
                    self._write(item)
                else:
                    self._finish(item)
        except BaseException as error:  # without this thread nothing is written any more
            self._failure = LogWriteError(path, f"can't be written: {error!r}")
            raise

    def _write(self, item: _Bytes) -> None:
        try:
            self._put(item.part, item.pieces)
            self._covered = max(self._covered, item.covered)
            self._unsynced += sum(map(len, item.pieces))
            if self._queue.empty() or self._unsynced > _MOST_UNSYNCED:
                self._sync(item.part)
        except OSError as error:
            self._failure = write_error(item.part.path, error)

    def _sync(self, part: PartStream) -> None:
        part.sync()
        self._unsynced = 0
        self._wal.release(self._covered)

    def _finish(self, item: _Finish) -> None:
        part = item.part
        last = item.last
        if self._hash:
            last = (*last, Metadata(PART_RECORD, {"previous_sha256": self._hash}))
        try:
            for record in last:
                write_description(item.writer, record)
            item.writer.finish()
            pieces = part.take()
            self._ends += sum(map(len, pieces))
            self._put(part, pieces)
            self._covered = max(self._covered, item.covered)
            part.sync()
            part.publish()
            self._unsynced = 0
            self._wal.release(self._covered)
        except OSError as error:
            self._failure = write_error(part.path, error)
            part.close()
            return
        self._hash = part.close()

    def _put(self, part: PartStream, pieces: list[bytes]) -> None:
        for piece in pieces:
            left = memoryview(piece)
            deadline = time.monotonic() + _PATIENCE_S
            while left:
                try:
                    written = part.put(left)
                except OSError as error:
                    if error.errno not in FULL or not self._make_room(part.path, error, deadline):
                        raise
                    continue
                left = left[written:]
                self._written += written

    def _make_room(self, path: Path, error: OSError, deadline: float) -> bool:
        """Free the ballast, or wait for freed space to come back; False when it doesn't."""
        if self._ballast.free():
            self._shortage = LogWriteError(
                path, f"{error.strerror}: recording must end; free some space or write elsewhere"
            )
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(_PAUSE_S)
        return True
