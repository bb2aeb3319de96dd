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
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import IntArray
from ..common.errors import ImportFormatError
from ..log.mcap.chunk import LAST_NS
from ..log.messages.frames import (
    DIR_RX,
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    holds_fd,
)
from .frame_log import FRAMES_PER_BLOCK, BlockBuilder, FrameLog, LogBlock

_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    r"(?:((?:[0-9A-Fa-f]{2}){0,8})(?:_([9A-Fa-f]))?|R([0-8]?)|"
    r"#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}){0,64}))"
    r"(?:\s+([RTrt]))?\s*"
)
_NS = 1_000_000_000


def read_candump(path: Path, lines: Iterator[str]) -> FrameLog:
    """Read a candump log.

    Args:
        lines: Its lines, with their line ends.

    Returns:
        The log; faults in its lines are raised while its blocks are taken.

    Raises:
        ImportFormatError: If a line is not what candump writes, or there is none.
    """
    head = next(lines, "")
    match = _LINE.fullmatch(head)
    if match is None:
        raise ImportFormatError(path, f"is not a candump log; its first line is {_quoted(head)}")
    log = FrameLog(iter(()), [], match[10] is not None, "as recorded, exact")
    log.blocks = _blocks(path, chain([head], lines), log)
    return log


def _blocks(path: Path, lines: Iterator[str], log: FrameLog) -> Iterator[LogBlock]:
    rows = BlockBuilder()
    other_way = done = 0
    size = max(path.stat().st_size, 1)
    for number, line in enumerate(lines, start=1):
        done += len(line)
        match = _LINE.fullmatch(line)
        if match is None:
            if not line.strip():
                continue
            if not line.endswith("\n"):
                log.problems.append(f"the last line is cut short and left out: {_quoted(line)}")
                break
            raise ImportFormatError(path, f"line {number} is no candump line: {_quoted(line)}")
        other_way += (match[10] is not None) != log.directions
        _append(rows, match, log.buses)
        if len(rows) == FRAMES_PER_BLOCK:
            yield rows.block(done / size)
            rows = BlockBuilder()
    if other_way:
        having = "without" if log.directions else "with"
        log.problems.append(f"{other_way} frames {having} a direction, unlike the first one")
    if len(rows):
        yield rows.block(1.0)


def _append(rows: BlockBuilder, match: re.Match[str], buses: list[str]) -> None:
    seconds, fraction, bus, digits, data, raw_dlc, remote_dlc, fd_flags, fd_data, way = (
        match.groups()
    )
    identifier = int(digits, 16)
    flags = 0
    if len(digits) == 8:
        # candump prints the error flag within the digits, and nothing else above 29 bits.
        flags = ERROR_FLAG if identifier & ERROR_FLAG else EXTENDED_FLAG
    if bus not in buses:
        buses.append(bus)
    # No block holds a later time; nor does a stamp, so such frames are left out anyway.
    t_ns = min(int(seconds) * _NS + int(fraction.ljust(9, "0")), LAST_NS)
    if fd_flags is not None:
        content = bytes.fromhex(fd_data)
        length = len(content)
    elif remote_dlc is not None:
        content, length = b"", int(remote_dlc or 0)
        flags |= REMOTE_FLAG
    else:
        content = bytes.fromhex(data)
        length = int(raw_dlc, 16) if raw_dlc else len(content)
    rows.append(
        t_ns=t_ns,
        id_flags=(identifier & ID_MASK) | flags,
        length=length,
        way=DIR_TX if way in {"T", "t"} else DIR_RX,
        bus=buses.index(bus),
        data=content,
        fd_flags=None if fd_flags is None else int(fd_flags, 16),
    )


def candump_lines(
    frames: FrameArray,
    buses: list[str],
    bus: IntArray,
    *,
    directions: bool,
    nanoseconds: bool,
) -> Iterator[str]:
    """Frames as candump writes them.

    Args:
        frames: The frames, classic or CAN FD, in the order wanted, shape (n,).
        bus: Index into ``buses`` for each frame, shape (n,).
        directions: Whether to write ``R`` and ``T``.
        nanoseconds: Whether times have nine decimals rather than six, as candump has them.

    Yields:
        One line a frame, with its line end.
    """
    t_ns: NDArray[np.uint64] = frames["t_host_ns"]
    digits, unit = (9, 1) if nanoseconds else (6, 1000)
    fd = holds_fd(frames)
    columns = (
        t_ns.tolist(),
        frames["id_flags"].tolist(),
        frames["len" if fd else "dlc"].tolist(),
        frames["dir"].tolist(),
        bus.tolist(),
        (frames["fd_flags"] & 0xF).tolist() if fd else [0] * len(frames),
    )
    data, room = frames["data"].tobytes(), 64 if fd else 8
    for i, (t, id_flags, dlc, way, which, fd_flags) in enumerate(zip(*columns, strict=True)):
        seconds, rest = divmod(t, _NS)
        payload = data[room * i : room * i + min(dlc, room)].hex().upper()
        if fd:
            payload = f"#{fd_flags:X}{payload}"
        elif id_flags & REMOTE_FLAG:
            payload = f"R{dlc or ''}"
        elif dlc > 8:
            payload += f"_{dlc:X}"
        tail = (" T" if way == DIR_TX else " R") if directions else ""
        time = f"({seconds}.{rest // unit:0{digits}d})"
        yield f"{time} {buses[which]} {_identifier(id_flags)}#{payload}{tail}\n"


def _identifier(id_flags: int) -> str:
    if id_flags & ERROR_FLAG:
        return f"{id_flags & (ID_MASK | ERROR_FLAG):08X}"
    return f"{id_flags & ID_MASK:0{8 if id_flags & EXTENDED_FLAG else 3}X}"


def _quoted(line: str) -> str:
    text = line.rstrip("\n")
    return repr(text if len(text) <= 60 else text[:57] + "...")
