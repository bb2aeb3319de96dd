"""What python-can's interfaces offer a recorder: listening only, and times of their own.

Looked up in python-can 4.6.1; an interface that isn't named here is opened as it comes.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping

import can
from can.interfaces import BACKENDS

from ..common.errors import UsageError
from ..common.strict_table import listed

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
