"""The log format of ``candump -L``, read and written exactly.

One frame a line::

    (1717639553.000022) can0 14B#9B00000000000000 T

that is time [s], interface, identifier (three hexadecimal digits, eight if extended or an error
frame), data, and in newer versions the direction: ``T`` sent, ``R`` received. ``ID#R`` or
``ID#R8`` is a remote frame; ``_9`` to ``_F`` after eight data bytes is a raw length code above 8;
``ID##F`` begins a CAN FD frame with up to 64 data bytes, where ``F`` is a digit of flags. Source:
``lib.c`` of https://github.com/linux-can/can-utils.

Times are kept as integers, so what is read here and written again is the same text.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TextIO

from ...common.arrays import NS
from ...common.errors import ImportFormatError, raised_as
from ...log.mcap.chunk import LAST_NS
from ...log.messages import frames as wire
from ...log.messages.frames import FrameArray, identifier_text
from ..frame_export import FrameWriter, WriteFrames
from ..frame_log import (
    FrameFacts,
    FrameLog,
    FrameRow,
    LogBlock,
    blocks_of,
    is_error,
    is_remote,
    possible,
    shorten,
)
from ..frame_reader import FrameReader
from ..packed import open_packed_text
from .format import Format

_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    r"(?:((?:[0-9A-Fa-f]{2}){0,8})(?:_([9A-Fa-f]))?|R([0-8]?)|"
    r"#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}){0,64}))"
    r"(?:\s+([RTrt]))?\s*"
)


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    line, end, _ = head.partition(b"\n")
    return float(bool(end) and _LINE.fullmatch(line.decode("ascii", "replace")) is not None)


@contextmanager
def _read(path: Path) -> Generator[FrameLog]:
    with open_packed_text(path, encoding="ascii", errors="replace") as stream:
        yield read_candump(path, _lines(path, stream))


def _lines(path: Path, stream: TextIO) -> Iterator[str]:
    """Yield the lines of a text; errors name the file."""
    with raised_as(ImportFormatError, path, "can't be read", OSError, EOFError):  # a damaged .gz
        yield from stream


def read_candump(path: Path, lines: Iterator[str]) -> FrameLog:
    """Read a candump log.

    Args:
        lines: Its lines, with their line ends.

    Returns:
        The log; faults in its lines are raised while its blocks are taken.

    Raises:
        ImportFormatError: If a line is not in the format of candump, or there is no line.
    """
    head = next(lines, "")
    match = _LINE.fullmatch(head)
    if match is None:
        raise ImportFormatError(path, f"is not a candump log; its first line is {_quoted(head)}")
    log = FrameLog(iter(()), [], match[10] is not None, "as recorded, exact")
    size = max(path.stat().st_size, 1)
    log.blocks = blocks_of(_rows(path, chain([head], lines), log), lambda: log.read / size)
    return log


def _rows(path: Path, lines: Iterator[str], log: FrameLog) -> Iterator[FrameRow]:
    other_way = 0
    for number, line in enumerate(lines, start=1):
        log.read += len(line)
        match = _LINE.fullmatch(line)
        if match is None:
            if not line.strip():
                continue
            if not line.endswith("\n"):
                log.problems.append(f"the last line is cut short and left out: {_quoted(line)}")
                break
            raise ImportFormatError(path, f"line {number} is no candump line: {_quoted(line)}")
        other_way += (match[10] is not None) != log.directions
        yield _row(match, log)
    if other_way:
        having = "without" if log.directions else "with"
        log.problems.append(f"{other_way} frames {having} a direction, unlike the first one")


def _row(match: re.Match[str], log: FrameLog) -> FrameRow:
    seconds, fraction, bus, digits, data, raw_dlc, remote_dlc, fd_flags, fd_data, way = (
        match.groups()
    )
    identifier = int(digits, 16)
    flags = 0
    if len(digits) == 8:
        # candump prints the error flag within the digits, and nothing else above 29 bits.
        flags = wire.ERROR_FLAG if identifier & wire.ERROR_FLAG else wire.EXTENDED_FLAG
    content = bytes.fromhex(data or fd_data or "")
    length = int(raw_dlc, 16) if raw_dlc else len(content)
    if remote_dlc is not None:
        length = int(remote_dlc or 0)
        flags |= wire.REMOTE_FLAG
    return FrameRow(
        # No block holds a later time; nor does a stamp, so such frames are left out anyway.
        min(int(seconds) * NS + int(fraction.ljust(9, "0")), LAST_NS),
        (identifier & wire.ID_MASK) | flags,
        length,
        wire.DIR_TX if way in {"T", "t"} else wire.DIR_RX,
        log.bus_index(bus),
        fd_flags is not None,
        int(fd_flags, 16) if fd_flags else 0,
        content,
    )


def candump_lines(
    block: LogBlock, buses: Sequence[str], *, directions: bool, nanoseconds: bool
) -> Iterator[str]:
    """Format frames as candump does, one line a frame with its line end.

    Args:
        buses: Names of the buses, by the block's indices.
        directions: Whether to write ``R`` and ``T``.
        nanoseconds: Whether times have nine decimals; candump writes six.
    """
    digits, unit = (9, 1) if nanoseconds else (6, 1000)
    for t_ns, id_flags, length, way, bus, is_fd, fd_flags, data in block.rows():
        seconds, rest = divmod(t_ns, NS)
        payload = data.hex().upper()
        if is_fd:
            payload = f"#{fd_flags & 0xF:X}{payload}"
        elif id_flags & wire.REMOTE_FLAG:
            payload = f"R{length or ''}"
        elif length > 8:
            payload += f"_{length:X}"
        tail = (" T" if way == wire.DIR_TX else " R") if directions else ""
        time = f"({seconds}.{rest // unit:0{digits}d})"
        yield f"{time} {buses[bus]} {_identifier(id_flags)}#{payload}{tail}\n"


def _identifier(id_flags: int) -> str:
    if id_flags & wire.ERROR_FLAG:
        return f"{id_flags & (wire.ID_MASK | wire.ERROR_FLAG):08X}"
    return identifier_text(id_flags)


def _quoted(line: str) -> str:
    text = line.rstrip("\n")
    return repr(text if len(text) <= 60 else text[:57] + "...")


def _kept(block: LogBlock) -> FrameArray:
    """Keep everything but data of remote frames and further flags of error frames."""
    frames = possible(block)
    frames["id_flags"][is_error(frames)] &= wire.ID_MASK | wire.ERROR_FLAG
    shorten(frames, is_remote(frames))
    return frames


@contextmanager
def _write(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    options = {"directions": facts.directions, "nanoseconds": facts.nanoseconds}
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        yield lambda block: stream.writelines(candump_lines(block, facts.buses, **options))


FORMAT = Format(
    "candump", "candump trace", (".log",), _sniff, FrameReader(_read),
    FrameWriter("candump -L", _kept, lambda _: (), _write), packed=True,
)  # fmt: skip
