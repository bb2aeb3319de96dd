"""What every edit of a log has in common: the new file, its report, and its refusals.

An edit never decodes a message: what it copies keeps its bytes, sequence number and publish time.

What was found on several channels and joints at once, as one finding.

A lost bus cycle is missing in every joint and on every topic that came with it: that is one reason,
not one for each of them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

from mcap.records import Attachment, Channel
from mcap.writer import Writer

from ...common.console import refuse_existing
from ...common.errors import DataError, UndulogError, UsageError
from ...common.files import part_file
from ...common.process import StopRequest
from .raw_messages import RawLog, RawMessage

_MOST_LISTED = 8


@dataclass(frozen=True)
class Finding:
    """Something that was found.

    Attributes:
        weight: Index into :data:`.VERDICTS`; 0 is worth knowing and no fault.
        sentence: What, where, how much.
    """

    weight: int
    sentence: str


@dataclass(frozen=True)
class Fault:
    """Something that was found on one channel, or on one joint of it.

    Attributes:
        weight: As a finding has it.
        topic: Where; the topic, or a label that begins with it.
        name: The joint; empty for all that the topic carries.
        gaps: How many gaps it is about; 0 if it is about something else.
        lost_ns: Begin and end of the longest of these gaps [Unix ns].
        part: Share of the samples that are missing in them.
    """

    weight: int
    topic: str
    name: str
    text: str
    gaps: int = 0
    lost_ns: tuple[int, int] = (0, 0)
    part: float = 0.0


def joined(faults: Iterable[Fault]) -> list[Finding]:
    """Join the faults of several channels and joints that are one.

    Of one text, and of gaps as many of each whose longest lie at one time, one finding names all
    channels and joints; of gaps it has the figures of where most is missing.

    Args:
        faults: In the order in which they are to be named.

    Returns:
        The findings, in the order of the first fault of each.
    """
    groups: list[list[Fault]] = []
    by_text: dict[tuple[int, str], list[Fault]] = {}
    for fault in faults:
        if fault.gaps:
            group = next((known for known in groups if _one_loss(known[0], fault)), None)
        else:
            group = by_text.get((fault.weight, fault.text))
        if group is not None:
            group.append(fault)
            continue
        groups.append([fault])
        if not fault.gaps:
            by_text[fault.weight, fault.text] = groups[-1]
    return [_finding(group) for group in groups]


def _one_loss(one: Fault, other: Fault) -> bool:
    """Whether the gaps of two channels are those of one loss: as many, the longest overlap."""
    if not one.gaps or (one.weight, one.gaps) != (other.weight, other.gaps):
        return False
    (begin, end), (start, stop) = one.lost_ns, other.lost_ns
    return 2 * (min(end, stop) - max(begin, start)) > min(end - begin, stop - start)


def _finding(group: Sequence[Fault]) -> Finding:
    worst = max(group, key=lambda fault: fault.part)
    where = _where(group)
    if len(group) == 1:
        return Finding(worst.weight, f"{where}: {worst.text}")
    each = "lost together: at most" if worst.gaps else "each:"
    return Finding(worst.weight, f"{where}, {each} {worst.text}")


def _where(group: Sequence[Fault]) -> str:
    """The channels and joints: topics of the same joints together."""
    names: dict[str, list[str]] = {}
    for fault in group:
        names.setdefault(fault.topic, []).append(fault.name)
    topics: dict[tuple[str, ...], list[str]] = {}
    for topic, found in names.items():
        topics.setdefault(tuple(found), []).append(topic)
    parts: list[str] = []
    for found, where in topics.items():
        label = listed(where)
        if found != ("",):
            label += f", {listed(found)}"
        parts.append(label)
    return "; ".join(parts)


def listed(names: Sequence[str], most: int = _MOST_LISTED) -> str:
    """Return a list as text.

    Returns:
        E.g. ``a, b and c`` or ``a, b and 7 more``.
    """
    if len(names) > most:
        return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


EDIT_RECORD = "undulog.edit"
"""Metadata record that says what an edited log was made from."""
HEALTH_RECORD = "undulog.health"
NS = 1_000_000_000
_MOST_CHANNELS = 2**16 - 1


@dataclass
class EditReport:
    """What an edit did.

    Attributes:
        verb: ``cut`` or ``merge``.
        sources: Of each source: ``path``, ``session_id``, ``sha256``.
        start_ns: First log time in it [Unix ns].
        end_ns: Last log time in it [Unix ns].
        messages: Topic to number of messages.
        warnings: What is missing or doubtful, one sentence each.
        notes: What is in order and worth knowing, one sentence each.
    """

    verb: str
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
        """The report as plain JSON values."""
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
    """A log being written: channels, messages and records exactly as the sources have them."""

    def __init__(self, stream: BinaryIO, profile: str) -> None:
        """Begin the file."""
        self._writer = Writer(stream)
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int, str], int] = {}
        self._topics: dict[int, str] = {}
        self.counts: dict[str, int] = {}
        self.first_ns: int | None = None
        self.last_ns = 0
        self._writer.start(profile=profile, library=f"undulog/{version('undulog')}")

    def channel(self, source: RawLog, channel: Channel) -> int:
        """Open a channel; one that is the same in every respect is opened once.

        Args:
            source: Where it comes from.
            channel: As the source has it.

        Returns:
            Its id in the new file.

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
            message: As the source has it.
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

    def attach(self, attachment: Attachment, name: str) -> None:
        """Copy an attachment.

        Args:
            attachment: As the source has it.
            name: Its name in the new file.
        """
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

    def finish(self) -> None:
        """Write indexes and summary."""
        self._writer.finish()


