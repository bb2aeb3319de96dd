"""Frames packed one by one: for a few dozen at a time, cheaper than numpy's columns.

What a packet to a ``unix:`` source looks like.

::

    [sequence:u64 dropped:u64]   optional head, 16 bytes, little-endian
    record[0..256]               32 bytes each: capture.log.frames.FRAME_DTYPE

``sequence`` is the running number of the packet's first frame among all that the sender had, from
0 at the connection's start; ``dropped`` how many of them it could not send. A head alone is a valid
packet: it tells of frames dropped after the last one sent. Whether there is a head is told by the
size.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np

from ..log.messages.frames import FD_FRAME_DTYPE, FRAME_DTYPE, FrameArray, frames_from_bytes

RECORD_SIZE = FRAME_DTYPE.itemsize
"""Bytes of one frame."""
MOST_RECORDS = 256
"""Frames in one packet at most."""
HEAD = struct.Struct("<QQ")
"""Head: sequence, dropped."""
LONGEST = HEAD.size + MOST_RECORDS * RECORD_SIZE
"""Bytes of the longest packet."""


pack_record = struct.Struct("<QQIBB2x8s").pack
"""Packs ``t_device_ns, t_host_ns, id_flags, dlc, dir, data`` as
:data:`.capture.log.messages.frames.FRAME_DTYPE` has them; data is filled with zeros."""

pack_fd_record = struct.Struct("<QQIBBBx64s").pack
"""Packs ``t_device_ns, t_host_ns, id_flags, len, dir, fd_flags, data`` as
:data:`.capture.log.messages.frames.FD_FRAME_DTYPE` has them; data is filled with zeros."""


def records(packed: Iterable[bytes]) -> FrameArray:
    """Put packed records together.

    Args:
        packed: What :data:`pack_record` gave.

    Returns:
        Shape (n,), writeable.
    """
    return frames_from_bytes(memoryview(bytearray().join(packed)))


def fd_records(packed: Iterable[bytes]) -> FrameArray:
    """Put packed records of CAN FD frames together.

    Args:
        packed: What :data:`pack_fd_record` gave.

    Returns:
        Shape (n,), writeable.
    """
    return np.frombuffer(bytearray().join(packed), dtype=FD_FRAME_DTYPE)
