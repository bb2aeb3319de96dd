"""Raw CAN frames of a session into a trace that other tools read."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from ..common.console import progress, refuse_existing
from ..common.errors import UsageError
from ..common.files import check_stop, part_file
from ..common.interruption import StopRequest
from ..log.read.session import Session
from .frame_blocks import chosen_buses, frame_blocks, frame_facts
from .frame_formats import FRAME_FORMATS
from .frame_losses import LossTally


@dataclass
class ExportReport:
    """What an export of frames did.

    Attributes:
        source: The session.
        output: The trace.
        title: Name of its format.
        buses: Bus to number of frames written.
        warnings: What the format doesn't hold, or the session doesn't give, one sentence each.
    """

    source: Path
    output: Path
    title: str
    buses: dict[str, int]
    warnings: list[str] = field(default_factory=list[str])


def export_log(
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
        source: The session.
        output: The trace to write; its suffix is one of
            :data:`.capture.exchange.frame_formats.FRAME_FORMATS`.
        bus: The bus to write; all if None.
        force: Replace an existing file.
        stop: Ends the export, with nothing left behind.

    Returns:
        What was done.

    Raises:
        UsageError: If the suffix is no format that can be written, or the output is the session.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no raw frames, or no such bus.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    chosen = FRAME_FORMATS.get(output.suffix.lower())
    if chosen is None:
        valid = ", ".join(FRAME_FORMATS)
        raise UsageError(f"{output}: no format has the suffix {output.suffix!r}; valid: {valid}")
    refuse_same(source, output)
    refuse_existing(output, force=force)
    tally = LossTally()
    with Session.open(source) as session:
        facts = frame_facts(session, chosen_buses(session, bus))
        with (
            part_file(output) as part,
            progress(f"export {output.name}", 1.0) as bar,
            chosen.open(part, facts) as write,
        ):
            for block in frame_blocks(session, facts.buses, fd=chosen.holds_fd):
                kept = replace(
                    block,
                    frames=chosen.kept(block.frames),
                    fd_frames=chosen.kept(block.fd_frames) if chosen.holds_fd else block.fd_frames,
                )
                tally.add(block.frames, kept.frames)
                tally.add(block.fd_frames, kept.fd_frames)
                write(kept)
                bar.update(block.done)
                check_stop(output, stop)
        counts, warnings = dict(facts.counts), [*session.warnings, *chosen.notes(facts)]
        if chosen.holds_fd:
            counts = {bus: count + facts.fd_counts[bus] for bus, count in counts.items()}
        elif left_out := sum(facts.fd_counts.values()):
            warnings.append(f"{left_out} CAN FD frames left out: the format has 8 bytes a frame")
        warnings += tally.sentences()
    return ExportReport(source, output, chosen.title, counts, warnings)


def refuse_same(source: Path, output: Path) -> None:
    """Check that an export doesn't replace its own session.

    Args:
        source: The session.
        output: The file to write.

    Raises:
        UsageError: If they are one file.
    """
    if output.exists() and source.exists() and output.samefile(source):
        raise UsageError(f"{output} is the session itself; choose another name")
