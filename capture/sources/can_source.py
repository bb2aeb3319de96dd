"""Sources with the scheme ``can``: ``can:INTERFACE:CHANNEL[?KEY=VALUE&...]``.

slcan adapters, socketcand servers and the kernel's own interfaces are read in bulk; every other
interface through python-can.

What python-can's interfaces offer a recorder: listening only, and times of their own.

Looked up in python-can 4.6.1; an interface that isn't named here is opened as it comes.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping

import can
from can.interfaces import BACKENDS
from can.util import cast_from_string

from ..common.errors import UsageError
from ..common.strict_table import listed
from .address import flag, number, only
from .contract import Source, SourceAddress
from .python_can import bus_class, python_can_source
from .slcan import SlcanSettings, slcan_source
from .socketcan import socketcan_source
from .socketcand import server_of, socketcand_source

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


def check_interface(text: str, interface: str) -> None:
    """See that python-can knows an interface.

    Args:
        text: The address, for the message.
        interface: E.g. ``pcan``.

    Raises:
        UsageError: If not; lists those that it knows.
    """
    if interface not in BACKENDS:
        valid = listed(sorted(BACKENDS), interface)
        raise UsageError(f"{text!r}: no CAN interface {interface!r}; valid: {valid}")


def known_options(bus: type[can.BusABC]) -> set[str]:
    """The options that an interface's class names in its signature or its documentation.

    Args:
        bus: The class.

    Returns:
        Their names, without the channel.
    """
    names = set(inspect.signature(bus.__init__).parameters)
    for documented in (bus, bus.__init__):
        names |= set(_PARAM.findall(documented.__doc__ or ""))
    return (names | _TIMING | _COMMON) - {"self", "channel", "args", "kwargs", "config"}


def open_can(address: SourceAddress) -> Source:
    """Make the source that a ``can:`` address names.

    Args:
        address: E.g. of ``can:slcan:/dev/ttyACM0?bitrate=1000000``.

    Returns:
        The source; nothing is opened.

    Raises:
        UsageError: If there is no such interface, or an option is unknown or has no valid value.
        SourceError: If it can never work here.
    """
    interface, _, channel = address.rest.partition(":")
    check_interface(address.text, interface)
    if not channel:
        raise UsageError(f"{address.text!r}: no channel; expected can:INTERFACE:CHANNEL")
    return _OPENERS.get(interface, _open_other)(address, interface, channel)


def _open_slcan(address: SourceAddress, interface: str, channel: str) -> Source:
    valid = ("bitrate", "listen_only", "timestamps", "tty_baud", "rtscts")
    only(address, valid)
    settings = SlcanSettings(
        bitrate=number(address, "bitrate", 0) or None,
        listen_only=flag(address, "listen_only", default=True),
        timestamps=flag(address, "timestamps", default=False),
        tty_baud=number(address, "tty_baud", SlcanSettings.tty_baud),
        rtscts=flag(address, "rtscts", default=False),
    )
    facts = _facts(interface, channel, settings.listen_only)
    if settings.bitrate is not None:
        facts["bitrate"] = str(settings.bitrate)
    facts["timestamps"] = "adapter, 1 ms" if settings.timestamps else "host"
    return slcan_source(address, channel, settings, facts)


def _open_socketcand(address: SourceAddress, interface: str, channel: str) -> Source:
    host, port = server_of(address)
    facts = _facts(interface, channel, None) | {"host": host, "port": str(port)}
    return socketcand_source(address, host, port, channel, facts)


def _open_socketcan(address: SourceAddress, interface: str, channel: str) -> Source:
    if "bitrate" in address.options:
        raise UsageError(
            f"{address.text!r}: the bit rate of a kernel interface is set when it is brought up: "
            f"ip link set {channel} up type can bitrate {address.options['bitrate']} listen-only on"
        )
    only(address, ("directions",))
    return socketcan_source(
        address,
        channel,
        _facts(interface, channel, None),
        directions=flag(address, "directions", default=False),
    )


def _open_other(address: SourceAddress, interface: str, channel: str) -> Source:
    bus = bus_class(address.text, interface)
    own = ("listen_only", "device_time")
    given = {key: value for key, value in address.options.items() if key not in own}
    if bus.__module__.startswith("can."):  # others' classes may take what they don't name
        only(address, {*own, *known_options(bus)})
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
    if interface in NO_CONTROLLER:
        detail = "never transmits"
        facts = _facts(interface, channel, None)
    else:
        detail = "listen-only" if listen_only else "acknowledges frames"
        facts = _facts(interface, channel, listen_only)
    facts |= given
    device_time = flag(address, "device_time", default=interface in DEVICE_TIME)
    return python_can_source(
        address, interface, options, facts, device_time=device_time, detail=detail
    )


_OPENERS: Mapping[str, Callable[[SourceAddress, str, str], Source]] = {
    "slcan": _open_slcan,
    "socketcand": _open_socketcand,
    "socketcan": _open_socketcan,
}


def _facts(interface: str, channel: str, listen_only: bool | None) -> dict[str, str]:
    facts = {"interface": interface, "channel": channel}
    if listen_only is not None:
        facts["listen_only"] = "yes" if listen_only else "no"
    return facts


def _converted(address: SourceAddress, key: str, value: str) -> object:
    """An option's value as python-can converts those of its configuration files."""
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
