"""Logs of CAN frames that other tools write, as blocks of frames.

candump is read here, other texts by python-can, binary formats by python-can and asammdf in a child
process. Logs whose times count from their own start (ASC, some TRC) are put at
:data:`.capture.exchange.frame_log.RELATIVE_EPOCH_NS`.
"""

from __future__ import annotations

import gzip
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO, cast

import numpy as np

from ..common.confined import Confined
from ..common.confined_child import Send
from ..common.errors import ImportFormatError, MissingExtraError, raised_as
from ..common.extras import defer, is_installed
from ..common.files import is_file, why_no_file
from ..common.packets import Packet
from ..log.messages.frames import FD_FRAME_DTYPE
from .candump import read_candump
from .frame_log import LATEST_NS, FrameLog, LogBlock

SUFFIXES = (".log", ".asc", ".blf", ".trc", ".csv", ".db", ".mf4")
"""Suffixes of the logs that can be read, each also with ``.gz`` behind it where it is text."""

_TEXTS = (".asc", ".trc", ".csv")
"""Read by Python code alone, line by line: no child process is needed."""

_CSV_HEADER = "timestamp,arbitration_id,"
"""How a CSV file begins that python-can wrote; any other needs a column map."""


@contextmanager
def open_frame_log(path: Path) -> Generator[FrameLog]:
    """Open a log of CAN frames by its suffix.

    Raises:
        ImportFormatError: If there is no such file, or its format isn't known or isn't that of
            its suffix; also while its blocks are taken.
        MissingExtraError: If the format is MF4 and its extra is not installed.
    """
    if not is_file(path):
        raise ImportFormatError(path, why_no_file(path))
    suffix = log_suffix(path)
    if suffix not in SUFFIXES:
        raise ImportFormatError(path, f"is no CAN log by its suffix; valid: {', '.join(SUFFIXES)}")
    if suffix == ".log":
        opener = gzip.open if path.suffix == ".gz" else open
        with cast("TextIO", opener(path, "rt", encoding="ascii", errors="replace")) as lines:
            yield _datable(read_candump(path, _lines(path, lines)))
        return
    if suffix in _TEXTS:
        from .can_readers import open_log

        with open_log(path, suffix) as log:
            yield _datable(log)
        return
    if suffix == ".mf4" and not is_installed("asammdf"):
        raise MissingExtraError(f"importing {path.name}", "mf4", "asammdf")
    with (
        TemporaryDirectory(prefix="undulog-") as scratch,
        closing(Confined(ImportFormatError)) as reader,
        closing(reader.stream(f"{__name__}:parse", path, suffix=suffix, scratch=scratch)) as taken,
    ):
        yield _datable(_received(taken))


def parse(path: Path, send: Send, *, suffix: str, scratch: str) -> None:
    """Send the frames of a log; runs in the child process.

    Args:
        scratch: Folder for temporary files.
    """
    defer()
    if suffix == ".mf4":
        from .mf4 import open_mf4

        opened = open_mf4(path, Path(scratch))
    else:
        from .can_readers import open_log

        opened = open_log(path, suffix)
    with opened as log:
        send(Packet(_facts(log)))
        for block in log.blocks:
            frames = block.frames.view(np.uint8).reshape(len(block), FD_FRAME_DTYPE.itemsize)
            arrays = {"frames": frames, "bus": block.bus, "is_fd": block.is_fd}
            send(Packet(_facts(log, block.done), arrays))
        send(Packet(_facts(log, 1.0)))


def _facts(log: FrameLog, done: float = 0.0) -> dict[str, Any]:
    kept = {"buses": log.buses, "problems": log.problems}
    return {**kept, "directions": log.directions, "time": log.time, "done": done}


def _received(packets: Iterator[Packet]) -> FrameLog:
    """Return the log whose facts and frames a child process sends."""
    first = next(packets).facts
    log = FrameLog(iter(()), [], bool(first["directions"]), first["time"], first["problems"])

    def blocks() -> Iterator[LogBlock]:
        for packet in packets:
            facts, arrays = packet.facts, packet.arrays
            log.buses[:], log.problems[:] = facts["buses"], facts["problems"]
            log.time = facts["time"]
            if arrays:
                frames = arrays["frames"].view(FD_FRAME_DTYPE).reshape(-1)
                yield LogBlock(frames, arrays["bus"], arrays["is_fd"], facts["done"])

    log.blocks = blocks()
    return log


def is_frame_csv(path: Path) -> bool:
    """Return whether a file is a CSV of CAN frames by python-can; False if it is unreadable."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as stream:
            return stream.readline().startswith(_CSV_HEADER)
    except OSError:
        return False


def _datable(log: FrameLog) -> FrameLog:
    """Leave out, and count, the frames whose time no stamp can hold."""
    log.blocks = _stampable(log.blocks, log)
    return log


def _stampable(blocks: Iterator[LogBlock], log: FrameLog) -> Iterator[LogBlock]:
    early = late = 0
    for block in blocks:
        t_ns = block.times_ns()
        kept = block[(t_ns >= 0) & (t_ns < LATEST_NS)]
        early += np.count_nonzero(t_ns < 0)
        late += np.count_nonzero(t_ns >= LATEST_NS)
        if len(kept):
            yield kept
    for count, when in ((early, "before 1970"), (late, "after 2038")):
        if count:
            log.problems.append(
                f"{count} frames are stamped {when}, which no stamp can hold: left out"
            )


def log_suffix(path: Path) -> str:
    """Return the suffix of the format in lower case, that before ``.gz``, e.g. ``.asc``."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return next((suffix for suffix in reversed(suffixes) if suffix != ".gz"), "")


def _lines(path: Path, stream: TextIO) -> Iterator[str]:
    """Yield the lines of a text; errors name the file."""
    with raised_as(ImportFormatError, path, "can't be read", OSError, EOFError):  # a damaged .gz
        yield from stream
