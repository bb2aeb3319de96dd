"""Raw CAN frames as the log keeps them: 32 bytes a classic frame, 88 a CAN FD frame.

``id_flags`` holds the identifier with the flag bits of Linux SocketCAN (``linux/can.h``). The two
kinds have separate topics, ``/can/BUS`` and ``/can_fd/BUS``.

A message of raw frames is a ``std_msgs/msg/UInt8MultiArray``: a head with three variable numbers,
then the records. A recorder writes hundreds of them a second, so the head is encoded once.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from .cdr import encode, layout_of
from .definitions import message_type

FrameArray: TypeAlias = NDArray[np.void]
"""Array of records of :data:`FRAME_DTYPE`, or :data:`FD_FRAME_DTYPE` where it says so, (n,)."""

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

FD_FRAME_DTYPE: np.dtype[np.void] = np.dtype(
    [
        ("t_device_ns", "<u8"),
        ("t_host_ns", "<u8"),
        ("id_flags", "<u4"),
        ("len", "u1"),
        ("dir", "u1"),
        ("fd_flags", "u1"),
        ("pad", "V1"),
        ("data", "u1", (64,)),
    ]
)
"""One CAN FD frame. ``len`` is the number of data bytes, as in ``struct canfd_frame``: beyond 8
every length has one code, so the code follows from it."""

FD_FRAME_LAYOUT = (
    "t_device_ns:u64,t_host_ns:u64,id_flags:u32,len:u8,dir:u8,fd_flags:u8,pad:1,data:64"
)
"""The label of the record dimension in the log."""

FRAME_TOPIC_PREFIX = "/can/"
"""Classic frames of bus ``can0`` are on ``/can/can0``."""

FD_TOPIC_PREFIX = "/can_fd/"
"""CAN FD frames of bus ``can0`` are on ``/can_fd/can0``."""

SERIAL_TOPIC_PREFIX = "/serial/"
"""Packets of serial servos on line ``ttyUSB0`` are on ``/serial/ttyUSB0``."""
SERIAL_MORE = 0x40
"""``fd_flags`` of a serial record: the packet goes on in the next record."""
SERIAL_NOISE = 0x80
"""``fd_flags`` of a serial record: bytes that belong to no packet with a valid checksum."""

FRAME_TOPIC_PREFIXES = (FRAME_TOPIC_PREFIX, FD_TOPIC_PREFIX)
"""How the topics of raw frames begin."""

FD_BRS = 0x01
"""``fd_flags``: the data were sent at the second bit rate."""
FD_ESI = 0x02
"""``fd_flags``: the sender is error passive."""

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

FRAMES_TYPE = "std_msgs/msg/UInt8MultiArray"
"""Type of a message of raw frames."""

_PAIR = struct.Struct("<II")
_COUNT = struct.Struct("<I")


def bus_of(topic: str) -> str:
    """Return the name of the bus of a topic that begins with one of the prefixes above."""
    return topic.removeprefix(FRAME_TOPIC_PREFIX).removeprefix(FD_TOPIC_PREFIX)


def empty_frames(count: int) -> FrameArray:
    """Return zeroed frame records, shape (count,), padding included."""
    return np.zeros(count, dtype=FRAME_DTYPE)


def empty_fd_frames(count: int) -> FrameArray:
    """Return zeroed records of :data:`FD_FRAME_DTYPE`, shape (count,), padding included."""
    return np.zeros(count, dtype=FD_FRAME_DTYPE)


def holds_fd(frames: FrameArray) -> bool:
    """Whether records are of :data:`FD_FRAME_DTYPE`."""
    return frames.dtype == FD_FRAME_DTYPE


def data_lengths(frames: FrameArray) -> NDArray[np.uint8]:
    """Return the number of data bytes of frames.

    Args:
        frames: Records of :data:`FRAME_DTYPE` or :data:`FD_FRAME_DTYPE`, shape (n,).

    Returns:
        At most 8 or 64, shape (n,). A remote frame of a length has as many, all zero.
    """
    return np.minimum(frames["len"], 64) if holds_fd(frames) else np.minimum(frames["dlc"], 8)


def widened(frames: FrameArray) -> FrameArray:
    """Return frames with room for 64 data bytes, so that one array can hold both kinds.

    Args:
        frames: Records of :data:`FRAME_DTYPE` or :data:`FD_FRAME_DTYPE`, shape (n,).

    Returns:
        Records of :data:`FD_FRAME_DTYPE`, shape (n,); CAN FD frames are not copied.
    """
    if holds_fd(frames):
        return frames
    wide = empty_fd_frames(len(frames))
    for name in ("t_device_ns", "t_host_ns", "id_flags", "dir"):
        wide[name] = frames[name]
    wide["len"] = data_lengths(frames)
    wide["data"][:, :8] = frames["data"]
    return wide


def in_one(arrays: Sequence[FrameArray]) -> FrameArray:
    """Return one array of frames of one or both kinds.

    Args:
        arrays: Records of :data:`FRAME_DTYPE` or :data:`FD_FRAME_DTYPE`, at least one array.

    Returns:
        A copy; records of :data:`FD_FRAME_DTYPE` if any array has them.
    """
    if any(holds_fd(frames) for frames in arrays):
        arrays = [widened(frames) for frames in arrays]
    return np.concatenate(arrays)


def frames_from_bytes(data: bytes | memoryview[Any]) -> FrameArray:
    """Read records from a message's payload.

    Args:
        data: A multiple of 32 bytes.

    Returns:
        A view of the bytes, shape (len(data) / 32,).
    """
    return np.frombuffer(data, dtype=FRAME_DTYPE)


def join_batches(
    batches: Sequence[tuple[IntArray, IntArray, FrameArray]],
    dtype: np.dtype[np.void] = FRAME_DTYPE,
) -> FrameArray:
    """Return one array of the frames of messages of different sizes.

    Args:
        batches: For messages of one size: their log times [Unix ns], shape (n,), their order in
            the file, shape (n,), and their frames, shape (n, frames per message).

    Returns:
        The frames of all messages by log time, then file order, shape (total,).
    """
    if not batches:
        return np.zeros(0, dtype=dtype)
    log_ns = np.concatenate([times for times, _, _ in batches])
    place = np.concatenate([places for _, places, _ in batches])
    in_order = (log_ns[1:] > log_ns[:-1]) | (
        (log_ns[1:] == log_ns[:-1]) & (place[1:] >= place[:-1])
    )
    if len(batches) == 1 and in_order.all():  # the usual case: nothing is moved
        return np.ascontiguousarray(batches[0][2]).reshape(-1)
    sizes = np.concatenate([np.full(len(frames), frames.shape[1]) for _, _, frames in batches])
    order = np.lexsort((place, log_ns))
    starts = np.empty(len(order), dtype=np.int64)
    starts[order] = np.cumsum(sizes[order]) - sizes[order]
    joined = np.zeros(int(sizes.sum()), dtype=dtype)
    done = 0
    for _, _, frames in batches:
        at = starts[done : done + len(frames)]
        joined[at[:, None] + np.arange(frames.shape[1])] = frames
        done += len(frames)
    return joined


def identifier_text(id_flags: int) -> str:
    """Return an identifier as candump writes it: three hexadecimal digits, or eight if extended.

    Returns:
        E.g. ``14B`` or ``18FEF100``.
    """
    return f"{id_flags & ID_MASK:0{8 if id_flags & EXTENDED_FLAG else 3}X}"


@lru_cache(maxsize=4)
def _head(label: str, record_size: int) -> tuple[bytes, bytes]:
    """Return the bytes before number and length of the records, and from there to the length."""
    dimensions = [
        {"label": "frame", "size": 0, "stride": 0},
        {"label": label, "size": record_size, "stride": record_size},
    ]
    kind = message_type(FRAMES_TYPE)
    empty = encode(kind, {"layout": {"dim": dimensions}, "data": np.empty(0, np.uint8)})
    at = layout_of(kind, empty).leaves["layout.dim[0].size"].offset
    return empty[:at], empty[at + _PAIR.size : -_COUNT.size]


def frame_message(
    frames: FrameArray, label: str = FRAME_LAYOUT, dtype: np.dtype[Any] = FRAME_DTYPE
) -> bytes:
    """Encode frames, records of ``dtype``, shape (n,), with the label of their layout."""
    (before, between), size = _head(label, dtype.itemsize), len(frames) * dtype.itemsize
    pair, count = _PAIR.pack(len(frames), size), _COUNT.pack(size)
    return b"".join((before, pair, between, count, frames.tobytes()))


def records_at(
    message: bytes, label: str = FRAME_LAYOUT, dtype: np.dtype[Any] = FRAME_DTYPE
) -> tuple[int, int] | None:
    """Find the records in a message of the form of :func:`frame_message`.

    Args:
        message: A CDR message.
        label: Required label of the records' layout.

    Returns:
        Offset of the first record and number of records; None for a message of another form.
    """
    before, between = _head(label, dtype.itemsize)
    pair_at = len(before)
    between_at = pair_at + _PAIR.size
    start = between_at + len(between) + _COUNT.size
    size = len(message) - start
    count = size // dtype.itemsize
    if size < 0 or count * dtype.itemsize != size:
        return None
    if not message.startswith(before) or not message.startswith(between, between_at):
        return None
    if _PAIR.unpack_from(message, pair_at) != (count, size):
        return None
    if _COUNT.unpack_from(message, start - _COUNT.size) != (size,):
        return None
    return start, count
