"""Sources with the scheme ``can``: ``can:INTERFACE:CHANNEL[?KEY=VALUE&...]``.

slcan adapters, socketcand servers and the kernel's own interfaces are read in bulk; every other
interface through python-can, by a thread: its ``recv`` waits and returns one frame at a time.

The tables of interfaces are those of python-can 4.6.1; an interface that isn't in them is opened
with its defaults.
"""

from __future__ import annotations

import importlib
import inspect
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import cast

import can
import numpy as np
from can.interfaces import BACKENDS
from can.util import cast_from_string

from ..common.errors import SourceError, UsageError
from ..common.process import join_running
from ..common.strict_table import listed
from ..log.messages import frames as wire
from ..log.messages.frames import FrameArray, empty_fd_frames, empty_frames
from ..robot.model import ClockDomain
from .contract import DEVICE_TIMES_END_NS, Source, SourceAddress, flag, only
from .events import IMPLAUSIBLE_TIME, Tally
from .link import LinkedSource
from .slcan import slcan_source
from .socketcan import socketcan_source
from .socketcand import socketcand_source

_WAIT_S = 0.1
_JOIN_S = 1.0
_MOST_HELD = 1_000_000
_TIMES_END_S = DEVICE_TIMES_END_NS / 1e9

LISTEN_ONLY: Mapping[str, Mapping[str, object]] = {
    "cantact": {"monitor": True},
    "kvaser": {"driver_mode": False},  # DRIVER_MODE_SILENT
    "nixnet": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "seeedstudio": {"operation_mode": "silent"},
    "systec": {"state": can.BusState.PASSIVE},
    "vector": {"listen_only": True},
}
"""Interface to the options that make its controller listen only (slcan: its L command)."""

NO_CONTROLLER = frozenset({"virtual", "udp_multicast", "socketcan", "socketcand"})
"""Interfaces that open no controller: there is nothing to make listen only."""

DEVICE_TIME = frozenset(
    {
        "canalystii",
        "etas",
        "ixxat",
        "kvaser",
        "neovi",
        "nican",
        "nixnet",
        "pcan",
        "serial",
        "systec",
        "vector",
    }
)
"""Interfaces whose messages carry the device's own time, in seconds.

The others stamp with the computer's wall clock, with a counter that starts again within the hour
(gs_usb, cantact), or in another unit (usb2can): the recorder's own time of arrival is better.
"""

_TIMING = {"f_clock", "brp", "tseg1", "tseg2", "sjw", "nof_samples"}
_COMMON = {"bitrate", "fd", "data_bitrate"}
_PARAM = re.compile(r":param\s+(?:[^:\n]*?\s)?(\w+):")

_OWN_LINKS: Mapping[str, Callable[[SourceAddress, str], Source]] = {
    "slcan": slcan_source,
    "socketcand": socketcand_source,
    "socketcan": socketcan_source,
}


def bus_class(text: str, interface: str) -> type[can.BusABC]:
    """Return the class of a known interface, e.g. ``pcan``.

    Raises:
        SourceError: If its driver is not installed.
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
            device_time: Whether the messages' times are the device's.
            detail: Description for messages.
        """
        self.detail = detail
        self._bus, self._tally, self._device_time = bus, tally, device_time
        self._held: deque[tuple[int, can.Message]] = deque()
        self._lost = self._reported = 0
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
        if self._lost > self._reported:
            lost, self._reported = self._lost - self._reported, self._lost
            self._tally.lost("frame dropped: it was not fetched in time", lost)
        if not count:
            return ()
        held = [self._held.popleft() for _ in range(count)]
        if self._device_time:
            odd = sum(not 0.0 <= message.timestamp < _TIMES_END_S for _, message in held)
            self._tally.malformed(IMPLAUSIBLE_TIME, odd)
        classic = [pair for pair in held if not _is_fd(pair[1])]
        fd = [pair for pair in held if _is_fd(pair[1])] if len(classic) < count else []
        return (
            frames_of(classic, device_time=self._device_time),
            frames_of(fd, device_time=self._device_time, fd=True),
        )

    def close(self) -> None:
        """End the thread, which closes the bus."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            join_running(self._thread, _JOIN_S)

    def _receive(self, wait_s: float) -> bool:
        """Receive one message; return whether one came within the time [s]."""
        message = self._bus.recv(wait_s)
        if message is None:
            return False
        if len(self._held) < _MOST_HELD:
            self._held.append((self._tally.now_ns(), message))
        else:
            self._lost += 1
        return True

    def _run(self) -> None:
        lost: OSError | None = None
        try:
            while not self._stop.is_set():
                self._receive(_WAIT_S)
        except Exception as error:  # noqa: BLE001 (a driver's fault is the end of its connection)
            lost = failure(error)
            with suppress(Exception):  # what the driver still holds
                while self._receive(0.0):
                    pass
        try:
            self._bus.shutdown()
        except Exception as error:  # noqa: BLE001 (a dead device can't be closed: it is lost)
            lost = lost or failure(error)
        self._error = lost  # last: whoever reads it needs not wait for the driver


def _is_fd(message: can.Message) -> bool:
    """Whether it is a CAN FD frame, also from a driver that doesn't mark it."""
    return (message.is_fd or len(message.data) > 8) and not message.is_error_frame


