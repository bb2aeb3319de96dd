"""Raw CAN frames as the log keeps them: 32 bytes a frame, many frames a message.

``id_flags`` holds the identifier with the flag bits of Linux SocketCAN (``linux/can.h``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray

FrameArray: TypeAlias = NDArray[np.void]
"""Array of records of :data:`FRAME_DTYPE`, shape (n,)."""

FRAME_DTYPE: np.dtype[np.void] = np.dtype(
    [
        ("t_device_ns", "<u8"),
        ("t_host_ns", "<u8"),
        ("id_flags", "<u4"),
        ("dlc", "u1"),
        ("dir", "u1"),
        ("pad", "V2"),
        ("data", "u1", (8,)),
    ]
)
"""One classic CAN frame: device and host time [Unix ns], identifier, length, way, data."""

FRAME_LAYOUT = "t_device_ns:u64,t_host_ns:u64,id_flags:u32,dlc:u8,dir:u8,pad:2,data:8"
"""The label of the record dimension in the log."""

EXTENDED_FLAG = 0x8000_0000
"""29-bit identifier."""
REMOTE_FLAG = 0x4000_0000
"""Remote transmission request."""
ERROR_FLAG = 0x2000_0000
"""Error frame."""
ID_MASK = 0x1FFF_FFFF
"""The identifier without flags."""

DIR_RX = 0
"""Received from the bus."""
DIR_TX = 1
"""Sent by the recording computer."""


def empty_frames(count: int) -> FrameArray:
    """An array of zeroed frame records.

    Args:
        count: Number of records.

    Returns:
        Shape (count,), every byte zero, padding included.
    """
    return np.zeros(count, dtype=FRAME_DTYPE)


def frames_from_bytes(data: bytes | memoryview[Any]) -> FrameArray:
    """Read records from a message's payload.

    Args:
        data: A multiple of 32 bytes.

    Returns:
        A view of the bytes, shape (len(data) / 32,).
    """
    return np.frombuffer(data, dtype=FRAME_DTYPE)


def join_batches(batches: Sequence[tuple[IntArray, IntArray, FrameArray]]) -> FrameArray:
    """One array of frames from messages of different sizes.

    Args:
        batches: For messages of one size: their log times [Unix ns], shape (n,), their places in
            the file, shape (n,), and their frames, shape (n, frames a message).

    Returns:
        The frames of all messages, by log time and then place, shape (total,).
    """
    if not batches:
        return empty_frames(0)
    log_ns = np.concatenate([each for each, _, _ in batches])
    place = np.concatenate([each for _, each, _ in batches])
    in_order = (log_ns[1:] > log_ns[:-1]) | (
        (log_ns[1:] == log_ns[:-1]) & (place[1:] >= place[:-1])
    )
    if len(batches) == 1 and in_order.all():  # the usual case: nothing is moved
        return np.ascontiguousarray(batches[0][2]).reshape(-1)
    sizes = np.concatenate([np.full(len(frames), frames.shape[1]) for _, _, frames in batches])
    order = np.lexsort((place, log_ns))
    starts = np.empty(len(order), dtype=np.int64)
    starts[order] = np.cumsum(sizes[order]) - sizes[order]
    joined = empty_frames(int(sizes.sum()))
    done = 0
    for _, _, frames in batches:
        at = starts[done : done + len(frames)]
        joined[at[:, None] + np.arange(frames.shape[1])] = frames
        done += len(frames)
    return joined
