"""Serial adapters with the slcan protocol (Lawicel), read in bulk from the terminal device.

python-can reads such an adapter byte by byte, 130 us a frame; a bus at 8,000 frames a second has
one every 125 us. Here a read takes all received bytes, and one expression finds the frames.

A frame is a line ended by a carriage return: ``t`` (11-bit identifier, three digits) or ``T``
(29-bit, eight), a length digit, two digits for each data byte, and, if the adapter stamps its
frames, four digits of milliseconds that start again after a minute. ``r`` and ``R`` are remote
requests; ``d`` and ``D`` CAN FD frames, ``b`` and ``B`` those with the second bit rate, all four
with a length code up to ``F``. A bell character reports an error of the adapter. A chunk with
anything else than frames is read line by line.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import select
import termios
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields

from ..common.errors import SourceError, UsageError
from ..log.messages import frames as wire
from ..log.messages.frames import FrameArray, empty_fd_frames
from ..robot.model import ClockDomain
from .contract import (
    SourceAddress,
    fd_records,
    flag,
    number,
    only,
    pack_fd_record,
    pack_record,
    records,
)
from .drained_link import DrainedLink
from .events import Tally
from .link import LinkedSource
from .serial_port import OverrunWatch, bauds, check_device, make_raw

STAMP_PERIOD_MS = 60_000
"""An adapter's time stamps start again after so many milliseconds."""

_FRAME = (  # x: CANDapter's T
    r"([tr][0-9A-Fa-f]{3}(?=[0-8])|[TRx][0-9A-Fa-f]{8}(?=[0-8])"
    r"|[db][0-9A-Fa-f]{3}|[DB][0-9A-Fa-f]{8})([0-9A-Fa-f])([0-9A-Fa-f]*)"
)
_FRAMES = re.compile(rf"(?<![^\r]){_FRAME}\r")
_ONE = re.compile(_FRAME)
_END = re.compile(r"[\r\a]")
_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_ANSWERS = "zZVvNF"  # acknowledged, version, serial number, status
_LONGEST = 200  # a CAN FD frame with 64 bytes has 142
_HIGHEST_STANDARD = 0x7FF
_NS_PER_MS = 1_000_000

_IN_ORDER = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
BITRATES = {rate: b"S%d" % k for k, rate in enumerate(_IN_ORDER)} | {750_000: b"S7", 83_300: b"S9"}
"""Bit rate [bit/s] to the command that sets it (S7 is 800,000 with some adapters)."""

_CHUNK = 65536
_SHORT = 2048  # a terminal gives up to 4095 bytes a read; after fewer there are no more
_MOST_BYTES = 1 << 20
_ANSWER_S = 0.2
_PAUSE_S = 0.002  # a later stamp against more waking: at most this late
_QUIET_S = 0.05
_WRITE_S = 1.0


