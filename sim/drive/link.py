"""A robot's bus as the control loop sees it; one that only listens, and the virtual robot's.

Commands go nowhere but to undulog's own virtual robot: it runs on this computer and says what it
is. A client that sends ``< undulog >`` is answered ``< undulog virtual-robot NAME PACE >``, and
from then on gets ``< tick N >`` after the frames of each control tick; PACE is ``paced`` (the robot
keeps to real time) or ``lockstep`` (it waits at each tick until every servo has a command).
Everything else is socketcand.
"""

from __future__ import annotations

import ipaddress
import re
import select
import time
from collections.abc import Sequence
from typing import Protocol

from capture.errors import SourceError, UsageError
from capture.log.frames import EXTENDED_FLAG, ID_MASK, FrameArray
from capture.sources.contract import Polled, Source, SourceAddress, SourceContext
from capture.sources.events import Tally
from capture.sources.socketcand import connect, enter_raw_mode, read_answer, server_of
from capture.sources.socketcand_text import SocketcandText

_TICK = re.compile(rb"< tick (\d{1,18}) >")
_IDENTITY = re.compile(r"undulog virtual-robot (\S+) (paced|lockstep)")
_CHUNK = 1 << 18
_SEND_S = 1.0


class Link(Protocol):
    """A bus."""

    @property
    def place(self) -> str:
        """What it is, for messages."""
        ...

    def receive(self) -> Sequence[FrameArray]:
        """Take what has come, without waiting.

        Returns:
            Arrays of records of :data:`capture.log.frames.FRAME_DTYPE`, in the order they came.

        Raises:
            SourceError: If the bus is lost.
        """
        ...

    def close(self) -> None:
        """Release it; safe to call twice."""
        ...


class ListeningLink:
    """Any bus that a recorder can read: it is opened in the same way, and nothing is sent."""

    def __init__(self, source: Source, address: SourceAddress, context: SourceContext) -> None:
        """Connect.

        Args:
            source: The bus, not started.
            address: Its address.
            context: Clock and writer for the source.

        Raises:
            SourceError: If it can't be opened.
        """
        self.place = address.text
        self._source = source
        source.start(context)
        if not source.connected:
            self._lost(source.poll())

    def receive(self) -> Sequence[FrameArray]:
        """Take what has come, without waiting.

        Returns:
            Arrays of frames.

        Raises:
            SourceError: If the bus is lost.
        """
        polled = self._source.poll()
        if not self._source.connected:
            self._lost(polled)
        return (*polled.frames, *polled.fd_frames)

    def close(self) -> None:
        """Release it; safe to call twice."""
        self._source.stop()

    def _lost(self, polled: Polled) -> None:
        told = [event.text for event in polled.events if event.level != "info"]
        self._source.stop()
        raise SourceError(self.place, "; ".join(told) or "the connection is gone")


