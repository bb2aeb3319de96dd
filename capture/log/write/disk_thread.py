"""The thread that writes finished chunks to the disk and then releases the write-ahead log."""

from __future__ import annotations

import errno
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from mcap.records import Metadata

from ...common.errors import LogWriteError
from ..file.parts import PART_RECORD
from ..mcap.writer import McapWriter
from ..wal.segment import FULL, ReservedSpace
from ..wal.writer import WriteAheadLog
from .mcap_sink import write_description, write_error
from .part_stream import FileDeletedError, PartStream

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
    """Writes, hashes and syncs parts, in order.

    Attributes:
        placed: Number of each finished part to its file.
        rescued: Those of them that are rescue files.
        no_rescue: Why there is no rescue file of a part that was deleted.
    """

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
        self._misplaced = ""
        self.no_rescue: LogWriteError | None = None
        self.placed: dict[int, Path] = {}
        self.rescued: dict[int, Path] = {}
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
    def misplaced(self) -> str:
        """Why a rescue file is written, one sentence; empty for none."""
        return self._misplaced

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
        try:
            part.sync()
        except OSError as error:
            if not self._rescue(part, error):
                raise
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
            self._sync(part)
            self._publish(part)
        except OSError as error:
            self._failure = write_error(part.path, error)
            part.close()
            return
        self._hash = part.close()

    def _publish(self, part: PartStream) -> None:
        try:
            part.publish()
        except FileDeletedError as error:
            if not self._rescue(part, error):
                raise
            part.publish()
        self.placed[part.number] = part.path
        if part.rescued:
            self.rescued[part.number] = part.path

    def _rescue(self, part: PartStream, error: OSError) -> bool:
        """Go on in a rescue file if the file will be lost; return whether there is one."""
        lost = part.place is None
        if not lost and error.errno != errno.EROFS:
            return False
        path, why = part.path, part.misplaced if lost else f"{error.strerror}"
        try:
            part.rescue(self.backlog)
        except LogWriteError as failure:
            self.no_rescue = failure
            return False
        self._misplaced = f"{path}: {why}"
        return True

    def _put(self, part: PartStream, pieces: list[bytes]) -> None:
        for piece in pieces:
            left = memoryview(piece)
            deadline = time.monotonic() + _PATIENCE_S
            while left:
                try:
                    written = part.put(left)
                except OSError as error:
                    if error.errno in FULL and self._make_room(part.path, error, deadline):
                        continue
                    if not self._rescue(part, error):
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