class SlcanText:
    """Turns an adapter's bytes into frames; keeps the beginning of an unfinished line."""

    def __init__(self, *, stamps: bool) -> None:
        """Start at the beginning of a line.

        Args:
            stamps: Whether to take the device times from the adapter's stamps.
        """
        self._stamps = AdapterClock() if stamps else None
        self._rest = b""
        self._has_fd = False

    def feed(self, chunk: bytes, t_ns: int, tally: Tally) -> tuple[FrameArray, FrameArray]:
        """Parse bytes that were read at ``t_ns`` [Unix ns].

        Returns:
            The frames whose lines have ended, classic ones and CAN FD ones.
        """
        whole = self._rest + chunk
        end = max(whole.rfind(b"\r"), whole.rfind(b"\a")) + 1
        self._rest = whole[end:]
        if len(self._rest) > _LONGEST:
            self._rest = b"?"  # noise: its end, when it comes, is one malformed line
        text = whole[:end].decode("latin-1")  # any byte is some character
        matches: list[tuple[str, str, str]] = _FRAMES.findall(text)
        if len(matches) != text.count("\r") or "\a" in text:
            matches = _line_by_line(text, tally)
        packed = [record for fields in matches if (record := self._record(*fields, t_ns))]
        tally.malformed("malformed line", len(matches) - len(packed))
        if not self._has_fd:  # the usual case: nothing to pick
            return records(packed), empty_fd_frames(0)
        size = wire.FRAME_DTYPE.itemsize
        fd = [record for record in packed if len(record) != size]
        return records(record for record in packed if len(record) == size), fd_records(fd)

    def _record(self, head: str, digit: str, rest: str, t_ns: int) -> bytes | None:
        """Return a frame's record; None if its line is malformed."""
        kind = head[0]
        flags = int(head[1:], 16)
        length = _FD_LENGTHS[int(digit, 16)]
        digits = 2 * length
        if kind in "TRxDB":
            if flags > wire.ID_MASK:
                return None
            flags |= wire.EXTENDED_FLAG
        elif flags > _HIGHEST_STANDARD:
            return None
        if kind in "rR":
            flags |= wire.REMOTE_FLAG
            digits = 0
        if (len(rest) - digits) not in (0, 4):
            return None
        device_ns: int | None = t_ns
        if self._stamps is not None:
            device_ns = self._stamps.time_ns(rest[digits:], t_ns)
            if device_ns is None:
                return None
        data = bytes.fromhex(rest[:digits])
        if kind in "dDbB":
            self._has_fd = True
            brs = wire.FD_BRS if kind in "bB" else 0
            return pack_fd_record(device_ns, t_ns, flags, length, 0, brs, data)
        return pack_record(device_ns, t_ns, flags, length, 0, data)


class AdapterClock:
    """Adds the minutes to an adapter's stamps, which start again after each."""

    def __init__(self) -> None:
        """Start before the first stamp."""
        self._last_ms: int | None = None
        self._last_host_ns = 0

    def time_ns(self, stamp: str, host_ns: int) -> int | None:
        """Return the device's time of a frame.

        Args:
            stamp: Four hexadecimal digits of milliseconds; may be empty.
            host_ns: Time of reading [Unix ns]: it gives the number of minutes of a pause.

        Returns:
            Time on the adapter's clock [ns]; ``host_ns`` if no frame had a stamp yet; None if the
            stamp is missing or beyond a minute.
        """
        if not stamp:
            return host_ns if self._last_ms is None else None
        time_ms = int(stamp, 16)
        if time_ms >= STAMP_PERIOD_MS:
            return None
        if self._last_ms is not None:
            half = STAMP_PERIOD_MS // 2
            expected = self._last_ms + (host_ns - self._last_host_ns) // _NS_PER_MS
            minutes = (expected - time_ms + half) // STAMP_PERIOD_MS
            time_ms += STAMP_PERIOD_MS * max(0, minutes)
        self._last_ms, self._last_host_ns = time_ms, host_ns
        return time_ms * _NS_PER_MS


def _line_by_line(text: str, tally: Tally) -> list[tuple[str, str, str]]:
    """Return the fields of the frames in a chunk that has other lines too."""
    tally.malformed("the adapter reports an error (bell)", text.count("\a"))
    matches: list[tuple[str, str, str]] = []
    malformed = 0
    for line in _END.split(text):
        frame = _ONE.fullmatch(line)
        if frame is not None:
            matches.append((frame[1], frame[2], frame[3]))
        elif line and line[0] not in _ANSWERS:
            malformed += 1
    tally.malformed("malformed line", malformed)
    return matches


@dataclass(frozen=True)
class SlcanSettings:
    """Settings of an adapter.

    Attributes:
        bitrate: Of the bus [bit/s]; None for the adapter's own.
        timestamps: Let the adapter stamp frames.
        tty_baud: Speed of the serial line [bit/s]; without effect on USB.
        rtscts: Hardware handshake on the serial line.
    """

    bitrate: int | None = None
    listen_only: bool = True
    timestamps: bool = False
    tty_baud: int = 115_200
    rtscts: bool = False


