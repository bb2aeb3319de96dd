"""A line of serial servos, listened to: ``serial:/dev/ttyUSB0?protocol=feetech&baud=1000000``.

Never a byte is written, unless ``tap=PATH`` has the source own the port and give the driver a
pseudo-terminal at that path: bytes then pass both ways unchanged, and each packet has a direction.

A packet's time is that of its last byte: the time of the read minus ten bit times for each byte
behind it. Records are those of CAN FD frames (:data:`.FD_FRAME_DTYPE`), on ``/serial/NAME``: the
servo's number in the place of the identifier, at most 64 bytes each, with the flags
:data:`.SERIAL_MORE` and :data:`.SERIAL_NOISE`.
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import stat
import struct
import termios
import threading
import tty
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ..common.errors import SourceError, UsageError
from ..common.process import join_running, share_priority
from ..common.strict_table import listed
from ..log.messages.frames import DIR_TX, SERIAL_MORE, SERIAL_NOISE, FrameArray
from ..robot.model import ClockDomain
from ..robot.serial_servos import PROTOCOLS, PacketSplitter
from .contract import SourceAddress, fd_records, number, only, pack_fd_record
from .drained_link import DrainedLink
from .events import Tally
from .link import LinkedSource

DEFAULT_BAUD = 1_000_000
"""Of both families' servos in robots [bit/s]."""

BITS_A_BYTE = 10
"""Start bit, eight data bits, stop bit."""

_RECORD = 64
_CHUNK = 4096
_PAUSE_S = 0.0002
_SILENCE_NS = 50_000_000  # no adapter holds bytes back for longer
_OTHER = "another process (of another user, or one that took it for itself)"

_TIOCGICOUNT = 0x545D
_COUNTERS = struct.Struct("11i36x")
"""``struct serial_icounter_struct`` (``linux/serial.h``): cts, dsr, rng, dcd, rx, tx, frame,
overrun, parity, brk, buf_overrun, and nine reserved."""
_OVERRUN, _BUFFER_OVERRUN = 7, 10


class PacketClock:
    """The packets of a stream that is read in chunks, each at the time of its last byte."""

    def __init__(self, protocol: str, baud: int, direction: int = 0) -> None:
        """Start.

        Args:
            protocol: One of :data:`.PROTOCOLS`.
            baud: [bit/s].
            direction: ``dir`` of the records.
        """
        self._splitter = PacketSplitter(protocol)
        self._id_at = PROTOCOLS[protocol].id_at
        self._byte_ns = BITS_A_BYTE * 1e9 / baud
        self._direction = direction
        self._stops: list[int] = []  # of the chunks that unfinished packets may lie in
        self._times_ns: list[int] = []

    def feed(self, chunk: bytes, t_ns: int, tally: Tally) -> FrameArray:
        """Take bytes that were read at ``t_ns`` [Unix ns]; none after a silence.

        Returns:
            The records of what is complete now.
        """
        stop = (self._stops[-1] if self._stops else 0) + len(chunk)
        if chunk:
            self._stops.append(stop)
            self._times_ns.append(t_ns)
        pieces = self._splitter.feed(chunk, silence=not chunk)
        stops, times_ns, way = self._stops, self._times_ns, self._direction
        packed: list[bytes] = []
        faulty = 0
        for data, end, valid in pieces:
            read = bisect_left(stops, end)
            t_ns = times_ns[read] - round((stops[read] - end) * self._byte_ns)
            servo, flags = (data[self._id_at], 0) if valid else (0, SERIAL_NOISE)
            faulty += not valid
            while len(data) > _RECORD:
                more = flags | SERIAL_MORE
                packed.append(pack_fd_record(t_ns, t_ns, servo, _RECORD, way, more, data[:_RECORD]))
                data = data[_RECORD:]  # noqa: PLW2901 (its rest)
            packed.append(pack_fd_record(t_ns, t_ns, servo, len(data), way, flags, data))
        tally.malformed("bytes that belong to no packet", faulty)
        keep = bisect_left(stops, pieces[-1].stop) if pieces else 0
        del stops[:keep], times_ns[:keep]
        return fd_records(packed)


class OverrunWatch:
    """Counts what a port lost while it was not read: overruns of its chip and its driver's buffer.

    Each overrun is counted as one lost frame. A pseudo-terminal has no such counter, and loses
    nothing: its far end waits.
    """

    def __init__(self, fileno: int, tally: Tally) -> None:
        """Start from the present counts of a terminal device."""
        self._fileno, self._tally = fileno, tally
        self.total = _overruns(fileno)
        """Overruns since the port exists; None without a counter."""
        if self.total is not None:
            tally.counts.dropped = tally.counts.dropped or 0

    def look(self) -> None:
        """Count what was lost since the last call."""
        if self.total is None:
            return
        now = _overruns(self._fileno)
        if now is not None and now != self.total:
            self._tally.lost("overrun of the serial port", max(0, now - self.total))
            self.total = now


