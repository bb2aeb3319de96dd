"""One bus of a recording: its raw frames are written at once, and decoded a little later.

A raw frame is safe as soon as it is written; decoding can wait, since it can be repeated from
the raw frames at any time. So a burst fills the queue of frames to decode and delays nothing else.
Frames whose decoding fails unexpectedly are tried again in smaller pieces; single frames that
still fail are kept raw only.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..bus.decoded_topics import DecodedTopics, TopicMessages
from ..bus.decoders import open_decoder
from ..bus.decoding import FrameTally
from ..common.errors import LogWriteError, UsageError
from ..log.messages.frames import (
    FD_TOPIC_PREFIX,
    FRAME_TOPIC_PREFIX,
    SERIAL_TOPIC_PREFIX,
    FrameArray,
    holds_fd,
    in_one,
)
from ..log.write.channels import FrameChannel
from ..log.write.writer import SessionWriter
from ..robot.description import load_robot
from ..robot.families import is_serial
from ..robot.model import Robot
from ..sources.contract import Source
from ..sources.serial_port import SerialSource
from .settings import RecordSettings
from .source_clock import SourceClock

_FRAMES_PER_MESSAGE = 4096
_FRAMES_PER_SLICE = 1024
_FEWEST = 256  # with fewer, each frame costs more
_LONG_NS = 12_000_000  # processor time of a slice: half as many frames next time
_SHORT_NS = 6_000_000  # twice as many
_PIECES = 8
_MOST_FAILURES = 16  # single frames in a row; then the rest of the slice is not tried


def robot_of(settings: RecordSettings, sources: Sequence[Source]) -> Robot | None:
    """Return the robot of the settings, or that of a source, or None.

    Raises:
        UsageError: If there would be several.
        RobotFileError: If a description has faults.
    """
    brought = {source.robot.name: source.robot for source in sources if source.robot is not None}
    if settings.robot is None:
        if len(brought) > 1:
            raise UsageError(f"the sources bring different robots: {', '.join(brought)}")
        return next(iter(brought.values()), None)
    robot = load_robot(settings.robot)
    if brought and robot.name not in brought:
        raise UsageError(
            f"--robot {settings.robot}, but the twin brings the robot {', '.join(brought)}; "
            "leave --robot out"
        )
    return robot


def decoded_source(
    settings: RecordSettings, sources: Sequence[Source], robot: Robot | None
) -> str | None:
    """Return the name of the source that is the robot's bus; None if no frames can be decoded.

    Raises:
        UsageError: If there is no such source, or several are possible.
    """
    candidates = [source for source in sources if source.robot is None]
    serial = is_serial(robot.bus if robot is not None else None)
    if robot is not None and robot.bus is not None:
        fitting = [source for source in candidates if isinstance(source, SerialSource) is serial]
        if candidates and not fitting:
            kind = "a serial line (serial:PORT?protocol=...)" if serial else "a CAN bus"
            raise UsageError(f"the motors of {robot.name} are on {kind}, and no source is one")
        candidates = fitting
    buses = [source.name for source in candidates]
    if settings.bus is not None:
        if settings.bus not in buses:
            raise UsageError(f"--bus {settings.bus}: no such bus; there are: {', '.join(buses)}")
        if robot is None or robot.bus is None:
            raise UsageError(f"--bus {settings.bus} needs a robot with a bus map (--robot)")
        return settings.bus
    if robot is None or robot.bus is None or any(s.robot is not None for s in sources):
        return None
    if len(buses) > 1:
        raise UsageError(
            f"which of {', '.join(buses)} is the bus of {robot.name}? Choose it by --bus NAME; the "
            "others are kept raw"
        )
    return buses[0] if buses else None


class BusRecorder:
    """Writes the frames of one source."""

    def __init__(
        self,
        name: str,
        writer: SessionWriter,
        clock: SourceClock,
        robot: Robot | None,
        *,
        directions: bool,
        serial: bool = False,
    ) -> None:
        """Open the bus.

        Args:
            clock: Maps the device's times onto the session's clock.
            robot: Its bus map decodes the frames; None to keep them raw only.
            directions: Whether the frames distinguish sent from received.
            serial: Whether they are packets of serial servos, on ``/serial/NAME``.

        Raises:
            DataError: If the robot has no bus map.
        """
        self._name, self._writer = name, writer
        self._raw_fd: FrameChannel | None = None
        self._serial = serial
        if serial:
            self._raw = self._raw_fd = writer.fd_frames(SERIAL_TOPIC_PREFIX + name)
        else:
            self._raw = writer.frames(FRAME_TOPIC_PREFIX + name)
        self._clock = clock
        self._decoder = self._topics = None
        if robot is not None:
            self._decoder = open_decoder(robot, directions=directions)
            self._topics = DecodedTopics(writer, robot, self._decoder)
        self._fresh: list[FrameArray] = []
        self._waiting: deque[FrameArray] = deque()
        self._pieces: deque[FrameArray] = deque()  # pieces of a slice that failed
        self._failures = 0
        self._faults: Counter[str] = Counter()
        self._messages: deque[TopicMessages] = deque()  # of the slice before, yet to be written
        self._slice_size = _FEWEST
        self._took_ns = 0  # of the last slice
        self.tally = FrameTally()
        self.backlog = 0

    @property
    def behind(self) -> bool:
        """Whether decoded messages wait to be written, or a whole slice of frames to be decoded."""
        return bool(self._messages or self._pieces) or self.backlog >= self._slice_size

    @property
    def decodes(self) -> bool:
        """Whether the frames are decoded."""
        return self._decoder is not None

    def add(self, frames: FrameArray) -> None:
        """Queue frames for :meth:`write_raw`.

        Args:
            frames: Records of :data:`.FRAME_DTYPE` or, CAN FD frames, of
                :data:`.capture.log.messages.frames.FD_FRAME_DTYPE`, shape (n,).
        """
        self._fresh.append(frames)

    def keep(self, frames: FrameArray, now_ns: Callable[[], int]) -> None:
        """Write classic frames that are not decoded, behind those of :meth:`add`.

        Args:
            frames: Records of :data:`.FRAME_DTYPE`, shape (n,), e.g. commands
                that the session has anyway.
            now_ns: The session's clock.
        """
        self.write_raw(now_ns)
        for batch in _batches([frames]):
            self._raw.write(now_ns(), batch)

    def write_raw(self, now_ns: Callable[[], int]) -> None:
        """Write the frames added since the last call; ``now_ns`` is the session's clock."""
        if not self._fresh:
            return
        fresh, self._fresh = self._fresh, []
        fd = [frames for frames in fresh if holds_fd(frames)]
        if not fd:
            for batch in _batches(fresh):
                self._raw.write(now_ns(), batch)
                self._wait(batch)
            return
        if self._raw_fd is None:
            self._raw_fd = self._writer.fd_frames(FD_TOPIC_PREFIX + self._name)
        for batch in _batches([frames for frames in fresh if not holds_fd(frames)]):
            self._raw.write(now_ns(), batch)
        for batch in _batches(fd):
            self._raw_fd.write(now_ns(), batch)
        # Sources return the kinds one after the other; on the bus they are mixed.
        both = in_one(fresh)
        if self._serial:  # their order is the line's: a reply belongs to the request before it
            self._wait(both)
            return
        self._wait(both[np.lexsort((both["t_device_ns"], both["t_host_ns"]))])

    def _wait(self, frames: FrameArray) -> None:
        self._waiting.append(frames)
        self.backlog += len(frames)

    def decode(self, now_ns: Callable[[], int], until_ns: int, *, rest: bool = True) -> None:
        """Decode the waiting frames, slice by slice, and write the messages.

        Args:
            now_ns: The session's clock.
            until_ns: No topic's messages are written after this time [Unix ns], and no slice is
                begun that would last longer, except for the first of the call.
            rest: Also decode the frames of an incomplete slice, which cost more each.
        """
        now, idle = now_ns(), True
        while True:
            while self._messages and now < until_ns:
                self._write(self._messages.popleft(), now)
                now, idle = now_ns(), False
            expected_ns = 0 if idle else self._took_ns
            nothing = not self._pieces and not self._waiting
            if self._messages or nothing or now + expected_ns >= until_ns:
                return
            if not rest and not self._pieces and self.backlog < self._slice_size:
                return
            self._decode_slice()
            now, idle = now_ns(), False

    def _decode_slice(self) -> None:
        begun_ns = time.thread_time_ns()
        frames = self._pieces.popleft() if self._pieces else self._mapped()
        if self._decoder is not None and self._topics is not None:
            try:
                samples, tally = self._decoder.decode(frames)
                messages = self._topics.add(samples)
            except LogWriteError:
                raise
            except Exception as error:  # noqa: BLE001 - reported; the other frames are decoded
                self._topics.forget()
                self._split(frames, repr(error))
                return
            self._failures = 0
            self.tally.add(tally)
            self._messages.extend(messages)
        self._took_ns = time.thread_time_ns() - begun_ns
        if self._took_ns > _LONG_NS:
            self._slice_size = max(self._slice_size // 2, _FEWEST)
        elif self._took_ns < _SHORT_NS:
            self._slice_size = min(self._slice_size * 2, _FRAMES_PER_SLICE)

    def take_faults(self) -> list[str]:
        """Return the failures of decoding since the last call, one sentence for each kind."""
        faults, self._faults = self._faults, Counter()
        return [
            f"decoding failed with {fault} and goes on; {count} frames are kept raw only"
            for fault, count in faults.items()
        ]

    def _mapped(self) -> FrameArray:
        """Return the next frames to decode, at their times on the session's clock."""
        frames = self._slice()
        try:
            frames["t_host_ns"] = self._clock.add(frames["t_device_ns"], frames["t_host_ns"])
        except Exception as error:  # noqa: BLE001 - reported; the arrivals' times stay
            self._clock.restart()
            self._faults[repr(error)] += 0
        return frames

    def _split(self, frames: FrameArray, fault: str) -> None:
        """Queue failed frames again, in pieces; a single one is given up."""
        self._faults[fault] += 0
        if len(frames) > 1:
            size = -(-len(frames) // _PIECES)
            pieces = [frames[start : start + size] for start in range(0, len(frames), size)]
            self._pieces.extendleft(reversed(pieces))
            return
        self._failures += 1
        self._faults[fault] += 1
        if self._failures >= _MOST_FAILURES:
            self._faults[fault] += sum(map(len, self._pieces))
            self._pieces.clear()
            self._failures = 0

    def _slice(self) -> FrameArray:
        """Return the next frames to decode, few enough for one tick."""
        slices, room = list[FrameArray](), self._slice_size
        while self._waiting and room:
            batch = self._waiting.popleft()
            if len(batch) > room:
                self._waiting.appendleft(batch[room:])
                batch = batch[:room]
            slices.append(batch)
            room -= len(batch)
        self.backlog -= self._slice_size - room
        return in_one(slices)

    def finish(self, now_ns: Callable[[], int]) -> None:
        """Write and decode the rest; ``now_ns`` is the session's clock."""
        self.write_raw(now_ns)
        self.decode(now_ns, 1 << 63)
        if self._topics is None:
            return
        try:
            self._messages.extend(self._topics.finish())
        except Exception as error:  # noqa: BLE001 - reported; the raw frames are safe
            self._faults[repr(error)] += 0
        self.decode(now_ns, 1 << 63)

    def _write(self, messages: TopicMessages, now_ns: int) -> None:
        try:
            messages.write(np.full(len(messages), now_ns))
        except LogWriteError:
            raise
        except Exception as error:  # noqa: BLE001 - reported; the other messages are written
            if len(messages) == 1:
                self._faults[f"{error!r} on {messages.topic}"] += 0
                return
            for k in range(len(messages)):
                self._write(messages.part(slice(k, k + 1)), now_ns)


def _batches(fresh: list[FrameArray]) -> Iterator[FrameArray]:
    """Join frames of one kind and cut them into batches of a message each."""
    if not fresh:
        return
    frames = fresh[0] if len(fresh) == 1 else np.concatenate(fresh)
    for start in range(0, len(frames), _FRAMES_PER_MESSAGE):
        yield frames[start : start + _FRAMES_PER_MESSAGE]
