"""A session as blocks of messages: one file, the parts of a split one, or an unfinished one.

The path of any part opens the whole. Messages that only the write-ahead log of a recorder has are
one more block, in memory, after the files' blocks; nothing on the disk is changed.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from numpy.typing import NDArray

from ...common.errors import LogError, NotALogError
from ...common.part_files import SUFFIX, stored_path
from ...common.remote import RemotePath, as_path
from ..mcap.chunk import LAST_NS, Block, read_message_heads
from ..mcap.file import Contents, McapFile
from ..wal.reader import MessageKey, WalContents, WalTail, beyond, read_wal
from .bag import BagCopy, is_bag
from .content import content_id, sha256_of
from .parts import PART_RECORD, PartFiles, first_part, open_parts

_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
"""glibc's (malloc_trim(3)); other allocators have none."""

RECOVER = "; 'undulog log recover' writes a whole file"
"""Advice at the end of a warning."""


def new_pages(size: int) -> mmap.mmap:
    """Return zeroed memory of small pages, which are allocated when they are first written.

    numpy would request huge pages, and in a virtual machine a new one costs milliseconds; a
    bytearray would write all of it at once.

    Args:
        size: Size [byte], more than 0.

    Raises:
        MemoryError: If there is not enough memory.
    """
    try:
        return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError as error:
        raise MemoryError(f"{size} bytes for what is read") from error


def keep_freed(size: int) -> None:
    """Make the allocator reuse the pages of freed memory.

    glibc returns a large piece to the system when it is freed, unless one of its size was freed
    before (mallopt(3), M_MMAP_THRESHOLD). Other allocators are not affected.

    Args:
        size: Size of the largest such piece [byte].
    """
    np.empty(size, dtype=np.uint8)  # freed at once, never written


class FilePages:
    """Memory backed by a file, so that unused pages can be released.

    The file has no name and is deleted with the last reference to it. Contents stay when the pages
    are released: the system writes them to the disk when it needs the memory.
    """

    def __init__(self, folder: Path) -> None:
        """Set the folder of the files, which should be on a disk."""
        self._folder = folder
        self._held: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
        self._used = False

    def new(self, size: int) -> mmap.mmap:
        """Return zeroed memory in a new file, or ordinary memory if the disk has no room.

        Args:
            size: Size [byte], more than 0.

        Raises:
            MemoryError: If there is not enough memory either.
        """
        if sys.platform != "linux":
            return new_pages(size)
        from tempfile import TemporaryFile

        try:
            with TemporaryFile(dir=self._folder) as file:
                # A hole in a mapped file ends the process when the disk is full: reserve it all.
                os.posix_fallocate(file.fileno(), 0, size)
                pages = mmap.mmap(file.fileno(), size)
        except OSError:
            return new_pages(size)
        self._held.add(pages)
        self._used = True
        return pages

    def release(self) -> None:
        """Release the pages, which are read again when needed, and freed memory."""
        held = list(self._held)
        for pages in held:
            pages.madvise(mmap.MADV_DONTNEED)
        if self._used and _TRIM is not None:
            _TRIM(0)
        self._used = bool(held)  # once more after the last one: it takes milliseconds


@dataclass(frozen=True)
class Recovered:
    """Contents of a session that was not finalised.

    Attributes:
        live: Whether its recorder is still writing.
        in_files: Number of messages in the files.
        from_wal: Number of messages that only the write-ahead log has.
        accepted: Number of messages that the recorder accepted; None if unknown.
        unfinished: Names of the part files that were being written.
        looked: Whether all messages were counted by reading; if not, summaries were used, or a part
            of the write-ahead log can't be read.
    """

    folder: Path
    live: bool
    in_files: int
    from_wal: int
    accepted: int | None
    looked: bool
    unfinished: tuple[str, ...] = ()

    @property
    def missing(self) -> int | None:
        """Number of accepted messages that are lost; None if unknown."""
        if self.accepted is None:
            return None
        return max(0, self.accepted - self.in_files - self.from_wal)

    @property
    def warning(self) -> str:
        """One sentence, with the fix."""
        left = ", ".join((*self.unfinished, self.folder.name))
        return f"{self}{'' if self.live else f'{RECOVER} from {left}'}"

    def __str__(self) -> str:
        """Return one sentence."""
        total = self.in_files + self.from_wal
        if self.live:
            return (
                f"this recording is running: its first {total} messages are read, "
                f"{self.from_wal} of them from its write-ahead log"
            )
        if self.missing is None:
            missing = "how many are missing is unknown"
        elif self.missing:
            missing = f"{self.missing} of {self.accepted} are missing"
        elif self.looked:
            missing = "none is missing"
        else:
            missing = "none is missing as far as is known"
        return (
            f"the recorder did not finish: {total} messages are read, {self.from_wal} of them "
            f"from its write-ahead log; {missing}"
        )


