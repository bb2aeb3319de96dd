"""Logs of CAN frames read and written by python-can.

python-can hands out times as floating-point seconds, which at today's Unix time resolve 0.24 us;
they are rounded to 1 us, the resolution of the formats it reads.
"""

from __future__ import annotations

import io
import logging
import os
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from can import Message
from can.io.blf import BLFParseError
from can.io.generic import MessageReader, MessageWriter

from ..common.arrays import NS
from ..common.errors import ImportFormatError, raised_as
from ..log.messages import frames as wire
from .frame_export import WriteFrames
from .frame_log import FrameFacts, FrameLog, FrameRow, LogBlock, blocks_of

_MOST_TEXTS = 20  # different warnings of a library that are reported
_LINES_LEFT_OUT = ("Unsupported type", "Dropping bus info line")
_LATEST_S = 8e9  # the year 2223; a time from the log's start fits behind its epoch, too
_MOST_BYTES = 64
_NUMBERED = re.compile(r"can(0|[1-9]\d{0,3})")

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


@contextmanager
def python_can_log(
    path: Path,
    open_reader: Callable[[], MessageReader],
    *,
    directions: bool = True,
    corrected: Callable[[Message], Message] | None = None,
) -> Generator[FrameLog]:
    """Open a log that python-can reads.

    Args:
        open_reader: Returns its reader, which is stopped at the end.
        directions: Whether the format has directions.
        corrected: Applied to each message.

    Raises:
        ImportFormatError: If its format isn't that of its reader; also while its blocks are taken.
    """
    problems: list[str] = []
    with (
        _noted("can", problems),
        raised_as(ImportFormatError, path, "can't be read", *_READ_ERRORS),
    ):
        reader = open_reader()
    log = FrameLog(iter(()), [], directions, "as recorded, rounded to 1 us", problems)
    messages = _messages(path, reader)
    rows = _rows(path, map(corrected, messages) if corrected else messages, log)
    log.blocks = blocks_of(rows, lambda: _read_part(reader))
    try:
        yield log
    finally:
        reader.stop()


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
    silent = logging.getLogger("can.io.trc")  # it passes over lines without a warning
    level = silent.level
    logger.addHandler(handler)
    silent.setLevel(logging.INFO)
    try:
        yield
    finally:
        silent.setLevel(level)
        logger.removeHandler(handler)


def channel_numbers(buses: Sequence[str]) -> list[int]:
    """Return numbers for buses in formats that have no names, counted from 0 as python-can does.

    Returns:
        N for a bus ``canN``, so that an import names it the same; the lowest free number for any
        other.
    """
    matches = [_NUMBERED.fullmatch(name) for name in buses]
    taken = {int(match[1]) for match in matches if match}
    free = (number for number in range(len(buses) + len(taken)) if number not in taken)
    return [int(match[1]) if match else next(free) for match in matches]


def notes_on_buses(facts: FrameFacts) -> Iterator[str]:
    """Report changed bus names and missing directions."""
    for name, number in zip(facts.buses, channel_numbers(facts.buses), strict=True):
        if name != f"can{number}":
            yield f"it has no names: bus {name} is channel {number + 1}"
    if not facts.directions:
        yield "no directions were recorded: all frames are written as received"


def frames_to(writer: MessageWriter, facts: FrameFacts, start_s: int) -> WriteFrames:
    """Return what hands frames to a writer of python-can, timed from ``start_s`` [Unix s]."""
    channels = channel_numbers(facts.buses)

    def write(block: LogBlock) -> None:
        for row in block.rows():
            message = Message(
                timestamp=(row.t_ns - start_s * NS + 0.5) / NS,  # python-can cuts to whole ns
                arbitration_id=row.id_flags & wire.ID_MASK,
                is_extended_id=bool(row.id_flags & wire.EXTENDED_FLAG),
                is_remote_frame=bool(row.id_flags & wire.REMOTE_FLAG),
                is_error_frame=bool(row.id_flags & wire.ERROR_FLAG),
                channel=channels[row.bus],
                dlc=row.length,
                data=row.data,
                is_rx=row.way != wire.DIR_TX,
                is_fd=row.is_fd,
                bitrate_switch=bool(row.fd_flags & wire.FD_BRS),
                error_state_indicator=bool(row.fd_flags & wire.FD_ESI),
            )
            writer(message)

    return write
