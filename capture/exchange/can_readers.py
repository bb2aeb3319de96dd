"""Logs of CAN frames by python-can; run in a child process (:mod:`.capture.exchange.can_logs`).

python-can hands out times as floating-point seconds, which at today's Unix time resolve 0.24 us;
they are rounded to 1 us, the resolution of the formats it reads.

Vector BLF files: python-can's reader, with the sizes that a file claims checked against it.

A file is a header and objects, most of them containers of compressed objects. A damaged size makes
python-can read the same object for ever, or reserve as much memory as a length field can state.
"""

from __future__ import annotations

import gzip
import io
import logging
import os
import sqlite3
import struct
import zlib
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from can import BLFReader, Message
from can.io.blf import (
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    NO_COMPRESSION,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
    BLFParseError,
)

from ..common.databases import check_pages, open_database
from ..common.errors import ImportFormatError, raised_as
from ..log.messages import frames as wire
from .frame_log import FrameLog, FrameRow, blocks_of

if TYPE_CHECKING:
    from can.io.generic import MessageReader


LARGEST_CONTAINER = 64 << 20
"""Bytes that a container may expand to; Vector's tools and python-can write 128 KiB."""

_FILE_HEADER_SIZE = 144
_LARGEST_HEADER = 1 << 16
_BASE_SIZE = OBJ_HEADER_BASE_STRUCT.size
_SIZE_AT = 8
"""Offset of an object's size in its header."""

_MOST_TEXTS = 20  # different warnings of a library that are reported
_LINES_LEFT_OUT = ("Unsupported type", "Dropping bus info line")
_WITHOUT_DIRECTIONS = (".csv", ".db")
_LATEST_S = 8e9  # the year 2223; a time from the log's start fits behind its epoch, too
_MOST_BYTES = 64

_READ_ERRORS = (
    ValueError,  # text that is no number, a wrong file version
    LookupError,
    TypeError,
    AttributeError,  # of None
    ArithmeticError,  # infinite or huge times
    EOFError,
    OSError,
    struct.error,
    zlib.error,
    sqlite3.Error,
    BLFParseError,
)
"""What python-can's readers raise on a damaged file."""


class CheckedBLFReader(BLFReader):
    """Messages of a BLF file; raises BLFParseError where a size can't be right."""

    file: BinaryIO

    def __init__(self, path: Path) -> None:
        """Open a file and read its header.

        Raises:
            OSError: If it can't be read.
            BLFParseError: If it is no BLF file.
        """
        opened = gzip.open if path.suffix.lower() == ".gz" else open
        with ExitStack() as stack:
            stream = stack.enter_context(opened(path, "rb"))
            _check_header(stream.read(_FILE_HEADER_SIZE))
            stream.seek(0)
            super().__init__(cast("BinaryIO", stream))
            stack.pop_all()  # the reader closes it

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


@contextmanager
def open_log(path: Path, suffix: str) -> Generator[FrameLog]:
    """Open a log of CAN frames that python-can reads.

    Args:
        suffix: Of its format, in lower case.

    Raises:
        ImportFormatError: If its format isn't that of its suffix; also while its blocks are taken.
    """
    problems: list[str] = []
    with _noted("can", problems):
        reader = _reader(path, suffix)
    try:
        yield _python_can_log(path, reader, suffix, problems)
    finally:
        reader.stop()


def _reader(path: Path, suffix: str) -> MessageReader:
    from can import LogReader

    with raised_as(ImportFormatError, path, "can't be read", *_READ_ERRORS):
        if suffix == ".blf":
            return CheckedBLFReader(path)
        if suffix == ".db":
            _check_database(path)
        return LogReader(path)


def _check_database(path: Path) -> None:
    """Refuse what isn't plain, and data that is a number: it would count as a number of bytes."""
    with open_database(path, ["messages"], immutable=False) as base:
        check_pages(base)
        number = "typeof(data) IN ('integer', 'real')"
        count = base.execute(f"SELECT count(*) FROM messages WHERE {number}").fetchone()[0]  # noqa: S608
    if count:
        raise ValueError(f"{count} rows have a number as data")


def _python_can_log(
    path: Path, reader: MessageReader, suffix: str, problems: list[str]
) -> FrameLog:
    log = FrameLog(
        blocks=iter(()),
        buses=[],
        directions=suffix not in _WITHOUT_DIRECTIONS,
        time="as recorded, rounded to 1 us",
        problems=problems,
    )
    messages = _messages(path, reader)
    if suffix == ".asc":
        messages = map(_with_length_code, messages)
    log.blocks = blocks_of(_rows(path, messages, log), lambda: _read_part(reader))
    claimed = getattr(reader, "file_size", 0)  # of a BLF file, by its header
    if suffix == ".blf" and claimed > path.stat().st_size:
        log.problems.append(
            f"the file is cut short: {path.stat().st_size} bytes of the {claimed} in its header"
        )
    return log


