"""What has blocks of messages: a file, the rest of a write-ahead log, or all of a session."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ...common.arrays import IntArray
from .chunk import Block, Buffer


class BlockSource(Protocol):
    """Gives out the payloads of its blocks, and where in them the messages are."""

    def payload(self, block: Block) -> tuple[Buffer, int]:
        """The uncompressed bytes of a block, and where in them the message offsets count from.

        Args:
            block: One of its blocks.

        Returns:
            A buffer and the base offset (0 unless the block is unchunked).

        Raises:
            LogError: If the payload can't be decompressed or its CRC doesn't fit.
        """
        ...

    def payload_once(self, block: Block) -> tuple[Buffer, int, int]:
        """The uncompressed bytes of a block, checked, and not kept in memory for later.

        Args:
            block: One of its blocks.

        Returns:
            A buffer, and the first and one past the last byte of the payload in it.

        Raises:
            LogError: If the payload can't be decompressed or its CRC doesn't fit.
        """
        ...

    def inflates(self, block: Block, limit: int) -> bool:
        """Whether :meth:`inflate_into` can be used: a whole zstd chunk of no more than ``limit``.

        Args:
            block: One of its blocks.
            limit: Largest size wanted [byte].

        Returns:
            False for a block that only :meth:`payload` can read.
        """
        ...

    def inflate_into(self, block: Block, room: memoryview) -> None:
        """Decompress a block into memory that is there already, and check it.

        Several threads may do so at once, each with a block and room of its own.

        Args:
            block: One for which :meth:`inflates` holds.
            room: As many bytes as it has.

        Raises:
            LogError: If it can't be decompressed or its CRC doesn't fit.
        """
        ...

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """Where the message records of some channels start in a block's payload, unchecked.

        Args:
            block: One of its blocks.
            channel_ids: The channels.

        Returns:
            For each channel the offsets of its records' opcode bytes, shape (n,), in the order of
            the index; they may be views of the file, to be let go of before it is closed.

        Raises:
            LogError: If the index or the payload is damaged.
        """
        ...

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """Where a channel's message records start in a block's payload.

        Args:
            block: One of its blocks.
            channel_id: The channel.

        Returns:
            Offsets of the records' opcode bytes, shape (n,), in the order of the index.

        Raises:
            LogError: If the index or the payload is damaged.
        """
        ...

    def close(self) -> None:
        """Release what it holds."""
        ...
