"""Messages that only a write-ahead log has, as a block like those of a file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from ...common.arrays import IntArray
from ...common.errors import LogError, NotALogError
from ..mcap.chunk import Block
from ..mcap.records import FIXED_SIZE, MESSAGE
from .format import Definition, is_live
from .reader import WalMessage, recover
from .writer import wal_folder

MessageKey = tuple[int, int, int]
"""Channel, sequence number and log time: no two messages of a session share all three."""


@dataclass(frozen=True)
class WalContents:
    """Contents of a write-ahead log.

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
        """Number of messages that the recorder accepted; 0 if unknown."""
        return self.messages[-1].position if self.messages else 0

    @property
    def before(self) -> int:
        """Number of messages accepted before the first one in the log."""
        return self.messages[0].position - 1 if self.messages else 0

    @property
    def damaged(self) -> bool:
        """Whether a part can't be read, so that it may have had more messages."""
        return any("header" not in text for text in self.warnings)


def read_wal(first: Path) -> WalContents | None:
    """Read the write-ahead log of a session, without changing it.

    Args:
        first: The session's first file; it need not be there.

    Returns:
        Its contents; None if there is no log.

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
        warnings = () if live else (str(error),)
        return WalContents(folder, (), (), live, warnings)
    except LogError:
        if not folder.is_dir():  # its recorder has just finished
            return None
        raise
    # Only log and file together show whether a message is missing.
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
            data += MESSAGE.pack(
                Opcode.MESSAGE,
                FIXED_SIZE + len(item.payload),
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

    def payload(self, block: Block) -> tuple[bytes, int, int]:
        """See :meth:`.McapPayloads.payload`."""
        return self._data, block.start, block.stop

    payload_once = payload

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """See :meth:`.McapFile.offsets`."""
        return (block.offsets or {}).get(channel_id, np.empty(0, dtype=np.int64))

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """See :meth:`.McapFile.indexed`."""
        return [self.offsets(block, channel_id) for channel_id in channel_ids]

    def inflates(self, block: Block, limit: int) -> bool:  # noqa: ARG002 (as a file has it)
        """Return False: nothing is compressed."""
        return False

    def inflate_into(self, block: Block, room: memoryview) -> None:
        """See :meth:`.McapPayloads.inflate_into`."""
        room[:] = self._data[block.start : block.stop]


def beyond(messages: Iterable[WalMessage], known: Collection[MessageKey]) -> list[WalMessage]:
    """Return the messages that a file lacks.

    Args:
        known: Keys of the file's messages: at least of the last ones, as many as the log has.
    """
    return [
        item for item in messages if (item.channel_id, item.sequence, item.log_time_ns) not in known
    ]