@contextmanager
def edited_log(
    sources: Sequence[RawLog], output: Path, *, force: bool, stop: StopRequest
) -> Generator[EditedLog]:
    """Write a new log, which appears under its name only when it is whole.

    Args:
        sources: What it is made from; none of them may be the output.
        stop: Request to stop; nothing is left behind then.

    Yields:
        The log to write to.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        UsageError: If the output is one of the sources.
        LogWriteError: If it can't be written; nothing is left behind then.
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
        sources: What it is made from.
        force: Whether an existing file may be replaced.

    Raises:
        OutputExistsError: If it is there and ``force`` is not given.
        UsageError: If it is no ``.mcap``, is one of the sources, or its folder doesn't exist.
    """
    if output.suffix.lower() != ".mcap":
        raise UsageError(f"{output}: a log is an .mcap file, not {output.suffix or 'nameless'}")
    for source in sources:
        if output.exists() and source.exists() and output.samefile(source):
            raise UsageError(f"{output} is a source; an edit always writes a new file")
    refuse_existing(output, force=force)


def refuse_stopped(stop: StopRequest) -> None:
    """End the work if that was asked for.

    Raises:
        UndulogError: If a stop was requested.
    """
    if stop.signal is not None:
        raise UndulogError(f"stopped by {stop.signal.name}; nothing was written")


def free_name(name: str, taken: Collection[str], pattern: str) -> str:
    """A name that isn't taken.

    Args:
        pattern: How a number is put to it, of ``{name}``, ``{stem}``, ``{suffix}`` and ``{n}``.

    Returns:
        The name, with the first free number from 2 on where it is taken.
    """
    stem, dot, suffix = name.rpartition(".")
    parts = {"stem": stem, "suffix": dot + suffix} if stem else {"stem": name, "suffix": ""}
    free, n = name, 1
    while free in taken:
        n += 1
        free = pattern.format(name=name, **parts, n=n)
    return free


def earlier_edit_name(taken: Collection[str]) -> str:
    """Where the record of an earlier edit goes: ``undulog.edit.1`` and so on.

    Returns:
        The name with the first free number.
    """
    return free_name(f"{EDIT_RECORD}.1", taken, "{stem}.{n}")


def portable(warnings: Sequence[str], sources: Sequence[RawLog]) -> str:
    """Warnings as a metadata entry: a JSON list, without the folders of this machine.

    Args:
        warnings: One sentence each.
        sources: The logs that they name.
    """
    told = list(warnings)
    for source in sources:
        told = [sentence.replace(str(source.path), source.path.name) for sentence in told]
    return json.dumps(told)
