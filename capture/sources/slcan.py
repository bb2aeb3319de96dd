"""Serial adapters that speak slcan (Lawicel), read in bulk from the terminal device.

python-can reads such an adapter byte by byte, 130 us a frame; a bus at 8,000 frames a second has
one every 125. Here a read takes all there is and one expression takes it apart.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import stat
import termios
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..common.errors import SourceError, UsageError
from ..log.messages.frames import FrameArray
from ..robot.model import ClockDomain
from .contract import SourceAddress
from .drained_link import DrainedLink
from .events import Tally
from .link import LinkedSource
from .slcan_text import SlcanText

BITRATES = {
    10_000: b"S0",
    20_000: b"S1",
    50_000: b"S2",
    100_000: b"S3",
    125_000: b"S4",
    250_000: b"S5",
    500_000: b"S6",
    750_000: b"S7",
    800_000: b"S7",
    1_000_000: b"S8",
    83_300: b"S9",
}
"""Bit rate [bit/s] to the command that sets it (S7 is 800,000 with some adapters)."""

_CHUNK = 65536
_SHORT = 2048  # a terminal gives up to 4095 bytes a read; after fewer there are no more
_MOST_BYTES = 1 << 20
_ANSWER_S = 0.2
_PAUSE_S = 0.002  # a later stamp against more waking: at most this late
_QUIET_S = 0.05
_WRITE_S = 1.0


@dataclass(frozen=True)
class SlcanSettings:
    """How to open an adapter.

    Attributes:
        bitrate: Of the bus [bit/s]; None leaves the adapter's own.
        listen_only: Neither acknowledge nor transmit.
        timestamps: Ask the adapter to stamp frames.
        tty_baud: Speed of the serial line [bit/s]; without meaning for USB.
        rtscts: Hardware handshake on the serial line.
    """

    bitrate: int | None = None
    listen_only: bool = True
    timestamps: bool = False
    tty_baud: int = 115_200
    rtscts: bool = False

    def check(self, text: str) -> None:
        """See that the adapter and the serial line know these numbers.

        Args:
            text: The address, for the message.

        Raises:
            UsageError: If not; lists those that are valid.
        """
        if self.bitrate is not None and self.bitrate not in BITRATES:
            valid = ", ".join(map(str, sorted(BITRATES)))
            raise UsageError(f"{text!r}: bitrate {self.bitrate} is not one of {valid}")
        if _speed(self.tty_baud) is None:
            valid = ", ".join(map(str, _speeds()))
            raise UsageError(f"{text!r}: tty_baud {self.tty_baud} is not one of {valid}")


class SlcanLink:
    """An open adapter."""

    def __init__(self, fileno: int, first: bytes, settings: SlcanSettings, tally: Tally) -> None:
        """Take over a terminal device.

        Args:
            fileno: Open, raw, non-blocking.
            first: What it sent already.
            settings: How it was opened.
            tally: Where to count.
        """
        rate = "" if settings.bitrate is None else f", {settings.bitrate} bit/s"
        self.detail = ("listen-only" if settings.listen_only else "acknowledges frames") + rate
        self._fileno: int | None = fileno
        self._first = first
        self._buffer = memoryview(bytearray(_CHUNK))
        self._text = SlcanText(stamps=settings.timestamps)
        self._tally = tally
        self._error: OSError | None = None

    def read(self, now_ns: int) -> Sequence[FrameArray]:
        """See :meth:`Link.read`."""
        if self._error is not None or self._fileno is None:
            raise self._error or OSError(errno.EBADF, "closed")
        chunks = [self._first] if self._first else []
        self._first = b""
        size = 0
        try:
            while size < _MOST_BYTES:
                count = os.readv(self._fileno, [self._buffer])
                if not count:
                    raise _hung_up()
                chunks.append(self._buffer[:count].tobytes())
                size += count
                if count < _SHORT:
                    break
        except BlockingIOError:
            pass
        except OSError as error:
            if not chunks:
                raise
            self._error = error  # first hand out what came before
        if not chunks:
            return ()
        return self._text.feed(b"".join(chunks), now_ns, self._tally)

    def fileno(self) -> int:
        """The device."""
        return -1 if self._fileno is None else self._fileno

    def close(self) -> None:
        """Close the channel and the device."""
        if self._fileno is None:
            return
        fileno, self._fileno = self._fileno, None
        _release(fileno)


def open_slcan(path: str, settings: SlcanSettings, tally: Tally) -> SlcanLink:
    """Open an adapter: bit rate, time stamps, then the channel.

    Args:
        path: The device.
        settings: How.
        tally: Where to count.

    Returns:
        The open link.

    Raises:
        OSError: If it isn't there, doesn't take commands, or refuses one.
        SourceError: If it is no terminal device.
    """
    fileno = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _make_raw(fileno, settings)
        fcntl.ioctl(fileno, termios.TIOCEXCL)  # a second reader would take half of the bytes
        _write(fileno, b"\r\r\rC\r")  # whatever it was in the middle of
        _settle(fileno)
        if settings.bitrate is not None:
            _command(fileno, BITRATES[settings.bitrate], f"bit rate {settings.bitrate}")
        if settings.timestamps:
            _command(fileno, b"Z1", "time stamps")
        if settings.listen_only:
            hint = "listen-only; with listen_only=0 it would be opened normally and acknowledge"
            first = _command(fileno, b"L", hint)
        else:
            first = _command(fileno, b"O", "to open the channel")
    except termios.error as error:
        os.close(fileno)
        code, text = error.args
        if code == errno.ENOTTY:
            raise SourceError(path, "is no serial device") from error
        raise OSError(code, text) from error
    except OSError:
        _release(fileno)
        raise
    return SlcanLink(fileno, first, settings, tally)


def slcan_source(
    address: SourceAddress, path: str, settings: SlcanSettings, facts: Mapping[str, str]
) -> LinkedSource:
    """Make the source of an adapter.

    Args:
        address: What was asked for.
        path: The device, e.g. ``/dev/ttyACM0``.
        settings: How to open it.
        facts: For the session's metadata.

    Returns:
        The source; nothing is opened.

    Raises:
        UsageError: If a setting has no valid value.
        SourceError: If the path is something else than a device.
    """
    settings.check(address.text)
    device = Path(path)
    if device.exists() and not stat.S_ISCHR(device.stat().st_mode):
        raise SourceError(address.text, f"{path} is no serial device")
    return LinkedSource(
        address,
        lambda tally: DrainedLink(open_slcan(path, settings, tally), tally, pause_s=_PAUSE_S),
        place=path,
        clock=ClockDomain.DEVICE if settings.timestamps else ClockDomain.HOST,
        facts=facts,
    )


def _speeds() -> list[int]:
    names = [name[1:] for name in dir(termios) if name.startswith("B") and name[1:].isdigit()]
    return sorted(int(name) for name in names if name != "0")


def _speed(baud: int) -> int | None:
    return getattr(termios, f"B{baud}") if baud in _speeds() else None


def _make_raw(fileno: int, settings: SlcanSettings) -> None:
    attributes = termios.tcgetattr(fileno)
    flags = termios.CS8 | termios.CREAD | termios.CLOCAL
    if settings.rtscts:
        flags |= termios.CRTSCTS
    speed = _speed(settings.tty_baud) or termios.B115200
    characters = attributes[6]
    characters[termios.VMIN] = 1  # so that an empty read means that it hung up
    characters[termios.VTIME] = 0
    termios.tcsetattr(
        fileno, termios.TCSANOW, [termios.IGNBRK, 0, flags, 0, speed, speed, characters]
    )
    termios.tcflush(fileno, termios.TCIOFLUSH)


def _write(fileno: int, data: bytes) -> None:
    until = time.monotonic() + _WRITE_S
    while data:
        left = until - time.monotonic()
        if left <= 0 or not select.select([], [fileno], [], left)[1]:
            raise TimeoutError(errno.ETIMEDOUT, "the adapter takes no commands")
        data = data[os.write(fileno, data) :]


def _hung_up() -> OSError:
    return OSError(errno.EIO, "the device hung up")


def _receive(fileno: int, timeout_s: float) -> bytes:
    """What comes next; empty if nothing does in time."""
    if not select.select([fileno], [], [], timeout_s)[0]:
        return b""
    chunk = os.read(fileno, _CHUNK)
    if not chunk:
        raise _hung_up()
    return chunk


def _settle(fileno: int) -> None:
    """Let pass what was on its way, until it is quiet (a closed channel sends nothing)."""
    until = time.monotonic() + 10 * _QUIET_S
    while time.monotonic() < until and _receive(fileno, _QUIET_S):
        pass


def _command(fileno: int, command: bytes, refused: str) -> bytes:
    """Give a command; returns what followed the answer. Some adapters give none."""
    _write(fileno, command + b"\r")
    answer = _receive(fileno, _ANSWER_S)
    if answer.startswith(b"\a"):
        raise OSError(errno.EPROTO, f"the adapter refuses {refused}")
    return answer.removeprefix(b"\r")


def _release(fileno: int) -> None:
    """Close the channel if the adapter still takes it, then the device."""
    try:
        os.write(fileno, b"C\r")
        fcntl.ioctl(fileno, termios.TIOCNXCL)
    except OSError:
        pass  # gone already: nothing to close
    finally:
        with contextlib.suppress(OSError):
            os.close(fileno)
