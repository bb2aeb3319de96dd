"""Message records of a block, many at a time: their heads, and copies of their fields.

Format: https://mcap.dev/spec#message-op0x05.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ...common.arrays import IntArray
from .chunk import PREFIX_SIZE, Buffer

HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8")]
)
"""Start of a message record; the publish time and the message follow."""

MESSAGE = struct.Struct("<BQHIQQ")
"""Message record before the message: opcode, length, channel, sequence, log and publish time."""

BODY_AT = MESSAGE.size
"""Offset of the message in its record."""
FIXED_SIZE = BODY_AT - PREFIX_SIZE
"""Part of a record's length before the message."""


def read_message_heads(
    data: Buffer, offsets: IntArray, stop: int | IntArray
) -> NDArray[np.void] | None:
    """Return the heads of message records, if whole messages are at the offsets.

    Args:
        data: The payloads of one or more blocks.
        offsets: Where they should start, shape (n,).
        stop: One past the last byte of the payload; for several, of each record's, shape (n,).

    Returns:
        Of :data:`HEAD`, shape (n,); None if any is not a whole message.
    """
    if (offsets < 0).any() or (offsets + BODY_AT > stop).any():
        return None
    heads = gather(data, offsets, HEAD)
    room = (stop - offsets - 9).astype(np.uint64)
    lengths = heads["length"]
    whole = (lengths >= FIXED_SIZE) & (lengths <= room) & (heads["opcode"] == Opcode.MESSAGE)
    return heads if whole.all() else None


def gather(
    data: Buffer | NDArray[np.uint8], at: IntArray, kind: np.dtype[Any] | str, shift: int = 0
) -> NDArray[Any]:
    """Return items of one type at any offsets, through a view with a stride of one byte.

    Args:
        at: Offsets, shape (n,).
        shift: Offset of the items from there; all are whole.

    Returns:
        A copy, shape (n,).
    """
    record = np.dtype(kind)
    size = max(len(data) - shift - record.itemsize + 1, 0)
    return np.ndarray((size,), record, data, shift, (1,))[at]


@dataclass(frozen=True)
class Places:
    """Offsets of messages in a buffer.

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
        """Return some of them, in order; evenly spaced if none between them is left out."""
        at, step = self.at[rows], self.step
        if step is not None and len(at) and int(at[-1] - at[0]) != step * (len(at) - 1):
            step = None
        return Places(self.data, at, step)

    def field(self, kind: np.dtype[Any] | str, shift: int) -> NDArray[Any]:
        """Return one field of each message.

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
        """Return an array field of each message.

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
