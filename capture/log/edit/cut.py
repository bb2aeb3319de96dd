"""Cut a log: the messages of a window and some topics, with all definitions and records.

The last message of a latched topic (``/gait/mode``, ``/robot_description``, ``/tf_static``) is
often before the window. A cut holds only the messages of the window, so that consecutive cuts can
be merged to the whole again. It lists the latched messages before it and copies them to its start
on request, as ROS sends a latched message to a late subscriber.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path

from mcap.records import Channel

from ...common.errors import DataError, MissingChannelError, UsageError
from ...common.process import StopRequest
from ..messages.definitions import adds_up, is_latched
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
