"""Sources with the scheme ``can``: ``can:INTERFACE:CHANNEL[?KEY=VALUE&...]``.

slcan adapters, socketcand servers and the kernel's own interfaces are read in bulk; every other
interface through python-can.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import can
from can.util import cast_from_string

from ..common.errors import UsageError
from ..common.strict_table import listed
from .can_interfaces import DEVICE_TIME, LISTEN_ONLY, NO_CONTROLLER, check_interface, known_options
from .contract import Source, SourceAddress
from .options import flag, number, only
from .python_can import bus_class, python_can_source
from .slcan import SlcanSettings, slcan_source
from .socketcan import socketcan_source
from .socketcand import server_of, socketcand_source


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
