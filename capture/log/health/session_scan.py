"""The health of a session from its messages, of a file or of a running recording.

Chunks of a file (:mod:`.session_check`) and messages of a recording get the same verdict.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import NS, IntArray
from ...robot.model import Quantity, Robot
from ..mcap.chunk import Buffer
from ..messages import COMMAND_TOPIC, RESPONSE_TOPIC
from ..messages.definitions import JOINT_STATE, MessageType
from ..messages.frames import identifier_text
from .bus_tally import SourceHealth, judge_source, measure_sources, named_identifiers, undecoded
from .channel_scan import ChannelScan, Limits, NameTallies
from .findings import WAITING, Finding, joined
from .freeze import FreezeTally
from .rules import (
    judge_body,
    judge_bus,
    judge_channel,
    judge_joints,
    judge_series,
    judge_silences,
    judge_topics,
    verdict_of,
)
from .skipped_cycles import with_skipped_cycles
from .tallies import BusHealth, ChannelHealth, JointHealth, SeriesHealth

_MOST_PAIRS = 4096
"""Most pairs of measured and commanded joint sets that are checked for frozen joints."""


@dataclass(frozen=True)
class SessionMeasures:
    """Measures and findings of a session's messages.

    Attributes:
        robot: Name of the robot; None without a usable description.
        start_ns: Log time of the first message [Unix ns]; 0 without messages.
        end_ns: Log time of the last.
        findings: Heaviest first.
        joints: By topic, in the order of the messages.
        sources: Counts of the recorder, by name.
    """

    robot: str | None
    start_ns: int
    end_ns: int
    findings: tuple[Finding, ...]
    channels: tuple[ChannelHealth, ...]
    series: tuple[SeriesHealth, ...]
    joints: tuple[JointHealth, ...]
    buses: tuple[BusHealth, ...]
    sources: tuple[SourceHealth, ...]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / NS

    @property
    def verdict(self) -> str:
        """``good``, ``degraded`` or ``bad``."""
        return verdict_of(self.findings)

    @property
    def waits(self) -> bool:
        """Whether the robot reports its joints and no command has come yet."""
        return WAITING in self.findings

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons of the verdict, heaviest first."""
        return tuple(finding.sentence for finding in self.findings if finding.weight)

    @property
    def notes(self) -> tuple[str, ...]:
        """Findings that are no fault."""
        return tuple(finding.sentence for finding in self.findings if not finding.weight)


@dataclass(frozen=True)
class ChannelMeasures:
    """Measures of one channel's messages.

    Attributes:
        series: One for each set of names.
    """

    channel: ChannelHealth
    series: tuple[SeriesHealth, ...]


