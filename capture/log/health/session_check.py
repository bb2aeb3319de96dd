"""One pass over a recorded session: every chunk, every message, to one statement of health."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from ...common.errors import DataError, LogError, RobotFileError
from ...following.session import faults_in_session
from ...robot.description import robot_in_session
from ...robot.model import Robot
from ..columns.topics import Topics
from ..edit.edited_log import Finding
from ..file.log_file import LogFile
from ..file.parts import check_chain
from ..mcap.chunk import Block
from ..mcap.container_check import Container, check_chunk, check_container
from ..mcap.file import McapFile
from ..mcap.records import read_message_heads
from ..read.session import Session
from .measures import FileHealth
from .rules import judge_file, judge_following, verdict_of
from .session_scan import SessionMeasures, SessionScan


@dataclass(frozen=True)
class SessionHealth(SessionMeasures):
    """The health of a session in a file.

    Attributes:
        session_id: Its id, or the file's name.
        stored: The verdict stored by whoever recorded it, or None.
        stored_reasons: The reasons stored with it.
        following: Joints that do not follow their command: only the whole file shows them, so a
            recorder's verdict is without.
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
    path: Path | str, on_part: Callable[[float], None] | None = None
) -> SessionHealth:
    """Measure and judge a session from its data alone.

    Args:
        path: An MCAP file, of any make; of a split session any part, or the folder.
        on_part: Told how much has been read, 0 to 1.

    Raises:
        NotALogError: If it is not an MCAP file or nothing in it can be read.
        LogError: If it can't be opened.
    """
    path = Path(path)
    log_file = LogFile(path)
    try:
        return _Check(log_file).run(on_part or (lambda _: None))
    finally:
        log_file.close()


