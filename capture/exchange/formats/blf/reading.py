"""Vector BLF files: python-can's reader, with the sizes that a file claims checked against it.

A file is a header and objects, most of them containers of compressed objects. A damaged size makes
python-can read the same object for ever, or reserve as much memory as a length field can state.
"""

from __future__ import annotations

import gzip
import logging
import struct
import zlib
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO, cast

from can import BLFReader, Message
from can.io.blf import (
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    NO_COMPRESSION,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
    BLFParseError,
)

from ...frame_log import FrameLog
from ...packed import is_packed
from ...python_can import python_can_log

LARGEST_CONTAINER = 64 << 20
"""Bytes that a container may expand to; Vector's tools and python-can write 128 KiB."""

_LOGGER = logging.getLogger("can.io.blf")
"""Its warnings become problems of the log."""

_FILE_HEADER_SIZE = 144
_LARGEST_HEADER = 1 << 16
_BASE_SIZE = OBJ_HEADER_BASE_STRUCT.size
_SIZE_AT = 8
"""Offset of an object's size in its header."""


@contextmanager
def open_blf(path: Path, scratch: Path) -> Generator[FrameLog]:  # noqa: ARG001 - as all openers
    """Open a file; runs in the child process.

    Raises:
        ImportFormatError: If it is no BLF file; also while its blocks are taken.
    """
    with python_can_log(path, lambda: CheckedBLFReader(path)) as log:
        yield log


class CheckedBLFReader(BLFReader):
    """Messages of a BLF file; raises BLFParseError where a size can't be right."""

    file: BinaryIO

    def __init__(self, path: Path) -> None:
        """Open a file and read its header.

        Raises:
            OSError: If it can't be read.
            BLFParseError: If it is no BLF file.
        """
        opened = gzip.open if is_packed(path) else open
        with ExitStack() as stack:
            stream = stack.enter_context(opened(path, "rb"))
            _check_header(stream.read(_FILE_HEADER_SIZE))
            stream.seek(0)
            super().__init__(cast("BinaryIO", stream))
            stack.pop_all()  # the reader closes it
        size = path.stat().st_size
        if self.file_size > size and not is_packed(path):
            _LOGGER.warning(
                "the file is cut short: %d bytes of the %d in its header", size, self.file_size
            )

    def __iter__(self) -> Iterator[Message]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Yield the messages of all containers."""
        while header := self.file.read(_BASE_SIZE):
            at = self.file.tell() - len(header)
            signature, _, _, size, kind = OBJ_HEADER_BASE_STRUCT.unpack(header)
            if signature != b"LOBJ" or size < _BASE_SIZE:
                raise BLFParseError(f"no object at byte {at}")
            data = self.file.read(min(size - _BASE_SIZE, LARGEST_CONTAINER))
            self.file.read(size % 4)  # padding
            if kind == LOG_CONTAINER:
                yield from self._parse_container(_expanded(data, at))
        self.stop()

    def _parse_data(self, data: bytes) -> Iterator[Message]:
        at = data.find(b"LOBJ", 0, 8)
        while 0 <= at <= len(data) - _BASE_SIZE:
            (size,) = struct.unpack_from("<I", data, at + _SIZE_AT)
            if size < _BASE_SIZE:
                raise BLFParseError(f"an object in a container states a size of {size} bytes")
            at = data.find(b"LOBJ", at + size, at + size + 8)
        return super()._parse_data(data)


def _check_header(header: bytes) -> None:
    size = int.from_bytes(header[4:8], "little")
    if header[:4] != b"LOGG" or not _FILE_HEADER_SIZE <= size <= _LARGEST_HEADER:
        raise BLFParseError("not a BLF file, or its header is damaged")


def _expanded(container: bytes, at: int) -> bytes:
    method, _ = LOG_CONTAINER_STRUCT.unpack_from(container)
    data = container[LOG_CONTAINER_STRUCT.size :]
    if method == NO_COMPRESSION:
        return data
    if method != ZLIB_DEFLATE:
        raise BLFParseError(f"the container at byte {at} has an unknown compression, {method}")
    expanded = zlib.decompressobj().decompress(data, LARGEST_CONTAINER + 1)
    if len(expanded) > LARGEST_CONTAINER:
        raise BLFParseError(
            f"the container at byte {at} expands to more than {LARGEST_CONTAINER >> 20} MiB"
        )
    return expanded
