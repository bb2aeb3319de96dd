"""Message records of a block, many at a time: their heads, and copies of what follows.

Format: https://mcap.dev/spec#message-op0x05.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..arrays import IntArray
from .chunk import Buffer

HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8")]
)
"""Start of a message record; the publish time and the message follow."""

BODY_AT = 31
"""Where the message starts in its record."""
FIXED_SIZE = 22
"""What a record's length counts before the message itself."""


def read_heads(data: Buffer, offsets: IntArray, stop: int) -> NDArray[np.void] | None:
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


def gather(data: Buffer, at: IntArray, kind: np.dtype[Any] | str, shift: int = 0) -> NDArray[Any]:
    """Records of one type at any offsets: an overlapping view with a stride of one byte.

    Args:
        data: The bytes.
        at: Where to count from, shape (n,).
        kind: Their type.
        shift: Where the records start, from there; all are whole.

    Returns:
        A copy, shape (n,).
    """
    record = np.dtype(kind)
    size = max(len(data) - shift - record.itemsize + 1, 0)
    return np.ndarray((size,), record, data, shift, (1,))[at]