class LogFile(Contents):
    """A session's blocks, channels, schemas, metadata and attachments, over all its files."""

    def __init__(
        self,
        path: Path,
        column_folder: Path | None = None,
        on_copied: Callable[[float], None] = lambda _: None,
    ) -> None:
        """Open a session.

        Args:
            path: Its file, any of its parts, or a folder that holds it and no other; a rosbag2
                folder, a ``.db3`` file or a ``.bag`` of ROS 1; or the URL of a file.
            column_folder: Folder for large columns in files, and for the copy of a bag; None for
                memory, and the system's temporary folder.
            on_copied: Called with the share of a bag that is copied, 0 to 1; may raise.

        Raises:
            NotALogError: If it is empty, not MCAP, or nothing in it can be read.
            LogError: If the operating system can't open it, or a folder holds several sessions.
            InputFileError: If it is a URL that can't be read.
        """
        super().__init__()
        self.path = path = as_path(path)
        self.recovered: Recovered | None = None
        self.foreign_wal = ""  # warning of a write-ahead log of another session
        self._sources: list[McapFile | WalTail] = []
        self.scratch: list[mmap.mmap] = []  # used memory, which costs no page faults
        self.pages = None if column_folder is None else FilePages(column_folder)
        self._bag = BagCopy(path, column_folder, on_copied) if is_bag(path) else None
        self.warnings += [] if self._bag is None else self._bag.warnings
        first = first_part(path if self._bag is None else self._bag.path)
        wal = read_wal(first)  # before the files: segments released meanwhile are in the files
        self.parts: PartFiles = open_parts(first, bare=wal is not None)
        try:
            for file in self.files:
                self._join(file)
            if wal is not None:
                self._leave_foreign(wal)
            if wal is not None and not self.foreign_wal:
                self._join_wal(wal)
            self.warnings += self.parts.missing
            if self._unfinished and self.recovered is None:
                fix = RECOVER if self.files[-1].cut else "; it is whole: rename it"
                self.warnings.append(
                    f"{', '.join(self._unfinished)} has not got its final name: its writer was "
                    f"ended, or is still writing{fix}"
                )
            if any(block.end_ns > LAST_NS for block in self.blocks):
                self.warnings.append(
                    "log times lie beyond the year 2262, which no clock shows: they are read as "
                    "its April 11"
                )
            self._require_channels()
        except BaseException:
            self.close()
            raise

    @property
    def files(self) -> list[McapFile]:
        """The files that were opened, in order; a block's ``part`` counts them from 0."""
        return list(self.parts.files.values())

    @cached_property
    def spans(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        """Earliest and latest log time of each block [ns], shape (n,) each."""
        times = [(block.start_ns, block.end_ns) for block in self.blocks]
        first, last = np.array(times, dtype=np.uint64).reshape(-1, 2).T.copy()
        return first, last

    @cached_property
    def limits(self) -> tuple[int, int]:
        """Log times of the first and the last message [Unix ns]; 0 and 0 without messages."""
        filled = [block for block in self.blocks if block.end_ns]
        if not filled:
            return 0, 0
        first, last = min(block.start_ns for block in filled), max(block.end_ns for block in filled)
        return min(first, LAST_NS), min(last, LAST_NS)

    def close(self) -> None:
        """Release everything."""
        self.scratch.clear()
        self.parts.close()
        if self._bag is not None:
            self._bag.close()

    def forget(self) -> None:
        """Release the data read; it is read again when needed."""
        for file in self.files:
            file.forget()
        if self.pages is not None:
            self.pages.release()

    def expect(self, blocks: Sequence[Block]) -> None:
        """Announce blocks that will be read next; those on a server are fetched many at a time."""
        for part, file in enumerate(self.files):
            if file.remote is not None:
                file.remote.expect([block for block in blocks if block.part == part])

    @cached_property
    def session_id(self) -> str:
        """The session's id; one from the content if it has none, or else the file's name."""
        if stated := self.metadata.get("undulog", {}).get("session_id"):
            return stated
        if self._bag is not None:
            return self._bag.content
        if not self.files:
            return self.path.stem
        file = self.files[0]

        def read(start: int, stop: int) -> bytes:
            if file.remote is not None:
                return file.remote.read(start, stop)
            return bytes(file.buffer[start:stop])

        return content_id([(len(file.buffer), read)])

    @property
    def size(self) -> int:
        """Size of the files [byte]."""
        return sum(len(file.buffer) for file in self.files)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the files, one after the other, or the ETags of those of a server.

        A hash would fetch the whole file.
        """
        tags = [file.remote.tag for file in self.files if file.remote is not None]
        if tags:
            return f"etag {' '.join(tags)}"
        return sha256_of(file.path for file in self.files)

    def source_of(self, block: Block) -> McapFile | WalTail:
        """Return the file, or the part of the write-ahead log, that holds a block."""
        return self._sources[block.part]

    @cached_property
    def _unfinished(self) -> tuple[str, ...]:
        """Names of the part files of the session."""
        local = (path for path in self.parts.paths if not isinstance(path, RemotePath))
        return tuple(stored_path(path).name for path in local if stored_path(path) != path)

    # -- putting together ------------------------------------------------------------------

    def _require_channels(self) -> None:
        if not self.channels:
            raise NotALogError(self.path, "an MCAP file without any channel that could be read")

    def _join(self, file: McapFile) -> None:
        several = len(self.parts.files) > 1
        self.warnings += [
            f"{file.path.name}: {text}" if several else text for text in file.warnings
        ]
        self.profile = self.profile or file.profile
        self.library = self.library or file.library
        self.schemas |= file.schemas
        self.channels |= file.channels
        for item in file.appendices:
            self._keep(item)
        self._add(file)

    def _add(self, source: McapFile | WalTail) -> None:
        for block in source.blocks:
            block.part = len(self._sources)
        self._sources.append(source)
        self.blocks += source.blocks
        for channel_id, count in source.counts.items():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + count

    def _keep(self, item: Attachment | Metadata) -> None:
        """Add a metadata record or attachment once; each part repeats those of the session."""
        if item.name == PART_RECORD or (len(self._sources) and item in self.appendices):
            return
        self.append(item)

    def _leave_foreign(self, wal: WalContents) -> None:
        """Warn of a write-ahead log of another session, left by a copy."""
        facts = [i for i in wal.definitions if isinstance(i, Metadata) and i.name == "undulog"]
        ids = {item.metadata["session_id"] for item in facts if "session_id" in item.metadata}
        session_id = self.metadata.get("undulog", {}).get("session_id")
        if session_id is None or not ids or session_id in ids:
            return
        part = wal.folder.with_suffix(SUFFIX)
        and_part = f", and {part.name} to NAME.mcap{SUFFIX}" if part.exists() else ""
        self.foreign_wal = (
            f"{wal.folder.name} is the write-ahead log of another session ({min(ids)}) and isn't "
            f"read; move it to NAME.mcap{wal.folder.suffix}{and_part}, then "
            "'undulog log recover NAME.mcap'"
        )
        self.warnings.append(self.foreign_wal)

    def _join_wal(self, wal: WalContents) -> None:
        self._define(wal)
        self._leave_cut_chunk(wal)
        # The log may begin before the files' end, and the files may have grown beyond the log.
        # Segments released while the log was read are a hole in it, of unknown channels.
        grown = max(0, sum(self.counts.values()) - wal.accepted)
        hole = wal.accepted - wal.before - len(wal.messages)
        listed = Counter(message.channel_id for message in wal.messages)
        keys, looked = self._last_keys({key: n + hole + grown for key, n in listed.items()})
        in_files = sum(self.counts.values())
        rest = beyond(wal.messages, keys)
        if rest:
            self._add(WalTail(rest))
        if not (rest or wal.live) and self.parts.finalised and wal.accepted <= in_files:
            return  # the recorder died after everything was written
        accepted = wal.accepted if wal.messages else None
        looked = looked and not wal.damaged
        self.recovered = Recovered(
            wal.folder, wal.live, in_files, len(rest), accepted, looked, self._unfinished
        )
        warnings = list(wal.warnings)
        if self.recovered.missing == 0:  # then a part that was only begun had no messages
            gone = [text for text in self.parts.missing if "can't be read" in text]
            self.parts.missing = [text for text in self.parts.missing if text not in gone]
            warnings = [text for text in warnings if "no readable header" not in text]
        self.warnings += [self.recovered.warning, *warnings]

    def _define(self, wal: WalContents) -> None:
        """Add definitions of a write-ahead log that the files don't have."""
        for item in wal.definitions:
            if isinstance(item, Header):
                self.profile = self.profile or item.profile
                self.library = self.library or item.library
            elif isinstance(item, Schema):
                self.schemas.setdefault(item.id, item)
            elif isinstance(item, Channel):
                self.channels.setdefault(item.id, item)
            elif item not in self.appendices:
                self._keep(item)

    def _leave_cut_chunk(self, wal: WalContents) -> None:
        """Leave out a chunk that is cut short if the log has all its messages."""
        last = self.files[-1] if self.files else None
        if last is None or not last.cut:
            return
        expected = [text for text in last.warnings if _is_of_the_end(text)]
        several = len(self.files) > 1
        dropped = {f"{last.path.name}: {text}" if several else text for text in expected}
        self.warnings = [text for text in self.warnings if text not in dropped]
        block = self.blocks[-1] if self.blocks else None
        if block is None or block.complete or not wal.messages:
            return
        if wal.before <= sum(self.counts.values()) - sum(map(len, (block.offsets or {}).values())):
            self._leave_out(block)

    def _last_keys(self, least: Mapping[int, int]) -> tuple[set[MessageKey], bool]:
        """Return the keys of the files' last messages of some channels.

        The messages of one channel are in order, while older ones of other channels may be in a
        later chunk. An unreadable chunk is left out: the write-ahead log may have its messages.
        """
        keys: set[MessageKey] = set()
        left = dict(least)
        trusted = {part for part, file in enumerate(self.files) if not file.cut}
        unread = {id(block) for block in self.blocks if block.part in trusted}
        for block in reversed(self.blocks.copy()):
            if not left:
                break
            ids = block.offsets if block.offsets is not None else block.index_at
            if ids and left.keys().isdisjoint(ids):
                continue
            try:
                heads = self._heads(block)
            except LogError as error:
                self._leave_out(block)
                self.warnings.append(
                    f"{error}; of its messages only the write-ahead log's are read"
                )
                continue
            columns = (heads[name].tolist() for name in ("channel", "sequence", "log"))
            keys.update(zip(*columns, strict=True))
            unread.discard(id(block))
            ids, counts = np.unique(heads["channel"], return_counts=True)
            passed = dict(zip(ids.tolist(), counts.tolist(), strict=True))
            left = {key: count - passed.get(key, 0) for key, count in left.items()}
            left = {key: count for key, count in left.items() if count > 0}
        return keys, not unread

    def _heads(self, block: Block) -> NDArray[np.void]:
        """Return the heads of all messages of a block."""
        ids = block.offsets if block.offsets is not None else block.index_at
        source = self.source_of(block)
        offsets = [source.offsets(block, channel_id) for channel_id in ids]
        data, base, stop = source.payload(block)
        places = np.concatenate([np.empty(0, dtype=np.int64), *offsets])
        heads = read_message_heads(data, places + base, stop)
        if heads is None:
            where = f"the message index of the chunk at byte {block.start}"
            raise LogError(self.files[block.part].path, f"{where} does not list its messages")
        return heads

    def _leave_out(self, block: Block) -> None:
        """Remove a block and the messages in its index from the counts."""
        self.blocks = [other for other in self.blocks if other is not block]
        for channel_id in block.offsets if block.offsets is not None else block.index_at:
            try:
                count = len(self.source_of(block).offsets(block, channel_id))
            except LogError:  # then the sum stays too high and is not final
                continue
            self.counts[channel_id] = max(0, self.counts.get(channel_id, 0) - count)


def _is_of_the_end(warning: str) -> bool:
    """Whether a warning only means that a file was not finalised."""
    return (
        warning.startswith(("the file is cut short", "the last ", "nothing of the last"))
        or "cut record" in warning
    )