def _messages(path: Path, reader: Iterable[Message]) -> Iterator[Message]:
    """Yield the reader's messages; errors name the file and the position."""
    count = 0
    try:
        for message in reader:
            yield message
            count += 1
    except _READ_ERRORS as error:
        raise ImportFormatError(path, f"can't be read after {count} frames: {error}") from error


def _read_part(reader: MessageReader) -> float:
    """Return the share of its file that a reader has read, 0 to 1; 0 if it is unknown."""
    stream = getattr(reader, "file", None)
    raw = getattr(
        stream, "buffer", stream
    )  # of a text stream, whose tell() fails while it is iterated
    if not isinstance(raw, io.BufferedIOBase):
        return 0.0
    try:
        return raw.tell() / os.fstat(raw.fileno()).st_size
    except (OSError, ZeroDivisionError):
        return 0.0


def _rows(path: Path, messages: Iterator[Message], log: FrameLog) -> Iterator[FrameRow]:
    epoch_ns, invalid, unmarked = None, 0, 0
    with _noted("can", log.problems):
        for message in messages:
            if not _is_frame(message):
                invalid += 1
                continue
            if epoch_ns is None:
                epoch_ns = log.epoch_ns(message.timestamp * 1e9, "rounded to 1 us")
            unmarked += not message.is_fd and len(message.data) > 8
            yield _row(path, message, log, epoch_ns)
    if invalid:
        log.problems.append(
            f"{invalid} records are no CAN frames (a time, an identifier, a length or data that "
            "can't be) and are left out"
        )
    if unmarked:
        log.problems.append(
            f"{unmarked} frames of more than 8 bytes are CAN FD frames; the log does not mark "
            "them, and shorter ones count as classic"
        )


def _is_frame(message: Message) -> bool:
    """Return whether a record of a damaged file can be a frame."""
    record: Any = message  # a database and a damaged file have any type and value
    time, identifier, code = record.timestamp, record.arbitration_id, record.dlc
    return (
        isinstance(time, int | float)
        and -_LATEST_S < time < _LATEST_S
        and isinstance(identifier, int)
        and 0 <= identifier <= wire.ID_MASK
        and isinstance(code, int)
        and 0 <= code <= _MOST_BYTES
        and isinstance(record.data, bytes | bytearray | memoryview)
    )


def _row(path: Path, message: Message, log: FrameLog, epoch_ns: int) -> FrameRow:
    t_ns = epoch_ns + round(message.timestamp * 1e6) * 1000
    if t_ns < 0:
        raise ImportFormatError(path, f"has a frame at {message.timestamp} s, before 1970")
    channel = message.channel
    # An error frame reports an event on the bus and is neither classic nor CAN FD.
    is_fd = (message.is_fd or len(message.data) > 8) and not message.is_error_frame
    data = bytes(message.data[: 64 if is_fd else 8])
    flags = (
        (wire.ERROR_FLAG if message.is_error_frame else 0)
        # None in CAN FD: python-can takes empty frames for such.
        | (wire.REMOTE_FLAG if message.is_remote_frame and not is_fd else 0)
        | (wire.EXTENDED_FLAG if message.is_extended_id and not message.is_error_frame else 0)
    )
    fd_flags = (wire.FD_BRS if message.bitrate_switch else 0) | (
        wire.FD_ESI if message.error_state_indicator else 0
    )
    return FrameRow(
        t_ns=t_ns,
        id_flags=message.arbitration_id | flags,
        length=len(data) if is_fd else message.dlc,
        way=wire.DIR_RX if message.is_rx else wire.DIR_TX,
        bus=log.bus_index(f"can{channel}" if isinstance(channel, int) else str(channel or "can0")),
        is_fd=is_fd,
        fd_flags=fd_flags if is_fd else 0,
        data=data,
    )


def _with_length_code(message: Message) -> Message:
    """Correct the length code of an ASC frame, which the reader decodes as CAN FD's: 9 as 12."""
    from can.util import len2dlc

    if not message.is_fd and not message.is_remote_frame:
        message.dlc = len2dlc(message.dlc)
    return message


class _Noting(logging.Handler):
    """Keeps the warnings of a logger: each text once, with how often it came."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__(logging.INFO)
        self._problems = problems
        self._seen: dict[str, tuple[int, int]] = {}  # text to its place and how often

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno < logging.WARNING and not any(word in text for word in _LINES_LEFT_OUT):
            return
        if text not in self._seen and len(self._seen) >= _MOST_TEXTS:
            text = "more lines of this kind"
        place, count = self._seen.get(text, (len(self._problems), 0))
        self._seen[text] = place, count + 1
        if count:
            self._problems[place] = f"{text} ({count + 1} times)"
        else:
            self._problems.append(text)


@contextmanager
def _noted(name: str, problems: list[str]) -> Generator[None]:
    """Note what a library only warns of, e.g. a line that it passes over."""
    logger, handler = logging.getLogger(name), _Noting(problems)
    trc = logging.getLogger("can.io.trc")  # it passes over lines without a warning
    level = trc.level
    logger.addHandler(handler)
    trc.setLevel(logging.INFO)
    try:
        yield
    finally:
        trc.setLevel(level)
        logger.removeHandler(handler)
