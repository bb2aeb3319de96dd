"""A robot's bus as the control loop sees it, and that of undulog's own virtual robot.

The virtual robot runs on this computer and says what it is. A client that sends ``< undulog >`` is
answered ``< undulog virtual-robot NAME PACE >``, and from then on gets ``< tick N >`` after the
frames of each control tick; PACE is ``paced`` (the robot keeps to real time) or ``lockstep`` (it
waits at each tick until every servo has a command). Everything else is socketcand.
"""

from __future__ import annotations

import ipaddress
import re
import select
import socket
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from undulog.capture.common.arrays import IntArray
from undulog.capture.common.errors import SourceError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, ID_MASK, FrameArray
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import SourceAddress
from undulog.capture.sources.events import Tally
from undulog.capture.sources.socketcand import connect, enter_raw_mode, read_answer, server_of
from undulog.capture.sources.socketcand_text import SocketcandText

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

    @property
    def clock(self) -> ClockDomain:
        """Whose clock the frames' device times are on."""
        ...

    def receive(self) -> Sequence[FrameArray]:
        """Take what has come, without waiting.

        Returns:
            Arrays of records of :data:`.FRAME_DTYPE`, in the order they came.

        Raises:
            SourceError: If the bus is lost.
        """
        ...

    def send(self, frames: FrameArray, earliest_ns: IntArray | None = None) -> IntArray:
        """Put frames on the bus.

        Args:
            frames: Records of :data:`.FRAME_DTYPE`, data frames, shape (n,).
            earliest_ns: No frame is sent before its time on the session's clock [ns], shape (n,);
                None: at once.

        Returns:
            When the bus had each of them, on the session's clock [ns], shape (n,).

        Raises:
            SourceError: If the bus doesn't take them.
        """
        ...

    def close(self) -> None:
        """Release it; safe to call twice."""
        ...


def find_virtual_robot(address: SourceAddress, tally: Tally) -> VirtualRobotLink | None:
    """Ask a socketcand server whether it is a virtual robot.

    Args:
        address: ``can:socketcand:CHANNEL?port=PORT``.
        tally: Where to count what is malformed.

    Returns:
        Its bus, opened; None if it is another server, which has been asked nothing else.

    Raises:
        SourceError: If nobody is there, or it has no such bus.
    """
    channel = address.rest.partition(":")[2]
    try:
        sock, rest = connect(*server_of(address))
    except OSError as error:
        raise SourceError(address.text, f"can't connect: {error.strerror or error}") from error
    try:
        found, rest = _identity(sock, rest)
        if found is None:
            sock.close()
            return None
        rest = enter_raw_mode(sock, rest, channel)
    except OSError as error:
        sock.close()
        raise SourceError(address.text, f"can't open it: {error.strerror or error}") from error
    return VirtualRobotLink(address.text, sock, rest, tally, found[1], lockstep=found[2] != "paced")


def _identity(sock: socket.socket, rest: bytes) -> tuple[re.Match[str] | None, bytes]:
    """What a server on this computer says that it is, and what came behind."""
    if not ipaddress.ip_address(sock.getpeername()[0]).is_loopback:
        return None, rest
    try:
        sock.sendall(b"< undulog >")
        answer, rest = read_answer(sock, rest)
    except OSError:  # others may end the connection at a word that they don't know
        return None, rest
    return _IDENTITY.fullmatch(answer), rest


class VirtualRobotLink:
    """The bus of a virtual robot.

    Attributes:
        place: What it is, for messages.
        clock: Whose clock the frames' device times are on: the twin's.
        robot_name: Who is there.
        lockstep: Whether it waits for commands at each tick.
    """

    def __init__(
        self,
        place: str,
        sock: socket.socket,
        rest: bytes,
        tally: Tally,
        robot_name: str,
        *,
        lockstep: bool,
    ) -> None:
        """Take over a connection; see :func:`find_virtual_robot`.

        Args:
            place: What it is, for messages.
            sock: In raw mode.
            rest: What came already.
            tally: Where to count what is malformed.
            robot_name: Who is there.
            lockstep: Whether it waits for commands at each tick.
        """
        self.place, self.robot_name, self.lockstep = place, robot_name, lockstep
        self.clock = ClockDomain.SIMULATED
        self._socket, self._rest = sock, rest
        self._socket.settimeout(_SEND_S)
        self._text, self._tally = SocketcandText(), tally
        self._ready: list[FrameArray] = []
        self._ticks: list[tuple[int, int]] = []  # tick, and how many of the ready arrays are of it

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

    def send(self, frames: FrameArray, earliest_ns: IntArray | None = None) -> IntArray:
        """Put frames on the bus, all of them at once.

        Args:
            frames: Records of :data:`.FRAME_DTYPE`, data frames, shape (n,).
            earliest_ns: No frame is sent before its time on the session's clock [ns], shape (n,);
                None: at once.

        Returns:
            When the bus had them, on the session's clock [ns], shape (n,).

        Raises:
            SourceError: If the robot is gone, or takes nothing.
        """
        text = sent_text(frames)
        if earliest_ns is not None:
            wait_until(int(earliest_ns.max(initial=0)), self._tally.now_ns)
        try:
            self._socket.sendall(text)
        except TimeoutError as error:
            raise SourceError(self.place, f"takes no commands for {_SEND_S:g} s") from error
        except OSError as error:
            raise self._gone(error) from error
        return np.full(len(frames), self._tally.now_ns(), dtype=np.int64)

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


def wait_until(earliest_ns: int, now_ns: Callable[[], int]) -> None:
    """Wait for a moment of a clock.

    Args:
        earliest_ns: The moment [ns].
        now_ns: The clock.
    """
    while (left_ns := earliest_ns - now_ns()) > 0:
        time.sleep(left_ns * 1e-9)


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
