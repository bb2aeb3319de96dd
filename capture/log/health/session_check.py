"""Check of a recorded session: its container record by record, every chunk, every message.

Only record headers and the parts outside the chunks' CRCs are read here; the payload of a chunk is
checked when it is read.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from ...common.errors import DataError, LogError
from ...common.process import threads_or_default
from ...common.remote import as_path
from ...judgement.session import judgement_of_session
from ..file.parts import check_chain
from ..mcap.chunk import MAGIC, PREFIX_SIZE, Block, chunk_at, read_message_heads, walk_records
from ..mcap.file import McapFile
from ..messages.definitions import stated_reasons
from ..read.joint_messages import joint_source
from ..read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from ..read.open_log import OpenLog
from ..read.session_view import SessionView
from .findings import Finding
from .rules import (
    judge_differences,
    judge_file,
    judge_following,
    judge_made_times,
    verdict_of,
)
from .session_scan import SessionMeasures, SessionScan
from .tallies import FileHealth

_PIECE = 1 << 24

CONTRACT_TOPICS = (COMMAND_TOPIC, RESPONSE_TOPIC)


@dataclass
class Container:
    """Result of the check.

    Attributes:
        chunks: Payload start to chunk, whole chunks only.
        damage: CRC mismatches and breaks in the chain of records, one sentence each.
        truncated: Whether the end is missing.
    """

    chunks: dict[int, Block] = field(default_factory=dict[int, Block])
    damage: list[str] = field(default_factory=list[str])
    truncated: bool = False


def check_container(file: McapFile) -> Container:
    """Check all records of an MCAP file whose magic is right."""
    container = Container()
    with file.whole() as data:
        last, at, header_stop = 0, len(MAGIC), len(MAGIC)
        ended = False
        for opcode, start, stop in walk_records(data, at, len(data)):
            last, at = opcode, stop
            if opcode == Opcode.HEADER:
                header_stop = stop
            elif opcode == Opcode.CHUNK:
                chunk = chunk_at(data, start, stop)
                if chunk is None:
                    container.damage.append(
                        f"the chunk at byte {start - PREFIX_SIZE} has no header"
                    )
                else:
                    chunk.complete = True  # as its record is
                    container.chunks[chunk.start] = chunk
            elif opcode == Opcode.DATA_END and ended:  # each CRC covers all of the data section
                container.damage.append(f"the data section ends a second time at byte {start}")
            elif stop - start >= 4:
                ended = ended or opcode == Opcode.DATA_END
                container.damage += _outside_chunks(data, opcode, start, stop, header_stop)
            if opcode == Opcode.FOOTER:
                break
        if last != Opcode.FOOTER:
            container.truncated = data[-len(MAGIC) :] != MAGIC
            if not container.truncated:
                container.damage.append(f"the chain of records breaks at byte {at}")
        elif data[at:] != MAGIC:
            container.truncated = True
    return container


def _outside_chunks(
    data: mmap.mmap, opcode: int, start: int, stop: int, header_stop: int
) -> list[str]:
    """Check the CRCs of attachments, data section and summary."""
    if opcode == Opcode.ATTACHMENT and not _fits(data, start, stop - 4, stop - 4):
        return [_corrupt("the attachment", start)]
    if opcode == Opcode.DATA_END:
        # Writers differ on whether the magic and the header belong to the section.
        begins = (0, len(MAGIC), header_stop)
        if not any(_fits(data, begin, start - PREFIX_SIZE, start) for begin in begins):
            return [_corrupt("the data section", header_stop)]
    if opcode == Opcode.FOOTER and stop - start >= 20:
        (summary,) = struct.unpack_from("<Q", data, start)
        if 0 < summary < start and not _fits(data, summary, stop - 4, stop - 4):
            return [_corrupt("the summary", summary)]
    return []


def _corrupt(what: str, at: int) -> str:
    return f"{what} at byte {at} is corrupt (its CRC doesn't fit)"


def _fits(data: mmap.mmap, start: int, stop: int, crc_at: int) -> bool:
    """Whether the bytes [start, stop) have the CRC stored at ``crc_at``; 0 means none."""
    (stored,) = struct.unpack_from("<I", data, crc_at)
    if not stored:
        return True
    crc = 0
    for at in range(start, stop, _PIECE):
        crc = zlib.crc32(data[at : min(at + _PIECE, stop)], crc)
    return crc == stored


@dataclass(frozen=True)
class SessionHealth(SessionMeasures):
    """The health of a session in a file.

    Attributes:
        session_id: Its id; one from the content if it has none.
        stored: The verdict stored in the file, or None.
        stored_reasons: The reasons stored with it.
        following: Joints that do not follow their command. Only the whole file shows them, so the
            recorder's verdict does not include them.
    """

    path: Path
    session_id: str
    stored: str | None
    stored_reasons: tuple[str, ...]
    file: FileHealth
    following: tuple[Finding, ...] = ()

    @property
    def verdict(self) -> str:
        """``good``, ``degraded`` or ``bad``."""
        return verdict_of((*self.findings, *self.following))

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not better: joints that do not follow first, then heaviest first."""
        return (*(finding.sentence for finding in self.following), *super().reasons)