def _overruns(fileno: int) -> int | None:
    counters = bytearray(_COUNTERS.size)
    try:
        fcntl.ioctl(fileno, _TIOCGICOUNT, counters)
    except OSError:  # no counters, or no device any more, which reading reports
        return None
    values = _COUNTERS.unpack(counters)
    return values[_OVERRUN] + values[_BUFFER_OVERRUN]


class SerialLink:
    """An open port."""

    def __init__(self, fileno: int, clock: PacketClock, tally: Tally, detail: str) -> None:
        """Take over a terminal device."""
        self.detail = detail
        self._fileno: int | None = fileno
        self._clock, self._tally = clock, tally
        self._overruns = OverrunWatch(fileno, tally)
        self._last_ns = 0
        self._error: OSError | None = None

    def read(self, now_ns: int) -> Sequence[FrameArray]:
        """See :meth:`Link.read`."""
        if self._error is not None or self._fileno is None:
            raise self._error or OSError(errno.EBADF, "closed")
        try:
            chunk = os.read(self._fileno, _CHUNK)
        except BlockingIOError:
            if now_ns - self._last_ns < _SILENCE_NS or not self._last_ns:
                return ()
            self._last_ns = 0
            return (self._clock.feed(b"", now_ns, self._tally),)
        except OSError as error:
            self._error = error
            chunk = b""
        if chunk:
            now_ns = self._last_ns = self._tally.now_ns()
            self._overruns.look()
        elif self._error is None:
            self._error = OSError(errno.EIO, "the device hung up")
        return (self._clock.feed(chunk, now_ns, self._tally),)

    def fileno(self) -> int:
        """The device."""
        return -1 if self._fileno is None else self._fileno

    def close(self) -> None:
        """Release the device."""
        if self._fileno is not None:
            fileno, self._fileno = self._fileno, None
            with suppress(OSError):
                fcntl.ioctl(fileno, termios.TIOCNXCL)
            os.close(fileno)


class TapLink:
    """An open port whose driver has a pseudo-terminal; bytes pass in a thread, as they come."""

    def __init__(
        self,
        fileno: int,
        path: Path,
        clocks: tuple[PacketClock, PacketClock],
        tally: Tally,
    ) -> None:
        """Take over a port, and make the driver's.

        Args:
            path: Where the driver finds its port, a link.
            clocks: Of what the servos send, and of what the driver sends.

        Raises:
            SourceError: If something else than a link is at the path.
        """
        if os.path.lexists(path) and not path.is_symlink():
            raise SourceError(str(path), "is there and no link; give another tap=PATH")
        self.detail = f"tapped, the driver's port is {path}"
        self._path, self._clocks, self._tally = path, clocks, tally
        self._port: int | None = fileno
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._slave = slave  # held, so that the driver may come and go
        os.set_blocking(self._master, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(slave))
        self._held: deque[FrameArray] = deque()
        self._error: OSError | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="undulog-tap", daemon=True)
        self._thread.start()

    def read(self, now_ns: int) -> Sequence[FrameArray]:  # noqa: ARG002 (stamped by the thread)
        """See :meth:`Link.read`."""
        error = self._error
        arrays: list[FrameArray] = []
        while self._held:
            arrays.append(self._held.popleft())
        if not arrays and error is not None:
            raise error
        return arrays

    def close(self) -> None:
        """End the thread, close both ports and remove the link."""
        if self._port is None:
            return
        self._stop.set()
        join_running(self._thread, 1.0)
        for fileno in (self._port, self._master, self._slave):
            with suppress(OSError):
                os.close(fileno)
        self._port = None
        self._path.unlink(missing_ok=True)

    def _run(self) -> None:
        share_priority()
        port = self._port
        assert port is not None  # noqa: S101 - closed after this thread
        ways = {port: (self._master, 0), self._master: (port, 1)}
        try:
            while not self._stop.is_set():
                ready = select.select(list(ways), [], [], _SILENCE_NS / 1e9)[0]
                for source in ready:
                    target, way = ways[source]
                    self._pass(source, target, self._clocks[way])
                if not ready:
                    for clock in self._clocks:
                        self._held.append(clock.feed(b"", 0, self._tally))
        except OSError as error:
            self._error = error

    def _pass(self, source: int, target: int, clock: PacketClock) -> None:
        chunk = os.read(source, _CHUNK)
        now_ns = self._tally.now_ns()
        if not chunk:
            raise OSError(errno.EIO, "the device hung up")
        rest = chunk
        while rest and not self._stop.is_set():
            try:
                rest = rest[os.write(target, rest) :]
            except BlockingIOError:
                if target == self._master:
                    break  # nobody reads the driver's port
                select.select([], [target], [], _SILENCE_NS / 1e9)
        self._held.append(clock.feed(chunk, now_ns, self._tally))


class SerialSource(LinkedSource):
    """A source of servo packets, which are kept on ``/serial/NAME``."""


