"""Imported sessions, and the import of CAN logs: frames kept raw, and what the bus map names."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from zstandard import STRATEGY_FAST, ZstdCompressionParameters

from ..bus.decoded_topics import DecodedTopics, TopicMessages
from ..bus.decoders import open_decoder
from ..bus.decoding import DecodedSignals, FrameTally
from ..common.arrays import NS, IntArray
from ..common.console import progress, refuse_existing
from ..common.errors import ImportFormatError
from ..common.files import part_file
from ..common.process import StopRequest, helpers, threads_or_default
from ..log.file.log_file import keep_freed
from ..log.health.bus_tally import undecoded
from ..log.mcap.writer import Compression
from ..log.messages.frames import FD_TOPIC_PREFIX, FRAME_TOPIC_PREFIX, FrameArray, holds_fd
from ..log.write.channels import FrameChannel
from ..log.write.mcap_sink import McapSink
from ..log.write.writer import SessionWriter
from ..robot.model import Robot
from .can_logs import log_suffix, open_frame_log
from .frame_log import DIRECTIONS_KEY, FrameLog, LogBlock

LEVEL: Compression = 2
"""Of compression: a third less time than level 3 for a few per cent more bytes."""

FLOAT32: Compression = ZstdCompressionParameters(
    window_log=20,
    hash_log=12,
    chain_log=12,
    search_log=1,
    min_match=5,
    target_length=1,
    strategy=STRATEGY_FAST,
    write_checksum=True,
)
"""Of messages whose numbers had single precision: those of neighbours share few bytes, so that a
table of matches in the nearest cache finds as many. A quarter to a third less time than level 2,
for 2 % fewer to 5 % more bytes; rounded decimals take up to twice as many."""

_REUSED = 1 << 24
"""Bytes of freed memory that are used again: blocks of rows and chunks are allocated anew, and
getting a new page from the system takes longer than filling it."""

_BATCH_NS = 50_000_000  # one message of raw frames spans at most this


@dataclass
class ImportReport:
    """What an import did.

    Attributes:
        start_ns: First sample or frame [Unix ns].
        end_ns: Last sample or frame [Unix ns].
        frames: Number of raw frames kept; None where the log has none.
        samples: Topic to number of messages.
        problems: What is missing or wrong, one sentence each.
        notes: What is in order and worth knowing, one sentence each.
        complete: False if the import was stopped on request.
    """

    source: Path
    output: Path
    robot: str
    start_ns: int = 0
    end_ns: int = 0
    frames: int | None = None
    samples: dict[str, int] = field(default_factory=dict[str, int])
    problems: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])
    complete: bool = True

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample or frame [s]."""
        return (self.end_ns - self.start_ns) / NS

    @property
    def verdict(self) -> str:
        """``good``, or ``degraded`` where something is missing or wrong."""
        return "good" if self.complete and not self.problems else "degraded"

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "source": str(self.source),
            "output": str(self.output),
            "robot": self.robot,
            "duration_s": self.duration_s,
            "frames": self.frames,
            "messages": self.samples,
            "verdict": self.verdict,
            "problems": self.problems,
            "notes": self.notes,
            "complete": self.complete,
        }


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest_of(files: Sequence[Path]) -> str:
    """Return the SHA-256 of one file, or of the names and digests of several."""
    if len(files) == 1:
        return file_digest(files[0])
    parts = "".join(f"{path.name} {file_digest(path)}\n" for path in files)
    return hashlib.sha256(parts.encode()).hexdigest()


@contextmanager
def imported_session(
    source: Path,
    output: Path,
    robot: Robot | None,
    *,
    epoch_ns: int,
    facts: Mapping[str, str],
    force: bool,
    digest: Callable[[], str] | None = None,
    compression: Compression = LEVEL,
) -> Generator[SessionWriter]:
    """Write an imported session, which appears under its name only when it is whole.

    The same log gives the same session id and, with the same robot, the same bytes: no clock and
    no path of this machine enters the file.

    Args:
        robot: The robot that made the log, if it is known.
        epoch_ns: Time of its first sample [Unix ns].
        facts: For the session's metadata.
        digest: Returns that of the log, where that is more than the file ``source``.
        compression: Of the messages.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    refuse_existing(output, force=force)
    keep_freed(_REUSED)
    of_log = file_digest(source) if digest is None else digest()
    with (
        part_file(output) as part,
        helpers(threads_or_default(None)) as pool,
        SessionWriter(
            part,
            session_id=f"import-{of_log[:16]}",
            epoch_ns=epoch_ns,
            robot=robot,
            clock={"log": str(robot.clock)} if robot else {},
            metadata={"source": source.name, "source.sha256": of_log, **facts},
            sink=McapSink(part, force=True, compression=compression, helpers=pool),
        ) as writer,
    ):
        yield writer


def import_can(
    source: Path,
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
        source: The log: candump, ASC, BLF, TRC, python-can CSV or SQLite, MF4.
        robot: The robot that made the log.
        bus: The bus to decode; the first one in the log if None.
        stop: Ends the import early, with a whole file of what was read so far.

    Raises:
        ImportFormatError: If the log can't be read or has no such bus.
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If the output can't be written.
    """
    report = ImportReport(source, output, robot.name, frames=0)
    with open_frame_log(source) as log, progress(f"import {source.name}", 1.0) as bar:
        blocks = iter(log.blocks)
        first = next(blocks, None)
        if first is None:
            raise ImportFormatError(source, "; ".join(["holds no CAN frames", *log.problems[:1]]))
        chosen = bus or log.buses[int(first.bus[0])]
        facts = {
            "import.format": log_suffix(source).removeprefix("."),
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