def check_session(
    path: Path | str,
    on_part: Callable[[float], None] | None = None,
    *,
    topics: tuple[str, str] = CONTRACT_TOPICS,
) -> SessionHealth:
    """Measure and judge a session from its data alone.

    Args:
        path: An MCAP file, of any make; of a split session any part, or the folder.
        on_part: Called with the part that has been read, 0 to 1.
        topics: Of commands and responses, as :meth:`.SessionView.joint_topics` takes them.

    Raises:
        NotALogError: If it is not an MCAP file or nothing in it can be read.
        LogError: If it can't be opened.
        MissingChannelError: If a topic that was chosen is not there.
        DataError: If an array was chosen whose joints are unknown.
    """
    log = OpenLog(as_path(path), None, threads_or_default(None))
    try:
        return _Check(log, topics).run(on_part or (lambda _: None))
    finally:
        log.file.close()


class _Check:
    """The pass over one open file."""

    def __init__(self, log: OpenLog, topics: tuple[str, str]) -> None:
        self._log = log
        self._file = log.file
        self._view = SessionView(log)
        if topics != CONTRACT_TOPICS:
            chosen = self._view.joint_topics(*topics)
            self._view = self._view.with_joints(*topics)
            topics = _recorded(log, chosen.command), _recorded(log, chosen.response)
        self._scan = SessionScan(log.checked_robot, topics=topics)
        self._notes = log.warnings[len(log.file.warnings) :]
        for key in log.file.channels:
            self._define(key)

    def run(self, on_part: Callable[[float], None]) -> SessionHealth:
        file = self._against_summary(self._read(on_part))
        facts = self._file.metadata.get("undulog", {})
        notes = [*judge_file(file), *judge_made_times(facts)]
        measures = self._scan.result(*self._file.limits, notes)
        stored = self._file.metadata.get("undulog.health", {})
        return SessionHealth(
            **{part.name: getattr(measures, part.name) for part in fields(measures)},
            path=self._file.path,
            session_id=self._file.session_id,
            stored=stored.get("verdict"),
            stored_reasons=stated_reasons(stored),
            file=file,
            following=tuple(self._judge_following(file, measures.reasons)),
        )

    def _judge_following(self, file: FileHealth, reasons: Sequence[str]) -> list[Finding]:
        """Find joints that do not follow their command, unless the file is damaged.

        Lost samples have rules of their own, whose reasons are not repeated.
        """
        if file.damage:
            return []
        try:
            judgement = judgement_of_session(self._view)
        except DataError as error:
            why = str(error).removeprefix(f"{self._file.path}: ")
            return [Finding(0, f"whether joints follow their command is not known: {why}")]
        return [
            judge_following(fault)
            for fault in judgement.faults
            if fault.kinds != ("lost_samples",)
            or not any(_names(reason, fault.joint) for reason in reasons)
        ] + [*judge_differences(judgement)]

    # -- reading ---------------------------------------------------------------------------

    def _read(self, on_part: Callable[[float], None]) -> FileHealth:
        log_file = self._file
        total = max(1, len(log_file.blocks))
        done = 0

        def step() -> None:
            nonlocal done
            done += 1
            on_part(done / total)

        files = log_file.files
        healths = [self._read_file(part, file, step) for part, file in enumerate(files)]
        prefixes = [f"{file.path.name}: " if len(files) > 1 else "" for file in files]
        of_files = list(zip(prefixes, healths, strict=True))
        for block in log_file.blocks:
            if block.part >= len(healths):  # from the write-ahead log, checked when it was read
                self._read_block(block, log_file.path)
                step()
        recovered = log_file.recovered
        missing = [*log_file.parts.missing, *check_chain(log_file.parts)]
        if recovered is not None and recovered.missing:
            missing.append(
                f"{recovered.missing} of {recovered.accepted} messages that the recorder accepted "
                "are missing"
            )
        return FileHealth(
            chunks=sum(health.chunks for health in healths),
            checked=sum(health.checked for health in healths),
            without_crc=sum(health.without_crc for health in healths),
            damage=(
                *(name + text for name, health in of_files for text in health.damage),
                *missing,
            ),
            truncated=any(health.truncated for health in healths),
            indexed=all(health.indexed for health in healths),
            notes=(
                *(name + text for name, health in of_files for text in health.notes),
                *self._notes,
                *filter(None, [log_file.foreign_wal]),
            ),
            unfinished="" if recovered is None else recovered.warning,
            running=recovered is not None and recovered.live,
        )

    def _read_file(self, part: int, file: McapFile, step: Callable[[], None]) -> FileHealth:
        path = file.path
        blocks = [block for block in self._file.blocks if block.part == part]
        container = check_container(file)
        loose = [block for block in blocks if block.complete]
        indexed = not container.truncated and all(b.index_at for b in loose if b.end_ns)
        skipped = [note for note in file.warnings if note.startswith("the record at byte")]
        # Of an unfinished recording, the write-ahead log has more than the file's end.
        notes = [note for note in file.warnings if note not in skipped and not self._file.recovered]
        damage = [*container.damage, *skipped]
        read = {block.start for block in blocks}
        positions = {note.split(" ", 5)[4] for note in skipped}  # after "the record at byte"
        damage += [
            _unlisted(file, chunk)
            for chunk in container.chunks.values()
            if chunk.start not in read and str(chunk.record_at) not in positions
        ]
        checked = without_crc = 0
        for block in blocks:
            try:
                self._read_block(block, path)
            except LogError as error:
                damage.append(str(error).removeprefix(f"{path}: ") + self._lost_with(block))
            else:
                chunk = container.chunks.get(block.start)
                checked += chunk is not None and chunk.crc != 0
                without_crc += chunk is not None and chunk.crc == 0
            step()
        return FileHealth(
            chunks=len(container.chunks),
            checked=checked,
            without_crc=without_crc,
            damage=tuple(damage),
            truncated=container.truncated,
            indexed=indexed,
            notes=tuple(notes),
        )

    def _lost_with(self, block: Block) -> str:
        """Describe the messages of an unreadable chunk, as listed in its index."""
        try:
            source = self._file.source_of(block)
            held = {key: len(source.offsets(block, key)) for key in block.index_at}
        except LogError:
            return ""
        channels = self._file.channels
        listed = [
            f"{count} of {channels[key].topic if key in channels else f'channel {key}'}"
            for key, count in sorted(held.items())
        ]
        return f"; it held {sum(held.values())} messages: {', '.join(listed)}" if listed else ""

    def _against_summary(self, file: FileHealth) -> FileHealth:
        """Compare the summary's counts with the messages read."""
        if file.damage or file.truncated or not file.indexed:
            return file  # messages are missing, for a known reason
        wrong = [
            f"the summary counts {count} messages of {self._file.channels[key].topic}, "
            f"{self._scan.count(key)} are in the file"
            for key, count in self._file.counts.items()
            if key in self._file.channels and count != self._scan.count(key)
        ]
        return replace(file, damage=tuple(wrong))

    def _read_block(self, block: Block, path: Path) -> None:
        """Read and scan one block, its CRC and its index checked."""
        source = self._file.source_of(block)
        data, base, stop = source.payload_once(block)
        if block.is_empty and not block.index_at:
            return
        if block.offsets is None and not block.index_at:  # found once, for all channels
            source.offsets(block, 0)
        keys = list(block.offsets if block.offsets is not None else block.index_at)
        if not keys:
            return
        places = [np.sort(source.offsets(block, key)) + base for key in keys]
        heads = read_message_heads(data, np.concatenate(places), stop)
        owners = np.repeat(keys, [len(offsets) for offsets in places])
        twice = any((np.diff(offsets) == 0).any() for offsets in places)
        if heads is None or twice or (heads["channel"] != owners).any():
            where = f"the message index of the chunk at byte {block.start}"
            raise LogError(path, f"{where} does not list its messages")
        begin = 0
        for key, offsets in zip(keys, places, strict=True):
            if len(offsets) and key in self._file.channels:
                self._scan.add(key, data, offsets, heads[begin : begin + len(offsets)])
            begin += len(offsets)

    def _define(self, key: int) -> None:
        channel = self._file.channels[key]
        try:
            kind = self._log.topics.message_type(channel.topic)
        except DataError as error:
            self._notes.append(str(error).removeprefix(f"{self._file.path}: "))
            kind = None
        schema = self._file.schemas.get(channel.schema_id)
        type_name = schema.name if schema is not None else ""
        if kind is not None and kind.name != type_name:  # a second type on one topic
            kind = None
        self._scan.define(key, channel.topic, type_name, kind, channel.metadata)


def _recorded(log: OpenLog, name: str) -> str:
    """Return the topic that a name of joints is read from."""
    source = joint_source(name, log.topics.channels)
    return name if source is None else source.topic


def _unlisted(file: McapFile, chunk: Block) -> str:
    """Describe what is wrong with a chunk that is in no index."""
    try:
        file.payload_once(chunk)
    except LogError as error:
        return str(error).removeprefix(f"{file.path}: ")
    return f"the chunk at byte {chunk.start} is missing in the index"


def _names(sentence: str, joint: str) -> bool:
    return re.search(rf"(?<![\w/]){re.escape(joint)}(?![\w/])", sentence) is not None
