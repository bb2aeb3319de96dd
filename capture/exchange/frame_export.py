"""Raw CAN frames of a session as a trace of another format; what is lost is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.console import progress
from ..common.files import check_stop, part_file
from ..common.process import StopRequest
from ..log.messages import frames as wire
from ..log.messages.frames import FrameArray
from .frame_log import (
    FrameFacts,
    LogBlock,
    chosen_buses,
    frame_blocks,
    frame_facts,
    is_error,
    is_remote,
)
from .reports import ExportReport
from .session_export import refuse_session

_FLAGS = wire.ERROR_FLAG | wire.REMOTE_FLAG | wire.EXTENDED_FLAG

_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    "identifier": lambda frames: frames["id_flags"] & wire.ID_MASK,
    "flags": lambda frames: frames["id_flags"] & _FLAGS,
    "length code": lambda frames: frames["len"],
    "data": lambda frames: frames["data"],
    "direction": lambda frames: frames["dir"],
    "time below 1 us": lambda frames: frames["t_host_ns"],
    "bit rate switch": lambda frames: frames["fd_flags"] & wire.FD_BRS,
    "error state": lambda frames: frames["fd_flags"] & wire.FD_ESI,
}
"""Field of a frame that a format may lose to its values, one row a frame."""

_FD_NAMES = {"length code": "length"}
"""Names that differ for CAN FD frames."""


class LossTally:
    """Count of the facts that are lost from a session to a format."""

    def __init__(self) -> None:
        """Start with nothing lost."""
        self._lost: Counter[tuple[str, str]] = Counter()

    def add(self, block: LogBlock, kept: FrameArray) -> None:
        """Compare frames with those that the format keeps, of the same shape."""
        frames, classic = block.frames, ~block.is_fd
        error, remote = is_error(frames), is_remote(frames)
        kinds = {
            "CAN FD frame": block.is_fd,
            "error frame": classic & error,
            "remote frame": classic & remote,
            "data frame": classic & ~error & ~remote,
        }
        for name, values in _FIELDS.items():
            lost = values(frames) != values(kept)
            lost = lost if lost.ndim == 1 else lost.any(axis=1)
            for kind, mask in kinds.items():
                shown = _FD_NAMES.get(name, name) if kind == "CAN FD frame" else name
                self._lost[kind, shown] += int(np.count_nonzero(lost & mask))
        device, host = frames["t_device_ns"], frames["t_host_ns"]
        no_host = (device != 0) & (device != host)
        self._lost["frame", "device time"] += int(np.count_nonzero(no_host))

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of frame and field that lost something."""
        return [
            f"{count} {kind} loses its {name}"
            if count == 1
            else f"{count} {kind}s lose their {name}"
            for (kind, name), count in sorted(self._lost.items())
            if count
        ]


WriteFrames: TypeAlias = Callable[["LogBlock"], None]
"""Writes a part of a log; CAN FD frames only where the format holds them."""


@dataclass(frozen=True)
class FrameWriter:
    """Writes CAN frames.

    A format declares what it keeps of frames and writes that, so that what is lost can be counted
    before it is lost.

    Attributes:
        title: The format, as in ``in the format of Vector BLF``.
        kept: Returns the frames as a reader of the format gets them, except for device times.
        notes: Yields what the format can't hold of the trace as a whole, one sentence each.
        open: Creates a file; gives a context of a function that writes frames, which must have been
            through ``kept``. Raises OSError if it can't be written.
        holds_fd: Whether it has CAN FD frames.
    """

    title: str
    kept: Callable[[LogBlock], FrameArray]
    notes: Callable[[FrameFacts], Iterable[str]]
    open: Callable[[Path, FrameFacts], AbstractContextManager[WriteFrames]]
    holds_fd: bool = True

    holds: str = field(default="has CAN frames", init=False)
    options: tuple[str, ...] = field(default=("bus",), init=False)
    several: bool = field(default=False, init=False)
    by_suffix: bool = field(default=True, init=False)

    def out_of_session(self, sources: Sequence[Path], output: Path, **options: Any) -> ExportReport:
        """Write the frames of a session; see :func:`export_frames`."""
        return export_frames(self, sources[0], output, **options)


def export_frames(
    writer: FrameWriter,
    source: Path,
    output: Path,
    *,
    bus: str | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write the raw frames of a session as a trace of another format.

    The frames of one bus come in the order they were logged, those of several, and of a bus with
    both classic and CAN FD frames, by their times. Identifier, flags, length code, data, direction
    and time are kept as far as the format holds them; what it doesn't hold is counted in the
    report. A candump log that was imported comes back bit for bit.

    Args:
        writer: That of the format.
        output: The trace to write.
        bus: The bus to write; all if None.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the output is the session.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no raw frames, or no such bus.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    from ..log.read.session import Session

    refuse_session(source, output, force=force)
    tally = LossTally()
    with Session.open(source) as session:
        facts = frame_facts(session, chosen_buses(session, bus))
        with (
            part_file(output) as part,
            progress(f"export {output.name}", 1.0) as bar,
            writer.open(part, facts) as write,
        ):
            for block in frame_blocks(session, facts.buses, fd=writer.holds_fd):
                kept = writer.kept(block)
                tally.add(block, kept)
                write(replace(block, frames=kept))
                bar.update(block.done)
                check_stop(output, stop)
        counts, warnings = dict(facts.counts), [*session.warnings, *writer.notes(facts)]
        if writer.holds_fd:
            counts = {bus: count + facts.fd_counts[bus] for bus, count in counts.items()}
        elif left_out := sum(facts.fd_counts.values()):
            warnings.append(f"{left_out} CAN FD frames left out: the format has 8 bytes a frame")
        warnings += tally.sentences()
    total = sum(counts.values())
    what = f"{total} frames of {', '.join(counts)}, in the format of {writer.title}"
    return ExportReport(what, {"frames": total, "buses": counts}, warnings)
