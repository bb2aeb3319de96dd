"""Opening the bus that is to be driven on."""

from __future__ import annotations

import dataclasses

from undulog.capture.common.errors import UsageError
from undulog.capture.sources.contract import SourceAddress
from undulog.capture.sources.events import Tally
from undulog.capture.sources.options import flag

from .link import VirtualRobotLink, find_virtual_robot
from .python_can_bus import PythonCanBus


def open_link(address: SourceAddress, tally: Tally) -> VirtualRobotLink | PythonCanBus:
    """Open a bus: a virtual robot's where one says that it is there, else any of python-can's.

    Args:
        address: ``can:INTERFACE:CHANNEL``; for socketcand with ``plain=yes`` the server is not
            asked whether it is a virtual robot.
        tally: Where to count.

    Returns:
        The bus.

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
    own = {key: value for key, value in address.options.items() if key != "plain"}
    address = dataclasses.replace(address, options=own)
    virtual = None if plain else find_virtual_robot(address, tally)
    return virtual or PythonCanBus(address, tally)
