"""Shared parts of the edits of logs: the new file, its report, and checks of the output.

An edit never decodes a message: a copy keeps its bytes, sequence number and publish time.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.records import Attachment, Channel

from ...common.arrays import NS
from ...common.console import progress, refuse_existing
from ...common.errors import DataError, UndulogError, UsageError
from ...common.files import part_file
from ...common.process import StopRequest
from ..mcap.writer import McapWriter
from ..write.mcap_sink import chunk_group, library_name
from .raw_messages import RawLog, RawMessage

EDIT_RECORD = "undulog.edit"
"""Metadata record of the sources of an edited log."""
HEALTH_RECORD = "undulog.health"
_MOST_CHANNELS = 2**16 - 1
_MOST_GROUPS = 128
"""Of topics with chunks of their own, each of which takes up to a chunk's bytes of memory."""
_STOP_CHECKED_EVERY = 1024


@dataclass
class EditReport:
    """Result of an edit.

    Attributes:
        sources: Of each source: ``path``, ``session_id``, ``sha256``.
        start_ns: First log time in it [Unix ns].
        end_ns: Last log time in it [Unix ns].
        messages: Topic to number of messages.
        warnings: Missing or doubtful parts, one sentence each.
        notes: Facts that are no fault, one sentence each.
    """

    output: Path
    sources: list[dict[str, str]]
    start_ns: int = 0
    end_ns: int = 0
    messages: dict[str, int] = field(default_factory=dict[str, int])
    warnings: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / NS

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "output": str(self.output),
            "sources": self.sources,
            "start_ns": self.start_ns,
            "duration_s": self.duration_s,
            "messages": self.messages,
            "warnings": self.warnings,
            "notes": self.notes,
        }


class EditedLog:
    """A new log with exact copies of channels, messages and records of its sources."""

    def __init__(self, stream: BinaryIO, profile: str) -> None:
        """Begin the file."""
        self._groups: set[str] = set()
        self._writer = McapWriter(stream, group_of=self._group_of)
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int, str], int] = {}
        self._topics: dict[int, str] = {}
        self.counts: dict[str, int] = {}
        self.first_ns: int | None = None
        self.last_ns = 0
        self._writer.start(profile=profile, library=library_name())

    def _group_of(self, topic: str, type_name: str) -> str:
        group = chunk_group(topic, type_name)
        if group not in self._groups and len(self._groups) == _MOST_GROUPS:
            return ""
        self._groups.add(group)
        return group

    def channel(self, source: RawLog, channel: Channel) -> int:
        """Open a copy of a channel, or find an equal one, and return its id in the new file.

        Raises:
            DataError: If the new file has as many channels as MCAP can number.
        """
        schema_id = 0
        schema = source.file.schemas.get(channel.schema_id)
        if schema is not None:
            kind = (schema.name, schema.encoding, schema.data)
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(*kind)
            schema_id = self._schemas[kind]
        facts = json.dumps(channel.metadata, sort_keys=True)
        key = (channel.topic, channel.message_encoding, schema_id, facts)
        if key not in self._channels:
            if len(self._channels) == _MOST_CHANNELS:
                raise DataError(
                    f"{source.path}: with its channels the new log would have more than "
                    f"{_MOST_CHANNELS}, which is all that MCAP can number: leave topics out first "
                    "(undulog log cut --topics)"
                )
            new_id = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
            )
            self._channels[key] = new_id
            self._topics[new_id] = channel.topic
            self.counts.setdefault(channel.topic, 0)
        return self._channels[key]

    def write(self, channel_id: int, message: RawMessage, log_time_ns: int | None = None) -> None:
        """Copy one message.

        Args:
            log_time_ns: Another log time [Unix ns]; its own if None.
        """
        log_ns = message.log_time_ns if log_time_ns is None else log_time_ns
        self._writer.add_message(
            channel_id, log_ns, message.data, message.publish_time_ns, message.sequence
        )
        self.counts[self._topics[channel_id]] += 1
        if self.first_ns is None or log_ns < self.first_ns:
            self.first_ns = log_ns
        self.last_ns = max(self.last_ns, log_ns)

    def write_all(
        self,
        label: str,
        messages: Iterable[tuple[int, RawMessage]],
        span_ns: tuple[int, int],
        stop: StopRequest,
    ) -> int:
        """Copy many messages with a progress bar and return their number.

        Args:
            messages: Channel ids in the new file and messages.
            span_ns: First and last log time of the messages [Unix ns].

        Raises:
            UndulogError: If a stop was requested.
        """
        start_ns, end_ns = span_ns
        copied = 0
        with progress(label, (end_ns - start_ns) / NS) as bar:
            for channel_id, message in messages:
                self.write(channel_id, message)
                if copied % _STOP_CHECKED_EVERY == 0:
                    refuse_stopped(stop)
                    bar.update((message.log_time_ns - start_ns) / NS)
                copied += 1
        return copied

    def copy_health(self, source: RawLog) -> None:
        """Copy the health records, which are the last in a log."""
        for record in source.metadata:
            if record.name == HEALTH_RECORD:
                self.note(record.name, record.metadata)

    def attach(self, attachment: Attachment, name: str) -> None:
        """Copy an attachment under a name."""
        self._writer.add_attachment(
            attachment.create_time,
            attachment.log_time,
            name,
            attachment.media_type,
            attachment.data,
        )

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, dict(facts))

    def measures(self) -> dict[str, Any]:
        """Return times [Unix ns] and counts of the messages, for the report."""
        counts = dict(sorted(self.counts.items()))
        return {"start_ns": self.first_ns, "end_ns": self.last_ns, "messages": counts}

    def finish(self) -> None:
        """Write indexes and summary."""
        self._writer.finish()


