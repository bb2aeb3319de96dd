"""One bus of a recording: its raw frames at once, and what they mean a little later.

A raw frame is safe as soon as it is written; decoding can wait, since it can be done again from
the raw frames at any time. So a burst fills the queue of frames to decode and delays nothing else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from ..bus.decoded_topics import DecodedTopics, Message
from ..bus.decoding import BusDecoder, FrameTally
from ..log.channels import FrameChannel
from ..log.frames import (
    FD_TOPIC_PREFIX,
    FRAME_TOPIC_PREFIX,
    FrameArray,
    holds_fd,
    in_one,
)
from ..log.writer import SessionWriter
from ..robot import Robot
from .source_clock import SourceClock

_FRAMES_PER_MESSAGE = 4096
_FRAMES_PER_SLICE = 1024


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
    ) -> None:
        """Open the bus.

        Args:
            name: Name of the source.
            writer: The session.
            clock: Maps the device's times onto the session's clock.
            robot: Whose bus this is: its frames are decoded. None: they are only kept.
            directions: Whether the frames tell sent from received.

        Raises:
            DataError: If the robot has no bus map.
        """
        self._name, self._writer = name, writer
        self._raw = writer.frames(FRAME_TOPIC_PREFIX + name)
        self._raw_fd: FrameChannel | None = None
        self._clock = clock
        self._decoder = BusDecoder(robot, directions=directions) if robot is not None else None
        self._topics = (
            DecodedTopics(writer, robot, self._decoder)
            if robot is not None and self._decoder is not None
            else None
        )
        self._fresh: list[FrameArray] = []
        self._waiting: deque[FrameArray] = deque()
        self.tally = FrameTally()
        self.backlog = 0

    @property
    def decodes(self) -> bool:
        """Whether the frames are decoded, too."""
        return self._decoder is not None

    def add(self, frames: FrameArray) -> None:
        """Take frames; they are not written yet.

        Args:
            frames: Records of :data:`capture.log.frames.FRAME_DTYPE` or, CAN FD frames, of
                :data:`capture.log.frames.FD_FRAME_DTYPE`, shape (n,).
        """
        self._fresh.append(frames)

    def keep(self, frames: FrameArray, now_ns: Callable[[], int]) -> None:
        """Write classic frames that are not to be decoded, after those taken before.

        Args:
            frames: Records of :data:`capture.log.frames.FRAME_DTYPE`, shape (n,), e.g. commands
                that the session has anyway.
            now_ns: The session's clock.

        Raises:
            LogWriteError: If they can't be written.
        """
        self.write_raw(now_ns)
        for batch in _batches([frames]):
            self._raw.write(now_ns(), batch)

    def write_raw(self, now_ns: Callable[[], int]) -> None:
        """Write the frames taken since the last call.

        Args:
            now_ns: The session's clock.

        Raises:
            LogWriteError: If they can't be written.
        """
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
        # Sources hand out the kinds one after the other; on the bus they took turns.
        both = in_one(fresh)
        self._wait(both[np.lexsort((both["t_device_ns"], both["t_host_ns"]))])

    def _wait(self, frames: FrameArray) -> None:
        self._waiting.append(frames)
        self.backlog += len(frames)

    def decode(self, now_ns: Callable[[], int], until_ns: int) -> None:
        """Decode what waits, slice by slice.

        Args:
            now_ns: The session's clock.
            until_ns: No slice is begun after this time [Unix ns].

        Raises:
            LogWriteError: If the messages can't be written.
        """
        while self._waiting and now_ns() < until_ns:
            frames = self._slice()
            frames["t_host_ns"] = self._clock.add(frames["t_device_ns"], frames["t_host_ns"])
            if self._decoder is not None and self._topics is not None:
                samples, tally = self._decoder.decode(frames)
                self.tally.add(tally)
                self._write(self._topics.add(samples), now_ns)

    def _slice(self) -> FrameArray:
        """The next frames to decode: few enough for one tick."""
        slices, room = list[FrameArray](), _FRAMES_PER_SLICE
        while self._waiting and room:
            batch = self._waiting.popleft()
            if len(batch) > room:
                self._waiting.appendleft(batch[room:])
                batch = batch[:room]
            slices.append(batch)
            room -= len(batch)
        self.backlog -= _FRAMES_PER_SLICE - room
        return in_one(slices)

    def decode_no_more(self) -> None:
        """Only keep the frames from here on; those that waited are safe already."""
        self._decoder = self._topics = None
        self._waiting.clear()
        self.backlog = 0

    def finish(self, now_ns: Callable[[], int]) -> None:
        """Write everything that is left.

        Args:
            now_ns: The session's clock.

        Raises:
            LogWriteError: If it can't be written.
        """
        self.write_raw(now_ns)
        self.decode(now_ns, 1 << 63)
        if self._topics is not None:
            self._write(self._topics.finish(), now_ns)

    @staticmethod
    def _write(messages: list[Message], now_ns: Callable[[], int]) -> None:
        messages.sort(key=lambda message: message.sampled_ns)
        for message in messages:
            message.write(now_ns())


def _batches(fresh: list[FrameArray]) -> Iterator[FrameArray]:
    """Frames of one kind, few enough for a message each."""
    if not fresh:
        return
    frames = fresh[0] if len(fresh) == 1 else np.concatenate(fresh)
    for start in range(0, len(frames), _FRAMES_PER_MESSAGE):
        yield frames[start : start + _FRAMES_PER_MESSAGE]
