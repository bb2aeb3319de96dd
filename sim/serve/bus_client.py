"""One client of a served bus, and what it sends."""

from __future__ import annotations

import selectors
import socket
import time
from typing import NamedTuple

from .socketcand_text import ClientText


class Sent(NamedTuple):
    """A frame that a client sent.

    Attributes:
        client: Number of the client.
        record: As :data:`.capture.sources.records.pack_record` packs it, without times.
    """

    client: int
    record: bytes


class BusClient:
    """One connection.

    Attributes:
        number: From 1, never used again.
        sock: The connection, non-blocking.
        peer: What it is called in messages.
        text: Cuts what it sends into messages.
        bus_open: Whether it has opened the bus.
        raw: Whether it is in raw mode and gets all frames.
        marks: Whether it is told of control ticks.
        heard: Time of the monotonic clock of its last message, or of its connection [s].
        held_until: Nothing is sent to it before this time of the monotonic clock [s].
        out: What waits to be sent to it.
        watched: The selector's events that it is registered for; 0: it is not.
    """

    def __init__(self, number: int, sock: socket.socket, port: int) -> None:
        """Take over a connection.

        Args:
            number: Its number.
            sock: The connection.
            port: The client's own port.
        """
        self.number, self.sock = number, sock
        self.peer = f"client {number} at port {port}"
        self.text = ClientText()
        self.bus_open = self.raw = self.marks = False
        self.heard = time.monotonic()
        self.held_until = 0.0
        self.out = bytearray()
        self.watched = selectors.EVENT_READ
