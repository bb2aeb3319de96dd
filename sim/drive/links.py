"""A robot's bus as the control loop uses it, and that of undulog's virtual robot.

The virtual robot runs on this computer and says what it is. A client that sends ``< undulog >`` is
answered ``< undulog virtual-robot NAME PACE >``, and from then on gets ``< tick N >`` after the
frames of each control tick; PACE is ``paced`` (the robot keeps to real time) or ``lockstep`` (it
waits at each tick until every servo has a command). Everything else is socketcand.

What the robot's computer knows, from the frames on its bus.

Each value is the newest that came. One that has not come for a while is unknown again: a controller
must not act on a distance of long ago.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import math
import re
import select
import socket
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from undulog.capture.bus.decoding import BusDecoder, DecodedSignals, FrameTally
from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.common.errors import SourceError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, ID_MASK, FrameArray
from undulog.capture.robot.model import ClockDomain, Quantity, Robot
from undulog.capture.sources.contract import SourceAddress
from undulog.capture.sources.events import Tally
from undulog.capture.sources.socketcand import (
    SocketcandText,
    connect,
    enter_raw_mode,
    read_answer,
    server_of,
)

from ..gait.contract import Readings
from .outcome import JointStatus

OLDEST_S = 0.5
"""A value older than this counts as unknown [s]; the slowest sensors come several times in it."""

_AXES = "xyz"
_OF_JOINTS = (
    Quantity.POSITION,
    Quantity.VELOCITY,
    Quantity.CURRENT,
    Quantity.TEMPERATURE,
    Quantity.VOLTAGE,
)
_VECTORS = (Quantity.ACCELERATION, Quantity.MAGNETIC_FIELD)
_GAIT_QUANTITIES = {*_OF_JOINTS, Quantity.RANGE, *_VECTORS}

_TICK = re.compile(rb"< tick (\d{1,18}) >")
_IDENTITY = re.compile(r"undulog virtual-robot (\S+) (paced|lockstep)")
_CHUNK = 1 << 18
_SEND_S = 1.0


class BusReadings:
    """Collects decoded frames; call :meth:`readings` once a control tick.

    Attributes:
        tally: Counts of frames by their decoding.
        angles: Angles received of each joint so far, shape (m,).
    """

    def __init__(self, robot: Robot, oldest_s: float = OLDEST_S) -> None:
        """Start without values.

        Args:
            robot: The robot; it has a bus map.
            oldest_s: So old a value may be [s].

        Raises:
            DataError: If the robot has no bus, or not the databases that its map needs.
        """
        self._decoder = BusDecoder(_with_gait_signals(robot))
        self._oldest_s = oldest_s
        self._joints = {name: i for i, name in enumerate(robot.joint_names)}
        self._range_max = {
            sensor.name: sensor.range_max if sensor.range_max is not None else math.inf
            for sensor in robot.sensors
        }
        count = len(robot.joints)
        self._joint_values = {quantity: np.full(count, np.nan) for quantity in _OF_JOINTS}
        self._joint_times = {quantity: np.full(count, -np.inf) for quantity in _OF_JOINTS}
        self._ranges: dict[str, tuple[float, float]] = {}
        self._vectors: dict[Quantity, dict[str, tuple[float, FloatArray]]] = {
            q: {} for q in _VECTORS
        }
        self.tally = FrameTally()
        self.angles: IntArray = np.zeros(count, dtype=np.int64)

    def add(self, frames: FrameArray, time_s: float) -> None:
        """Take frames, in the order in which they came.

        Args:
            frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).
            time_s: When they came, on the loop's clock [s].
        """
        samples, tally = self._decoder.decode(frames)
        self.tally.add(tally)
        for decoded in samples:
            self._take(decoded, time_s)

    def readings(self, time_s: float) -> Readings:
        """Return the newest values.

        Args:
            time_s: Now, on the loop's clock [s].

        Returns:
            The newest values; NaN, or absent, what has not come or is too old.
        """
        since_s = time_s - self._oldest_s
        angle = self._newest(Quantity.POSITION, since_s)
        velocity = self._newest(Quantity.VELOCITY, since_s)
        acceleration, field = (
            {name: vector for name, (at_s, vector) in self._vectors[q].items() if at_s >= since_s}
            for q in _VECTORS
        )
        ranges = {name: value for name, (at_s, value) in self._ranges.items() if at_s >= since_s}
        return Readings(angle, velocity, ranges, acceleration, field)

    def status(self, time_s: float) -> JointStatus:
        """Return the newest values of the servos.

        Args:
            time_s: Now, on the loop's clock [s].

        Returns:
            The newest values of each joint, NaN likewise, and how long it has been silent.
        """
        since_s = time_s - self._oldest_s
        return JointStatus(
            angle=self._newest(Quantity.POSITION, since_s),
            current=self._newest(Quantity.CURRENT, since_s),
            temperature=self._newest(Quantity.TEMPERATURE, since_s),
            voltage=self._newest(Quantity.VOLTAGE, since_s),
            silence_s=frozen(time_s - self._joint_times[Quantity.POSITION]),
        )

    def _newest(self, quantity: Quantity, since_s: float) -> FloatArray:
        """A joint quantity, NaN where it is older."""
        values, times = self._joint_values[quantity], self._joint_times[quantity]
        return frozen(np.where(times >= since_s, values, np.nan))

    def _take(self, decoded: DecodedSignals, time_s: float) -> None:
        """Keep the values that are known; of several of one target the last one stays."""
        quantity, axis = decoded.signals[0].quantity, decoded.signals[0].axis
        if quantity in self._joint_values:
            targets = np.array([self._joints[signal.target] for signal in decoded.signals])
            finite = np.isfinite(decoded.values)  # no servo is at infinity
            joints = targets[decoded.member[finite]]
            self._joint_values[quantity][joints] = decoded.values[finite]
            self._joint_times[quantity][joints] = time_s
            if quantity is Quantity.POSITION:
                np.add.at(self.angles, joints, 1)
            return
        members: list[int] = decoded.member.tolist()
        values: list[float] = decoded.values.tolist()
        for member, value in zip(members, values, strict=True):
            if math.isnan(value):
                continue
            target = decoded.signals[member].target
            if quantity is Quantity.RANGE:
                # REP 117: a reading beyond the greatest range means that nothing is in it.
                beyond = value > self._range_max[target]
                self._ranges[target] = time_s, math.inf if beyond else value
            elif quantity in _VECTORS:
                vectors = self._vectors[quantity]
                vector = vectors[target][1].copy() if target in vectors else np.full(3, np.nan)
                vector[_AXES.index(axis)] = value
                vectors[target] = time_s, frozen(vector)


def _with_gait_signals(robot: Robot) -> Robot:
    """Return the robot with only the signals of a gait in its bus map, to save time."""
    if robot.bus is None:
        return robot
    signals = tuple(signal for signal in robot.bus.signals if signal.quantity in _GAIT_QUANTITIES)
    return dataclasses.replace(robot, bus=dataclasses.replace(robot.bus, signals=signals))


class BusLink(Protocol):
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
        """Return the received frames, without waiting.

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


def find_virtual_robot(address: SourceAddress, tally: Tally) -> VirtualRobotLink | None:
    """Find out whether a socketcand server is a virtual robot.

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
        identity, rest = _identity(sock, rest)
        if identity is None:
            sock.close()
            return None
        rest = enter_raw_mode(sock, rest, channel)
    except OSError as error:
        sock.close()
        raise SourceError(address.text, f"can't open it: {error.strerror or error}") from error
    return VirtualRobotLink(
        address.text, sock, rest, tally, identity[1], lockstep=identity[2] != "paced"
    )


def _identity(sock: socket.socket, rest: bytes) -> tuple[re.Match[str] | None, bytes]:
    """Return the identity of a server on this computer, and the rest of its answer."""
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
            tally: Where to count what is malformed.
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
        """Return the received frames, without waiting; tick marks are skipped."""
        while select.select([self._socket], [], [], 0.0)[0]:
            self._read()
        frames, self._ready, self._ticks = self._ready, [], []
        return frames

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
        """Put frames on the bus, all of them at once."""
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
        """Read one chunk of received text."""
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
