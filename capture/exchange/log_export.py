"""Raw CAN frames of a session into a log that other tools read."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from ..console import progress, refuse_existing
from ..errors import LogWriteError, MissingChannelError, UsageError
from ..log.session import Session
from .can_import import DIRECTIONS_KEY, FRAME_TOPIC_PREFIX
from .candump import candump_lines

EXPORT_SUFFIXES = (".log",)
"""Suffixes of the formats that can be written: candump."""

_LINES_PER_WRITE = 10_000


@dataclass(frozen=True)
class ExportReport:
    """What an export did.

    Attributes:
        source: The session.
        output: The log.
        buses: Bus to number of frames written.
    """

    source: Path
    output: Path
    buses: dict[str, int]


def export_log(
    source: Path, output: Path, *, bus: str | None = None, force: bool = False
) -> ExportReport:
    """Write the raw frames of a session as a candump log.

    The frames of one bus come in the order they were logged, those of several by their times.
    A log imported from candump comes back bit for bit.

    Args:
        source: The session.
        output: The log to write; its suffix is one of :data:`EXPORT_SUFFIXES`.
        bus: The bus to write; all if None.
        force: Replace an existing file.

    Returns:
        What was done.

    Raises:
        UsageError: If the suffix is no format that can be written.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no raw frames, or no such bus.
        LogWriteError: If the output can't be written; nothing is left behind then.
    """
    if output.suffix.lower() not in EXPORT_SUFFIXES:
        valid = ", ".join(EXPORT_SUFFIXES)
        raise UsageError(f"{output}: no format has the suffix {output.suffix!r}; valid: {valid}")
    refuse_existing(output, force=force)
    with Session.open(source) as session:
        names = [
            topic.removeprefix(FRAME_TOPIC_PREFIX)
            for topic in sorted(session.channels)
            if topic.startswith(FRAME_TOPIC_PREFIX)
        ]
        if not names:
            raise MissingChannelError(source, "raw CAN frames", sorted(session.channels))
        if bus is not None and bus not in names:
            raise MissingChannelError(source, f"bus {bus}", names)
        chosen = [bus] if bus is not None else names
        logs = [session.frames(FRAME_TOPIC_PREFIX + name) for name in chosen]
        facts = session.metadata.get("undulog", {})
        directions = facts.get(DIRECTIONS_KEY, "recorded") == "recorded"
    frames = np.concatenate(logs)
    which = np.repeat(np.arange(len(logs)), [len(log) for log in logs])
    if len(logs) > 1:
        order = np.argsort(frames["t_host_ns"], kind="stable")
        frames, which = frames[order], which[order]
    part = output.with_name(f"{output.name}.part")
    try:
        with (
            part.open("w", encoding="utf-8", newline="\n") as stream,
            progress(f"export {output.name}", len(frames)) as bar,
        ):
            lines = candump_lines(frames, chosen, which, directions=directions)
            for start in range(0, len(frames), _LINES_PER_WRITE):
                stream.writelines(islice(lines, _LINES_PER_WRITE))
                bar.update(start)
        part.replace(output)
    except OSError as error:
        raise LogWriteError(output, f"can't be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return ExportReport(
        source, output, {name: len(log) for name, log in zip(chosen, logs, strict=True)}
    )
