"""Any bus that python-can can open: a thread receives, the control loop sends."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import can
import numpy as np
from can.util import cast_from_string

from undulog.capture.common.arrays import IntArray
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, ID_MASK, FrameArray, holds_fd
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.can import (
    DEVICE_TIME,
    PythonCanLink,
    bus_class,
    failure,
    interface_of,
    known_options,
    open_bus,
)
from undulog.capture.sources.contract import SourceAddress, flag, only
from undulog.capture.sources.events import Tally
from undulog.capture.sources.socketcand import server_of

from .links import VirtualRobotLink, find_virtual_robot, wait_until

# So long a full transmit queue may hold a frame up [s]; of 25 frames on 1 Mbit/s the last one waits
# 3 ms.
_SEND_S = 0.02


class _Complaints(logging.Handler):
    """What python-can's socketcand logs, counted as ours is, instead of lines on the terminal."""

    _LOGGER = logging.getLogger("can.interfaces.socketcand")
    _UNREAD = ("Invalid Frame", "Bad data", "Incomplete message exceeds")
    """The rest of it says nothing new: it reads 1024 bytes at a time, which end within a message
    ("Got incomplete message"), and raises what fails."""

    def __init__(self, tally: Tally) -> None:
        """Listen to it."""
        super().__init__(logging.WARNING)
        self._tally = tally
        self._LOGGER.propagate = False
        self._LOGGER.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Count a message that it could not read."""
        if record.getMessage().startswith(self._UNREAD):
            self._tally.malformed("malformed message", 1)

    def end(self) -> None:
        """Listen no more; safe to call twice."""
        self._LOGGER.removeHandler(self)
        self._LOGGER.propagate = True


class PythonCanBus:
    """One bus of python-can.

    Attributes:
        place: What it is, for messages.
        clock: Whose clock the frames' device times are on.
    """

    def __init__(self, address: SourceAddress, tally: Tally) -> None:
        """Open it.

        Args:
            address: ``can:INTERFACE:CHANNEL``; its options are those of python-can's interface.

        Raises:
            UsageError: If there is no such interface, or it has no such option.
            SourceError: If it can't be opened.
        """
        interface, channel = interface_of(address)
        device_time = interface in DEVICE_TIME
        self.place = address.text
        self.clock = ClockDomain.DEVICE if device_time else ClockDomain.HOST
        kind = bus_class(address.text, interface)
        self._complaints: _Complaints | None = None
        options: dict[str, object] = {"channel": cast_from_string(channel)}
        if interface == "socketcand":
            options["host"], options["port"] = server_of(address)
            options["tcp_tune"] = True  # else a command waits for the acknowledgement of another
            self._complaints = _Complaints(tally)
        else:
            if kind.__module__.startswith("can."):  # others' classes may take what they don't name
                only(address, known_options(kind))
            options |= {key: cast_from_string(value) for key, value in address.options.items()}
        try:
            self._bus = open_bus(address.text, kind, options)
        except (OSError, SourceError) as error:
            if self._complaints is not None:
                self._complaints.end()
            if isinstance(error, SourceError):
                raise
            reason = error.strerror or str(error)
            raise SourceError(address.text, f"can't open it: {reason}") from error
        self._link = PythonCanLink(self._bus, tally, device_time=device_time, detail="")
        self._now_ns = tally.now_ns

    def receive(self) -> Sequence[FrameArray]:
        """Take what has come, without waiting; CAN FD frames carry nothing of a bus map."""
        try:
            received = self._link.read(self._now_ns())
        except OSError as error:
            raise self._lost(error) from error
        return [frames for frames in received if len(frames) and not holds_fd(frames)]

    def send(self, frames: FrameArray, earliest_ns: IntArray | None = None) -> IntArray:
        """Put frames on the bus, one after the other."""
        sent_ns: list[int] = []
        times: list[int] = [0] * len(frames) if earliest_ns is None else earliest_ns.tolist()
        columns = (frames["id_flags"].tolist(), frames["dlc"].tolist(), frames["data"], times)
        for id_flags, length, data, at_ns in zip(*columns, strict=True):
            message = can.Message(
                arbitration_id=id_flags & ID_MASK,
                is_extended_id=bool(id_flags & EXTENDED_FLAG),
                data=data[:length].tobytes(),
            )
            wait_until(at_ns, self._now_ns)
            try:
                self._bus.send(message, timeout=_SEND_S)
            except (can.CanError, OSError) as error:
                raise self._lost(failure(error)) from error
            sent_ns.append(self._now_ns())
        return np.array(sent_ns, dtype=np.int64)

    def close(self) -> None:
        """Release it; safe to call twice."""
        self._link.close()
        if self._complaints is not None:
            self._complaints.end()

    def _lost(self, error: OSError) -> SourceError:
        reason = (error.strerror or str(error)).partition("\n")[0].strip()
        return SourceError(self.place, f"the bus is lost: {reason}")


def open_link(address: SourceAddress, tally: Tally) -> VirtualRobotLink | PythonCanBus:
    """Open a bus: that of a virtual robot if one answers, else one of python-can.

    Args:
        address: ``can:INTERFACE:CHANNEL``; for socketcand with ``plain=yes`` the server is not
            asked whether it is a virtual robot.

    Raises:
        UsageError: If there is no such interface or option.
        SourceError: If it can't be opened.
    """
    interface, _, channel = address.rest.partition(":")
    if interface != "socketcand":
        return PythonCanBus(address, tally)
    if not channel:
        raise UsageError(f"{address.text!r}: no channel; expected can:socketcand:CHANNEL")
    plain = flag(address, "plain", default=False)
    options = {key: value for key, value in address.options.items() if key != "plain"}
    address = dataclasses.replace(address, options=options)
    virtual = None if plain else find_virtual_robot(address, tally)
    return virtual or PythonCanBus(address, tally)
