"""CAN buses served over TCP by socketcand, its raw mode read in bulk.

The server's own times of the frames are kept, to the microsecond, as the device's clock.

A frame is ``< frame 123 1700000000.123456 1122AABB >``: an identifier of three digits (11 bit) or
eight (29 bit), the server's time, the data, with some servers with blanks between the bytes. One
expression finds them all. Rare messages are read one by one: remote requests
``< rtr 123 TIME LENGTH >``, error frames ``< error CLASSES TIME >``, times with another number of
decimals or out of range, and malformed ones.
"""

from __future__ import annotations

import contextlib
import errno
import re
import socket
from bisect import bisect_left
from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from ..common.errors import UsageError
from ..log.messages.frames import ERROR_FLAG, EXTENDED_FLAG, ID_MASK, REMOTE_FLAG, FrameArray
from ..robot.model import ClockDomain
from .contract import SourceAddress, number, only, pack_record, records
from .events import IMPLAUSIBLE_TIME, Tally
from .link import LinkedSource
from .reader_thread import ArrivalClock, ReceiveThread

_FRAMES = re.compile(
    r"< frame ([0-9A-Fa-f]{1,8}) (\d{1,10})\.(\d{6}) ((?:[0-9A-Fa-f]{2} ?){0,8}) ?>", re.ASCII
)
_MESSAGE = re.compile(r"<[^<>]*>")
_ANY = re.compile(
    r"< *(frame|rtr|error) +([0-9A-Fa-f]{1,8})"
    r" +(-?\d+(?:\.\d*)?(?:[Ee][-+]?\d+)?|-?(?:[Nn][Aa][Nn]|[Ii][Nn][Ff]))"
    r"(?: +([0-9A-Fa-f ]*?))? *>",
    re.ASCII,
)
_TIME = re.compile(r"(\d{1,10})(?:\.(\d{1,9}))?", re.ASCII)
_WORD = re.compile(r"< *(hi|ok|echo) *>")
_ERROR = re.compile(r"< *(error\b[^>]*?) *>")
_LONGEST = 400  # a CAN FD frame with 64 bytes and blanks has about 220
_HIGHEST_STANDARD = 0x7FF

PORT = 29536
"""Where socketcand listens unless told otherwise."""

_CONNECT_S = 5.0
_PIECE = 4096  # bytes that share a time of arrival: those of one segment, mostly fewer
_MOST_PIECES = 512  # in one read
_LATEST_NS = 1_000_000_000  # a piece is taken from the kernel within this time
_LONGEST_ANSWER = 4096


class SocketcandText:
    """Turns a server's bytes into frames; keeps the beginning of an unfinished message."""

    def __init__(self) -> None:
        """Start between two messages."""
        self._rest = b""

    def feed(self, chunk: bytes, t_ns: int, tally: Tally) -> FrameArray:
        """Return the frames of bytes that came at ``t_ns`` [Unix ns]."""
        return self.feed_pieces((chunk,), (t_ns,), tally)

    def feed_pieces(
        self, pieces: Sequence[bytes], times_ns: Sequence[int], tally: Tally
    ) -> FrameArray:
        """Parse pieces that came at ``times_ns`` [Unix ns].

        Returns:
            The frames whose messages have ended, with the time of the piece that ended them.
        """
        whole = b"".join((self._rest, *pieces))
        begun = len(self._rest)
        end = whole.rfind(b">") + 1
        self._rest = whole[end:]
        if len(self._rest) > _LONGEST:
            self._rest = b"<"  # noise: its end, when it comes, is one malformed message
        text = whole[:end].decode("latin-1")  # any byte is some character
        matches: list[tuple[str, str, str, str]] = _FRAMES.findall(text)
        packed = None
        if len(matches) == text.count("<") == text.count(">"):
            packed = _together(matches)
        if packed is not None:
            frames = records(packed)
            counts = [piece.count(b">") for piece in pieces]
            frames["t_host_ns"] = np.repeat(np.array(times_ns, dtype=np.uint64), counts)
            return frames
        stops = list(accumulate(map(len, pieces), initial=begun))[1:]
        return records(_one_by_one(text, stops, times_ns, tally))


def _together(matches: list[tuple[str, str, str, str]]) -> list[bytes] | None:
    """Records from their fields; None if an identifier is too high for its number of digits."""
    packed: list[bytes] = []
    for digits, seconds, micros, field in matches:
        flags = int(digits, 16)
        if len(digits) > 3:
            if flags > ID_MASK:
                return None
            flags |= EXTENDED_FLAG
        elif flags > _HIGHEST_STANDARD:
            return None
        data = bytes.fromhex(field)
        packed.append(pack_record(int(seconds + micros) * 1000, 0, flags, len(data), 0, data))
    return packed


def _one_by_one(
    text: str, stops: Sequence[int], times_ns: Sequence[int], tally: Tally
) -> list[bytes]:
    """Records of all messages; ``stops`` are the ends of the pieces that they came in."""
    messages = list(_MESSAGE.finditer(text))
    tally.malformed("malformed message", text.count("<") + text.count(">") - 2 * len(messages))
    return [
        record
        for message in messages
        if (record := _record(message[0], times_ns[bisect_left(stops, message.end())], tally))
    ]


