"""Vector BLF: what a file keeps of frames, and how it is read and written."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

from ....common.arrays import NS
from ....log.messages import frames as wire
from ....log.messages.frames import FrameArray
from ...confined_log import confined
from ...frame_export import FrameWriter, WriteFrames
from ...frame_log import FrameFacts, LogBlock, is_error, possible, shorten
from ...frame_reader import FrameReader
from ..format import Format

_BLF_EPOCH_NS = 631_152_000 * NS  # 1990: python-can takes less for no date


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    return float(head.startswith(b"LOGG"))


def _kept(block: LogBlock) -> FrameArray:
    """Keep everything but data of remote frames, and directions and flags of error frames."""
    frames = possible(block)
    error = is_error(frames)
    frames["id_flags"][error] &= wire.ID_MASK | wire.ERROR_FLAG
    shorten(frames, error & ~block.is_fd)
    frames["dir"][error & ~block.is_fd] = wire.DIR_RX
    return frames


def _notes(facts: FrameFacts) -> Iterator[str]:
    """Report changed bus names, missing directions, and dates before 1990."""
    from ...python_can import notes_on_buses

    yield from notes_on_buses(facts)
    if facts.start_ns < _BLF_EPOCH_NS:
        yield "its dates begin in 1990: the times are those since 1970, without a date"


@contextmanager
def _write(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    """Create a file; its times count from the last whole second before the first frame."""
    from can import BLFWriter

    from ...python_can import frames_to

    dated = facts.start_ns >= _BLF_EPOCH_NS
    start_s = facts.start_ns // NS if dated else 0
    with BLFWriter(path) as writer:
        # Counted from the start, times are exact to 1 ns; as Unix times, which python-can
        # keeps as floating-point seconds, they would be to 240 ns.
        writer.start_timestamp = 0.0
        yield frames_to(writer, facts, start_s)
        writer.start_timestamp = float(start_s) if dated else None
        writer.stop_timestamp = facts.end_ns / NS


FORMAT = Format(
    "blf", "Vector BLF", (".blf",), _sniff,
    FrameReader(confined(f"{__package__}.reading:open_blf")),
    FrameWriter("Vector BLF", _kept, _notes, _write), packed=True,
)  # fmt: skip
