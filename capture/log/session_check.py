"""One pass over a recorded session: every chunk, every message, to one statement of health."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..errors import DataError, LogError, RobotFileError
from ..robot import Robot
from ..robot.description import parse_robot
from .channel_scan import ChannelScan, Limits, Series
from .chunk import Block
from .container_check import Container, check_chunk, check_container
from .health import (
    Finding,
    frozen_time,
    judge_bus,
    judge_channel,
    judge_file,
    judge_joints,
    judge_series,
    judge_topics,
    verdict_of,
)
from .measures import BusHealth, ChannelHealth, FileHealth, JointHealth, SeriesHealth
from .message_heads import read_heads
from .storage import LogFile
from .tallies import NS
from .topics import Topics

COMMANDS, STATES = "/joint_commands", "/joint_states"


@dataclass(frozen=True)
class SessionHealth:
    """The health of a session.

    Attributes:
        path: The file.
        session_id: Its id, or the file's name.
        robot: Name of the robot; None without a usable description.
        start_ns: Log time of the first message [Unix ns]; 0 without messages.
        end_ns: Log time of the last.
        findings: All that was found, heaviest first.
        stored: The verdict stored by whoever recorded it, or None.
        stored_reasons: The reasons stored with it.
        file: The container.
        channels: By topic.
        series: By topic and names.
        joints: By topic, in the order of the messages.
        buses: By topic.
    """

    path: Path
    session_id: str
    robot: str | None
    start_ns: int
    end_ns: int
    findings: tuple[Finding, ...]
    stored: str | None
    stored_reasons: tuple[str, ...]
    file: FileHealth
    channels: tuple[ChannelHealth, ...]
    series: tuple[SeriesHealth, ...]
    joints: tuple[JointHealth, ...]
    buses: tuple[BusHealth, ...]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / NS

    @property
    def verdict(self) -> str:
        """``good``, ``degraded`` or ``bad``."""
        return verdict_of(self.findings)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not better, heaviest first."""
        return tuple(finding.sentence for finding in self.findings if finding.weight)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is worth knowing and no fault."""
        return tuple(finding.sentence for finding in self.findings if not finding.weight)


def check_session(
    path: Path | str, on_part: Callable[[float], None] | None = None
) -> SessionHealth:
    """Measure and judge a session from its data alone.

    Args:
        path: An MCAP file, of any make.
        on_part: Told how much has been read, 0 to 1.

    Returns:
        Its health.

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
        self._scans = {key: self._scan(key) for key in log_file.channels}

    def run(self, on_part: Callable[[float], None]) -> SessionHealth:
        """Read, then judge."""
        file = self._read(on_part)
        for scan in self._scans.values():
            scan.flush()
        file = self._against_summary(file)
        blocks = [block for block in self._file.blocks if block.end_ns]
        start_ns = min((block.start_ns for block in blocks), default=0)
        end_ns = max((block.end_ns for block in blocks), default=0)
        found = [(key, scan) for key, scan in self._scans.items() if scan.count]
        found.sort(key=lambda item: item[1].topic)
        channels = tuple(self._channel(key, scan) for key, scan in found)
        series = tuple(
            self._series(key, scan.topic, tally)
            for key, scan in found
            for tally in scan.series.values()
        )
        joints = self._joints([scan for _, scan in found])
        bitrate = self._bitrate([scan for _, scan in found if scan.bus is not None])
        buses = tuple(
            scan.bus.result(scan.topic, bitrate) for _, scan in found if scan.bus is not None
        )
        findings = judge_file(file)
        types = {channel.topic: channel.type_name for channel in channels}
        chain = self._robot.joint_names if self._robot is not None else ()
        seen = [joint.name for joint in joints if joint.topic == STATES]
        findings += judge_topics(types, chain, seen)
        for channel in channels:
            findings += judge_channel(channel)
        # Messages of frames come when a batch is full; the frames themselves are judged.
        framed = {bus.topic for bus in buses}
        for each in series:
            if each.topic not in framed:
                findings += judge_series(each, start_ns, end_ns)
        findings += judge_joints(joints, start_ns)
        for bus in buses:
            findings += judge_bus(bus, start_ns)
        findings.sort(key=lambda finding: -finding.weight)
        stored = self._file.metadata.get("undulog.health", {})
        return SessionHealth(
            path=self._file.path,
            session_id=self._file.metadata.get("undulog", {}).get("session_id")
            or self._file.path.stem,
            robot=self._robot.name if self._robot is not None else None,
            start_ns=start_ns,
            end_ns=end_ns,
            findings=tuple(dict.fromkeys(findings)),
            stored=stored.get("verdict"),
            stored_reasons=_reasons(stored.get("reasons", "[]")),
            file=file,
            channels=channels,
            series=series,
            joints=joints,
            buses=buses,
        )

    # -- reading ---------------------------------------------------------------------------

    def _read(self, on_part: Callable[[float], None]) -> FileHealth:
        path, blocks = self._file.path, self._file.blocks
        container = check_container(path)
        loose = [block for block in blocks if block.complete]
        indexed = not container.truncated and all(b.index_at for b in loose if b.end_ns)
        skipped = [note for note in self._file.warnings if note.startswith("the record at byte")]
        notes = [note for note in self._file.warnings if note not in skipped]
        damage = [*container.damage, *skipped]
        read = {block.start for block in blocks}
        for place in container.chunks.values():
            known = any(
                note.startswith(f"the record at byte {place.record_at} ") for note in skipped
            )
            if known or place.start in read:
                continue
            wrong = check_chunk(path, place)
            damage.append(wrong or f"the chunk at byte {place.start} is missing in the index")
        checked = without_crc = 0
        for done, block in enumerate(blocks):
            try:
                crc = self._read_block(block, container)
                checked += crc
                without_crc += not crc and block.start in container.chunks
            except LogError as error:
                damage.append(str(error).removeprefix(f"{path}: "))
            on_part((done + 1) / len(blocks))
        return FileHealth(
            chunks=len(container.chunks),
            checked=checked,
            without_crc=without_crc,
            damage=tuple(damage),
            truncated=container.truncated,
            indexed=indexed,
            notes=(*notes, *self._notes),
        )

    def _against_summary(self, file: FileHealth) -> FileHealth:
        """The file's health with the summary's counts held against the messages read."""
        if file.damage or file.truncated or not file.indexed:
            return file  # then messages are missing anyway, and the reason is known
        wrong = [
            f"the summary counts {count} messages of {self._scans[key].topic}, "
            f"{self._scans[key].count} are in the file"
            for key, count in self._file.counts.items()
            if key in self._scans and count != self._scans[key].count
        ]
        return replace(file, damage=tuple(wrong))

    def _read_block(self, block: Block, container: Container) -> bool:
        """Read one block; whether a CRC was there and fits."""
        data, base = self._file.payload(block)  # its CRC is checked where it is compressed
        chunk = container.chunks.get(block.start)
        stop = len(data) if block.compression else block.stop
        plain = chunk is not None and not block.compression and chunk.crc
        if plain and zlib.crc32(data[block.start : block.stop]) != block.crc:
            where = f"the chunk at byte {block.start}"
            raise LogError(self._file.path, f"{where} is corrupt (its CRC doesn't fit)")
        keys = list(block.offsets if block.offsets is not None else block.index_at)
        if not keys:
            keys = list(self._scans)
        found = [np.sort(self._file.offsets(block, key)) + base for key in keys]
        heads = read_heads(data, np.concatenate(found), stop)
        owners = np.repeat(keys, [len(offsets) for offsets in found])
        twice = any((np.diff(offsets) == 0).any() for offsets in found)
        if heads is None or twice or (heads["channel"] != owners).any():
            where = f"the message index of the chunk at byte {block.start}"
            raise LogError(self._file.path, f"{where} does not list its messages")
        begin = 0
        for key, offsets in zip(keys, found, strict=True):
            if len(offsets) and key in self._scans:
                self._scans[key].add(data, offsets, heads[begin : begin + len(offsets)])
            begin += len(offsets)
        return chunk is not None and bool(chunk.crc)

    def _read_robot(self) -> Robot | None:
        stored = self._file.attachments
        if "robot.toml" not in stored:
            return None
        databases = {
            name: item.data.decode("utf-8", "replace")
            for name, item in stored.items()
            if name.endswith(".dbc")
        }
        try:
            text = stored["robot.toml"].data.decode()
            return parse_robot(text, source=f"{self._file.path}:robot.toml", databases=databases)
        except (RobotFileError, UnicodeDecodeError) as error:
            self._notes.append(f"the attached robot description can't be used: {error}")
            return None

    def _scan(self, key: int) -> ChannelScan:
        channel = self._file.channels[key]
        try:
            kind = self._topics.message_type(channel.topic)
        except DataError as error:
            self._notes.append(str(error).removeprefix(f"{self._file.path}: "))
            kind = None
        type_name = self._type_name(key)
        if kind is not None and kind.name != type_name:  # a second type on one topic
            kind = None
        angles = channel.topic in (COMMANDS, STATES)
        angles = angles and channel.metadata.get("unit", "rad") == "rad"
        limits: Limits | None = {} if angles else None
        if angles and self._robot is not None:
            limits = {joint.name: (joint.lower, joint.upper) for joint in self._robot.joints}
        joints = kind is not None and type_name == "sensor_msgs/msg/JointState"
        return ChannelScan(channel.topic, kind, joints=joints, limits=limits)

    def _type_name(self, key: int) -> str:
        schema = self._file.schemas.get(self._file.channels[key].schema_id)
        return schema.name if schema is not None else ""

    # -- results ---------------------------------------------------------------------------

    def _channel(self, key: int, scan: ChannelScan) -> ChannelHealth:
        sequence = scan.sequence.result()
        return ChannelHealth(scan.topic, self._type_name(key), scan.count, scan.unread, sequence)

    def _series(self, key: int, topic: str, tally: Series) -> SeriesHealth:
        return SeriesHealth(
            topic=topic,
            type_name=self._type_name(key),
            names=tally.names,
            timing=tally.timing.result(),
            first_log_ns=tally.first_log_ns,
            last_log_ns=tally.last_log_ns,
            numbers=tally.numbers,
            nan=tally.nan,
        )

    def _joints(self, scans: list[ChannelScan]) -> tuple[JointHealth, ...]:
        tallies = [(scan.topic, series) for scan in scans for series in scan.series.values()]
        commands = [
            (series.names, series.ranges.result(len(series.names)))
            for topic, series in tallies
            if topic == COMMANDS
        ]
        limited = set(self._robot.joint_names) if self._robot is not None else set[str]()
        found: dict[tuple[str, str], JointHealth] = {}
        for topic, series in tallies:
            measured = series.ranges.result(len(series.names))
            for k, name in enumerate(series.names):
                runs = [
                    frozen_time(measured, k, command, names.index(name))
                    for names, command in commands
                    if topic == STATES and name in names
                ]
                bounded = name in limited and topic in (COMMANDS, STATES) and series.rows
                longest = max(runs, default=None)
                joint = JointHealth(
                    topic=topic,
                    name=name,
                    samples=series.rows,
                    nan=int(series.joint_nan[k]),
                    at_limit=float(series.at_limit[k] / series.rows) if bounded else None,
                    frozen_s=None if longest is None else longest[0],
                    frozen_at_ns=0 if longest is None else longest[1] * NS,
                )
                had = found.get((topic, name))
                found[topic, name] = joint if had is None else had.with_more(joint)
        return tuple(found.values())

    def _bitrate(self, buses: list[ChannelScan]) -> int | None:
        """The described bus's bitrate, where it is clear which one that is."""
        if self._robot is None or self._robot.bus is None or len(buses) != 1:
            return None
        return self._robot.bus.bitrate


def _reasons(text: str) -> tuple[str, ...]:
    try:
        found: Any = json.loads(text)
    except ValueError:
        return (text,)
    return tuple(map(str, cast("list[Any]", found))) if isinstance(found, list) else (str(found),)
