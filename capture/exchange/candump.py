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
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from ..common.arrays import NS
from ..common.errors import ImportFormatError
from ..log.mcap.chunk import LAST_NS
from ..log.messages import frames as wire
from ..log.messages.frames import identifier_text
from .frame_log import FrameLog, FrameRow, LogBlock, blocks_of

_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    r"(?:((?:[0-9A-Fa-f]{2}){0,8})(?:_([9A-Fa-f]))?|R([0-8]?)|"
    r"#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}){0,64}))"
    r"(?:\s+([RTrt]))?\s*"
)


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
