"""Any interface of python-can, read by a thread.

python-can offers one frame at a time, by a call that waits; so a thread waits, and the recorder
takes what has gathered.
"""

from __future__ import annotations

import importlib
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import cast

import can
import numpy as np
from can.interfaces import BACKENDS

from ..common.errors import SourceError
from ..log.messages.frames import (
    DIR_RX,
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    FD_BRS,
    FD_ESI,
    REMOTE_FLAG,
    FrameArray,
    empty_fd_frames,
    empty_frames,
)
from ..robot.model import ClockDomain
from .contract import DEVICE_TIMES_END_NS, SourceAddress
from .events import ODD_TIME, Tally
from .link import LinkedSource

_WAIT_S = 0.1
_JOIN_S = 1.0
_MOST_HELD = 1_000_000
_TIMES_END_S = DEVICE_TIMES_END_NS / 1e9


def bus_class(text: str, interface: str) -> type[can.BusABC]:
    """The class of an interface.

    Args:
        text: The address, for messages.
        interface: E.g. ``pcan``; one that is known.

    Returns:
        The class.

    Raises:
        SourceError: If what it needs is not installed.
    """
    module, name = BACKENDS[interface]
    try:
        return cast("type[can.BusABC]", getattr(importlib.import_module(module), name))
    except (ImportError, OSError, AttributeError) as error:
        raise SourceError(text, f"python-can can't load {interface}: {error}") from error


class PythonCanLink:
    """An open bus and the thread that reads it."""

    def __init__(self, bus: can.BusABC, tally: Tally, *, device_time: bool, detail: str) -> None:
        """Take over a bus.

        Args:
            bus: Open.
            tally: Where to count.
            device_time: Whether the messages' times are the device's.
            detail: What is worth telling of it.
        """
        self.detail = detail
        self._bus = bus
        self._tally = tally
        self._device_time = device_time
        self._held: deque[tuple[int, can.Message]] = deque()
        self._lost = 0
        self._told = 0
        self._error: OSError | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="undulog-can", daemon=True)
        self._thread.start()

    def read(self, now_ns: int) -> Sequence[FrameArray]:  # noqa: ARG002 (stamped by the thread)
        """See :meth:`Link.read`."""
        error = self._error  # before the frames: none comes after it
        count = len(self._held)
        if not count and error is not None:
            raise error
        if self._lost > self._told:
            lost, self._told = self._lost - self._told, self._lost
            self._tally.counts.dropped = (self._tally.counts.dropped or 0) + lost
            self._tally.events.say("warn", "frame dropped, as nobody fetched it", lost)
        if not count:
            return ()
        held = [self._held.popleft() for _ in range(count)]
        if self._device_time:
            odd = sum(not 0.0 <= message.timestamp < _TIMES_END_S for _, message in held)
            self._tally.malformed(ODD_TIME, odd)
        classic = [pair for pair in held if not _is_fd(pair[1])]
        fd = [pair for pair in held if _is_fd(pair[1])] if len(classic) < count else []
        return (
            frames_of(classic, device_time=self._device_time),
            fd_frames_of(fd, device_time=self._device_time),
        )

    def close(self) -> None:
        """End the thread, which closes the bus."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        found: OSError | None = None
        try:
            while not self._stop.is_set():
                message = self._bus.recv(_WAIT_S)
                if message is None:
                    continue
                if len(self._held) < _MOST_HELD:
                    self._held.append((self._tally.now_ns(), message))
                else:
                    self._lost += 1
        except Exception as error:  # noqa: BLE001 (a driver's fault is the end of its connection)
            found = failure(error)
        try:
            self._bus.shutdown()
        except Exception as error:  # noqa: BLE001 (a dead device can't be closed: it is lost)
            found = found or failure(error)
        self._error = found  # last, so that nobody who sees it has to wait for the driver


def _is_fd(message: can.Message) -> bool:
    """Whether it is a CAN FD frame, also from a driver that doesn't say so."""
    return (message.is_fd or len(message.data) > 8) and not message.is_error_frame


def frames_of(messages: Sequence[tuple[int, can.Message]], *, device_time: bool) -> FrameArray:
    """Turn python-can's messages of classic frames into frames.

    Args:
        messages: Arrival [Unix ns] and message, of at most 8 bytes.
        device_time: Whether to take the messages' times, to the microsecond, as the device's; those
            that are negative, not finite or out of range are replaced by the arrival's.

    Returns:
        The frames.
    """
    frames = empty_frames(len(messages))
    _fill(frames, messages, device_time=device_time)
    frames["dlc"] = [m.dlc for _, m in messages]
    return frames


