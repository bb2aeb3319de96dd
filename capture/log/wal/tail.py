"""Messages that only a write-ahead log has, as a block like those of a file."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from ...common.arrays import IntArray
from ...common.errors import LogError, NotALogError
from ..mcap.chunk import Block, Buffer
from .format import Definition, is_live
from .reader import WalMessage, recover
from .writer import wal_folder

_RECORD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FIXED_SIZE = 22

MessageKey = tuple[int, int, int]
"""Channel, sequence number and log time: no two messages of a session share all three."""


@dataclass(frozen=True)
class WalContents:
    """All that a write-ahead log holds.

    Attributes:
        definitions: Headers, schemas, channels, metadata, attachments, in the order given.
        messages: In the order they were accepted.
        live: Whether a recorder is writing it.
        warnings: What was damaged, one sentence each.
    """

    folder: Path
    definitions: tuple[Definition, ...]
    messages: tuple[WalMessage, ...]
    live: bool
    warnings: tuple[str, ...]

    @property
    def accepted(self) -> int:
        """How many messages the recorder accepted, as far as the log tells; 0 if it doesn't."""
        return self.messages[-1].position if self.messages else 0

    @property
    def before(self) -> int:
        """How many messages were accepted before the first that the log still has."""
        return self.messages[0].position - 1 if self.messages else 0

    @property
    def damaged(self) -> bool:
        """Whether something of it can't be read: then it may have had more messages."""
        return any("header" not in text for text in self.warnings)


def read_wal(first: Path) -> WalContents | None:
    """Read the write-ahead log of a session, without changing it.

    Args:
        first: The session's first file; it need not be there.

    Returns:
        What it holds; None where there is none, or nothing of it can be read and no recorder
        has it open.

    Raises:
        LogError: If its folder can't be listed.
    """
    folder = wal_folder(first)
    if not folder.is_dir():
        return None
    live = is_live(folder)
    try:
        recovery = recover(folder)
        messages = tuple(recovery)
    except NotALogError as error:
        told = () if live else (str(error),)
        return WalContents(folder, (), (), live, told)
    except LogError:
        if not folder.is_dir():  # its recorder has just finished
            return None
        raise
    # Whether one is missing, only log and file together tell.
    warnings = [text for text in recovery.warnings if "messages are missing" not in text]
    return WalContents(folder, recovery.definitions, messages, live, tuple(warnings))


class WalTail:
    """A block in memory; read like a file's."""

    def __init__(self, messages: Iterable[WalMessage]) -> None:
        """Lay out messages as MCAP records.

        Args:
            messages: At least one, in order.
        """
        data = bytearray()
        places: dict[int, list[int]] = {}
        start_ns, end_ns = 1 << 63, 0
        for item in messages:
            places.setdefault(item.channel_id, []).append(len(data))
            data += _RECORD.pack(
                Opcode.MESSAGE,
                _FIXED_SIZE + len(item.payload),
                item.channel_id,
                item.sequence,
                item.log_time_ns,
                item.publish_time_ns,
            )
            data += item.payload
            start_ns = min(start_ns, item.log_time_ns)
            end_ns = max(end_ns, item.log_time_ns)
        self._data = bytes(data)
        self.counts = {channel_id: len(at) for channel_id, at in places.items()}
        offsets = {channel_id: np.array(at, dtype=np.int64) for channel_id, at in places.items()}
        size = len(self._data)
        self.blocks = [Block(0, size, "", size, 0, start_ns, end_ns, offsets=offsets)]

    def payload(self, block: Block) -> tuple[Buffer, int]:
        """See :meth:`BlockSource.payload`."""
        return self._data, block.start

    def payload_once(self, block: Block) -> tuple[Buffer, int, int]:
        """See :meth:`BlockSource.payload_once`."""
        return self._data, block.start, block.stop

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """See :meth:`BlockSource.offsets`."""
        return (block.offsets or {}).get(channel_id, np.empty(0, dtype=np.int64))

    def inflates(self, block: Block, limit: int) -> bool:  # noqa: ARG002 (as a file has it)
        """See :meth:`BlockSource.inflates`; never: nothing is compressed."""
        return False

    def inflate_into(self, block: Block, room: memoryview) -> None:
        """See :meth:`BlockSource.inflate_into`."""
        room[:] = self._data[block.start : block.stop]

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """See :meth:`BlockSource.indexed`."""
        return [self.offsets(block, channel_id) for channel_id in channel_ids]

    def close(self) -> None:
        """Nothing to release."""


def beyond(messages: Iterable[WalMessage], known: Collection[MessageKey]) -> list[WalMessage]:
    """The messages that a file lacks.

    Args:
        known: Of the file: at least its last ones, as many as the log has.

    Returns:
        Those that are not among them.
    """
    return [
        item for item in messages if (item.channel_id, item.sequence, item.log_time_ns) not in known
    ]
