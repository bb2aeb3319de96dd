"""Frames packed one by one: for a few dozen at a time, cheaper than numpy's columns."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np

from ..log.messages.frames import FD_FRAME_DTYPE, FrameArray, frames_from_bytes

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
