"""A log as undecoded messages, block after block, with one chunk in memory.

Unreadable parts are left out and listed in the log's warnings.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata

from ...common.errors import LogError
from ...common.strict_table import read_toml
from ..file.log_file import LogFile
from ..mcap.chunk import PREFIX_SIZE, Block, Buffer, walk_records

_LENGTH = struct.Struct("<Q")
_FIXED = struct.Struct("<HIQQ")  # of a message: channel, sequence, log time, publish time
_BODY_AT = PREFIX_SIZE + _FIXED.size
FOREVER_NS = 1 << 64


class RawMessage(NamedTuple):
    """One message as it is stored.

    Attributes:
        log_time_ns: Log time [Unix ns].
        channel_id: Channel in its own file.
        publish_time_ns: As stored [Unix ns].
    """

    log_time_ns: int
    channel_id: int
    sequence: int
    publish_time_ns: int
    data: bytes


class RawLog:
    """A log opened for its bytes; ``with`` releases it."""

    def __init__(self, path: Path) -> None:
        """Open a log.

        Args:
            path: The MCAP file; of a split session any part, or the folder.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
        """
        self.path = path
        self.file = LogFile(path)
        self.warnings = list(self.file.warnings)
        self.paths = [file.path for file in self.file.files]
        self.sha256 = _hash(self.paths)
        filled = [block for block in self.file.blocks if block.end_ns]
        self.start_ns = min((block.start_ns for block in filled), default=0)
        self.end_ns = max((block.end_ns for block in filled), default=0)
        self.session_id = self.file.metadata.get("undulog", {}).get("session_id") or path.stem
        self.robot = _robot_name(self.file)

    def __enter__(self) -> RawLog:
        """Return the log."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the file."""
        self.file.close()

    @property
    def facts(self) -> dict[str, str]:
        """Path, id and digest, for the report of an edit."""
        return {"path": str(self.path), "session_id": self.session_id, "sha256": self.sha256}

    @property
    def metadata(self) -> list[Metadata]:
        """The metadata records, in the order of the file; names may repeat."""
        return [item for item in self.file.appendices if isinstance(item, Metadata)]

    @property
    def attachments(self) -> list[Attachment]:
        """The attachments, in the order of the file; names may repeat."""
        return [item for item in self.file.appendices if isinstance(item, Attachment)]

    def warn(self, sentence: str) -> None:
        """Add a warning, once."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def type_name(self, channel: Channel) -> str:
        """Return a channel's message type; empty if the channel has no schema."""
        schema = self.file.schemas.get(channel.schema_id)
        return schema.name if schema is not None else ""

    def messages(
        self, channel_ids: Collection[int], start_ns: int = 0, stop_ns: int = FOREVER_NS
    ) -> Iterator[RawMessage]:
        """Yield messages of some channels in a window, in the order of the file.

        Args:
            start_ns: First log time [Unix ns].
            stop_ns: One past the last log time [Unix ns].
        """
        for block in self.file.blocks:
            if not (block.end_ns and (block.start_ns >= stop_ns or block.end_ns < start_ns)):
                yield from self._block_messages(block, channel_ids, start_ns, stop_ns)

    def last_messages(self, channel_ids: Collection[int], before_ns: int) -> list[RawMessage]:
        """Return the last message of each channel before a time, in order of log time.

        The blocks are read backward until all are found.

        Args:
            before_ns: One past the last log time [Unix ns].

        Returns:
            At most one message per channel; of equal log times, the later one in the file.
        """
        # With log time, and file and place of its block.
        last: dict[int, tuple[tuple[int, int, int], RawMessage]] = {}
        for block in sorted(self.file.blocks, key=lambda b: (b.end_ns, b.part, b.start))[::-1]:
            if block.end_ns and block.start_ns >= before_ns:
                continue
            open_ids = {k for k in channel_ids if k not in last or last[k][0][0] <= block.end_ns}
            if not open_ids:
                break
            for message in self._block_messages(block, open_ids, 0, before_ns):
                place = (message.log_time_ns, block.part, block.start)
                former = last.get(message.channel_id)
                if former is None or place >= former[0]:
                    last[message.channel_id] = (place, message)
        return sorted((message for _, message in last.values()), key=lambda m: m.log_time_ns)

    def _block_messages(
        self, block: Block, channel_ids: Collection[int], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        if block.index_at and not any(key in channel_ids for key in block.index_at):
            return
        try:
            data, start, stop = self.file.source_of(block).payload_once(block)
        except LogError as error:
            self.warn(f"{error}; its messages are missing")
            return
        loose = not block.start  # the unchunked messages lie between other records
        offsets = (at for found in (block.offsets or {}).values() for at in found.tolist())
        places = sorted(offsets) if loose else self._places(block, data, start, stop)
        unknown = 0
        for at in places:
            (length,) = _LENGTH.unpack_from(data, at + 1)
            end = at + PREFIX_SIZE + length
            if at + _BODY_AT > end:
                self.warn(f"{self.path}: the message at byte {at} is too short: left out")
                continue
            channel_id, sequence, log_ns, publish_ns = _FIXED.unpack_from(data, at + PREFIX_SIZE)
            if channel_id in channel_ids:
                if start_ns <= log_ns < stop_ns:
                    message = bytes(data[at + _BODY_AT : end])
                    yield RawMessage(log_ns, channel_id, sequence, publish_ns, message)
            elif channel_id not in self.file.channels:
                unknown += 1
        if unknown:
            self.warn(
                f"{self.path}: {unknown} messages from byte {block.start} on are of channels that "
                "the file doesn't describe: left out"
            )

    def _places(self, block: Block, data: Buffer, start: int, stop: int) -> Iterator[int]:
        """Yield the offsets of the whole message records of a chunk."""
        end = start
        for opcode, body, body_stop in walk_records(data, start, stop):
            if opcode == Opcode.MESSAGE:
                yield body - PREFIX_SIZE
            end = body_stop
        if block.complete and end != stop:
            self.warn(
                f"{self.path}: the last {stop - end} bytes of the chunk at byte {block.start} "
                "are no whole record: left out"
            )


def _hash(paths: list[Path]) -> str:
    """Return the SHA-256 of one file, or of all parts one after the other."""
    total = hashlib.sha256()
    for path in paths:
        with path.open("rb") as stream:
            hashlib.file_digest(stream, lambda: total)
    return total.hexdigest()


def _robot_name(log_file: LogFile) -> str:
    """Return the robot of a log; empty if it is not stated."""
    stated = log_file.metadata.get("undulog", {}).get("robot")
    if stated:
        return stated
    attached = log_file.attachments.get("robot.toml")
    if attached is not None:
        with suppress(ValueError):
            return str(read_toml(attached.data.decode()).get("name", ""))
    return ""
