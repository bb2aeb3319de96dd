"""The recorder's sink: an MCAP file, or several, with a write-ahead log beside them.

A message is in the write-ahead log before :meth:`DurableSink.write` returns, so a crash of the
process loses none. A separate thread writes whole chunks to the MCAP file, hashes and syncs them,
and then releases them from the write-ahead log. At a regular end the write-ahead log is deleted; if
it is left, ``Session`` and ``undulog log recover`` combine the two.
"""

from __future__ import annotations

import time
from pathlib import Path

from mcap.records import Header, Metadata

from ...common.errors import DataError, LogWriteError, OutputExistsError, UndulogError
from ...common.part_files import unfinished_path
from ..file.parts import PART_RECORD, later_parts, part_path
from ..mcap.batch import MessageBatch
from ..mcap.writer import McapWriter
from ..wal.segment import ReservedSpace
from ..wal.writer import WriteAheadLog, wal_folder
from .disk_thread import DiskThread
from .mcap_sink import (
    PROFILE,
    Description,
    chunk_group,
    library_name,
    write_description,
    write_error,
)
from .part_stream import FileDeletedError, NameTakenError, PartStream

CHUNK_SIZE = 1 << 19
"""Bytes of messages in a chunk: as small as costs nothing in compression, since one is compressed
and indexed on the recorder's own thread."""

_NEVER_NS = 1 << 63


