"""Recover a whole file after a crash from chunks of the MCAP and the write-ahead log."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ...common.errors import DataError, LogError
from ...common.process import StopRequest
from ..file.parts import first_part
from ..wal.writer import wal_folder
from .edited_log import (
    HEALTH_RECORD,
    EditedLog,
    EditReport,
    RawLog,
    edited_log,
    portable,
    refuse_output,
)

RECOVERED_RECORD = "undulog.recovered"
"""Metadata record of the sources of a recovered log."""


@dataclass
class RecoverReport(EditReport):
    """Result of a recovery.

    Attributes:
        from_wal: Messages that only the write-ahead log had.
        missing: Messages that the recorder accepted and that are lost; None if unknown.
    """

    from_wal: int = 0
    missing: int | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return super().as_json() | {"from_wal": self.from_wal, "missing": self.missing}


def recovered_path(path: Path) -> Path:
    """Return the default output of a recovery, e.g. ``run.recovered.mcap``.

    Args:
        path: Any part of the session, or its folder.

    Raises:
        LogError: If a folder holds no session, or several.
    """
    first = first_part(path)
    return first.with_name(f"{first.stem}.recovered.mcap")


def recover_log(
    path: Path, output: Path, *, force: bool = False, stop: StopRequest | None = None
) -> RecoverReport:
    """Write the readable part of a session to one new, whole file.

    Args:
        path: The damaged or unfinished log; of a split one any part, or the folder. It is not
            changed.

    Raises:
        UsageError: If the output is not possible.
        DataError: If no message can be read.
        LogError: If the log can't be read, its recorder is still writing it, or the new file
            can't be written.
        UndulogError: If a stop was requested; no file is left then.
    """
    refuse_output(output, [path], force=force)
    stop = stop or StopRequest()
    with RawLog(path) as source:
        found = source.file.recovered
        if found is not None and found.live:
            raise LogError(path, "this recording is running; end it first")
        if found is not None:  # without the advice to recover it
            source.warnings = [
                str(found) if text == found.warning else text for text in source.warnings
            ]
        with edited_log([source], output, force=force, stop=stop) as log:
            for attachment in source.attachments:
                log.attach(attachment, attachment.name)
            for record in source.metadata:
                if record.name != HEALTH_RECORD:
                    log.note(record.name, record.metadata)
            channels = source.file.channels.values()
            ids = {channel.id: log.channel(source, channel) for channel in channels}
            messages = source.messages(ids)
            log.write_all(
                f"recovering {path.name}",
                ((ids[message.channel_id], message) for message in messages),
                (source.start_ns, source.end_ns),
                stop,
            )
            if log.first_ns is None:
                raise DataError(f"{path}: no message of it can be read")
            report = RecoverReport(
                output=output,
                sources=[{**source.facts, "path": str(each)} for each in source.paths],
                **log.measures(),
                warnings=source.warnings,
                from_wal=found.from_wal if found is not None else 0,
                missing=_missing(source, log),
            )
            _note(source, log, report)
        cut = any(file.cut for file in source.file.files)
    first = first_part(path)
    wal = wal_folder(first)
    if found is None and not source.warnings:
        report.notes.append("the log was whole: nothing had to be recovered")
    if found is None and cut:
        report.notes.append(
            f"there is no {wal.name} beside {first.name}, the write-ahead log that a killed "
            "recorder leaves: where the file is a copy, copy that folder, too, and recover again"
        )
    return report


def _missing(source: RawLog, log: EditedLog) -> int | None:
    """Count the accepted messages that are not in the new file; None if unknown."""
    found = source.file.recovered
    if found is None or found.accepted is None:
        return None
    return max(0, found.accepted - sum(log.counts.values()))


def _note(source: RawLog, log: EditedLog, report: RecoverReport) -> None:
    facts = {
        "undulog": version("undulog"),
        "sources": json.dumps([path.name for path in source.paths]),
        "sha256": source.sha256,
        "messages": str(sum(report.messages.values())),
        "from_wal": str(report.from_wal),
        "missing": "" if report.missing is None else str(report.missing),
        "warnings": portable(source.warnings, [source]),
    }
    log.note(RECOVERED_RECORD, facts)
    log.copy_health(source)
