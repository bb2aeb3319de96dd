"""Edits of one log: cut to a window and some topics, and recovered after a crash.

The last message of a latched topic (``/gait/mode``, ``/robot_description``, ``/tf_static``) is
often before the window. A cut holds only the messages of the window, so that consecutive cuts can
be merged to the whole again. It lists the latched messages before it and copies them to its start
on request, as ROS sends a latched message to a late subscriber.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcap.records import Channel

from ..common.errors import DataError, LogError, MissingChannelError, UsageError
from ..common.part_files import stored_path
from ..common.process import StopRequest
from .edited_log import (
    EDIT_RECORD,
    FOREVER_NS,
    HEALTH_RECORD,
    NS,
    EditedLog,
    EditReport,
    RawLog,
    RawMessage,
    earlier_edit_name,
    edited_log,
    portable,
    refuse_output,
)
from .file.log_file import RECOVER
from .file.parts import first_part
from .messages.definitions import adds_up, is_latched
from .wal.writer import wal_folder

RECOVERED_RECORD = "undulog.recovered"
"""Metadata record of the sources of a recovered log."""


def cut_log(
    path: Path,
    output: Path,
    *,
    start_s: float = 0.0,
    stop_s: float | None = None,
    topics: Sequence[str] = (),
    carry_state: bool = False,
    force: bool = False,
    stop: StopRequest | None = None,
) -> EditReport:
    """Write a part of a log to a new file.

    Args:
        start_s: First log time wanted, from the log's first message [s].
        stop_s: One past the last log time wanted, from the log's first message [s]; None for all
            of the rest.
        topics: Topics to keep, ``*`` and ``?`` as in a shell; all if none are given.
        carry_state: Copy the last earlier message of each latched topic to the start.

    Raises:
        UsageError: If the window is empty, or the output is not possible.
        MissingChannelError: If the log has no such topic.
        DataError: If no message is in the window.
        LogError: If the log can't be read or the new one can't be written.
        UndulogError: If a stop was requested; no file is left then.
    """
    _check_window(start_s, stop_s)
    refuse_output(output, [path], force=force)
    stop = stop or StopRequest()
    with RawLog(path) as source:
        start_ns = source.start_ns + round(start_s * NS)
        stop_ns = FOREVER_NS if stop_s is None else source.start_ns + round(stop_s * NS)
        kept = _channels(source, topics)
        latched = [channel for channel in kept if is_latched(source.type_name(channel), channel)]
        state = _state_before(source, latched, start_ns)
        with edited_log([source], output, force=force, stop=stop) as log:
            ids = {channel.id: log.channel(source, channel) for channel in kept}
            _copy_records(source, log)
            for message in state if carry_state else []:
                log.write(ids[message.channel_id], message, start_ns)
            messages = source.messages(ids, start_ns, stop_ns)
            copied = log.write_all(
                f"cutting {path.name}",
                ((ids[message.channel_id], message) for message in messages),
                (start_ns, min(stop_ns, source.end_ns)),
                stop,
            )
            if log.first_ns is None or not copied:
                raise DataError(_nothing(source, topics, start_s, stop_s))
            carried = {source.file.channels[m.channel_id].topic: m.log_time_ns for m in state}
            facts = {
                "verb": "cut",
                "undulog": version("undulog"),
                "source": path.name,
                "source.session_id": source.session_id,
                "source.sha256": source.sha256,
                "start_s": repr(start_s),
                "stop_s": "" if stop_s is None else repr(stop_s),
                "start_ns": str(start_ns),
                "stop_ns": "" if stop_s is None else str(stop_ns),
                "topics": json.dumps(list(topics)),
                "carried": json.dumps(carried if carry_state else {}),
                "warnings": portable(source.warnings, [source]),
            }
            log.note(EDIT_RECORD, facts)
            log.copy_health(source)
    return EditReport(
        output=output,
        sources=[source.facts],
        **log.measures(),
        warnings=source.warnings,
        notes=[] if carry_state else _left_behind(source, state, start_ns),
    )


def _check_window(start_s: float, stop_s: float | None) -> None:
    if not (math.isfinite(start_s) and start_s >= 0.0):
        raise UsageError(f"--start {start_s:g}: seconds from the log's start, 0 or more")
    if stop_s is not None and not (math.isfinite(stop_s) and stop_s > start_s):
        raise UsageError(f"--stop {stop_s:g} must be later than --start {start_s:g}")


def _nothing(source: RawLog, topics: Sequence[str], start_s: float, stop_s: float | None) -> str:
    until = "" if stop_s is None else f" and before {stop_s:g} s"
    seconds = (source.end_ns - source.start_ns) / NS
    which = f" of {', '.join(topics)}" if topics else ""
    return (
        f"{source.path}: no message{which} at or after {start_s:g} s{until}; "
        f"the log lasts {seconds:g} s"
    )


def _channels(source: RawLog, topics: Sequence[str]) -> list[Channel]:
    """Return the channels of the requested topics, in the order of the file."""
    every = list(source.file.channels.values())
    for pattern in topics:
        if not any(fnmatchcase(channel.topic, pattern) for channel in every):
            there = sorted({channel.topic for channel in every})
            raise MissingChannelError(source.path, pattern, there)
    return [
        channel
        for channel in every
        if not topics or any(fnmatchcase(channel.topic, pattern) for pattern in topics)
    ]


def _state_before(source: RawLog, latched: Collection[Channel], start_ns: int) -> list[RawMessage]:
    """Return the last message of each latched channel before a time, in order of time.

    Of static transforms every different message, since each holds some of them.
    """
    if start_ns <= source.start_ns:
        return []
    adding_up = {channel.id for channel in latched if adds_up(channel)}
    latest = {channel.id for channel in latched} - adding_up
    static: dict[bytes, RawMessage] = {}
    if adding_up:
        for message in source.messages(adding_up, 0, start_ns):
            static[message.data] = message
    state = [*source.last_messages(latest, start_ns), *static.values()]
    return sorted(state, key=lambda message: message.log_time_ns)


def _left_behind(source: RawLog, state: Sequence[RawMessage], start_ns: int) -> list[str]:
    if not state:
        return []
    earlier_s = {  # by topic: of several messages the latest
        source.file.channels[message.channel_id].topic: (start_ns - message.log_time_ns) / NS
        for message in state
    }
    texts = (f"{topic} ({before:.2f} s earlier)" for topic, before in earlier_s.items())
    return [f"left before the cut, though in force: {', '.join(texts)}; --carry-state copies them"]


def _copy_records(source: RawLog, log: EditedLog) -> None:
    """Copy metadata and attachments; an earlier edit's record is renamed."""
    records = source.metadata
    taken = {record.name for record in records} | {EDIT_RECORD}
    for record in records:
        name = record.name
        if name == HEALTH_RECORD:
            continue
        if name == EDIT_RECORD:
            name = earlier_edit_name(taken)
            taken.add(name)
        log.note(name, record.metadata)
    for attachment in source.attachments:
        log.attach(attachment, attachment.name)


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
        recovered = source.file.recovered
        if recovered is not None and recovered.live:
            raise LogError(path, "this recording is running; end it first")
        source.warnings = [text.partition(RECOVER)[0] for text in source.warnings]
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
                sources=[{**source.facts, "path": str(path)} for path in source.paths],
                **log.measures(),
                warnings=source.warnings,
                from_wal=recovered.from_wal if recovered is not None else 0,
                missing=_missing(source, log),
            )
            _note(source, log, report)
        cut = any(file.cut for file in source.file.files)
    first = first_part(path)
    wal = wal_folder(first)
    if recovered is None and not source.warnings:
        report.notes.append("the log was whole: nothing had to be recovered")
    if recovered is None and cut:
        beside = stored_path(first).name
        report.notes.append(
            f"there is no {wal.name} beside {beside}, the write-ahead log that a killed "
            "recorder leaves: where the file is a copy, copy that folder, too, and recover again"
        )
    return report


def _missing(source: RawLog, log: EditedLog) -> int | None:
    """Count the accepted messages that are not in the new file; None if unknown."""
    recovered = source.file.recovered
    if recovered is None or recovered.accepted is None:
        return None
    return max(0, recovered.accepted - sum(log.counts.values()))


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
