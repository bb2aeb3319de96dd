"""Logs of CAN frames into sessions: frames kept raw, and what the bus map names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from ..bus.decoded_topics import DecodedTopics, TopicMessages
from ..bus.decoders import open_decoder
from ..bus.decoding import DecodedSignals, FrameTally
from ..common.arrays import IntArray
from ..common.console import progress
from ..common.errors import ImportFormatError
from ..common.process import StopRequest
from ..log.health.bus_tally import undecoded
from ..log.messages.frames import FD_TOPIC_PREFIX, FRAME_TOPIC_PREFIX, FrameArray, holds_fd
from ..log.write.channels import FrameChannel
from ..log.write.writer import SessionWriter
from ..robot.model import Robot
from .frame_log import DIRECTIONS_KEY, LATEST_NS, FrameLog, LogBlock
from .packed import format_suffix
from .reports import ImportReport
from .session_import import imported_session

_BATCH_NS = 50_000_000  # one message of raw frames spans at most this


def import_frames(
    source: Path,
    log: FrameLog,
    output: Path,
    robot: Robot,
    *,
    bus: str | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ImportReport:
    """Turn a log of CAN frames into a session.

    Every frame is kept raw, on ``/can/<bus>`` or, CAN FD frames, on ``/can_fd/<bus>``. The frames
    of one bus are decoded by the robot's databases and bus map onto the topics of the log contract
    (:mod:`.capture.bus.decoded_topics`); each sample keeps the time of its frame.

    Args:
        source: The file, which the session names.
        log: Its frames.
        robot: The robot that made the log.
        bus: The bus to decode; the first one in the log if None.
        stop: Ends the import early, with a whole file of what was read so far.

    Raises:
        ImportFormatError: If the log can't be read or has no such bus.
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If the output can't be written.
    """
    report = ImportReport(source, output, robot.name, frames=0)
    with progress(f"import {source.name}", 1.0) as bar:
        blocks = _stampable(log)
        first = next(blocks, None)
        if first is None:
            raise ImportFormatError(source, "; ".join(["holds no CAN frames", *log.problems[:1]]))
        chosen = bus or log.buses[int(first.bus[0])]
        facts = {
            "import.format": format_suffix(source).removeprefix("."),
            "import.time": log.time,
            DIRECTIONS_KEY: "recorded" if log.directions else "none",
            "import.bus": chosen,
        }
        report.start_ns = report.end_ns = int(first.times_ns()[0])
        with imported_session(
            source, output, robot, epoch_ns=report.start_ns, facts=facts, force=force
        ) as writer:
            work = _Import(writer, robot, log, chosen, report)
            for block in chain([first], blocks):
                work.add(block)
                bar.update(block.done)
                if stop is not None and stop.requested:
                    report.complete = False
                    break
            work.finish()
            if chosen not in log.buses:
                raise ImportFormatError(
                    source, f"has no frames of bus {chosen}; it has {', '.join(log.buses)}"
                )
            writer.set_verdict(report.verdict, [*report.problems, *report.notes])
    return report


def _stampable(log: FrameLog) -> Iterator[LogBlock]:
    """Yield the blocks; leave out, and count, the frames whose time no stamp can hold."""
    early = late = 0
    for block in log.blocks:
        t_ns = block.times_ns()
        kept = block[(t_ns >= 0) & (t_ns < LATEST_NS)]
        early += np.count_nonzero(t_ns < 0)
        late += np.count_nonzero(t_ns >= LATEST_NS)
        if len(kept):
            yield kept
    for count, when in ((early, "before 1970"), (late, "after 2038")):
        if count:
            log.problems.append(
                f"{count} frames are stamped {when}, which no stamp can hold: left out"
            )


@dataclass(frozen=True)
class _RawMessage:
    topic: str
    log_ns: int
    channel: FrameChannel
    frames: FrameArray


class _Import:
    """One import at work."""

    def __init__(
        self, writer: SessionWriter, robot: Robot, log: FrameLog, chosen: str, report: ImportReport
    ) -> None:
        self._writer, self._log, self._chosen, self._report = writer, log, chosen, report
        self._decoder = open_decoder(robot, directions=log.directions) if robot.bus else None
        self._topics = DecodedTopics(writer, robot, self._decoder) if self._decoder else None
        self._channels: dict[str, FrameChannel] = {}
        self._tally = FrameTally()
        self._other_buses: Counter[str] = Counter()
        self._latest_ns: dict[str, int] = {}
        self._backward = 0
        self._unseen = set(robot.joint_names)

    def add(self, block: LogBlock) -> None:
        raw, messages = list[_RawMessage](), list[TopicMessages]()
        for index, name in enumerate(self._log.buses):
            part = block[block.bus == index]
            if not len(part):
                continue
            raw += self._raw_messages(FRAME_TOPIC_PREFIX + name, part.classic())
            raw += self._raw_messages(FD_TOPIC_PREFIX + name, part.frames[part.is_fd])
            if name != self._chosen:
                self._other_buses[name] += len(part)
            elif self._decoder is not None and self._topics is not None:
                samples, tally = self._decoder.decode(part.to_decode())
                self._tally.add(tally)
                self._unseen -= _targets(samples) if self._unseen else set()
                messages += self._topics.add(samples)
        self._write(raw, messages)
        self._note_times(block.times_ns())

    def finish(self) -> None:
        report, log = self._report, self._log
        if self._topics is not None:
            self._write([], self._topics.finish())
        report.problems += log.problems + self._tally.problems()
        if self._backward:
            report.problems.append(f"{self._backward} frames are stamped before the one ahead")
        if self._decoder is None:
            report.problems.append(f"nothing decoded: the robot {report.robot} has no bus map")
        elif (why := self._undecoded()) is not None:
            report.problems.append(why)
        else:
            report.notes += self._tally.notes()
        for name, count in self._other_buses.items():
            report.notes.append(f"{count} frames of bus {name} kept raw, not decoded")
        if not log.directions:
            report.notes.append("the log has no directions: all frames count as received")

    def _undecoded(self) -> str | None:
        tally = self._tally
        frames = tally.frames - tally.errors - tally.remote
        others = tally.unknown + tally.silent
        all_joints = not self._unseen
        return undecoded(self._report.robot, tally.decoded, frames, others, all_joints=all_joints)

    def _write(self, raw: list[_RawMessage], decoded: list[TopicMessages]) -> None:
        """Write the messages of a block, topic by topic for each 50 ms."""
        samples, pieces = self._report.samples, list[tuple[int, _RawMessage | TopicMessages]]()
        for messages in decoded:
            order = np.argsort(messages.sampled_ns, kind="stable")
            samples[messages.topic] = samples.get(messages.topic, 0) + len(messages)
            for rows in _batches(messages.sampled_ns[order]):
                part = messages.part(order[rows])
                pieces.append((int(part.sampled_ns[0]), part))
        for message in raw:
            samples[message.topic] = samples.get(message.topic, 0) + 1
            pieces.append((message.log_ns, message))
        for _, piece in sorted(pieces, key=lambda item: item[0] // _BATCH_NS):
            if isinstance(piece, TopicMessages):
                piece.write(piece.sampled_ns)
            else:
                piece.channel.write(piece.log_ns, piece.frames)

    def _note_times(self, t_ns: IntArray) -> None:
        report = self._report
        report.frames = (report.frames or 0) + len(t_ns)
        self._backward += int((np.diff(t_ns, prepend=report.end_ns) < 0).sum())
        report.start_ns = min(report.start_ns, int(t_ns.min()))
        report.end_ns = max(report.end_ns, int(t_ns.max()))

    def _raw_messages(self, topic: str, frames: FrameArray) -> Iterator[_RawMessage]:
        """Yield batches of raw frames; their log times increase, so that their order is kept."""
        if not len(frames):
            return
        if topic not in self._channels:
            opened = self._writer.fd_frames if holds_fd(frames) else self._writer.frames
            self._channels[topic] = opened(topic)
        channel = self._channels[topic]
        t_ns = np.maximum.accumulate(frames["t_host_ns"].astype(np.int64))
        for batch in _batches(t_ns):
            latest_ns = max(self._latest_ns.get(topic, 0) + 1, int(t_ns[batch[-1]]))
            self._latest_ns[topic] = latest_ns
            yield _RawMessage(topic, latest_ns, channel, frames[batch])


def _batches(t_ns: IntArray) -> list[IntArray]:
    """Return the indices of increasing times, shape (n,), in one piece for each period."""
    return np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(t_ns // _BATCH_NS)) + 1)


def _targets(samples: Iterable[DecodedSignals]) -> set[str]:
    """Return the joints and sensors that have samples."""
    targets: set[str] = set()
    for decoded in samples:
        members: list[int] = np.unique(decoded.member).tolist()
        targets.update(decoded.signals[member].target for member in members)
    return targets