class SlcanLink:
    """An open adapter."""

    def __init__(self, fileno: int, first: bytes, settings: SlcanSettings, tally: Tally) -> None:
        """Take over a terminal device."""
        rate = "" if settings.bitrate is None else f", {settings.bitrate} bit/s"
        self.detail = ("listen-only" if settings.listen_only else "acknowledges frames") + rate
        self._fileno: int | None = fileno
        self._first = first
        self._buffer = memoryview(bytearray(_CHUNK))
        self._text = SlcanText(stamps=settings.timestamps)
        self._tally = tally
        self._overruns = OverrunWatch(fileno, tally)
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
        self._overruns.look()
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

    Raises:
        OSError: If it isn't there, doesn't take commands, or refuses one.
        SourceError: If it is no terminal device.
    """
    fileno = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        make_raw(fileno, settings.tty_baud, termios.CRTSCTS if settings.rtscts else 0)
        termios.tcflush(fileno, termios.TCIOFLUSH)
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


def slcan_source(address: SourceAddress, path: str) -> LinkedSource:
    """Make the source of an adapter; nothing is opened.

    Args:
        path: The device, e.g. ``/dev/ttyACM0``.

    Raises:
        UsageError: If an option is unknown or has no valid value.
        SourceError: If the path is not that of a device.
    """
    only(address, [field.name for field in fields(SlcanSettings)])
    settings = SlcanSettings(
        bitrate=number(address, "bitrate", 0) or None,
        listen_only=flag(address, "listen_only", default=True),
        timestamps=flag(address, "timestamps", default=False),
        tty_baud=number(address, "tty_baud", SlcanSettings.tty_baud),
        rtscts=flag(address, "rtscts", default=False),
    )
    facts = {"interface": "slcan", "channel": path}
    facts["listen_only"] = "yes" if settings.listen_only else "no"
    if settings.bitrate is not None:
        _check_option(address, "bitrate", settings.bitrate, sorted(BITRATES))
        facts["bitrate"] = str(settings.bitrate)
    _check_option(address, "tty_baud", settings.tty_baud, bauds())
    facts["timestamps"] = "adapter, 1 ms" if settings.timestamps else "host"
    check_device(address.text, path)
    return LinkedSource(
        address,
        lambda tally: DrainedLink(open_slcan(path, settings, tally), tally, pause_s=_PAUSE_S),
        place=path,
        clock=ClockDomain.DEVICE if settings.timestamps else ClockDomain.HOST,
        facts=facts,
    )


def _check_option(address: SourceAddress, key: str, value: int, valid: list[int]) -> None:
    if value not in valid:
        listed = ", ".join(map(str, valid))
        raise UsageError(f"{address.text!r}: {key} {value} is not one of {listed}")


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
    """Return the next bytes; none after the time limit."""
    if not select.select([fileno], [], [], timeout_s)[0]:
        return b""
    chunk = os.read(fileno, _CHUNK)
    if not chunk:
        raise _hung_up()
    return chunk


def _settle(fileno: int) -> None:
    """Discard late bytes until none come (a closed channel sends nothing)."""
    until = time.monotonic() + 10 * _QUIET_S
    while time.monotonic() < until and _receive(fileno, _QUIET_S):
        pass


def _command(fileno: int, command: bytes, refused: str) -> bytes:
    """Send a command; return the bytes behind its answer, which some adapters don't send."""
    _write(fileno, command + b"\r")
    answer = _receive(fileno, _ANSWER_S)
    if answer.startswith(b"\a"):
        raise OSError(errno.EPROTO, f"the adapter refuses {refused}")
    return answer.removeprefix(b"\r")


def _release(fileno: int) -> None:
    """Close the channel if the adapter still takes it, then the device."""
    with contextlib.suppress(OSError):  # an unplugged device
        os.write(fileno, b"C\r")
        fcntl.ioctl(fileno, termios.TIOCNXCL)
    with contextlib.suppress(OSError):
        os.close(fileno)