class _Check:
    """The pass over one open file."""

    def __init__(self, log_file: LogFile) -> None:
        self._file = log_file
        self._notes: list[str] = []
        self._topics = Topics(log_file, self._notes.append)
        self._robot = self._read_robot()
        self._scan = SessionScan(self._robot)
        for key in log_file.channels:
            self._define(key)

    def run(self, on_part: Callable[[float], None]) -> SessionHealth:
        """Read, then judge."""
        file = self._against_summary(self._read(on_part))
        found = self._scan.result(*self._file.limits, judge_file(file))
        stored = self._file.metadata.get("undulog.health", {})
        return SessionHealth(
            **{each.name: getattr(found, each.name) for each in fields(found)},
            path=self._file.path,
            session_id=self._file.metadata.get("undulog", {}).get("session_id")
            or self._file.path.stem,
            stored=stored.get("verdict"),
            stored_reasons=_reasons(stored.get("reasons", "[]")),
            file=file,
            following=tuple(self._judge_following(file, found.reasons)),
        )

    def _judge_following(self, file: FileHealth, said: Sequence[str]) -> list[Finding]:
        """Joints that do not follow their command; none of a file with damage.

        Lost samples have rules of their own; what these say of a joint is not said twice.
        """
        if file.damage:
            return []
        try:
            with Session(self._file.path) as session:
                faults = faults_in_session(session)
        except DataError as error:
            why = str(error).removeprefix(f"{self._file.path}: ")
            return [Finding(0, f"whether joints follow their command is not known: {why}")]
        return [
            judge_following(fault)
            for fault in faults
            if fault.kinds != ("lost_samples",) or not any(_names(one, fault.joint) for one in said)
        ]

    # -- reading ---------------------------------------------------------------------------

    def _read(self, on_part: Callable[[float], None]) -> FileHealth:
        log_file = self._file
        total = max(1, len(log_file.blocks))
        done = 0

        def step() -> None:
            nonlocal done
            done += 1
            on_part(done / total)

        several = len(log_file.files) > 1
        found = [
            _with_name(self._read_file(part, file, step), file.path.name if several else "")
            for part, file in enumerate(log_file.files)
        ]
        for block in log_file.blocks:
            if block.part >= len(found):  # from the write-ahead log, checked when it was read
                self._read_block(block, Container(), log_file.path)
                step()
        recovered = log_file.recovered
        told = [*log_file.parts.missing, *check_chain(log_file.parts)]
        if recovered is not None and recovered.missing:
            told.append(
                f"{recovered.missing} of {recovered.accepted} messages that the recorder accepted "
                "are missing"
            )
        return FileHealth(
            chunks=sum(one.chunks for one in found),
            checked=sum(one.checked for one in found),
            without_crc=sum(one.without_crc for one in found),
            damage=(*(text for one in found for text in one.damage), *told),
            truncated=any(one.truncated for one in found),
            indexed=all(one.indexed for one in found),
            notes=(
                *(text for one in found for text in one.notes),
                *self._notes,
                *filter(None, [log_file.foreign_wal]),
            ),
            unfinished="" if recovered is None else recovered.warning,
            running=recovered is not None and recovered.live,
        )

    def _read_file(self, part: int, file: McapFile, step: Callable[[], None]) -> FileHealth:
        path = file.path
        blocks = [block for block in self._file.blocks if block.part == part]
        container = check_container(path)
        loose = [block for block in blocks if block.complete]
        indexed = not container.truncated and all(b.index_at for b in loose if b.end_ns)
        skipped = [note for note in file.warnings if note.startswith("the record at byte")]
        # Of what was not finalised, the write-ahead log knows more than the file's end.
        notes = [note for note in file.warnings if note not in skipped and not self._file.recovered]
        damage = [*container.damage, *skipped]
        read = {block.start for block in blocks}
        known = {note.split(" ", 5)[4] for note in skipped}  # after "the record at byte"
        for place in container.chunks.values():
            if place.start in read or str(place.record_at) in known:
                continue
            wrong = check_chunk(path, place)
            damage.append(wrong or f"the chunk at byte {place.start} is missing in the index")
        checked = without_crc = 0
        for block in blocks:
            try:
                crc = self._read_block(block, container, path)
                checked += crc
                without_crc += not crc and block.start in container.chunks
            except LogError as error:
                damage.append(str(error).removeprefix(f"{path}: ") + self._lost_with(block))
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
        """What a chunk that can't be read held, as its index has it."""
        try:
            held = {key: len(self._file.offsets(block, key)) for key in block.index_at}
        except LogError:
            return ""
        channels = self._file.channels
        listed = [
            f"{count} of {channels[key].topic if key in channels else f'channel {key}'}"
            for key, count in sorted(held.items())
        ]
        return f"; it held {sum(held.values())} messages: {', '.join(listed)}" if listed else ""

    def _against_summary(self, file: FileHealth) -> FileHealth:
        """The file's health with the summary's counts held against the messages read."""
        if file.damage or file.truncated or not file.indexed:
            return file  # then messages are missing anyway, and the reason is known
        wrong = [
            f"the summary counts {count} messages of {self._scan.topic(key)}, "
            f"{self._scan.count(key)} are in the file"
            for key, count in self._file.counts.items()
            if self._scan.has(key) and count != self._scan.count(key)
        ]
        return replace(file, damage=tuple(wrong))

    def _read_block(self, block: Block, container: Container, path: Path) -> bool:
        """Read one block; whether a CRC was there and fits."""
        data, base = self._file.payload(block)  # its CRC is checked where it is compressed
        chunk = container.chunks.get(block.start)
        stop = len(data) if block.compression else block.stop
        plain = chunk is not None and not block.compression and chunk.crc
        if plain and zlib.crc32(data[block.start : block.stop]) != block.crc:
            where = f"the chunk at byte {block.start}"
            raise LogError(path, f"{where} is corrupt (its CRC doesn't fit)")
        if block.is_empty and not block.index_at:
            return chunk is not None and bool(chunk.crc)
        if block.offsets is None and not block.index_at:  # looked for once, for all channels
            self._file.offsets(block, 0)
        keys = list(block.offsets if block.offsets is not None else block.index_at)
        if not keys:
            return chunk is not None and bool(chunk.crc)
        found = [np.sort(self._file.offsets(block, key)) + base for key in keys]
        heads = read_message_heads(data, np.concatenate(found), stop)
        owners = np.repeat(keys, [len(offsets) for offsets in found])
        twice = any((np.diff(offsets) == 0).any() for offsets in found)
        if heads is None or twice or (heads["channel"] != owners).any():
            where = f"the message index of the chunk at byte {block.start}"
            raise LogError(path, f"{where} does not list its messages")
        begin = 0
        for key, offsets in zip(keys, found, strict=True):
            if len(offsets) and self._scan.has(key):
                self._scan.add(key, data, offsets, heads[begin : begin + len(offsets)])
            begin += len(offsets)
        return chunk is not None and bool(chunk.crc)

    def _read_robot(self) -> Robot | None:
        stored = {name: item.data for name, item in self._file.attachments.items()}
        try:
            return robot_in_session(stored, self._file.path)
        except RobotFileError as error:
            self._notes.append(f"the attached robot description can't be used: {error}")
            return None

    def _define(self, key: int) -> None:
        channel = self._file.channels[key]
        try:
            kind = self._topics.message_type(channel.topic)
        except DataError as error:
            self._notes.append(str(error).removeprefix(f"{self._file.path}: "))
            kind = None
        schema = self._file.schemas.get(channel.schema_id)
        type_name = schema.name if schema is not None else ""
        if kind is not None and kind.name != type_name:  # a second type on one topic
            kind = None
        self._scan.define(key, channel.topic, type_name, kind, channel.metadata)


def _with_name(health: FileHealth, name: str) -> FileHealth:
    """The health of one part, its sentences beginning with its name."""
    if not name:
        return health
    return replace(
        health,
        damage=tuple(f"{name}: {text}" for text in health.damage),
        notes=tuple(f"{name}: {text}" for text in health.notes),
    )


def _reasons(text: str) -> tuple[str, ...]:
    try:
        found: Any = json.loads(text)
    except (ValueError, RecursionError):
        return (text,)
    return tuple(map(str, cast("list[Any]", found))) if isinstance(found, list) else (str(found),)


def _names(sentence: str, joint: str) -> bool:
    return re.search(rf"(?<![\w/]){re.escape(joint)}(?![\w/])", sentence) is not None
