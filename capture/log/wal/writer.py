"""The write-ahead log: accepted messages survive a crash of the recorder.

MCAP messages reach the disk chunk by chunk, so a killed recorder would lose the last seconds.
Each message goes first into a memory-mapped segment file beside the MCAP: after a few memory stores
the kernel has it, even if the process dies. A background thread syncs the pages to the disk once a
second (power loss costs about that) and reserves the next segment in advance. Use by a session
writer::

    wal = WriteAheadLog(wal_folder(path))
    wal.define(Schema(...)), wal.define(Channel(...))  # at registration, before the MCAP writer
    position = wal.append(channel_id, log_time_ns, publish_time_ns, sequence, payload)
    mcap_writer.add_message(...)                       # in the same order; if it fails, the end
    ...
    reached = wal.position                             # once a second or a chunk
    mcap_writer.flush()
    os.fdatasync(mcap_file)                            # off the hot thread
    wal.release(reached)
    ...
    mcap_writer.finish(), os.fdatasync(mcap_file)
    wal.release(wal.position)
    wal.close()                                        # all is in the MCAP: deletes the folder

If the folder exists later, the recorder died: the truncated MCAP file has the first m messages, and
those of :func:`.capture.log.wal.reader.recover` with a position above m are the rest.

Segments are deleted, not reused: a new one is all zeros, so any other bytes behind the last record
are damage, and on a copy-on-write file system only the first write to reserved blocks is sure of
its space.
"""

from __future__ import annotations

import errno
import os
import stat
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

from mcap.opcode import Opcode

from ...common.errors import DataError, LogWriteError, OutputExistsError
from ...common.part_files import sync_folder
from ..mcap.batch import MessageFields
from .format import (
    DEFINITIONS,
    MARK,
    MAX_PAYLOAD,
    MESSAGES,
    RECORD_SIZE,
    Definition,
    SegmentHeader,
    WalLock,
    pack_definition,
    segment_files,
    segment_name,
)
from .segment import SEGMENT_OVERHEAD, Segment

_MESSAGE = int(Opcode.MESSAGE)
_DEFINITIONS_SIZE = 1 << 18
_LEAST_SIZE = 4096
_HOLD_S = 0.1
_HELD = 2 << 20  # bytes ahead of the writing: a second of two saturated buses


def wal_folder(path: Path | str) -> Path:
    """Return the folder of the write-ahead log of a session file, e.g. ``run.mcap.wal``."""
    path = Path(path)
    return path.with_name(f"{path.name}.wal")


