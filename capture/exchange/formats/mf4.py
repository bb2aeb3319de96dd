"""MF4, the measurement format of ASAM (MDF 4), as loggers write CAN frames into it; by asammdf.

The frames lie in channel groups, one for each kind of frame and often one for each bus. A group has
a channel for each field, as columns: ``CAN_DataFrame.ID``, ``.IDE``, ``.DLC``, ``.DataLength``,
``.DataBytes``, ``.Dir``, ``.BusChannel``; ``CAN_RemoteFrame`` and ``CAN_ErrorFrame`` have the same
names; CAN FD frames have ``.EDL``, ``.BRS`` and ``.ESI`` besides. Source: "MDF bus logging" of https://www.asam.net/standards/detail/mdf/.

python-can reads the format too, but a frame at a time, without the length codes above 8, and with
times as floating-point Unix seconds; the file has them from its start, good to 1 ns.
"""

from __future__ import annotations

import gc
import gzip
import logging
import sys
import traceback
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import NS, BoolArray, IntArray
from ...common.errors import ImportFormatError, MissingExtraError
from ...common.extras import is_installed, undefer
from ...log.messages import frames as wire
from ...log.messages.frames import empty_fd_frames
from ..confined_log import confined
from ..frame_log import FRAMES_PER_BLOCK, FrameLog, LogBlock, joined
from ..frame_reader import FrameReader
from ..packed import is_packed
from .format import Format

_KIND_FLAGS = {
    "CAN_DataFrame": 0,
    "CAN_RemoteFrame": wire.REMOTE_FLAG,
    "CAN_ErrorFrame": wire.ERROR_FLAG,
}
_LOCAL_TIME = 1  # bit of the header's time flags: civil time, of no zone
_PLACES: IntArray = np.arange(64)
_VERSION_4 = (b"MDF", b"UnFinMF")


@contextmanager
def _readable(path: Path, what: str) -> Generator[None]:
    """Turn any error of asammdf into an ImportFormatError that begins with ``what``."""
    try:
        yield
    except ImportFormatError:
        raise
    except Exception as error:  # a damaged file raises anything, from IndexError to IsalError
        _let_go(error)
        raise ImportFormatError(path, f"{what}: {error}") from error


def _let_go(error: Exception) -> None:
    """Free what asammdf half opened: it fails again when it is deleted, with a message."""
    before = sys.unraisablehook

    def quiet(fault: sys.UnraisableHookArgs) -> None:
        if not getattr(fault.object, "__qualname__", "").startswith("MDF"):
            before(fault)

    sys.unraisablehook = quiet
    try:
        traceback.clear_frames(error.__traceback__)
        gc.collect()
    finally:
        sys.unraisablehook = before


