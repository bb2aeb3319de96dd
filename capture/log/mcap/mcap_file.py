"""MCAP as blocks of messages: what the file holds and where, without decoding it.

A :class:`Block` is one chunk (or the unchunked part of a file) with the offsets of each
channel's messages. An indexed file is opened from its summary alone; a file without one
(truncated, or written without an index) is walked record by record, and what could not be read
is said in ``warnings``.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from ...common.arrays import IntArray, frozen
from ...common.errors import LogError
from .chunk import PREFIX_SIZE, Block
from .mcap_opening import read_contents
from .mcap_payloads import McapPayloads

_INDEX_HEAD = struct.Struct("<BQHI")  # of a message index: opcode, length, channel, entries' size
_NO_OFFSETS: IntArray = frozen(np.empty(0, dtype=np.int64))


class McapFile(McapPayloads):
    """An MCAP file as blocks, channels, schemas, metadata and attachments.

    Its attributes are those of :class:`.capture.log.mcap.mcap_opening.McapContents`.
    """

    def __init__(self, path: Path, *, bare: bool = False) -> None:
        """Open a file and find what it holds.

        Args:
            path: The MCAP file.
            bare: Take it without any channel too: a write-ahead log or another part has them.

        Raises:
            NotALogError: If it is empty, not MCAP, or nothing in it can be read.
            LogError: If the operating system can't open it.
        """
        super().__init__(path)
        try:
            held = read_contents(self, bare=bare)
        except BaseException:
            self.close()
            raise
        self._held = held
        self.warnings = held.warnings
        self.profile = held.profile
        self.library = held.library
        self.schemas = held.schemas
        self.channels = held.channels
        self.blocks = held.blocks
        self.counts = held.counts
        self.metadata = held.metadata
        self.attachments = held.attachments
        self.appendices = held.appendices
        self.cut = held.cut

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """See :meth:`BlockSource.indexed`."""
        if block.offsets is not None or not block.index_at:
            return [self.offsets(block, channel_id) for channel_id in channel_ids]
        buffer, end = self.buffer, len(self.buffer)
        head_size = _INDEX_HEAD.size
        found: list[IntArray] = []
        for channel_id in channel_ids:
            at = block.index_at.get(channel_id)
            if at is None:
                found.append(_NO_OFFSETS)
                continue
            if at + head_size > end:
                raise LogError(self.path, f"an index points to byte {at}, where no record is")
            opcode, length, found_id, size = _INDEX_HEAD.unpack_from(buffer, at)
            if opcode != Opcode.MESSAGE_INDEX or at + head_size + size > end:
                raise LogError(self.path, f"no message index at byte {at}")
            if found_id != channel_id or size + 6 != length or size % 16:
                raise LogError(self.path, f"the message index at byte {at} is damaged")
            entries = np.frombuffer(buffer, "<i8", size // 8, at + head_size)
            found.append(entries[1::2])  # log time and offset of each
        return found

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """See :meth:`BlockSource.offsets`."""
        if block.offsets is None and block.index_at:
            return self._message_index(block, channel_id)
        if block.offsets is None:  # a chunk that was written without a message index
            block.offsets = self._held.walk(block, *self.payload(block))
        return block.offsets.get(channel_id, np.empty(0, dtype=np.int64))

    def _message_index(self, block: Block, channel_id: int) -> IntArray:
        (offsets,) = self.indexed(block, [channel_id])
        if offsets.size and not 0 <= offsets.min() <= offsets.max() <= block.size - PREFIX_SIZE:
            raise LogError(
                self.path, f"a message index of channel {channel_id} points outside its chunk"
            )
        return offsets.copy()
