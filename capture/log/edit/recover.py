"""A whole file from what a crash left: chunks of the MCAP, and the write-ahead log beyond them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ...common.console import progress
from ...common.errors import DataError, LogError
from ...common.process import StopRequest
from ..file.parts import first_part
from ..wal.writer import wal_folder
from .edited_log import (
    HEALTH_RECORD,
    EditedLog,
    EditReport,
    edited_log,
    portable,
    refuse_output,
    refuse_stopped,
)
from .raw_messages import RawLog

RECOVERED_RECORD = "undulog.recovered"
"""Metadata record that says what a recovered log was made from."""

_ALL_NS = (0, 1 << 64)
_LOOK_EVERY = 4096


@dataclass
class RecoverReport(EditReport):
    """What a recovery found.

    Attributes:
        from_wal: Messages that only the write-ahead log had.
        missing: Messages that the recorder accepted and that are nowhere; None where nothing
            tells.
    """

    from_wal: int = 0
    missing: int | None = None

    def as_json(self) -> dict[str, Any]:
        """The report as plain JSON values."""
        found = {"from_wal": self.from_wal, "missing": self.missing}
        return super().as_json() | found


def recovered_path(path: Path) -> Path:
    """Where a recovery writes by default.

    Args:
        path: Any part of the session, or its folder.

    Returns:
        E.g. ``run.recovered.mcap`` beside ``run.mcap``.

    Raises:
        LogError: If a folder holds no session, or several.
    """
    first = first_part(path)
    return first.with_name(f"{first.stem}.recovered.mcap")


def recover_log(
    path: Path, output: Path, *, force: bool = False, stop: StopRequest | None = None
) -> RecoverReport:
    """Write all that can be read of a session to one new, whole file.

    Args:
        path: The damaged or unfinished log; of a split one any part, or the folder. Nothing of
            it is changed.

    Raises:
        UsageError: If the output can't be that.
        DataError: If no message can be read.
        LogError: If the log can't be read, its recorder is still writing it, or the new file
            can't be written.
        UndulogError: If a stop was requested; nothing is left behind then.
    """
    refuse_output(output, [path], force=force)
    stop = stop or StopRequest()
    with RawLog(path) as source:
        found = source.file.recovered
        if found is not None and found.live:
            raise LogError(path, "this recording is running; end it first")
        if found is not None:  # without the advice to do what is being done
            source.warnings = [
                str(found) if text == found.warning else text for text in source.warnings
            ]
        with edited_log([source], output, force=force, stop=stop) as log:
            for attachment in source.attachments:
                log.attach(attachment, attachment.name)
            _copy(source, log, stop)
            if log.first_ns is None:
                raise DataError(f"{path}: no message of it can be read")
            report = RecoverReport(
                verb="recover",
                output=output,
                sources=[
                    {"path": str(each), "session_id": source.session_id, "sha256": source.sha256}
                    for each in source.paths
                ],
                start_ns=log.first_ns,
                end_ns=log.last_ns,
                messages=dict(sorted(log.counts.items())),
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


def _copy(source: RawLog, log: EditedLog, stop: StopRequest) -> None:
    """Copy metadata and messages; all but the health, which comes last."""
    for record in source.metadata:
        if record.name != HEALTH_RECORD:
            log.note(record.name, record.metadata)
    ids = {channel.id: log.channel(source, channel) for channel in source.file.channels.values()}
    total = sum(source.file.counts.values())
    with progress(f"recovering {source.path.name}", total) as bar:
        for done, message in enumerate(source.messages(ids, *_ALL_NS)):
            log.write(ids[message.channel_id], message)
            if done % _LOOK_EVERY == 0:
                refuse_stopped(stop)
                bar.update(done)


def _missing(source: RawLog, log: EditedLog) -> int | None:
    """How many messages that were accepted are not in the new file; None where nothing tells."""
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
    for record in source.metadata:
        if record.name == HEALTH_RECORD:
            log.note(record.name, record.metadata)