class _Saying(logging.Filter):
    """Keeps what a logger would print, in one line each, and lets none of it through."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__()
        self._problems = problems

    def filter(self, record: logging.LogRecord) -> bool:
        lines = record.getMessage().strip().splitlines()
        text = lines[0] if len(lines) == 1 else f"{lines[0].partition(':')[0]}: {lines[-1]}"
        if record.levelno >= logging.WARNING:
            self._problems.append(f"asammdf: {text}")
        return False


@contextmanager
def _noted(problems: list[str]) -> Generator[None]:
    """Add what asammdf logs to the problems, a sentence each, instead of printing it."""
    logger, saying = logging.getLogger("asammdf"), _Saying(problems)
    logger.addFilter(saying)
    try:
        yield
    finally:
        logger.removeFilter(saying)


@dataclass(frozen=True)
class _Group:
    """A channel group of CAN frames of one kind."""

    index: int
    kind: str
    count: int
    channels: dict[str, int]


@dataclass(frozen=True)
class _Piece:
    """Frames of one group; ``order`` never decreases, not even where their times do."""

    order: IntArray
    block: LogBlock  # its buses are numbers, as in the file


@contextmanager
def open_mf4(path: Path, scratch: Path) -> Generator[FrameLog]:
    """Open an MF4 file of CAN frames.

    Args:
        path: The file, also compressed, with ``.gz`` behind its suffix.
        scratch: Folder for temporary files.

    Yields:
        The log: frames of all groups merged by their times, to the nanosecond; a bus is named
        after its number, ``can0`` where it has none.

    Raises:
        ImportFormatError: If the file can't be read or holds no CAN frames; also while its blocks
            are taken.
        ImportError: If asammdf is not installed.
    """
    undefer("asammdf")
    from asammdf import MDF

    # Its messages here are about decoding by databases inside the file, which is not needed.
    with _noted([]), _readable(path, "can't be read"):
        _check_head(path)
        source = BytesIO(gzip.decompress(path.read_bytes())) if is_packed(path) else path
        mdf = MDF(source, temporary_folder=scratch)
    try:
        with _readable(path, "can't be read"):
            log = _log(path, mdf)
        yield log
    finally:
        mdf.close()


def _check_head(path: Path) -> None:
    """Refuse what asammdf would take for something else, or leave open."""
    opener = gzip.open if is_packed(path) else open
    with opener(path, "rb") as stream:
        head = stream.read(64)
    if head[:8].strip() not in _VERSION_4:
        raise ValueError("not an MF4 file")
    if not head[8:16].startswith(b"4"):
        version = head[8:16].decode("ascii", "replace").strip(" \0")
        raise ValueError(f"it is of version {version!r}; bus logging began with MDF 4")


def _log(path: Path, mdf: Any) -> FrameLog:
    groups, problems = _groups(mdf)
    total = sum(group.count for group in groups)
    if not total:
        raise ImportFormatError(path, "holds no CAN frames")
    start_ns, zone = _start(mdf.header)
    with_way = sum(group.count for group in groups if "Dir" in group.channels)
    log = FrameLog(
        blocks=iter(()),
        buses=[],
        directions=with_way > 0,
        time=f"to 1 ns from a start to 1 us, in {zone}",
        problems=problems,
    )
    if 0 < with_way < total:
        log.problems.append(f"{total - with_way} frames have no direction, unlike others")
    log.blocks = _blocks(path, _Reader(mdf, start_ns, log), groups, total)
    return log


def _groups(mdf: Any) -> tuple[list[_Group], list[str]]:
    """Return the groups of CAN frames, and sentences on records that are left out."""
    groups: list[_Group] = []
    left_out: dict[str, int] = {}
    for index, group in enumerate(mdf.groups):
        names: list[str] = [str(channel.name) for channel in group.channels]
        count = int(group.channel_group.cycles_nr)
        kind = next((name for name in _KIND_FLAGS if name in names), None)
        if kind is not None:
            fields = {
                name.removeprefix(f"{kind}."): place
                for place, name in enumerate(names)
                if name.startswith(f"{kind}.")
            }
            groups.append(_Group(index, kind, count, fields))
        elif count:
            what = names[1] if len(names) > 1 else names[0] if names else f"group {index}"
            left_out[what] = left_out.get(what, 0) + count
    sentences = [
        f"{count} records of {what} left out: only CAN data, remote and error frames are kept"
        for what, count in left_out.items()
    ]
    return groups, sentences


def _start(header: Any) -> tuple[int, str]:
    """Return the start of the measurement [Unix ns], and its clock.

    It is taken to 1 us: asammdf computes it in floating point, to 0.1 us.
    """
    start_ns = (int(header.abs_time) + 500) // 1000 * 1000
    if not header.time_flags & _LOCAL_TIME:
        return start_ns, "UTC"
    seconds, rest = divmod(start_ns, NS)
    civil = datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None)
    return int(civil.timestamp()) * NS + rest, "local time of no zone, taken as this machine's"


class _Reader:
    """Takes the frames out of the groups."""

    def __init__(self, mdf: Any, start_ns: int, log: FrameLog) -> None:
        self.log = log
        self._mdf, self._start_ns = mdf, start_ns

    def pieces(self, group: _Group) -> Iterator[_Piece]:
        """Yield the frames of a group, in the order they were logged."""
        latest = np.iinfo(np.int64).min
        for first in range(0, group.count, FRAMES_PER_BLOCK):
            count = min(FRAMES_PER_BLOCK, group.count - first)
            times = self._mdf.get_master(group.index, record_offset=first, record_count=count)
            t_ns = self._start_ns + np.rint(np.asarray(times) * 1e9).astype(np.int64)
            block = self._frames(group, first, count)
            block.frames["t_host_ns"] = t_ns.astype(np.uint64)
            order = np.maximum(np.maximum.accumulate(t_ns), latest)
            latest = int(order[-1])
            yield _Piece(order, block)

    def _frames(self, group: _Group, first: int, count: int) -> LogBlock:
        def column(name: str, *, converted: bool = False) -> NDArray[Any] | None:
            if name not in group.channels:
                return None
            samples, _ = self._mdf.get(
                group=group.index,
                index=group.channels[name],
                raw=not converted,
                samples_only=True,
                record_offset=first,
                record_count=count,
            )
            if len(samples) != count:
                raise ValueError(f"{group.kind}.{name} has {len(samples)} of {count} values")
            return np.asarray(samples)

        def numbers(name: str) -> IntArray | None:
            values = column(name)
            return None if values is None else values.astype(np.int64)

        frames = empty_fd_frames(count)
        none = np.zeros(count, dtype=np.int64)
        identifier = none if (logged := numbers("ID")) is None else logged
        extended = identifier & wire.EXTENDED_FLAG != 0
        if (wide := numbers("IDE")) is not None:
            extended |= wide != 0
        if group.kind == "CAN_ErrorFrame":
            extended[:] = False  # an error frame has no identifier, and no width of it
        frames["id_flags"] = (
            (identifier & wire.ID_MASK) | extended * wire.EXTENDED_FLAG | _KIND_FLAGS[group.kind]
        )
        data, size = column("DataBytes"), numbers("DataLength")
        dlc = numbers("DLC")
        if size is None:
            size = none if data is None or dlc is None else np.minimum(dlc, 8)
        is_fd, frames["fd_flags"] = _fd_facts(group.kind, size, numbers)
        frames["len"] = size if dlc is None else np.where(is_fd, np.minimum(size, 64), dlc)
        if data is not None:
            if data.dtype.kind != "u":  # a text would have been cut at its first zero
                raise ValueError(f"{group.kind}.DataBytes are of type {data.dtype}, not bytes")
            cells = np.ascontiguousarray(data).view(np.uint8).reshape(count, -1)[:, :64]
            cells = cells * (_PLACES[: cells.shape[1]] < size[:, None])
            frames["data"][:, : cells.shape[1]] = cells
        frames["dir"] = _ways(column("Dir", converted=True), count)
        bus = none if (logged := numbers("BusChannel")) is None else logged
        return LogBlock(frames, bus, is_fd)


def _fd_facts(
    kind: str, size: IntArray, numbers: Callable[[str], IntArray | None]
) -> tuple[BoolArray, NDArray[np.uint8]]:
    """Return which frames are CAN FD frames, and their flags; an error frame is neither kind."""
    is_fd, flags = size > 8, np.zeros(len(size), dtype=np.uint8)
    if (longer := numbers("EDL")) is not None:
        is_fd |= longer != 0
    is_fd &= kind != "CAN_ErrorFrame"
    for name, flag in (("BRS", wire.FD_BRS), ("ESI", wire.FD_ESI)):
        if (values := numbers(name)) is not None:
            flags[is_fd & (values != 0)] |= flag
    return is_fd, flags


def _ways(column: NDArray[Any] | None, count: int) -> NDArray[np.uint8]:
    """Convert directions, numbers or the texts Rx and Tx."""
    if column is None:
        return np.full(count, wire.DIR_RX, dtype=np.uint8)
    texts = column.dtype.kind in "SU"
    sent = np.char.lower(column.astype("S")) == b"tx" if texts else column != 0
    return np.where(sent, wire.DIR_TX, wire.DIR_RX).astype(np.uint8)


def _blocks(path: Path, reader: _Reader, groups: list[_Group], total: int) -> Iterator[LogBlock]:
    log, taken, epoch_ns = reader.log, 0, None
    with _noted(log.problems):
        merged = _merged([reader.pieces(group) for group in groups])
        while True:
            with _readable(path, f"can't be read after {taken} frames"):
                piece = next(merged, None)
            if piece is None:
                break
            t_ns = piece.times_ns()
            if epoch_ns is None:
                epoch_ns = log.epoch_ns(int(t_ns[0]), "to 1 ns")
            if (earliest := int(t_ns.min()) + epoch_ns) < 0:
                raise ImportFormatError(path, f"has a frame at {earliest / NS} s, before 1970")
            piece.frames["t_host_ns"] = (t_ns + epoch_ns).astype(np.uint64)
            taken += len(piece)
            yield replace(piece, bus=_indices(piece.bus, log), done=taken / total)


def _indices(numbers: IntArray, log: FrameLog) -> IntArray:
    """Return indices of buses by their numbers; a new bus is added, in order of appearance."""
    buses, first, which = np.unique(numbers, return_index=True, return_inverse=True)
    indices = np.empty(len(buses), dtype=np.int64)
    for k in np.argsort(first):
        indices[k] = log.bus_index(f"can{buses[k]}")
    return indices[which]


def _merged(streams: list[Iterator[_Piece]]) -> Iterator[LogBlock]:
    """Merge the groups by time; only one piece of each is in memory."""
    heads = [next(stream, None) for stream in streams]
    while live := [(i, head) for i, head in enumerate(heads) if head is not None]:
        # What comes later in any group is not before the end of the piece that ends first.
        until = min(int(head.order[-1]) for _, head in live)
        orders: list[IntArray] = []
        parts: list[LogBlock] = []
        for i, head in live:
            cut = int(np.searchsorted(head.order, until, side="right"))
            orders.append(head.order[:cut])
            parts.append(head.block[:cut])
            rest = _Piece(head.order[cut:], head.block[cut:])
            heads[i] = rest if len(rest.order) else next(streams[i], None)
        yield joined(parts)[np.argsort(np.concatenate(orders), kind="stable")]


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    return float(head[:8].strip() in _VERSION_4)


@contextmanager
def _read(path: Path) -> Generator[FrameLog]:
    if not is_installed("asammdf"):
        raise MissingExtraError(f"importing {path.name}", "mf4", "asammdf")
    with confined(f"{__name__}:open_mf4")(path) as log:
        yield log


FORMAT = Format("mf4", "MF4", (".mf4",), _sniff, FrameReader(_read), packed=True)