def holders(path: str | Path) -> list[str]:
    """Return the processes that have a device open, as ``NAME (PID)``, without this one.

    Those of other users can't be seen.
    """
    processes: list[str] = []
    device = Path(path).resolve()
    for process in Path("/proc").glob("[0-9]*"):
        if int(process.name) == os.getpid():
            continue
        with suppress(OSError):
            if device in {link.readlink() for link in (process / "fd").iterdir()}:
                name = (process / "comm").read_text().strip()
                processes.append(f"{name} ({process.name})")
    return sorted(processes)


def open_exclusively(path: str, baud: int, *, write: bool = False) -> int:
    """Open a port raw, for this process alone; return its file number.

    Args:
        baud: [bit/s].
        write: Open it for writing too.

    Raises:
        OSError: If it isn't there.
        SourceError: If another process holds it, named as far as it can be seen, or it is no
            terminal device.
    """
    if held := holders(path):
        raise SourceError(
            path,
            f"is held by {', '.join(held)}; end that, or give its driver the path of ?tap=PATH",
        )
    way = os.O_RDWR if write else os.O_RDONLY
    try:
        fileno = os.open(path, way | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.EBUSY:  # TIOCEXCL
            raise SourceError(path, f"is held by {_OTHER}") from error
        raise
    try:
        fcntl.flock(fileno, fcntl.LOCK_EX | fcntl.LOCK_NB)
        fcntl.ioctl(fileno, termios.TIOCEXCL)
        make_raw(fileno, baud)
        termios.tcflush(fileno, termios.TCIFLUSH)  # what was said before is not of this session
    except termios.error as error:
        os.close(fileno)
        raise SourceError(path, "is no serial device") from error
    except OSError as error:
        os.close(fileno)
        if error.errno == errno.ENOTTY:
            raise SourceError(path, "is no serial device") from error
        if isinstance(error, BlockingIOError):
            raise SourceError(path, f"is held by {_OTHER}") from error
        raise
    return fileno


def make_raw(fileno: int, baud: int, more: int = 0) -> None:
    """Set a terminal device raw, 8N1 at ``baud`` [bit/s], with ``more`` control flags."""
    speed = getattr(termios, f"B{baud}")
    characters = termios.tcgetattr(fileno)[6]
    # An empty read means that it hung up.
    characters[termios.VMIN], characters[termios.VTIME] = 1, 0
    flags = termios.CS8 | termios.CREAD | termios.CLOCAL | more
    termios.tcsetattr(
        fileno, termios.TCSANOW, [termios.IGNBRK, 0, flags, 0, speed, speed, characters]
    )


def check_device(source: str, path: str) -> None:
    """Refuse a path of something else than a device.

    Raises:
        SourceError: If it is one.
    """
    if Path(path).exists() and not stat.S_ISCHR(Path(path).stat().st_mode):
        raise SourceError(source, f"{path} is no serial device")


def bauds() -> list[int]:
    """Return the speeds that a port can have [bit/s]."""
    names = (name[1:] for name in dir(termios) if name.startswith("B"))
    return sorted(int(name) for name in names if name.isdigit() and name != "0")


def line_settings(address: SourceAddress) -> tuple[str, int]:
    """Return protocol and speed [bit/s] of an address.

    Raises:
        UsageError: If one is missing or isn't valid.
    """
    protocol, baud = address.options.get("protocol", ""), number(address, "baud", DEFAULT_BAUD)
    if protocol not in PROTOCOLS:
        valid = listed(PROTOCOLS, protocol or None)
        raise UsageError(f"{address.text!r}: give the servos' protocol=...; valid: {valid}")
    if baud not in bauds():
        raise UsageError(f"{address.text!r}: baud {baud} is not one of {bauds()}")
    return protocol, baud


def open_serial(address: SourceAddress) -> SerialSource:
    """Make the source of a serial line; nothing is opened.

    Raises:
        UsageError: If an option is unknown or has no valid value.
        SourceError: If the path is not that of a device.
    """
    only(address, ("protocol", "baud", "tap"))
    protocol, baud = line_settings(address)
    path = address.rest
    check_device(address.text, path)
    tap = address.options.get("tap")

    def open_link(tally: Tally) -> DrainedLink | TapLink:
        fileno = open_exclusively(path, baud, write=tap is not None)
        if tap is not None:
            both = PacketClock(protocol, baud), PacketClock(protocol, baud, DIR_TX)
            try:
                return TapLink(fileno, Path(tap), both, tally)
            except BaseException:
                os.close(fileno)
                raise
        link = SerialLink(fileno, PacketClock(protocol, baud), tally, f"never writes, {baud} baud")
        return DrainedLink(link, tally, pause_s=_PAUSE_S, longest_s=_SILENCE_NS / 1e9)

    return SerialSource(
        address,
        open_link,
        place=path,
        clock=ClockDomain.HOST,
        facts={"interface": "serial", "port": path, "protocol": protocol, "baud": str(baud)},
        directions=tap is not None,
    )