class WriteAheadLog:
    """Stores messages until the MCAP has them.

    One thread appends and defines; any thread may release.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        segment_size: int = 16 << 20,
        sync_interval_s: float = 1.0,
        force: bool = False,
    ) -> None:
        """Create the folder and reserve the first segments.

        Args:
            folder: The folder to create, see :func:`wal_folder`.
            segment_size: Bytes of a segment file; two are reserved at any time.
            sync_interval_s: Time between two syncs [s]; power loss costs about that.
            force: Delete the segments of an earlier log in the folder.

        Raises:
            OutputExistsError: If there are segments of an unfinished recording and ``force`` is not
                given.
            LogWriteError: If there is no room, the folder can't be written, or another recorder
                is writing it.
            DataError: If a size or time makes no sense.
        """
        if segment_size < _LEAST_SIZE or not sync_interval_s > 0:
            raise DataError(
                f"a segment has at least {_LEAST_SIZE} bytes and the sync interval is positive; "
                f"got {segment_size} bytes, {sync_interval_s} s"
            )
        self.folder = Path(folder)
        self._segment_size, self._interval_s = segment_size, sync_interval_s
        self._log_id = os.urandom(16)
        self._position = self._defined = 0
        self._released = -1
        self._synced = 0
        self._named = False  # whether the folder's own name was synced
        self._lossy = False  # whether a sync has failed
        self._numbers = {MESSAGES: 0, DEFINITIONS: 0}
        self._sealed: list[Segment] = []
        self._spare: Segment | None = None
        self._closed = False
        self._failure: LogWriteError | None = None
        self._shortage: LogWriteError | None = None
        # _files: which segments there are, and reserving. _disk: syncing and deleting, so that no
        # file is closed under a sync. The appending thread takes _disk only when the disk is full.
        self._files = threading.Lock()
        self._disk = threading.Lock()
        self._wake = threading.Event()
        self._lock = _prepare(self.folder, force=force)
        self._definitions: list[Segment] = []
        try:
            self._definitions.append(self._reserve(DEFINITIONS, _DEFINITIONS_SIZE))
            self._current = self._reserve(MESSAGES, segment_size)
        except LogWriteError:
            for segment in self._definitions:
                segment.close(remove=True)
            self._lock.release()
            with suppress(OSError):
                self.folder.rmdir()
            raise
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"sync {folder}", daemon=True)
        self._holder = threading.Thread(target=self._hold, name=f"hold {folder}", daemon=True)
        self._thread.start()
        self._holder.start()

    def __enter__(self) -> Self:
        """Return the log."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close; messages that were not released are kept."""
        self.close()

    # -- facts -----------------------------------------------------------------------------

    @property
    def position(self) -> int:
        """Position of the last message accepted; messages are counted from 1."""
        return self._position

    @property
    def synced(self) -> int:
        """Position up to which messages survive power loss."""
        return self._synced

    @property
    def place(self) -> Path | None:
        """Where its folder is now; None if it was deleted."""
        return self._lock.folder

    @property
    def shortage(self) -> LogWriteError | None:
        """Why the next segment can't be reserved: space runs out when the current one is full."""
        return self._shortage

    # -- writing ---------------------------------------------------------------------------

    def append(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> int:
        """Accept one message: after the call, a crash of the process does not lose it.

        Args:
            channel_id: MCAP channel, defined before.
            log_time_ns: When it was recorded [Unix ns].
            publish_time_ns: When it was sampled [Unix ns].
            sequence: The message's own counter, 32 bits.

        Returns:
            Its position, for :meth:`release`.

        Raises:
            LogWriteError: If there is no room for another segment, a former sync failed or the
                log is closed. The message is not accepted, all before it are safe; after
                space was freed or released the same call works again.
            DataError: If a number or the payload is out of range.
        """
        position = self._position + 1
        fields = (position, _MESSAGE, MARK, channel_id, sequence, log_time_ns, publish_time_ns)
        if self._failure is not None or not self._current.put(fields, payload):
            self._make_room(payload)
            self._current.put(fields, payload)
        self._position = position
        return position

    def append_all(self, messages: Sequence[MessageFields]) -> bool:
        """Accept messages of one size if the segment has room for all of them.

        Args:
            messages: The arguments of :meth:`append` for each.

        Returns:
            Whether they are accepted. If not, none is: :meth:`append` them one by one, which goes
            to the next segment, or says what is wrong.
        """
        position = self._position + 1
        fields = (position, _MESSAGE, MARK)
        if self._failure is not None or not self._current.put_all(fields, messages):
            return False
        self._position += len(messages)
        return True

    def define(self, record: Definition) -> None:
        """Accept a definition, which is kept until the log is closed.

        Raises:
            LogWriteError: If there is no room for it or the log is closed.
            DataError: If it is longer than a record can be.
        """
        self._check(b"")
        kind, payload = pack_definition(record)
        self._check(payload)
        fields = (self._defined + 1, kind, MARK, 0, 0, 0, 0)
        if not self._definitions[-1].put(fields, payload):
            if self._definitions[-1].cut:
                self._failure = _cut_error(self._definitions[-1].path)
                raise self._failure
            with self._files:
                size = max(_DEFINITIONS_SIZE, _room_for(payload))
                self._definitions.append(self._reserve(DEFINITIONS, size))
            self._definitions[-1].put(fields, payload)
        self._defined += 1

    def release(self, position: int) -> None:
        """Release all messages up to a position, after the MCAP has them and is synced.

        Segments without other messages are deleted, in the background.

        Args:
            position: Position of the last of them, or 0 for none.

        Raises:
            DataError: If there is no such message.
        """
        if not 0 <= position <= self._position:
            raise DataError(
                f"{self.folder}: can't release up to {position}; "
                f"the positions go up to {self._position}"
            )
        self._released = max(self._released, position)
        sealed = self._sealed
        if sealed and sealed[0].last <= position:
            self._wake.set()

    def close(self) -> None:
        """End the log; safe to call twice.

        The folder is deleted if everything was released; else it is synced and kept for
        recovery.

        Raises:
            LogWriteError: If the log is kept and can't be synced.
        """
        if self._closed:
            return
        self._closed = True
        self._wake.set()
        self._ended.set()
        self._thread.join()
        self._holder.join()
        done = self._released >= self._position
        spare, self._spare = self._spare, None
        if spare is not None:
            spare.close(remove=True)
        self._drop_released()
        try:
            if not done:
                self._sync(whole=True)
        finally:
            for segment in (*self._definitions, *self._sealed, self._current):
                segment.close(remove=done)
            folder = self.place
            self._lock.release()
            if done and folder is not None:
                with suppress(OSError):  # not empty: other files are in it
                    folder.rmdir()
        if not done and self._failure is not None:
            raise self._failure

    # -- segments --------------------------------------------------------------------------

    def _check(self, payload: bytes) -> None:
        if self._closed:
            raise LogWriteError(self.folder, "the log is closed")
        if self._failure is not None:
            raise self._failure
        if len(payload) > MAX_PAYLOAD:
            raise DataError(
                f"{self.folder}: a record of {len(payload)} bytes; at most {MAX_PAYLOAD} are kept"
            )

    def _make_room(self, payload: bytes) -> None:
        """Go to the next segment; changes nothing if that fails."""
        self._check(payload)
        if self._current.cut:
            self._failure = _cut_error(self._current.path)
            raise self._failure
        size = _room_for(payload)
        try:
            following = self._following(size)
        except LogWriteError as error:
            self._shortage = error
            if not self._drop_released():
                raise
            following = self._following(size)
        with self._files:
            self._sealed = [*self._sealed, self._current]
            self._current = following
        self._wake.set()

    def _following(self, size: int) -> Segment:
        with self._files:
            spare, self._spare = self._spare, None
            if spare is not None and spare.size >= size:
                return spare
            if spare is not None:
                spare.close(remove=True)
            return self._reserve(MESSAGES, max(size, self._segment_size))

    def _reserve(self, stream: int, size: int) -> Segment:
        number = self._numbers[stream] + 1
        path = self.folder / segment_name(stream, number)
        salt, size = int.from_bytes(os.urandom(4)), (size + 7) & -8
        segment = Segment(path, SegmentHeader(stream, salt, number, size, self._log_id))
        self._numbers[stream] = number
        return segment

    # -- in the background -----------------------------------------------------------------

    def _work(self) -> None:
        due = time.monotonic() + self._interval_s
        try:
            while not self._closed:
                self._ahead()
                self._drop_released()
                if time.monotonic() >= due:
                    self._sync()
                    due = time.monotonic() + self._interval_s
                self._wake.wait(max(0.0, due - time.monotonic()))
                self._wake.clear()
        except BaseException as error:  # without this thread nothing is synced any more
            self._failure = LogWriteError(self.folder, f"the log can't be looked after: {error!r}")
            raise

    def _ahead(self) -> None:
        """Reserve the next segment before it is needed."""
        with self._files:
            if self._spare is None:
                try:
                    self._spare = self._reserve(MESSAGES, self._segment_size)
                    self._shortage = None
                except LogWriteError as error:
                    self._shortage = error

    def _drop_released(self) -> bool:
        """Delete the segments that are no longer needed; returns whether there were any."""
        with self._disk:
            with self._files:
                released = self._released
                gone = [segment for segment in self._sealed if segment.last <= released]
                self._sealed = [segment for segment in self._sealed if segment.last > released]
            for segment in gone:
                segment.close(remove=True)
        return bool(gone)

    def _sync(self, *, whole: bool = False) -> None:
        """Sync the accepted messages; a failure is raised by the next append."""
        with self._disk:
            position = self._position
            with self._files:
                current, sealed = self._current, self._sealed
                others = [*self._definitions, *([self._spare] if self._spare is not None else [])]
            path = self.folder
            try:
                named = all(segment.synced for segment in (*others, current, *sealed))
                for segment in others:
                    path = segment.path
                    segment.sync()
                path = current.path
                reached = current.sync(whole=whole)
                for segment in sealed:
                    path = segment.path
                    if segment.last > self._released:  # checked again: it may be released meanwhile
                        segment.sync()
                if not named and (folder := self.place) is not None:
                    sync_folder(folder)
                    if not self._named:
                        sync_folder(folder.parent)
                        self._named = True
            except OSError as error:
                # After a failed sync the kernel may drop the pages: a second try that succeeds
                # would prove nothing, so nothing more counts as synced.
                reason = f"can't be brought to the disk: {os.strerror(error.errno or 0)}"
                self._failure, self._lossy = LogWriteError(path, reason), True
                return
            if not self._lossy:
                before = sealed[-1].last if sealed else self._synced
                self._synced = min(position, max(before, reached))

    def _hold(self) -> None:
        """Take the page faults ahead of the appending thread, which they would delay."""
        while not self._ended.wait(_HOLD_S):
            with self._files:
                current, spare = self._current, self._spare
            try:
                beyond = current.hold(_HELD)
                if beyond and spare is not None:
                    spare.hold(beyond)
            except OSError as error:
                if error.errno == errno.EFAULT:  # there is no such page any more
                    self._failure = _cut_error(current.path)
                return  # or before Linux 5.14: the appending thread takes its own


def _cut_error(path: Path) -> LogWriteError:
    return LogWriteError(
        path, "was cut short by another program; nothing more can be accepted, all before is kept"
    )


def _room_for(payload: bytes) -> int:
    return SEGMENT_OVERHEAD + RECORD_SIZE + len(payload)


def _prepare(folder: Path, *, force: bool) -> WalLock:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise LogWriteError(folder, f"can't be created: {error.strerror}") from error
    _refuse_foreign(folder)
    lock = WalLock(folder)
    try:
        segments = segment_files(folder)
        if segments and not force:
            raise OutputExistsError(folder)
        for _, _, path in segments:
            path.unlink()
    except OSError as error:
        lock.release()
        if isinstance(error, OutputExistsError):
            raise
        raise LogWriteError(folder, f"can't be created: {error.strerror}") from error
    return lock


def _refuse_foreign(folder: Path) -> None:
    """Refuse a folder that another user planted where several may write, or a link to one."""
    try:
        facts, above = folder.lstat(), folder.absolute().parent.stat()
    except OSError as error:
        raise LogWriteError(folder, f"can't be used: {error.strerror}") from error
    if stat.S_ISLNK(facts.st_mode):
        raise LogWriteError(folder, "is a symbolic link, which is not followed; remove it")
    if facts.st_uid not in (os.geteuid(), above.st_uid):
        raise LogWriteError(folder, "is another user's; name another output")
