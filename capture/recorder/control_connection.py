"""One connection to the control socket: what came, and what waits to go."""

from __future__ import annotations

import socket
from collections.abc import Iterator

from .control_lines import BUFFER


class Connection:
    """One client.

    Attributes:
        socket: Its socket, non-blocking.
        heard: The poll in which it last said something.
        incoming: Bytes of requests that are not answered yet.
        outgoing: Bytes of replies that it has not taken yet.
        ended: It will send no more.
        closing: We take no more from it.
        waits: For the end of the recording.
        more: A whole request is left from the last poll.
    """

    def __init__(self, connection: socket.socket, number: int) -> None:
        """Nothing has come yet.

        Args:
            connection: The socket.
            number: The poll in which it connected.
        """
        self.socket = connection
        self.heard = number
        self.incoming = bytearray()
        self.outgoing = bytearray()
        self.ended = False
        self.closing = False
        self.waits = False
        self.more = False

    @property
    def has_room(self) -> bool:
        """Whether a reply still fits."""
        return len(self.outgoing) < BUFFER

    @property
    def has_request(self) -> bool:
        """Whether a whole request has come."""
        # The last one of a client that has ended may lack its newline.
        return b"\n" in self.incoming or (self.ended and bool(self.incoming))

    def lines(self) -> Iterator[bytes]:
        """The requests that have come whole.

        Yields:
            Each, taken off the buffer as it is handed out.
        """
        while self.has_request:
            at = self.incoming.find(b"\n")
            end = len(self.incoming) if at < 0 else at + 1
            line = bytes(self.incoming[:end])
            del self.incoming[:end]
            yield line
