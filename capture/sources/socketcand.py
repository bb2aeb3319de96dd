"""CAN buses served over TCP by socketcand, its raw mode read in bulk.

The server's own times of the frames are kept, to the microsecond, as the device's clock.
"""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Mapping, Sequence

from ..common.errors import UsageError
from ..log.messages.frames import FrameArray
from ..robot.model import ClockDomain
from .address import number, only
from .contract import SourceAddress
from .events import Tally
from .link import LinkedSource
from .receive_many import ArrivalClock
from .receive_thread import ReceiveThread
from .socketcand_text import SocketcandText

PORT = 29536
"""Where socketcand listens unless told otherwise."""

_CONNECT_S = 5.0
_PIECE = 4096  # bytes that share a time of arrival: those of one segment, mostly fewer
_MOST_PIECES = 512  # in one read
_LATEST_NS = 1_000_000_000  # a piece is taken from the kernel within this time
_LONGEST_ANSWER = 4096


class SocketcandLink:
    """An open connection in raw mode."""

    detail = "never transmits"

    def __init__(self, sock: socket.socket, first: bytes, tally: Tally) -> None:
        """Take over a connection.

        Args:
            sock: In raw mode.
            first: What came already behind the last answer.
            tally: Where to count.
        """
        self._first = first
        self._text = SocketcandText()
        self._tally = tally
        self._clock = ArrivalClock(tally.now_ns)
        self._floor_ns = tally.now_ns()
        self._receiver = ReceiveThread(sock, _PIECE)

    def read(self, now_ns: int) -> Sequence[FrameArray]:
        """See :meth:`Link.read`."""
        pieces: list[bytes] = []
        times_ns: list[int] = []
        if self._first:
            pieces.append(self._first)
            times_ns.append(now_ns)
            self._first = b""
        batches = self._receiver.take(_MOST_PIECES)
        ended = self._receiver.ended
        for batch in batches:
            pieces += [
                row[:size].tobytes() for row, size in zip(batch.packets, batch.sizes, strict=True)
            ]
            found = self._clock.times(batch.stamps_ns, self._floor_ns)
            self._floor_ns = found[-1]
            times_ns += found
        if pieces:
            return (self._text.feed_pieces(pieces, times_ns, self._tally),)
        self._floor_ns = max(self._floor_ns, now_ns - _LATEST_NS)
        if ended:
            raise self._receiver.error or ConnectionResetError(
                errno.ECONNRESET, "the server closed the connection"
            )
        return ()

    def close(self) -> None:
        """Close the connection."""
        self._receiver.close()


def server_of(address: SourceAddress) -> tuple[str, int]:
    """Where an address says that its server is.

    Args:
        address: E.g. of ``can:socketcand:can0?host=192.168.7.2``.

    Returns:
        Host and TCP port.

    Raises:
        UsageError: If an option is unknown or has no valid value.
    """
    only(address, ("host", "port"))
    port = number(address, "port", PORT)
    if not 0 < port < 65536:
        raise UsageError(f"{address.text!r}: port {port} is not one of 1 to 65535")
    return address.options.get("host", "localhost"), port


def open_socketcand(host: str, port: int, channel: str, tally: Tally) -> SocketcandLink:
    """Connect, open the bus and go to raw mode.

    Args:
        host: Name or address.
        port: TCP port.
        channel: The bus, as the server calls it.
        tally: Where to count.

    Returns:
        The open link.

    Raises:
        OSError: If the server isn't there, has no such bus, or speaks something else.
    """
    sock, rest = connect(host, port)
    try:
        rest = enter_raw_mode(sock, rest, channel)
    except OSError:
        sock.close()
        raise
    return SocketcandLink(sock, rest, tally)


def connect(host: str, port: int) -> tuple[socket.socket, bytes]:
    """Connect and be greeted.

    Args:
        host: Name or address.
        port: TCP port.

    Returns:
        The socket, with a time limit, and what came already behind the greeting.

    Raises:
        OSError: If the server isn't there, or speaks something else.
    """
    sock = socket.create_connection((host, port), timeout=_CONNECT_S)
    try:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A server whose computer lost its power says no farewell: ask, after 5 s of silence.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
        return sock, _expect(sock, b"", b"hi")
    except OSError:
        sock.close()
        raise


def enter_raw_mode(sock: socket.socket, rest: bytes, channel: str) -> bytes:
    """Open a bus and go to raw mode.

    Args:
        sock: Connected and greeted.
        rest: What came already.
        channel: The bus, as the server calls it.

    Returns:
        What came already behind the last answer.

    Raises:
        OSError: If the server has no such bus, or speaks something else.
    """
    sock.sendall(b"< open %s >" % channel.encode())
    rest = _expect(sock, rest, b"ok")
    sock.sendall(b"< rawmode >")
    return _expect(sock, rest, b"ok")


def socketcand_source(
    address: SourceAddress, host: str, port: int, channel: str, facts: Mapping[str, str]
) -> LinkedSource:
    """Make the source of a served bus.

    Args:
        address: What was asked for.
        host: Name or address of the server.
        port: Its TCP port.
        channel: The bus, as the server calls it.
        facts: For the session's metadata.

    Returns:
        The source; nothing is opened.
    """
    return LinkedSource(
        address,
        lambda tally: open_socketcand(host, port, channel, tally),
        place=f"{channel} at {host}:{port}",
        clock=ClockDomain.DEVICE,
        facts=facts,
    )


def read_answer(sock: socket.socket, rest: bytes) -> tuple[str, bytes]:
    """Wait for an answer.

    Args:
        sock: With a time limit.
        rest: What came already.

    Returns:
        What stands in its brackets, blanks around it removed, and what came behind it.

    Raises:
        OSError: If none comes.
    """
    while b">" not in rest:
        chunk = sock.recv(4096)
        if not chunk:
            raise ConnectionResetError(errno.ECONNRESET, "the server closed the connection")
        rest += chunk
        if len(rest) > _LONGEST_ANSWER:
            break
    answer, _, rest = rest.partition(b">")
    return answer.replace(b"<", b"").strip().decode("ascii", "replace"), rest


def _expect(sock: socket.socket, rest: bytes, word: bytes) -> bytes:
    """Wait for an answer; returns what came behind it."""
    answer, rest = read_answer(sock, rest)
    if answer != word.decode():
        with contextlib.suppress(OSError):
            sock.shutdown(socket.SHUT_RDWR)
        said = answer[:80]
        raise OSError(errno.EPROTO, f"the server says {said!r} instead of '< {word.decode()} >'")
    return rest