def fd_frames_of(messages: Sequence[tuple[int, can.Message]], *, device_time: bool) -> FrameArray:
    """Turn python-can's messages of CAN FD frames into frames.

    Args:
        messages: Arrival [Unix ns] and message, of at most 64 bytes.
        device_time: Whether to take the messages' times, to the microsecond, as the device's.

    Returns:
        The CAN FD frames.
    """
    frames = empty_fd_frames(len(messages))
    _fill(frames, messages, device_time=device_time)
    frames["len"] = [len(m.data) for _, m in messages]
    frames["fd_flags"] = [
        (FD_BRS if m.bitrate_switch else 0) | (FD_ESI if m.error_state_indicator else 0)
        for _, m in messages
    ]
    return frames


def _fill(
    frames: FrameArray, messages: Sequence[tuple[int, can.Message]], *, device_time: bool
) -> None:
    """What both kinds have."""
    host = np.array([t_ns for t_ns, _ in messages], dtype=np.uint64)
    frames["t_host_ns"] = host
    frames["t_device_ns"] = host
    if device_time:
        stamps = np.array([m.timestamp for _, m in messages], dtype=np.float64)
        given = (stamps > 0.0) & (stamps < _TIMES_END_S)  # a driver without times says 0
        micros = np.rint(stamps[given] * 1e6).astype(np.uint64)
        frames["t_device_ns"][given] = micros * np.uint64(1000)
    frames["id_flags"] = [
        m.arbitration_id
        | (EXTENDED_FLAG if m.is_extended_id and not m.is_error_frame else 0)
        | (REMOTE_FLAG if m.is_remote_frame else 0)
        | (ERROR_FLAG if m.is_error_frame else 0)
        for _, m in messages
    ]
    frames["dir"] = [DIR_RX if m.is_rx else DIR_TX for _, m in messages]
    cells = frames["data"]
    data = b"".join(bytes(m.data).ljust(cells.shape[1], b"\0") for _, m in messages)
    frames["data"] = np.frombuffer(data, dtype=np.uint8).reshape(cells.shape)


def failure(error: Exception) -> OSError:
    """An error of a driver as the loss of a connection.

    Args:
        error: What was raised.

    Returns:
        The same, as OSError.
    """
    if isinstance(error, OSError):
        return error
    code = getattr(error, "error_code", None)
    text = str(error) or type(error).__name__
    return OSError(code if isinstance(code, int) else 0, text)


def open_bus(text: str, bus: type[can.BusABC], options: Mapping[str, object]) -> can.BusABC:
    """Open a bus.

    Args:
        text: The address, for messages.
        bus: Its class.
        options: What to give it, the channel among them.

    Returns:
        The open bus.

    Raises:
        OSError: If it can't be opened now.
        SourceError: If it never can: a driver missing, an option that it doesn't know.
    """
    try:
        return bus(**options)  # type: ignore[arg-type]
    except (can.CanInterfaceNotImplementedError, ImportError, NotImplementedError) as error:
        raise SourceError(text, str(error)) from error
    except can.CanInitializationError as error:
        raise failure(error) from error
    except (TypeError, ValueError, KeyError) as error:
        raise SourceError(text, f"python-can refuses the options: {error}") from error
    except (can.CanError, OSError) as error:
        raise failure(error) from error
    except Exception as error:  # python-can's own fault, e.g. a name that its driver should bring
        kind = type(error).__name__
        raise SourceError(text, f"python-can can't open it: {kind}: {error}") from error


def python_can_source(
    address: SourceAddress,
    interface: str,
    options: Mapping[str, object],
    facts: Mapping[str, str],
    *,
    device_time: bool,
    detail: str,
) -> LinkedSource:
    """Make the source of a python-can interface.

    Args:
        address: What was asked for.
        interface: E.g. ``pcan``; one that is known.
        options: What to give it, the channel among them.
        facts: For the session's metadata.
        device_time: Whether its messages' times are the device's.
        detail: What is worth telling of it.

    Returns:
        The source; nothing is opened.

    Raises:
        SourceError: If what it needs is not installed.
    """
    bus = bus_class(address.text, interface)
    return LinkedSource(
        address,
        lambda tally: PythonCanLink(
            open_bus(address.text, bus, options), tally, device_time=device_time, detail=detail
        ),
        place=f"{interface} {options['channel']}",
        clock=ClockDomain.DEVICE if device_time else ClockDomain.HOST,
        facts=facts,
    )