def frames_of(
    messages: Sequence[tuple[int, can.Message]], *, device_time: bool, fd: bool = False
) -> FrameArray:
    """Turn python-can's messages of one kind, classic or CAN FD, into frames.

    Args:
        messages: Arrival [Unix ns] and message, of at most 8 bytes, with ``fd`` 64.
        device_time: Whether to take the messages' times, to the microsecond, as the device's; those
            that are negative, not finite or out of range are replaced by the arrival's.
    """
    if fd:
        frames = empty_fd_frames(len(messages))
        frames["len"] = [len(m.data) for _, m in messages]
        frames["fd_flags"] = [
            (wire.FD_BRS if m.bitrate_switch else 0)
            | (wire.FD_ESI if m.error_state_indicator else 0)
            for _, m in messages
        ]
    else:
        frames = empty_frames(len(messages))
        frames["dlc"] = [m.dlc for _, m in messages]
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
        | (wire.EXTENDED_FLAG if m.is_extended_id and not m.is_error_frame else 0)
        | (wire.REMOTE_FLAG if m.is_remote_frame else 0)
        | (wire.ERROR_FLAG if m.is_error_frame else 0)
        for _, m in messages
    ]
    frames["dir"] = [wire.DIR_RX if m.is_rx else wire.DIR_TX for _, m in messages]
    cells = frames["data"]
    data = b"".join(bytes(m.data).ljust(cells.shape[1], b"\0") for _, m in messages)
    frames["data"] = np.frombuffer(data, dtype=np.uint8).reshape(cells.shape)
    return frames


def failure(error: Exception) -> OSError:
    """Convert an error of a driver into the loss of a connection."""
    if isinstance(error, OSError):
        return error
    code = getattr(error, "error_code", None)
    return OSError(code if isinstance(code, int) else 0, str(error) or type(error).__name__)


def open_bus(text: str, bus: type[can.BusABC], options: Mapping[str, object]) -> can.BusABC:
    """Open a bus.

    Args:
        options: Its arguments, the channel among them.

    Raises:
        OSError: If it can't be opened now.
        SourceError: If it never can: a missing driver, an unknown option.
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


def interface_of(address: SourceAddress) -> tuple[str, str]:
    """Return interface and channel of an address.

    Raises:
        UsageError: If python-can has no such interface (lists those that it has), or the channel
            is missing.
    """
    interface, _, channel = address.rest.partition(":")
    if interface not in BACKENDS:
        valid = listed(sorted(BACKENDS), interface)
        raise UsageError(f"{address.text!r}: no CAN interface {interface!r}; valid: {valid}")
    if not channel:
        raise UsageError(f"{address.text!r}: no channel; expected can:INTERFACE:CHANNEL")
    return interface, channel


def known_options(bus: type[can.BusABC]) -> set[str]:
    """Return the options in the signature or the documentation of an interface's class."""
    names = set(inspect.signature(bus.__init__).parameters)
    for documented in (bus, bus.__init__):
        names |= set(_PARAM.findall(documented.__doc__ or ""))
    return (names | _TIMING | _COMMON) - {"self", "channel", "args", "kwargs", "config"}


def open_can(address: SourceAddress) -> Source:
    """Make the source of an address such as ``can:slcan:/dev/ttyACM0``; nothing is opened.

    Raises:
        UsageError: If there is no such interface, or an option is unknown or has no valid value.
        SourceError: If it can never work here.
    """
    interface, channel = interface_of(address)
    if interface in _OWN_LINKS:
        return _OWN_LINKS[interface](address, channel)
    return _open_other(address, interface, channel)


def _open_other(address: SourceAddress, interface: str, channel: str) -> Source:
    """Make the source of an interface that python-can reads."""
    bus = bus_class(address.text, interface)
    handled = ("listen_only", "device_time")
    given = {key: value for key, value in address.options.items() if key not in handled}
    if bus.__module__.startswith("can."):  # others' classes may take what they don't name
        only(address, {*handled, *known_options(bus)})
    offered = interface in LISTEN_ONLY
    listen_only = flag(address, "listen_only", default=offered)
    if listen_only and not offered:
        raise UsageError(
            f"{address.text!r}: python-can offers no listen-only for {interface}; it does for "
            f"{', '.join(sorted(['slcan', *LISTEN_ONLY]))}"
        )
    options: dict[str, object] = {"channel": cast_from_string(channel)}
    options |= {key: _converted(address, key, value) for key, value in given.items()}
    if listen_only:
        options |= LISTEN_ONLY[interface]
    facts, detail = {"interface": interface, "channel": channel}, "never transmits"
    if interface not in NO_CONTROLLER:
        facts["listen_only"] = "yes" if listen_only else "no"
        detail = "listen-only" if listen_only else "acknowledges frames"
    facts |= given
    device_time = flag(address, "device_time", default=interface in DEVICE_TIME)
    return LinkedSource(
        address,
        lambda tally: PythonCanLink(
            open_bus(address.text, bus, options), tally, device_time=device_time, detail=detail
        ),
        place=f"{interface} {options['channel']}",
        clock=ClockDomain.DEVICE if device_time else ClockDomain.HOST,
        facts=facts,
    )


def _converted(address: SourceAddress, key: str, value: str) -> object:
    """Convert an option's value as python-can does in its configuration files."""
    if key == "fd":
        return flag(address, key, default=False)
    if key == "state":
        try:
            return can.BusState[value]
        except KeyError:
            valid = listed((state.name for state in can.BusState), value)
            raise UsageError(
                f"{address.text!r}: state {value} is not valid; valid: {valid}"
            ) from None
    return cast_from_string(value)