class VirtualRobotLink:
    """The bus of a virtual robot; the only one that takes commands.

    Attributes:
        place: What it is, for messages.
        robot_name: Who is there.
        lockstep: Whether it waits for commands at each tick.
    """

    def __init__(self, address: SourceAddress, tally: Tally) -> None:
        """Connect, and see that a virtual robot is there.

        Args:
            address: ``can:socketcand:CHANNEL?port=PORT``.
            tally: Where to count what is malformed.

        Raises:
            UsageError: If it is no virtual robot on this computer.
            SourceError: If nobody is there.
        """
        self.place = address.text
        interface, _, channel = address.rest.partition(":")
        if interface != "socketcand" or not channel:
            raise _refused(address, "is no virtual robot's bus")
        host, port = server_of(address)
        try:
            self._socket, rest = connect(host, port)
        except OSError as error:
            raise SourceError(address.text, f"can't connect: {error.strerror or error}") from error
        try:
            self.robot_name, self.lockstep, rest = self._identify(address, rest)
            self._rest = enter_raw_mode(self._socket, rest, channel)
        except OSError as error:
            self._socket.close()
            raise SourceError(address.text, f"can't open it: {error.strerror or error}") from error
        except UsageError:
            self._socket.close()
            raise
        self._socket.settimeout(_SEND_S)
        self._text, self._tally = SocketcandText(), tally
        self._ready: list[FrameArray] = []
        self._ticks: list[tuple[int, int]] = []  # tick, and how many of the ready arrays are of it

    def _identify(self, address: SourceAddress, rest: bytes) -> tuple[str, bool, bytes]:
        peer = self._socket.getpeername()[0]
        if not ipaddress.ip_address(peer).is_loopback:
            raise _refused(address, f"is at {peer}, not on this computer")
        try:
            self._socket.sendall(b"< undulog >")
            answer, rest = read_answer(self._socket, rest)
        except OSError:
            answer = ""
        found = _IDENTITY.fullmatch(answer)
        if found is None:
            raise _refused(address, "does not say that it is a virtual robot")
        return found[1], found[2] == "lockstep", rest

    def receive(self) -> Sequence[FrameArray]:
        """Take what has come, without waiting; tick marks are passed over.

        Returns:
            Arrays of frames.

        Raises:
            SourceError: If the robot is gone.
        """
        while select.select([self._socket], [], [], 0.0)[0]:
            self._read()
        found, self._ready, self._ticks = self._ready, [], []
        return found

    def wait_tick(self, timeout_s: float) -> tuple[int, Sequence[FrameArray]] | None:
        """Wait for the robot's next control tick.

        Args:
            timeout_s: How long at most [s].

        Returns:
            Its number and the frames that came by it; None if there is none in time.

        Raises:
            SourceError: If the robot is gone.
        """
        deadline = time.monotonic() + timeout_s
        while not self._ticks:
            left_s = deadline - time.monotonic()
            if left_s <= 0.0 or not select.select([self._socket], [], [], left_s)[0]:
                return None
            self._read()
        tick, count = self._ticks.pop(0)
        frames, self._ready = self._ready[:count], self._ready[count:]
        self._ticks = [(later, at - count) for later, at in self._ticks]
        return tick, frames

    def send(self, frames: FrameArray) -> None:
        """Put frames on the bus.

        Args:
            frames: Records of :data:`capture.log.frames.FRAME_DTYPE`, data frames, shape (n,).

        Raises:
            SourceError: If the robot is gone, or takes nothing.
        """
        try:
            self._socket.sendall(sent_text(frames))
        except TimeoutError as error:
            raise SourceError(self.place, f"takes no commands for {_SEND_S:g} s") from error
        except OSError as error:
            raise self._gone(error) from error

    def close(self) -> None:
        """Release it; safe to call twice."""
        self._socket.close()

    def _read(self) -> None:
        """Take one piece of what has come."""
        try:
            chunk = self._socket.recv(_CHUNK)
        except OSError as error:
            raise self._gone(error) from error
        if not chunk:
            raise SourceError(self.place, "the robot closed the connection")
        whole = self._rest + chunk
        end = whole.rfind(b">") + 1
        self._rest = whole[end:]
        pieces: list[bytes] = _TICK.split(whole[:end])  # text, tick, text, tick, ..., text
        for k, piece in enumerate(pieces):
            if k % 2:
                self._ticks.append((int(piece), len(self._ready)))
            elif piece:
                frames = self._text.feed(piece, self._tally.now_ns(), self._tally)
                if len(frames):
                    self._ready.append(frames)

    def _gone(self, error: OSError) -> SourceError:
        return SourceError(self.place, f"the robot is gone: {error.strerror or error}")


def sent_text(frames: FrameArray) -> bytes:
    """Frames as a client of socketcand sends them.

    Args:
        frames: Data frames, shape (n,).

    Returns:
        ``< send 101 2 1F A0 >`` for each.
    """
    text: list[str] = []
    columns = (frames["id_flags"].tolist(), frames["dlc"].tolist(), frames["data"])
    for id_flags, length, data in zip(*columns, strict=True):
        digits = 8 if id_flags & EXTENDED_FLAG else 3
        payload = data[:length].tobytes().hex(" ").upper()
        text.append(f"< send {id_flags & ID_MASK:0{digits}X} {length} {payload} >")
    return "".join(text).encode()


def _refused(address: SourceAddress, why: str) -> UsageError:
    return UsageError(
        f"{address.text} {why}; commands are sent to undulog's own virtual robot only, on this "
        "computer: start one with 'undulog sim serve', or leave --arm out to look on"
    )