@contextmanager
def edited_log(
    sources: Sequence[RawLog], output: Path, *, force: bool, stop: StopRequest
) -> Generator[EditedLog]:
    """Write a new log, which gets its name only when it is complete.

    Args:
        sources: Its sources; none of them may be the output.
        stop: Request to stop; no file is left then.

    Yields:
        The log to write to.

    Raises:
        OutputExistsError: If the output exists and ``force`` is not given.
        UsageError: If the output is one of the sources.
        LogWriteError: If it can't be written; no file is left then.
        UndulogError: If a stop was requested.
    """
    read = [path for source in sources for path in (source.path, *source.file.parts.paths)]
    refuse_output(output, read, force=force)
    profiles = {source.file.profile for source in sources}
    with part_file(output) as part:
        with part.open("wb") as stream:
            log = EditedLog(stream, profiles.pop() if len(profiles) == 1 else "")
            yield log
            log.finish()
        refuse_stopped(stop)


def refuse_output(output: Path, sources: Sequence[Path], *, force: bool) -> None:
    """Check the output of an edit before any work is done.

    Args:
        sources: Its sources.

    Raises:
        OutputExistsError: If it exists and ``force`` is not given.
        UsageError: If it is no ``.mcap``, is one of the sources, or its folder doesn't exist.
    """
    if output.suffix.lower() != ".mcap":
        raise UsageError(f"{output}: a log is an .mcap file, not {output.suffix or 'nameless'}")
    for source in sources:
        if output.exists() and source.exists() and output.samefile(source):
            raise UsageError(f"{output} is a source; an edit always writes a new file")
    refuse_existing(output, force=force)


def refuse_stopped(stop: StopRequest) -> None:
    """Raise if a stop was requested.

    Raises:
        UndulogError: If a stop was requested.
    """
    if stop.signal is not None:
        raise UndulogError(f"stopped by {stop.signal.name}; nothing was written")


def free_name(name: str, taken: Collection[str], pattern: str) -> str:
    """Return a name that isn't taken, with the first free number from 2 on if it is.

    Args:
        pattern: The name with a number, of ``{name}``, ``{stem}``, ``{suffix}`` and ``{n}``.
    """
    stem, dot, suffix = name.rpartition(".")
    parts = {"stem": stem, "suffix": dot + suffix} if stem else {"stem": name, "suffix": ""}
    free, n = name, 1
    while free in taken:
        n += 1
        free = pattern.format(name=name, **parts, n=n)
    return free


def earlier_edit_name(taken: Collection[str]) -> str:
    """Return a free name for the record of an earlier edit: ``undulog.edit.1`` and so on."""
    return free_name(f"{EDIT_RECORD}.1", taken, "{stem}.{n}")


def portable(warnings: Sequence[str], sources: Sequence[RawLog]) -> str:
    """Return warnings as a JSON list for a metadata entry, without the folders of this machine.

    Args:
        warnings: One sentence each.
        sources: The logs that they name.
    """
    texts = list(warnings)
    for source in sources:
        texts = [text.replace(str(source.path), source.path.name) for text in texts]
    return json.dumps(texts)
