"""The health of a running recording, by the rules of ``undulog log check``.

The sink offers each accepted message here; once a second those of the last second go through
the same scan as the chunks of a file, one channel a tick, so the verdict at the end is that of the
file's data. Memory is bounded: data older than a minute are summed up.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from ..common.arrays import NS
from ..common.errors import DataError
from ..log.health.findings import WAITS_FOR_COMMANDS
from ..log.health.rules import FROZEN_SECONDS, MAX_AT_LIMIT
from ..log.health.session_scan import ChannelMeasures, SessionMeasures, SessionScan
from ..log.health.tallies import BusHealth, JointHealth, Timing
from ..log.mcap.batch import MessageBatch, MessageFields
from ..log.mcap.chunk import BODY_AT, FIXED_SIZE, HEAD
from ..log.messages.definitions import parse_message_type
from ..log.messages.frames import FRAME_TOPIC_PREFIX, FRAME_TOPIC_PREFIXES, SERIAL_TOPIC_PREFIX
from ..log.write.mcap_sink import Description
from ..robot.model import Robot
from ..sources.contract import Source
from .source_clock import SourceClock
from .status import SourceSnapshot, TopicSnapshot

HORIZON_S = 60
"""How far the stamps of a running recording may go back [s]: older data are summed up."""

PIECE = 1 << 17
"""Approximate bytes of messages in one step: raw frames come in hundreds of kB."""

ROUND_NS = 1_000_000_000
"""Interval of scanning all channels [ns]."""

MEASURE_EVERY = 4
"""Rounds between two measures of a channel."""

RECENT = 6
"""Rounds over which a rate is computed."""


_Message = tuple[int, int, bytes]  # log time, sequence number, payload


@dataclass
class _Topic:
    """Message counts of a topic, for its rate."""

    name: str
    last_ns: int = 0
    count: int = 0
    recent: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=RECENT))

    def rate_hz(self) -> float | None:
        if len(self.recent) < 2:
            return None
        (began, had), (ended, has) = self.recent[0], self.recent[-1]
        return (has - had) * NS / (ended - began) if ended > began else None


class LiveHealth:
    """Judges a recording while it runs, as a listener of its sink."""

    def __init__(self, robot: Robot | None) -> None:
        """Start without messages; the robot has limits, joints and the bitrate."""
        self._scan = SessionScan(robot, horizon_s=HORIZON_S)
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, _Topic] = {}
        self._sources: dict[str, _Topic] = {}
        self._measured: dict[int, ChannelMeasures] = {}
        self._scanned: set[int] = set()
        self._unmeasured: dict[int, int] = {}  # log time up to which a channel's measure goes
        self._round_end_ns = 0
        self._round_keys = frozenset[int]()
        self._rounds = 0
        self._pending: defaultdict[int, list[_Message]] = defaultdict(list)
        self._round: list[tuple[int, list[_Message]]] = []
        self._in_round = False
        self._due_ns = 0
        self._span: tuple[int, int] | None = None
        self._now_ns = 0
        self._latest: SessionMeasures | None = None

    def define(self, record: Description) -> None:
        """Take a schema or a channel; other definitions are ignored."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        if not isinstance(record, Channel) or record.id in self._topics:
            return  # every part of a split session defines its channels again
        schema = self._schemas.get(record.schema_id)
        kind = None
        if schema is not None and (schema.encoding, record.message_encoding) == ("ros2msg", "cdr"):
            with suppress(DataError):  # then only times are examined, as in a file
                kind = parse_message_type(schema.name, schema.data.decode("utf-8", "replace"))
        name = schema.name if schema is not None else ""
        self._topics[record.id] = _Topic(record.topic)
        self._scan.define(record.id, record.topic, name, kind, record.metadata)

    def offer(self, *message: *MessageFields) -> None:
        """Keep a message for the next round; see :meth:`MessageSink.write`."""
        channel_id, log_time_ns, _, sequence, payload = message
        self._pending[channel_id].append((log_time_ns, sequence, payload))

    def offer_batch(self, batch: MessageBatch) -> None:
        """Keep messages for the next round; see :meth:`MessageSink.write_batch`."""
        self._pending[batch.channel_id] += [
            (log_time_ns, sequence, payload)
            for _, log_time_ns, _, sequence, payload in batch.messages
        ]

    def step(self, now_ns: int) -> None:
        """Scan the messages of one channel, once a second each; called every tick.

        Args:
            now_ns: The session's clock [Unix ns].
        """
        if self._round:
            key, messages = self._round.pop()
            self._add(key, messages)
            if key not in self._measured or key % MEASURE_EVERY == self._rounds % MEASURE_EVERY:
                self._measured[key] = self._scan.measure(key)
                self._unmeasured.pop(key, None)
            else:
                self._unmeasured.setdefault(key, self._round_end_ns)
        elif self._in_round:
            self._end_round(now_ns)
        elif now_ns >= self._due_ns:
            self._due_ns = now_ns + ROUND_NS
            self._begin_round()

    def update(self, now_ns: int | None = None) -> None:
        """Scan all messages so far.

        Args:
            now_ns: The session's clock [Unix ns]; the latest log time by default.
        """
        while self._round:
            self._add(*self._round.pop())
        self._begin_round()
        while self._round:
            self._add(*self._round.pop())
        for key in self._scanned:
            self._measured[key] = self._scan.measure(key)
        self._unmeasured.clear()
        self._end_round(now_ns)

    def _begin_round(self) -> None:
        self._round = [
            (key, part) for key, messages in self._pending.items() for part in _pieces(messages)
        ]
        self._round.reverse()  # they are taken from the end
        self._round_keys = frozenset(self._pending)
        self._pending = defaultdict(list)
        self._in_round = True

    def _end_round(self, now_ns: int | None) -> None:
        self._in_round = False
        self._rounds += 1
        for key in [key for key in self._unmeasured if key not in self._round_keys]:
            self._measured[key] = self._scan.measure(key)  # without messages in this round
            del self._unmeasured[key]
        latest = self._round_end_ns = self._span[1] if self._span is not None else 0
        self._now_ns = max(self._now_ns, latest if now_ns is None else now_ns)
        for topic in self._topics.values():
            topic.recent.append((self._now_ns, topic.count))
        self._latest = None
        self.result()  # sums up old data; the snapshot of this second uses it

    def _add(self, key: int, messages: list[_Message]) -> None:
        log_ns, sequence, payloads = zip(*messages, strict=True)
        heads = np.empty(len(messages), HEAD)
        lengths = np.fromiter(map(len, payloads), np.int64, len(messages))
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = lengths + FIXED_SIZE
        heads["channel"], heads["sequence"], heads["log"] = key, sequence, log_ns
        self._scan.add(key, b"".join(payloads), np.cumsum(lengths) - lengths - BODY_AT, heads)
        self._scanned.add(key)
        low, high = min(log_ns), max(log_ns)
        topic = self._topics[key]
        topic.count += len(messages)
        topic.last_ns = max(topic.last_ns, high)
        if self._span is not None:
            low, high = min(low, self._span[0]), max(high, self._span[1])
        self._span = low, high

    def result(self) -> SessionMeasures:
        """Return the verdict on the scanned messages, its reasons and all measures."""
        if self._latest is None:
            start_ns, end_ns = self._span or (0, 0)
            # A channel that was not measured lately is not a channel that ended early.
            end_ns = min(self._unmeasured.values(), default=end_ns)
            self._latest = self._scan.result(start_ns, end_ns, measured=self._measured)
        return self._latest

    def standing(self, sources: Sequence[Source]) -> tuple[str, str, tuple[str, ...]]:
        """Return state, verdict and reasons so far.

        A robot whose servos only answer is silent until its controller asks: while every source is
        connected and has given no frame, that is no fault. At the end it is.
        """
        measures = self.result()
        silent = all(source.connected and not source.counts.frames for source in sources)
        if self._scan.commanded and silent:
            return WAITS_FOR_COMMANDS, "good", ()
        state = WAITS_FOR_COMMANDS if measures.waits else "recording"
        return state, measures.verdict, measures.reasons

    def final(self) -> SessionMeasures:
        """Return the verdict on all messages, which is stored when the session is closed.

        ``undulog log check`` of the finished file has the same result, except for faults of the
        container, if no stamp goes back by more than :data:`HORIZON_S`.
        """
        self.update()
        return self.result()

    def topics(self) -> tuple[TopicSnapshot, ...]:
        """Return the topics with messages at the last scan, by name."""
        result = self.result()
        joints: dict[str, list[JointHealth]] = {}
        for joint in result.joints:
            joints.setdefault(joint.topic, []).append(joint)
        timings: dict[str, list[Timing]] = {}
        for series in result.series:
            timings.setdefault(series.topic, []).append(series.timing)
        snapshots = [
            self._topic(
                topic,
                self._measured[key],
                timings.get(topic.name, []),
                joints.get(topic.name, []),
            )
            for key, topic in self._topics.items()
            if key in self._measured
        ]
        return tuple(sorted(snapshots, key=lambda topic: topic.topic))

    def _topic(
        self,
        topic: _Topic,
        measured: ChannelMeasures,
        rhythms: list[Timing],
        joints: list[JointHealth],
    ) -> TopicSnapshot:
        # Messages of frames are written per batch, without a rhythm of their own.
        framed = topic.name.startswith((*FRAME_TOPIC_PREFIXES, SERIAL_TOPIC_PREFIX))
        timings = [] if framed else rhythms
        steady = [timing for timing in timings if timing.regular]
        jitters = [(timing.std_s or 0.0) / timing.median_s for timing in steady if timing.median_s]
        whole = bool(steady) and len(steady) == len(timings)
        return TopicSnapshot(
            topic=topic.name,
            count=topic.count,
            rate_hz=topic.rate_hz(),
            age_s=max(self._now_ns - topic.last_ns, 0) / NS,
            gaps=sum(timing.gaps for timing in timings) if whole else None,
            missing=sum(timing.missing for timing in timings) if whole else None,
            jitter=max(jitters) if whole and jitters else None,
            dropped=measured.channel.sequence.dropped,
            at_limit=tuple(j.name for j in joints if (j.at_limit or 0.0) > MAX_AT_LIMIT),
            frozen=tuple(j.name for j in joints if (j.frozen_s or 0) >= FROZEN_SECONDS),
            nan=sum(series.nan for series in measured.series),
        )

    def source(self, source: Source, address: str, clock: SourceClock | None) -> SourceSnapshot:
        """Return the state of a source at the last scan.

        Args:
            address: Address on the command line.
            clock: Maps its times; None for a source that writes its own channels.
        """
        counts = source.counts
        prefixes = (*FRAME_TOPIC_PREFIXES, SERIAL_TOPIC_PREFIX)
        topics = [prefix + source.name for prefix in prefixes]
        buses: list[BusHealth] = [bus for bus in self.result().buses if bus.topic in topics]
        frames = None if source.robot is not None and not counts.frames else counts.frames
        recent = self._sources.setdefault(source.name, _Topic(source.name))
        if frames is not None and self._now_ns:
            recent.recent.append((self._now_ns, frames))
        last = max((t.last_ns for t in self._topics.values() if t.name in topics), default=0)
        return SourceSnapshot(
            name=source.name,
            address=address,
            connected=source.connected,
            finished=source.finished,
            frames=frames,
            rate_hz=recent.rate_hz(),
            age_s=max(self._now_ns - last, 0) / NS if last else None,
            dropped=counts.dropped,
            malformed=counts.malformed,
            error_frames=counts.error_frames,
            reconnects=counts.reconnects,
            load=self._scan.last_load(FRAME_TOPIC_PREFIX + source.name) if buses else None,
            clock=clock.result() if clock is not None and clock.pair() is not None else None,
        )


def _pieces(messages: list[_Message]) -> list[list[_Message]]:
    """Split messages into pieces of about equal numbers, in order."""
    count = -(-sum(len(payload) for _, _, payload in messages) // PIECE) or 1
    size = -(-len(messages) // count)
    return [messages[start : start + size] for start in range(0, len(messages), size)]