def _record(message: str, t_host_ns: int, tally: Tally) -> bytes | None:
    """Read one message; None if it is no frame."""
    match = _ANY.fullmatch(message)
    if match is None:
        if (error := _ERROR.fullmatch(message)) is not None:
            tally.events.log_event("warn", f"the server answered: {error[1]!r}")
        elif not _WORD.fullmatch(message):
            tally.malformed("malformed message", 1)
        return None
    kind, digits, stamp, rest = match.groups(default="")
    identifier = int(digits, 16)
    if kind == "error":  # the server keeps the details to itself
        flags = identifier & ID_MASK | ERROR_FLAG
        return pack_record(_time_ns(stamp, t_host_ns, tally), t_host_ns, flags, 0, 0, b"")
    extended = len(digits) > 3
    flags = extended * EXTENDED_FLAG
    rest = rest.replace(" ", "")
    if kind == "rtr":
        flags |= REMOTE_FLAG
        length, data = int(rest) if rest.isdigit() else -1, b""
    else:
        data = bytes.fromhex(rest) if len(rest) % 2 == 0 else None
        length = -1 if data is None else len(data)
    if length > 8 and kind == "frame":
        tally.events.log_event("warn", "CAN FD frame left out")
        return None
    highest = ID_MASK if extended else _HIGHEST_STANDARD
    if data is None or not 0 <= length <= 8 or identifier > highest:
        tally.malformed("malformed message", 1)
        return None
    t_ns = _time_ns(stamp, t_host_ns, tally)
    return pack_record(t_ns, t_host_ns, identifier | flags, length, 0, data)


def _time_ns(stamp: str, t_host_ns: int, tally: Tally) -> int:
    """A frame's time; that of its arrival where the server's is negative, infinite or too long."""
    match = _TIME.fullmatch(stamp)
    if match is None:
        tally.malformed(IMPLAUSIBLE_TIME, 1)
        return t_host_ns
    seconds, fraction = match.groups(default="")
    return int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))


class SocketcandLink:
    """An open connection in raw mode."""

    detail = "never transmits"

    def __init__(self, sock: socket.socket, first: bytes, tally: Tally) -> None:
        """Take over a connection; ``first`` are the bytes behind the last answer."""
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
            times_ns.append(self._floor_ns)  # when the connection was open
            self._first = b""
        pending = self._receiver.pending  # before: what isn't taken then comes later
        batches = self._receiver.take(_MOST_PIECES)
        ended = self._receiver.ended
        for batch in batches:
            pieces += [
                row[:size].tobytes() for row, size in zip(batch.packets, batch.sizes, strict=True)
            ]
            stamps_ns = self._clock.times(batch.stamps_ns, self._floor_ns)
            self._floor_ns = stamps_ns[-1]
            times_ns += stamps_ns
        if pieces:
            return (self._text.feed_pieces(pieces, times_ns, self._tally),)
        if not pending:  # after a stop of this process, pieces may wait for long
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
    """Return host and port of an address such as ``can:socketcand:can0?host=192.168.7.2``.

    Raises:
        UsageError: If an option is unknown or has no valid value.
    """
    only(address, ("host", "port"))
    port = number(address, "port", PORT)
    if not 0 < port < 65536:
        raise UsageError(f"{address.text!r}: port {port} is not one of 1 to 65535")
    return address.options.get("host", "localhost"), port


def connect(host: str, port: int) -> tuple[socket.socket, bytes]:
    """Connect and wait for the greeting.

    Returns:
        The socket, with a time limit, and the bytes behind the greeting.

    Raises:
        OSError: If no server answers there, or it has another protocol.
    """
    sock = socket.create_connection((host, port), timeout=_CONNECT_S)
    try:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A server whose computer lost its power closes nothing: probe it after 5 s of silence.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
        return sock, _expect(sock, b"", b"hi")
    except OSError:
        sock.close()
        raise


def enter_raw_mode(sock: socket.socket, rest: bytes, channel: str) -> bytes:
    """Open a bus and change to raw mode; return the bytes behind the last answer.

    Args:
        channel: The server's name of the bus.

    Raises:
        OSError: If the server has no such bus, or has another protocol.
    """
    sock.sendall(b"< open %s >" % channel.encode())
    rest = _expect(sock, rest, b"ok")
    sock.sendall(b"< rawmode >")
    return _expect(sock, rest, b"ok")


def socketcand_source(address: SourceAddress, channel: str) -> LinkedSource:
    """Make the source of a served bus; nothing is opened.

    Args:
        channel: The server's name of the bus.

    Raises:
        UsageError: If an option is unknown or has no valid value.
    """
    host, port = server_of(address)

    def open_link(tally: Tally) -> SocketcandLink:
        sock, rest = connect(host, port)
        try:
            rest = enter_raw_mode(sock, rest, channel)
        except OSError:
            sock.close()
            raise
        return SocketcandLink(sock, rest, tally)

    return LinkedSource(
        address,
        open_link,
        place=f"{channel} at {host}:{port}",
        clock=ClockDomain.DEVICE,
        facts={"interface": "socketcand", "channel": channel, "host": host, "port": str(port)},
    )


def read_answer(sock: socket.socket, rest: bytes) -> tuple[str, bytes]:
    """Wait for an answer.

    Returns:
        The text between its brackets, stripped, and the bytes behind it.

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
    """Wait for an answer; return the bytes behind it."""
    answer, rest = read_answer(sock, rest)
    if answer != word.decode():
        with contextlib.suppress(OSError):
            sock.shutdown(socket.SHUT_RDWR)
        fault = f"the server answered {answer[:80]!r}, not '< {word.decode()} >'"
        raise OSError(errno.EPROTO, fault)
    return rest