class SessionScan:
    """The scan of one session, channel by channel."""

    def __init__(
        self,
        robot: Robot | None,
        *,
        horizon_s: int | None = None,
        topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC),
    ) -> None:
        """Start without channels.

        Args:
            robot: The robot of the session; None without a usable description.
            topics: Of commands and responses.
            horizon_s: How far stamps may go back in a running recording [s]. Older samples are
                summed up, so that memory is bounded, and later ones are not checked for frozen
                joints. None for a file.
        """
        self._robot, self._horizon_s = robot, horizon_s
        self._angles = self._commands, self._states = topics
        self._freezes: dict[tuple[int, tuple[str, ...], int, tuple[str, ...]], FreezeTally] = {}
        self._scans: dict[int, ChannelScan] = {}
        self._types: dict[int, str] = {}

    def define(
        self,
        key: int,
        topic: str,
        type_name: str,
        kind: MessageType | None,
        metadata: Mapping[str, str],
    ) -> None:
        """Add a channel, before its messages.

        Args:
            key: The channel's id.
            kind: Its type; None if it can't be read: then only times are used.
            metadata: Of the channel, e.g. ``unit``.
        """
        angles = topic in self._angles and metadata.get("unit", "rad") == "rad"
        limits: Limits | None = {} if angles else None
        if angles and self._robot is not None:
            limits = {joint.name: (joint.lower, joint.upper) for joint in self._robot.joints}
        joints = kind is not None and type_name == JOINT_STATE
        self._scans[key] = ChannelScan(
            topic, kind, joints=joints, limits=limits, horizon_s=self._horizon_s
        )
        self._types[key] = type_name

    def add(self, key: int, data: Buffer, offsets: IntArray, heads: NDArray[np.void]) -> None:
        """Add messages of one channel.

        Args:
            data: Bytes that hold their records.
            offsets: Offsets of the records, in the order of the session, shape (n,).
            heads: The records' heads, of :data:`.capture.log.mcap.chunk.HEAD`, shape (n,).
        """
        self._scans[key].add(data, offsets, heads)

    def count(self, key: int) -> int:
        """Return the number of messages of a channel so far."""
        self._scans[key].flush()
        return self._scans[key].count

    def measure(self, key: int) -> ChannelMeasures:
        """Return the measures of a channel so far."""
        scan, type_name = self._scans[key], self._types[key]
        scan.flush()
        return ChannelMeasures(
            ChannelHealth(scan.topic, type_name, scan.count, scan.unread, scan.sequence.result()),
            tuple(_series(scan.topic, type_name, tally) for tally in scan.series.values()),
        )

    def result(
        self,
        start_ns: int,
        end_ns: int,
        before: Iterable[Finding] = (),
        measured: Mapping[int, ChannelMeasures] | None = None,
    ) -> SessionMeasures:
        """Judge the messages so far.

        Args:
            start_ns: Log time of the first message [Unix ns]; 0 without messages.
            end_ns: Log time of the last.
            before: Other findings, e.g. on the container.
            measured: Existing measures of channels.
        """
        taken = measured or {}
        scans = [
            (key, scan) for key, scan in self._scans.items() if key in taken or self.count(key)
        ]
        scans.sort(key=lambda item: item[1].topic)
        every = [taken.get(key) or self.measure(key) for key, _ in scans]
        channels = tuple(measures.channel for measures in every)
        series = tuple(series for measures in every for series in measures.series)
        joints = self._joints(scans)
        bitrate = self._bitrate([scan for _, scan in scans if scan.bus is not None])
        buses = tuple(
            scan.bus.result(scan.topic, bitrate) for _, scan in scans if scan.bus is not None
        )
        sources = tuple(
            source
            for _, scan in scans
            if scan.ends is not None and scan.kind is not None
            for source in measure_sources(scan.kind, *scan.ends)
        )
        series = with_skipped_cycles(series, channels, sources, self._commands)
        types = {channel.topic: channel.type_name for channel in channels}
        chain = self._robot.joint_names if self._robot is not None else ()
        seen = [joint.name for joint in joints if joint.topic == self._states]
        unseen = set(chain).difference(joint.name for joint in joints if joint.nan < joint.samples)
        why = self._undecoded([scan for _, scan in scans], all_joints=not unseen)
        topics = judge_topics(types, self._angles, chain, seen, why, commanded=self.commanded)
        findings = [*before, *topics]
        faults = [fault for channel in channels for fault in judge_channel(channel)]
        # Messages of frames come when a batch is full; the frames themselves are judged.
        framed = {bus.topic for bus in buses}
        first = [channel.first_log_ns for channel in series if channel.topic == self._commands]
        commands_ns = min(first, default=None)
        for health in series:
            if health.topic not in framed:
                faults += judge_series(health, start_ns, end_ns, commands_ns)
        findings += joined([*faults, *judge_joints(joints, start_ns)])
        states = [joint for joint in joints if joint.topic == self._states]
        findings += judge_body(states, (end_ns - start_ns) / NS)
        for bus in buses:
            findings += judge_bus(bus)
        findings += judge_silences(buses, start_ns)
        for source in sources:
            findings += judge_source(source)
        findings.sort(key=lambda finding: -finding.weight)
        return SessionMeasures(
            robot=self._robot.name if self._robot is not None else None,
            start_ns=start_ns,
            end_ns=end_ns,
            findings=tuple(dict.fromkeys(findings)),
            channels=channels,
            series=series,
            joints=joints,
            buses=buses,
            sources=sources,
        )

    @cached_property
    def commanded(self) -> bool:
        """Whether the robot's bus map defines commands."""
        bus = None if self._robot is None else self._robot.bus
        return bus is not None and any(s.quantity is Quantity.COMMAND for s in bus.signals)

    @cached_property
    def _named(self) -> frozenset[int]:
        return frozenset() if self._robot is None else named_identifiers(self._robot)

    def _undecoded(self, scans: list[ChannelScan], *, all_joints: bool) -> str | None:
        """Return why almost no frame could be decoded; None if enough were, or without a map."""
        tallies = [scan.bus.identifiers for scan in scans if scan.bus is not None]
        robot = self._robot
        if all_joints or robot is None or robot.bus is None or not tallies:
            return None
        counts = Counter[int]()
        for tally in tallies:
            counts.update(tally.counts)
        decoded = sum(counts.pop(identifier, 0) for identifier in self._named)
        others = {identifier_text(identifier): count for identifier, count in counts.items()}
        frames = sum(tally.frames for tally in tallies)
        return undecoded(robot.name, decoded, frames, others, all_joints=all_joints)

    def _joints(self, scans: list[tuple[int, ChannelScan]]) -> tuple[JointHealth, ...]:
        limited = set(self._robot.joint_names) if self._robot is not None else set[str]()
        healths: dict[tuple[str, str], JointHealth] = {}
        for key, scan in scans:
            for series in scan.series.values():
                runs = self._frozen(key, series, scans) if scan.topic == self._states else {}
                for k, name in enumerate(series.names):
                    bounded = name in limited and scan.topic in self._angles and series.rows
                    longest = max(runs.get(k, ()), default=None)
                    joint = JointHealth(
                        topic=scan.topic,
                        name=name,
                        samples=series.rows,
                        nan=int(series.joint_nan[k]),
                        at_limit=float(series.at_limit[k] / series.rows) if bounded else None,
                        frozen_s=None if longest is None else longest[0],
                        frozen_at_ns=0 if longest is None else longest[1] * NS,
                    )
                    had = healths.get((scan.topic, name))
                    healths[scan.topic, name] = joint if had is None else had.with_more(joint)
        closed = self._closed(scans)
        for _, scan in scans:
            for series in scan.series.values():
                series.ranges.forget(closed)
        return tuple(healths.values())

    def _frozen(
        self, key: int, series: NameTallies, scans: list[tuple[int, ChannelScan]]
    ) -> dict[int, list[tuple[int, int]]]:
        """Return frozen seconds and the first one, for each joint with a command, by its index."""
        measured = series.ranges.result(len(series.names))
        runs: dict[int, list[tuple[int, int]]] = {}
        closed = self._closed(scans)
        for other, scan in scans:
            for command in scan.series.values() if scan.topic == self._commands else ():
                if len(self._freezes) >= _MOST_PAIRS:
                    return runs
                pair = (key, series.names, other, command.names)
                if pair not in self._freezes:
                    self._freezes[pair] = FreezeTally(series.names, command.names)
                freeze = self._freezes[pair]
                if not freeze.columns:
                    continue
                ranges = command.ranges.result(len(command.names))
                lasted, since = freeze.result(measured, ranges, closed)
                for k, *run in zip(freeze.columns, lasted.tolist(), since.tolist(), strict=True):
                    runs.setdefault(k, []).append((run[0], run[1]))
        return runs

    def _closed(self, scans: list[tuple[int, ChannelScan]]) -> int | None:
        """Return the second before which no series of angles will change."""
        every = [
            series.ranges.closed
            for _, scan in scans
            for series in scan.series.values()
            if scan.topic in self._angles
        ]
        return min((second for second in every if second is not None), default=None)

    def last_load(self, topic: str) -> tuple[float, float] | None:
        """Return the load of a bus in its last whole second; see :meth:`.BusTally.last_second`."""
        buses = [scan for scan in self._scans.values() if scan.bus is not None and scan.count]
        for scan in buses:
            if scan.topic == topic and scan.bus is not None:
                return scan.bus.last_second(self._bitrate(buses))
        return None

    def _bitrate(self, buses: list[ChannelScan]) -> int | None:
        """Return the described bus's bitrate; None if there are several buses."""
        if self._robot is None or self._robot.bus is None or len(buses) != 1:
            return None
        return self._robot.bus.bitrate


def _series(topic: str, type_name: str, tally: NameTallies) -> SeriesHealth:
    return SeriesHealth(
        topic=topic,
        type_name=type_name,
        names=tally.names,
        timing=tally.timing.result(),
        first_log_ns=tally.first_log_ns,
        last_log_ns=tally.last_log_ns,
        numbers=tally.numbers,
        nan=tally.nan,
    )
