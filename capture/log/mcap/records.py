"""Message records of a block, many at a time: their heads, and copies of what follows.

Format: https://mcap.dev/spec#message-op0x05.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ...common.arrays import IntArray
from .chunk import Block, Buffer


class BlockSource(Protocol):
    """Gives out the payloads of its blocks, and where in them the messages are."""

    def payload(self, block: Block) -> tuple[Buffer, int]:
        """The uncompressed bytes of a block, and where in them the message offsets count from.

        Returns:
            A buffer and the base offset (0 unless the block is unchunked).

        Raises:
            LogError: If the payload can't be decompressed or its CRC doesn't fit.
        """
        ...

    def payload_once(self, block: Block) -> tuple[Buffer, int, int]:
        """The uncompressed bytes of a block, checked, and not kept in memory for later.

        Returns:
            A buffer, and the first and one past the last byte of the payload in it.

        Raises:
            LogError: If the payload can't be decompressed or its CRC doesn't fit.
        """
        ...

    def inflates(self, block: Block, limit: int) -> bool:
        """Whether :meth:`inflate_into` can be used: a whole zstd chunk of no more than ``limit``.

        Args:
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

        Returns:
            For each channel the offsets of its records' opcode bytes, shape (n,), in the order of
            the index; they may be views of the file, to be let go of before it is closed.

        Raises:
            LogError: If the index or the payload is damaged.
        """
        ...

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """Where a channel's message records start in a block's payload.

        Returns:
            Offsets of the records' opcode bytes, shape (n,), in the order of the index.

        Raises:
            LogError: If the index or the payload is damaged.
        """
        ...

    def close(self) -> None:
        """Release what it holds."""
        ...


HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8")]
)
"""Start of a message record; the publish time and the message follow."""

BODY_AT = 31
"""Where the message starts in its record."""
FIXED_SIZE = 22
"""What a record's length counts before the message itself."""


def read_message_heads(data: Buffer, offsets: IntArray, stop: int) -> NDArray[np.void] | None:
    """The heads of message records, if whole messages lie where an index says.

    Args:
        data: A block's payload.
        offsets: Where they should start, shape (n,).
        stop: One past the payload's last byte.

    Returns:
        Of :data:`HEAD`, shape (n,); None if any is not a whole message.
    """
    if not len(offsets):
        return np.empty(0, HEAD)
    if offsets.min() < 0 or offsets.max() + BODY_AT > stop:
        return None
    heads = gather(data, offsets, HEAD)
    room = (stop - offsets - 9).astype(np.uint64)
    lengths = heads["length"]
    whole = (lengths >= FIXED_SIZE) & (lengths <= room) & (heads["opcode"] == Opcode.MESSAGE)
    return heads if whole.all() else None


def gather(
    data: Buffer | NDArray[np.uint8], at: IntArray, kind: np.dtype[Any] | str, shift: int = 0
) -> NDArray[Any]:
    """Records of one type at any offsets: an overlapping view with a stride of one byte.

    Args:
        at: Where to count from, shape (n,).
        shift: Where the records start, from there; all are whole.

    Returns:
        A copy, shape (n,).
    """
    record = np.dtype(kind)
    size = max(len(data) - shift - record.itemsize + 1, 0)
    return np.ndarray((size,), record, data, shift, (1,))[at]


@dataclass(frozen=True)
class Places:
    """Where messages start in a buffer.

    Attributes:
        at: Offsets, shape (n,).
        step: From each to the next, if they are evenly spaced and whole; otherwise None.
    """

    data: Buffer | NDArray[np.uint8]
    at: IntArray
    step: int | None = None

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.at)

    def take(self, rows: NDArray[Any] | slice) -> Places:
        """Some of them.

        Args:
            rows: Which, as numpy chooses, in order.

        Returns:
            Their places; evenly spaced if none between them is left out.
        """
        at, step = self.at[rows], self.step
        if step is not None and len(at) and int(at[-1] - at[0]) != step * (len(at) - 1):
            step = None
        return Places(self.data, at, step)

    def field(self, kind: np.dtype[Any] | str, shift: int) -> NDArray[Any]:
        """What lies at the same place in each.

        Args:
            shift: Offset from the message's start, not negative.

        Returns:
            Shape (n,): a view where they are evenly spaced, otherwise a copy.
        """
        if self.step is None:
            return gather(self.data, self.at, kind, shift)
        first = int(self.at[0]) + shift if len(self.at) else 0
        return np.ndarray((len(self.at),), kind, self.data, first, (self.step,))

    def rows(self, kind: np.dtype[Any], count: int, shift: int) -> NDArray[Any]:
        """Runs of numbers that lie at the same place in each.

        Args:
            shift: Offset from the message's start.

        Returns:
            Shape (n, count): a view where they are evenly spaced, otherwise a copy.
        """
        if not count:
            return np.empty((len(self.at), 0), kind)
        if self.step is None:
            run = kind if count == 1 else f"V{count * kind.itemsize}"
            return gather(self.data, self.at, run, shift).view(kind).reshape(len(self.at), count)
        first = int(self.at[0]) + shift if len(self.at) else 0
        steps = (self.step, kind.itemsize)
        return np.ndarray((len(self.at), count), kind, self.data, first, steps)
