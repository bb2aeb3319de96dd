"""Facts and arrays that one process hands to another without trust, in sealed shared memory.

A packet is a file in memory (memfd): a header in JSON, then the bytes of the arrays, written once.
It is sealed, so that the sender can change or shorten it no more, and the receiver maps it: its
arrays are views of those pages. Nothing in it is run or unpickled.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import socket
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PLAIN = "biufcMm"
"""Kinds of arrays that can be sent: those without references and without fields."""

_HEAD = struct.Struct("<Q")
_LARGEST_HEADER = 1 << 26
"""Bytes of a header; the names of 4,096 columns and the texts of a block take a quarter of it."""

_ALIGNED = 64
"""Alignment [byte], that of a cache line."""

_POPULATED = 1 << 24
"""Up to here all pages are mapped at once, which is faster than a fault for each [byte]."""

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL


@dataclass(frozen=True)
class Packet:
    """What is sent at once.

    Attributes:
        facts: Values of JSON.
        arrays: Arrays of numbers, times or truth values, of any shape and strides.
    """

    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])


class _Memory:
    """Bytes of memory that arrays cover, for NumPy."""

    def __init__(self, start: int, stop: int) -> None:
        self.__array_interface__ = {
            "data": (start, True), "shape": (stop - start,), "typestr": "|u1", "version": 3,
        }  # fmt: skip


def is_plain(array: NDArray[Any]) -> bool:
    """Return whether an array can be sent."""
    return array.dtype.kind in _PLAIN


def send(channel: socket.socket, packet: Packet) -> None:
    """Send a packet over a Unix socket that keeps the borders of messages.

    Views of one array are sent as views of one array: the bytes of each are sent once.

    Raises:
        OSError: If the other end is closed, or memory is refused.
    """
    descriptor = os.memfd_create("undulog", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        _write(descriptor, packet)
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEALS)
        socket.send_fds(channel, [b"P"], [descriptor])
    finally:
        os.close(descriptor)


def receive(channel: socket.socket, most: int, *, skip: bool = False) -> Packet | None:
    """Return the next packet; None if the other end is closed.

    Args:
        most: Bytes that it may have.
        skip: Whether to pass over messages that carry none.

    Raises:
        ValueError: If it is no packet, or a larger one.
        OSError: If the socket fails.
    """
    data, descriptors, _, _ = socket.recv_fds(channel, 16, 1)
    while data and skip and not descriptors:
        data, descriptors, _, _ = socket.recv_fds(channel, 16, 1)
    if not data:
        return None
    if len(descriptors) != 1:
        raise ValueError("a message without a packet")
    (descriptor,) = descriptors
    try:
        return _read(descriptor, most)
    finally:
        os.close(descriptor)


def _write(descriptor: int, packet: Packet) -> None:
    regions = _regions(_bounds(array) for array in packet.arrays.values() if array.size)
    at, places = 0, dict[int, int]()
    for start, stop in regions:
        at += -at % _ALIGNED + start % _ALIGNED
        places[start] = at
        at += stop - start
    starts = np.array(list(places), dtype=np.uint64)
    described: list[list[Any]] = []
    for name, array in packet.arrays.items():
        place = 0
        if array.size:
            first = array.__array_interface__["data"][0]
            start = int(starts[np.searchsorted(starts, first, side="right") - 1])
            place = places[start] + first - start
        described.append([name, array.dtype.str, array.shape, array.strides, place])
    text = json.dumps({"facts": packet.facts, "arrays": described}, ensure_ascii=False)
    header = text.encode("utf-8", "surrogatepass")
    begin = _begin(len(header))
    _write_at(descriptor, _HEAD.pack(len(header)) + header, 0)
    for start, stop in regions:
        _write_at(descriptor, np.asarray(_Memory(start, stop)).data, begin + places[start])


def _begin(header: int) -> int:
    """Return where the bytes of the arrays begin, behind a header of some bytes."""
    end = _HEAD.size + header
    return end + -end % _ALIGNED


def _bounds(array: NDArray[Any]) -> tuple[int, int]:
    """Return the addresses between which the elements of an array lie."""
    start = stop = int(array.__array_interface__["data"][0])
    for count, step in zip(array.shape, array.strides, strict=True):
        start += min(0, (count - 1) * step)
        stop += max(0, (count - 1) * step)
    return start, stop + array.itemsize


def _regions(bounds: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the union of regions of memory, in order."""
    joined: list[tuple[int, int]] = []
    for start, stop in sorted(bounds):
        if joined and start < joined[-1][1]:
            joined[-1] = joined[-1][0], max(stop, joined[-1][1])
        else:
            joined.append((start, stop))
    return joined


def _write_at(descriptor: int, data: bytes | memoryview, at: int) -> None:
    view = memoryview(data)
    while view:
        count = os.pwrite(descriptor, view, at)
        view, at = view[count:], at + count


def _read(descriptor: int, most: int) -> Packet:
    if fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & _SEALS != _SEALS:
        raise ValueError("a packet that is not sealed")
    size = os.fstat(descriptor).st_size
    if not _HEAD.size < size <= most:
        raise ValueError(f"a packet of {size} bytes")
    flags = mmap.MAP_SHARED | (mmap.MAP_POPULATE if size <= _POPULATED else 0)
    mapped = mmap.mmap(descriptor, size, flags=flags, prot=mmap.PROT_READ)
    (length,) = _HEAD.unpack_from(mapped)
    if not 0 < length <= min(_LARGEST_HEADER, size - _HEAD.size):
        raise ValueError(f"a header of {length} bytes")
    text = mapped[_HEAD.size : _HEAD.size + length].decode("utf-8", "surrogatepass")
    header = json.loads(text)
    begin, arrays = _begin(length), dict[str, NDArray[Any]]()
    for name, kind, shape, strides, place in header["arrays"]:
        dtype = np.dtype(kind)
        if dtype.kind not in _PLAIN:
            raise ValueError(f"an array of {kind}")
        if 0 in shape:
            arrays[name] = np.zeros(shape, dtype)
        else:  # it checks that the elements lie inside
            arrays[name] = np.ndarray(shape, dtype, mapped, begin + place, strides)
    return Packet(header["facts"], arrays)
