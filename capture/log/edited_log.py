"""A log as undecoded messages, block after block, and the new file that an edit writes.

Unreadable parts are left out and listed in the log's warnings.

Format: https://mcap.dev/spec.

An edit never decodes a message: a copy keeps its bytes, sequence number and publish time.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata

from ..common.arrays import NS
from ..common.console import progress, refuse_existing
from ..common.errors import DataError, LogError, UndulogError, UsageError
from ..common.files import Closing, part_file
from ..common.part_files import stored_path
from ..common.process import StopRequest
from ..common.untrusted_text import read_toml
from .file.content import sha256_of
from .file.log_file import LogFile
from .mcap.chunk import PREFIX_SIZE, Block, Buffer, walk_records
from .mcap.writer import McapWriter
from .write.mcap_sink import chunk_group, library_name

_LENGTH = struct.Struct("<Q")
_FIXED = struct.Struct("<HIQQ")  # of a message: channel, sequence, log time, publish time
_BODY_AT = PREFIX_SIZE + _FIXED.size
FOREVER_NS = 1 << 64

EDIT_RECORD = "undulog.edit"
"""Metadata record of the sources of an edited log."""
HEALTH_RECORD = "undulog.health"
_MOST_CHANNELS = 2**16 - 1
_MOST_GROUPS = 128
"""Of topics with chunks of their own, each of which takes up to a chunk's bytes of memory."""
_STOP_CHECKED_EVERY = 1024


class RawMessage(NamedTuple):
    """One message as it is stored.

    Attributes:
        log_time_ns: Log time [Unix ns].
        channel_id: Channel in its own file.
        publish_time_ns: As stored [Unix ns].
    """

    log_time_ns: int
    channel_id: int
    sequence: int
    publish_time_ns: int
    data: bytes


class RawLog(Closing):
    """A log opened for its bytes; ``with`` releases it."""

    def __init__(self, path: Path) -> None:
        """Open a log.

        Args:
            path: The MCAP file; of a split session any part, or the folder.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
        """
        self.path = path
        self.file = LogFile(path)
        self.warnings = list(self.file.warnings)
        self.paths = [file.path for file in self.file.files]
        self.sha256 = sha256_of(self.paths)
        filled = [block for block in self.file.blocks if block.end_ns]
        self.start_ns = min((block.start_ns for block in filled), default=0)
        self.end_ns = max((block.end_ns for block in filled), default=0)
        self.session_id = self.file.session_id
        self.robot = _robot_name(self.file)

    def close(self) -> None:
        """Release the file."""
        self.file.close()

    @property
    def facts(self) -> dict[str, str]:
        """Path, id and digest, for the report of an edit."""
        return {"path": str(self.path), "session_id": self.session_id, "sha256": self.sha256}

    @property
    def metadata(self) -> list[Metadata]:
        """The metadata records, in the order of the file; names may repeat."""
        return [item for item in self.file.appendices if isinstance(item, Metadata)]

    @property
    def attachments(self) -> list[Attachment]:
        """The attachments, in the order of the file; names may repeat."""
        return [item for item in self.file.appendices if isinstance(item, Attachment)]

    def warn(self, sentence: str) -> None:
        """Add a warning, once."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def type_name(self, channel: Channel) -> str:
        """Return a channel's message type; empty if the channel has no schema."""
        schema = self.file.schemas.get(channel.schema_id)
        return schema.name if schema is not None else ""

    def messages(
        self, channel_ids: Collection[int], start_ns: int = 0, stop_ns: int = FOREVER_NS
    ) -> Iterator[RawMessage]:
        """Yield messages of some channels in a window, in the order of the file.

        Args:
            start_ns: First log time [Unix ns].
            stop_ns: One past the last log time [Unix ns].
        """
        for block in self.file.blocks:
            if not (block.end_ns and (block.start_ns >= stop_ns or block.end_ns < start_ns)):
                yield from self._block_messages(block, channel_ids, start_ns, stop_ns)

    def last_messages(self, channel_ids: Collection[int], before_ns: int) -> list[RawMessage]:
        """Return the last message of each channel before a time, in order of log time.

        The blocks are read backward until all are found.

        Args:
            before_ns: One past the last log time [Unix ns].

        Returns:
            At most one message per channel; of equal log times, the later one in the file.
        """
        # With log time, and file and place of its block.
        last: dict[int, tuple[tuple[int, int, int], RawMessage]] = {}
        for block in sorted(self.file.blocks, key=lambda b: (b.end_ns, b.part, b.start))[::-1]:
            if block.end_ns and block.start_ns >= before_ns:
                continue
            open_ids = {k for k in channel_ids if k not in last or last[k][0][0] <= block.end_ns}
            if not open_ids:
                break
            for message in self._block_messages(block, open_ids, 0, before_ns):
                place = (message.log_time_ns, block.part, block.start)
                former = last.get(message.channel_id)
                if former is None or place >= former[0]:
                    last[message.channel_id] = (place, message)
        return sorted((message for _, message in last.values()), key=lambda m: m.log_time_ns)

    def _block_messages(
        self, block: Block, channel_ids: Collection[int], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        if block.index_at and not any(key in channel_ids for key in block.index_at):
            return
        try:
            data, start, stop = self.file.source_of(block).payload_once(block)
        except LogError as error:
            self.warn(f"{error}; its messages are missing")
            return
        loose = not block.start  # the unchunked messages lie between other records
        offsets = (at for offset in (block.offsets or {}).values() for at in offset.tolist())
        places = sorted(offsets) if loose else self._places(block, data, start, stop)
        unknown = 0
        for at in places:
            (length,) = _LENGTH.unpack_from(data, at + 1)
            end = at + PREFIX_SIZE + length
            if at + _BODY_AT > end:
                self.warn(f"{self.path}: the message at byte {at} is too short: left out")
                continue
            channel_id, sequence, log_ns, publish_ns = _FIXED.unpack_from(data, at + PREFIX_SIZE)
            if channel_id in channel_ids:
                if start_ns <= log_ns < stop_ns:
                    message = bytes(data[at + _BODY_AT : end])
                    yield RawMessage(log_ns, channel_id, sequence, publish_ns, message)
            elif channel_id not in self.file.channels:
                unknown += 1
        if unknown:
            self.warn(
                f"{self.path}: {unknown} messages from byte {block.start} on are of channels that "
                "the file doesn't describe: left out"
            )

    def _places(self, block: Block, data: Buffer, start: int, stop: int) -> Iterator[int]:
        """Yield the offsets of the whole message records of a chunk."""
        end = start
        for opcode, body, body_stop in walk_records(data, start, stop):
            if opcode == Opcode.MESSAGE:
                yield body - PREFIX_SIZE
            end = body_stop
        if block.complete and end != stop:
            self.warn(
                f"{self.path}: the last {stop - end} bytes of the chunk at byte {block.start} "
                "are no whole record: left out"
            )


def _robot_name(log_file: LogFile) -> str:
    """Return the robot of a log; empty if it is not stated."""
    stated = log_file.metadata.get("undulog", {}).get("robot")
    if stated:
        return stated
    attached = log_file.attachments.get("robot.toml")
    if attached is not None:
        with suppress(ValueError):
            return str(read_toml(attached.data.decode()).get("name", ""))
    return ""


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
    with part_file(output, durable=True) as part:  # the sources may be deleted then
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
    there = stored_path(output)
    for source in map(stored_path, sources):
        if there.exists() and source.exists() and there.samefile(source):
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
