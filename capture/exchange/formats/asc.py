"""Vector ASC: texts of CAN traces, by python-can."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from ...common.arrays import NS
from ...log.messages import frames as wire
from ...log.messages.frames import FrameArray
from ..frame_export import FrameWriter, WriteFrames
from ..frame_log import FrameFacts, FrameLog, LogBlock, is_error, possible, shorten
from ..frame_reader import FrameReader
from ..packed import open_packed_text
from .format import Format

if TYPE_CHECKING:
    from can import Message

_HEADER = re.compile(rb"\s*(date\s+\S|base\s+(hex|dec)\b)", re.IGNORECASE)


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    return float(_HEADER.match(head) is not None)


@contextmanager
def _read(path: Path) -> Generator[FrameLog]:
    from can import ASCReader

    from ..python_can import python_can_log

    def opened() -> ASCReader:
        return ASCReader(open_packed_text(path))

    with python_can_log(path, opened, corrected=_with_length_code) as log:
        yield log


def _with_length_code(message: Message) -> Message:
    """Correct the length code of an ASC frame, which the reader decodes as CAN FD's: 9 as 12."""
    from can.util import len2dlc

    if not message.is_fd and not message.is_remote_frame:
        message.dlc = len2dlc(message.dlc)
    return message


def _kept(block: LogBlock) -> FrameArray:
    """Keep data and remote frames at whole microseconds; of error frames only the time."""
    frames = possible(block)
    frames["t_host_ns"] = (frames["t_host_ns"] + 500) // 1000 * 1000
    empty = is_error(frames) & ~block.is_fd
    frames["id_flags"][empty] = wire.ERROR_FLAG
    for name in ("len", "data", "dir"):
        frames[name][empty] = 0
    # Readers take a length code above 8 for that of a CAN FD frame.
    shorten(frames, ~block.is_fd)
    return frames


@contextmanager
def _write(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    """Create a file; its times count from the last whole second before the first frame."""
    from can import ASCWriter

    from ..python_can import frames_to

    start_s = facts.start_ns // NS
    # The format's dates are local times, and its readers take them as such.
    date = datetime.fromtimestamp(start_s).strftime("%a %b %d %H:%M:%S.000 %Y")  # noqa: DTZ006
    with path.open("w", encoding="ascii", newline="\n") as stream, ASCWriter(stream) as writer:
        # The writer dates the file by the clock, and from a first frame's fraction of a second.
        stream.seek(0)
        stream.truncate()
        stream.write(f"date {date}\nbase hex  timestamps absolute\ninternal events logged\n")
        stream.write(f"Begin Triggerblock {date}\n{0:9.6f} Start of measurement\n")
        writer.header_written = True
        yield frames_to(writer, facts, start_s)


def _notes(facts: FrameFacts) -> Iterator[str]:
    from ..python_can import notes_on_buses

    return notes_on_buses(facts)


FORMAT = Format(
    "asc", "Vector ASC", (".asc",), _sniff, FrameReader(_read),
    FrameWriter("Vector ASC", _kept, _notes, _write), packed=True,
)  # fmt: skip
