"""Messages of raw frames: a head that is the same but for three numbers, then the records.

They are ``std_msgs/msg/UInt8MultiArray`` like any other, and are written and read as such; but a
recorder writes hundreds a second, so the head is encoded once.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from .cdr import encode, layout_of
from .frames import FRAME_DTYPE, FRAME_LAYOUT, FrameArray
from .schemas import message_type

FRAMES_TYPE = "std_msgs/msg/UInt8MultiArray"
"""Type of a message of raw frames."""

_PAIR = struct.Struct("<II")
_COUNT = struct.Struct("<I")


@dataclass(frozen=True)
class _Head:
    """What stands before the records.

    Attributes:
        before: Bytes before the number and the length of the records.
        between: Bytes from there to the length of the data.
    """

    before: bytes
    between: bytes

    @property
    def size(self) -> int:
        return len(self.before) + _PAIR.size + len(self.between) + _COUNT.size


@lru_cache(maxsize=4)
def _head(label: str, record_size: int) -> _Head:
    dimensions = [
        {"label": "frame", "size": 0, "stride": 0},
        {"label": label, "size": record_size, "stride": record_size},
    ]
    kind = message_type(FRAMES_TYPE)
    empty = encode(kind, {"layout": {"dim": dimensions}, "data": np.empty(0, np.uint8)})
    leaves = layout_of(kind, empty).leaves
    at = leaves["layout.dim[0].size"].offset
    return _Head(empty[:at], empty[at + _PAIR.size : -_COUNT.size])


def frame_message(
    frames: FrameArray, label: str = FRAME_LAYOUT, dtype: np.dtype[Any] = FRAME_DTYPE
) -> bytes:
    """Encode frames.

    Args:
        frames: Records of ``dtype``, shape (n,).
        label: What the message says of a record's layout.
        dtype: The layout.

    Returns:
        The CDR message.
    """
    head, size = _head(label, dtype.itemsize), len(frames) * dtype.itemsize
    pair, count = _PAIR.pack(len(frames), size), _COUNT.pack(size)
    return b"".join((head.before, pair, head.between, count, frames.tobytes()))


def records_at(
    message: bytes, label: str = FRAME_LAYOUT, dtype: np.dtype[Any] = FRAME_DTYPE
) -> tuple[int, int] | None:
    """Where the records are in a message that :func:`frame_message` would write.

    Args:
        message: A CDR message, or its beginning and all that follows of it.
        label: What it has to say of a record's layout.
        dtype: The layout.

    Returns:
        Offset of the first record and number of records; None for any other message, also where
        it could mean the same.
    """
    head = _head(label, dtype.itemsize)
    at = len(head.before)
    count, size = (len(message) - head.size) // dtype.itemsize, len(message) - head.size
    if size < 0 or count * dtype.itemsize != size:
        return None
    same = message.startswith(head.before) and message.startswith(head.between, at + _PAIR.size)
    if not same or _PAIR.unpack_from(message, at) != (count, size):
        return None
    if _COUNT.unpack_from(message, head.size - _COUNT.size) != (size,):
        return None
    return head.size, count