class DurableSink:
    """Keeps accepted messages through kills, full disks and lost power.

    One thread defines, writes, splits and closes; the properties may be read from any.

    Attributes:
        path: The first part.
        messages: Messages accepted, over all parts.
        split_trouble: Why the last split failed; the open part is continued.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        force: bool = False,
        segment_size: int = 16 << 20,
        split_size: int | None = None,
        split_ns: int | None = None,
        flush_interval_s: float = 10.0,
        sync_interval_s: float = 1.0,
        ballast: int = 8 << 20,
        last_words: int = 0,
    ) -> None:
        """Create the first part and the write-ahead log.

        Args:
            path: The first part, e.g. ``run.mcap``; the next is ``run_0002.mcap``.
            force: Replace existing files and the write-ahead log of an earlier recorder.
            segment_size: Bytes of a segment of the write-ahead log; two are reserved at any time.
            split_size: Bytes of a part at which the next one begins; None for never. A part is
                longer by the chunks that are open then.
            split_ns: Log time of a part [ns]; None for never.
            flush_interval_s: Longest time that a message waits for its chunk to be full [s], and
                twice the shortest that it may have to; the file lags behind by that, while the
                write-ahead log has everything.
            sync_interval_s: What power loss costs at most, about [s].
            ballast: Bytes kept in reserve for finalising on a full disk.
            last_words: Bytes of messages that are accepted after the ballast was freed, for a safe
                stop of the robot; well below the ballast. The caller checks :attr:`shortage`.

        Raises:
            OutputExistsError: If a file or a write-ahead log exists and ``force`` is not given.
            LogWriteError: If there is no room, a file can't be created, or another recorder
                writes it.
            DataError: If a size or time makes no sense.
        """
        limits = [value for value in (split_size, split_ns) if value is not None]
        if min(limits, default=1) < 1 or not flush_interval_s > 0 or min(ballast, last_words) < 0:
            raise DataError("sizes and times of a recording are positive")
        self.path = Path(path)
        self._force, self._split_size, self._split_ns = force, split_size, split_ns
        self._split_at_ns = _NEVER_NS if split_ns is None else 0
        self._half_interval_s = flush_interval_s / 2
        self._due = time.monotonic() + self._half_interval_s
        self._mark = 0  # messages that the part had one half of the interval ago
        self._descriptions: list[Description] = []
        self.messages = 0
        self._last_words = last_words
        self._refused: LogWriteError | None = None
        self._part_began: int = 0
        self.split_trouble: UndulogError | None = None
        self._reported = self._must_end = ""
        self._open = True
        if not force:
            _refuse_existing(self.path)
        self._wal = WriteAheadLog(
            wal_folder(self.path),
            segment_size=segment_size,
            sync_interval_s=sync_interval_s,
            force=force,
        )
        kept: ReservedSpace | None = None
        try:
            self._wal.define(Header(PROFILE, library_name()))
            kept = self._ballast = ReservedSpace(self._wal.folder, ballast)
            self._part = PartStream(self.path, 1, force=force)
        except (LogWriteError, OutputExistsError):
            if kept is not None:
                kept.free()
            self._wal.release(0)
            self._wal.close()
            raise
        self._disk = DiskThread(self._wal, self._ballast)
        self._writer = self._new_writer()

    # -- facts -----------------------------------------------------------------------------

    @property
    def part(self) -> int:
        """Number of the part that is being written, from 1."""
        return self._part.number

    @property
    def part_path(self) -> Path:
        """File of the part that is being written."""
        return self._part.path

    @property
    def size(self) -> int:
        """Bytes of MCAP so far, over all parts, without the open chunks."""
        return self._disk.bytes_given

    @property
    def backlog(self) -> int:
        """Bytes that wait for the disk."""
        return self._disk.backlog

    @property
    def unsynced(self) -> int:
        """Messages that would be lost by power loss now."""
        return self._wal.position - self._wal.synced

    @property
    def shortage(self) -> LogWriteError | None:
        """Why recording must end soon, or has ended: no space, or a disk that fails."""
        return self._disk.trouble or self._refused or self._wal.shortage

    @property
    def must_end(self) -> str:
        """Why the recording must end in good order, in one sentence; empty if it need not.

        Its file, its write-ahead log or their folder was deleted or moved: what was accepted so far
        and what is accepted before the end is kept.
        """
        if not self._must_end:
            self._must_end = self._disk.misplaced or (self._misplaced() if self._open else "")
        return self._must_end

    @property
    def misplaced(self) -> str:
        """As :attr:`must_end`, as far as it is known without looking at the disk."""
        return self._must_end or self._disk.misplaced

    @property
    def rescued(self) -> tuple[Path, ...]:
        """Rescue files, which have what was accepted in the place of deleted ones; for the end."""
        return tuple(self._disk.rescued.values())

    # -- writing ---------------------------------------------------------------------------

    def define(self, record: Description) -> None:
        """See :meth:`MessageSink.define`; every later part repeats the definition.

        Raises:
            LogWriteError: If it can't be kept.
            DataError: If the id of a schema or channel is not the next one.
        """
        self._refuse_closed()
        self._wal.define(record)
        write_description(self._writer, record)
        self._descriptions.append(record)
        self._disk.write(self._part, 0)

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """See :meth:`MessageSink.write`; after the call, a crash of the process does not lose it.

        Raises:
            LogWriteError: If the disk is full or fails; this message is not accepted, all earlier
                ones are.
            DataError: If a number is out of range.
        """
        if self._disk.trouble is not None or self._refused is not None or not self._open:
            self._refuse(len(payload))
        if log_time_ns >= self._split_at_ns:
            self._split_by_time(log_time_ns)
        try:
            self._wal.append(channel_id, log_time_ns, publish_time_ns, sequence, payload)
        except LogWriteError as error:
            self._refused = error  # for good: a gap in what was accepted would be worse
            raise
        part = self._part
        size = part.size
        self._writer.add_message(channel_id, log_time_ns, payload, publish_time_ns, sequence)
        self.messages += 1
        if part.size != size:
            self._chunk_done()
        if time.monotonic() >= self._due:
            self._flush()

    def write_batch(self, batch: MessageBatch) -> None:
        """See :meth:`MessageSink.write_batch`; as safe as :meth:`write`.

        Raises:
            LogWriteError: If the disk is full or fails; the message and those behind it are not
                accepted, all earlier ones are.
            DataError: If a number is out of range.
        """
        usual = self._disk.trouble is None and self._refused is None and self._open
        if (
            not usual
            or not len(batch.log_ns)
            or (self._split_ns is not None and int(batch.log_ns.max()) >= self._split_at_ns)
            or not self._wal.append_all(batch.messages)
        ):
            for message in batch.messages:
                self.write(*message)
            return
        part = self._part
        size = part.size
        for channel_id, log_ns, publish_ns, sequence, payload in batch.messages:
            self._writer.add_message(channel_id, log_ns, payload, publish_ns, sequence)
        self.messages += len(batch.log_ns)
        if part.size != size:
            self._chunk_done()
        if time.monotonic() >= self._due:
            self._flush()

    def files(self) -> tuple[Path, ...]:
        """Return the parts, in order."""
        numbers, placed = range(1, self.part + 1), self._disk.placed
        return tuple(placed.get(k, part_path(self.path, k)) for k in numbers)

    def tick(self) -> list[tuple[str, str]]:
        """Flush if due; call it once a second for sessions with long pauses.

        Returns:
            Events, level and one sentence each: a new reason why the next part can't be begun.

        Raises:
            LogWriteError: If the session is closed.
        """
        self._refuse_closed()
        if time.monotonic() >= self._due:
            self._flush()
        trouble = str(self.split_trouble or "")
        if trouble in ("", self._reported):
            return []
        self._reported = trouble
        return [("error", f"the next part could not be begun, this one goes on: {trouble}")]

    def split(self) -> Path:
        """Begin the next part; the former is finalised in the background.

        Returns:
            The file of the part that is being written now: the same as before if it has no
            message yet.

        Raises:
            OutputExistsError: If the next file exists and ``force`` was not given; the open part is
                continued.
            LogWriteError: If it can't be created; likewise.
        """
        self._refuse_closed()
        if self.messages == self._part_began:
            return self._part.path
        former, writer = self._part, self._writer
        number = former.number + 1
        following = PartStream(part_path(self.path, number), number, force=self._force)
        begin = Metadata(PART_RECORD, {"part": str(number), "previous": former.path.name})
        try:
            after = {"after": str(self.messages)}  # for recovery: where the part begins
            self._wal.define(Metadata(PART_RECORD, {**begin.metadata, **after}))
        except LogWriteError:
            following.discard()
            raise
        end = Metadata(PART_RECORD, {"part": str(former.number), "next": following.path.name})
        self._disk.finish(former, writer, (end,), self._wal.position)
        self._part, self._part_began = following, self.messages
        self._writer = self._new_writer()
        for record in (*self._descriptions, begin):
            write_description(self._writer, record)
        self._disk.write(self._part, 0)
        self._mark = 0
        return following.path

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Finalise; safe to call twice.

        Args:
            last: Metadata for the end.

        Raises:
            LogWriteError: If not everything reached the file. The write-ahead log is kept then.
        """
        if not self._open:
            return
        self._open = False
        trouble: LogWriteError | None = None
        try:
            for record in last:
                self._wal.define(record)
        except LogWriteError as error:  # the file has them, if it can be finalised
            trouble = error
        number = self._part.number
        if number > 1:
            last = (*last, Metadata(PART_RECORD, {"part": str(number), "parts": str(number)}))
        whole = self.messages == self._wal.position  # not so after an interrupt in between
        self._disk.finish(self._part, self._writer, last, self._wal.position if whole else 0)
        self._disk.close()
        self._ballast.free()
        trouble = self._disk.failure or (None if whole else trouble)
        left = self._wal.place
        if trouble is None and not whole:
            trouble = LogWriteError(self._part.path, "the last message was interrupted")
        try:
            self._wal.close()
        except LogWriteError as error:
            trouble = trouble or error
        if isinstance(trouble, FileDeletedError):
            reasons = [_reason(trouble)]
            if self._disk.no_rescue is not None:
                reasons.append(_reason(self._disk.no_rescue))
            reasons.append(f"only what {left} still has is left" if left else "nothing is left")
            raise FileDeletedError(trouble.path, "; ".join(reasons)) from trouble
        if isinstance(trouble, NameTakenError):
            raise trouble
        if trouble is not None:
            raise LogWriteError(
                trouble.path,
                f"{_reason(trouble)}; all {self._wal.position} messages are kept, the last of them "
                f"in {self._wal.folder}: free some space, then 'undulog log recover {self.path}'",
            ) from trouble

    # -- inside ----------------------------------------------------------------------------

    def _new_writer(self) -> McapWriter:
        writer = McapWriter(self._part, CHUNK_SIZE, chunk_group)
        writer.start(profile=PROFILE, library=library_name())
        return writer

    def _chunk_done(self) -> None:
        self._disk.write(self._part, self._part_began + self._writer.settled)
        if self._split_size is not None and self._part.size >= self._split_size:
            self._try_split()

    def _flush(self) -> None:
        """Write the chunks begun before the last call, so that busy ones are not cut short."""
        size = self._part.size
        self._writer.settle(self._mark)
        self._mark = self._writer.messages
        self._due = time.monotonic() + self._half_interval_s
        if self._part.size != size:
            self._chunk_done()

    def _split_by_time(self, log_time_ns: int) -> None:
        """Begin the next part if this message is the first behind a boundary."""
        step = self._split_ns or _NEVER_NS
        if not self._split_at_ns:  # the first message: boundaries are counted from it
            self._split_at_ns = log_time_ns + step
            return
        self._split_at_ns += ((log_time_ns - self._split_at_ns) // step + 1) * step
        self._try_split()

    def _misplaced(self) -> str:
        """How the open part or the write-ahead log was deleted or moved; empty if it wasn't."""
        path = self._part.path
        if (how := self._part.misplaced) != "":
            self._disk.write(self._part, 0)  # at once to a rescue file, if it needs one
            return f"{path}: {how}"
        if self._wal.place is None:
            return f"{self._wal.folder}: was deleted while it was being written"
        return ""

    def _try_split(self) -> None:
        """Split; on failure continue the open part."""
        try:
            self.split()
            self.split_trouble = None
        except (LogWriteError, OutputExistsError) as error:
            self.split_trouble = error

    def _refuse_closed(self) -> None:
        if not self._open:
            raise LogWriteError(self.path, "the session is closed")

    def _refuse(self, size: int) -> None:
        """Refuse a message, unless it fits into the reserve of ``last_words``."""
        self._refuse_closed()
        if self._disk.failure is None and self._refused is None and size <= self._last_words:
            self._last_words -= size
            return
        trouble = self._disk.trouble or self._refused
        if trouble is not None:
            raise type(trouble)(trouble.path, _reason(trouble))


def _reason(error: LogWriteError) -> str:
    """An error's sentence without its file."""
    return str(error).removeprefix(f"{error.path}: ")


def _refuse_existing(path: Path) -> None:
    """Refuse a session that has a file already."""
    if path.exists():
        raise OutputExistsError(path)
    if unfinished_path(path).exists():
        raise OutputExistsError(unfinished_path(path))
    try:
        later = later_parts(path)
    except OSError as error:
        raise write_error(path, error) from error
    if later:
        raise OutputExistsError(later[0])
