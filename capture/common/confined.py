"""Parsers of foreign binary files, in a child process with limits of memory and processor time.

Libraries in C that read SQLite, Parquet, MATLAB or CAN logs end the process on some damaged files,
or take memory and time without bound. Here such a parser is a function of a module, run by a fresh
interpreter that imports no more than it needs::

    def parse(path: Path, send: Send, **options) -> None:
        send(Packet(facts, arrays))

    for packet in Confined(ImportFormatError).stream("undulog.capture.x:parse", path):
        ...

What it sends is mapped, not copied (:mod:`.capture.common.packets`), and it waits while the parent
is behind, so that a large file is never whole in memory. Whatever ends the child, a signal, a limit
or an exception, is one error that names the file. The limits grow with the file: what is small
can't need much, and what is large is read as far as it is what it says.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import weakref
from collections.abc import Generator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from . import errors
from .confined_child import STOP, TAKEN
from .errors import LogError, UndulogError
from .files import check_regular
from .packets import Packet, receive, send

_MIB = 1 << 20

_MEMORY = 640 * _MIB
"""Private memory that any file may take [byte]; with the parent's less than 1 GB in all."""

_MEMORY_A_BYTE = 8
"""More for each byte of the file: what it expands to, and a copy."""

_CPU_S, _CPU_S_A_MIB = 15, 6
"""Processor time that any file may take, and that for each MiB [s]; the slowest reader, that of BLF
by python-can, takes about 1 s for a MiB."""

_FILE_SIZE, _FILE_SIZE_A_BYTE = 1 << 30, 128
"""Largest file that a parser may write [byte]."""

_STILL_S = 120.0
"""A parser that neither computes nor reads for so long hangs, as on a disk that is away [s]."""

_LOOK_S = 5.0
"""Between two looks at what a silent parser does [s]."""

_END_S = 10.0
"""To wait for a child whose socket is closed already [s]."""

_STOP_S = 0.5
"""To wait for a parser that is asked to stop; starting another one takes as long [s]."""

_CODE = (
    "import sys; sys.path[:] = sys.argv[3:]; "
    f"from {__name__}_child import serve; serve(int(sys.argv[1]), int(sys.argv[2]))"
)

_MOST_THREADS = 4
"""Of Arrow, each with its stack; beyond this the parent is what takes the time."""

_EXPORT = "export or record it again"


@dataclass(frozen=True)
class ParserLimits:
    """What a parser may take.

    Attributes:
        memory: Private memory [byte]; mapped files and what was sent don't count.
        cpu_s: Processor time of all its threads [s].
        file_size: Of a file that it writes, and of a packet [byte].
    """

    memory: int
    cpu_s: int
    file_size: int

    @classmethod
    def of(cls, size: int) -> ParserLimits:
        """Return the limits for a file of so many bytes."""
        return cls(
            memory=_MEMORY + _MEMORY_A_BYTE * size,
            cpu_s=max(_CPU_S, _CPU_S_A_MIB * size // _MIB),
            file_size=max(_FILE_SIZE, _FILE_SIZE_A_BYTE * size),
        )


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of the files of a folder.

    Raises:
        OSError: If it isn't there or can't be read.
    """
    check_regular(path)
    if path.is_dir():
        return sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    return path.stat().st_size


class Confined:
    """Runs parsers in a child process, which is kept for the next one and ends with the object.

    A child that failed, or that doesn't stop where its packets are not all taken, is ended.
    """

    def __init__(self, kind: type[LogError]) -> None:
        """Start nothing yet.

        Args:
            kind: The error for a parser that ends by a signal, a limit or an exception.
        """
        self._kind = kind
        self._idle: list[_Child] = []
        self._finalizer = weakref.finalize(self, _end_all, self._idle)

    def stream(
        self, parser: str, path: Path, *, size: int | None = None, **options: Any
    ) -> Generator[Packet]:
        """Yield what a parser sends.

        Args:
            parser: ``module:function``; called with the path, a function that sends a packet, and
                the options.
            path: The file, which errors name.
            size: Its bytes, if it is a folder or one of several files.
            options: Values of JSON.

        Raises:
            LogError: If the parser ends by a signal, a limit, an exception or stands still; of the
                kind that was given.
            UndulogError: An error of the tree that it raises.
        """
        try:
            limits = ParserLimits.of(size_of(path) if size is None else size)
        except OSError as error:
            raise self._kind(path, f"can't be read: {error.strerror or error}") from error
        child = self._idle.pop() if self._idle else self._started(path)
        try:
            try:
                child.request(parser, path, limits, options)
            except OSError:  # it ended while it was idle
                child.end()
                child = self._started(path)
                child.request(parser, path, limits, options)
            while (packet := self._packet(child, path, limits)) is not None:
                yield packet
        finally:
            if child.stopped(limits):
                self._idle.append(child)
            else:
                child.end()

    def call(self, parser: str, path: Path, *, size: int | None = None, **options: Any) -> Packet:
        """Return the only packet that a parser sends; errors as of :meth:`stream`."""
        (packet,) = self.stream(parser, path, size=size, **options)
        return packet

    def close(self) -> None:
        """End the child."""
        _end_all(self._idle)

    def _started(self, path: Path) -> _Child:
        try:
            return _Child()
        except OSError as error:
            why = f"can't be read: no process can be started for it: {error.strerror or error}"
            raise self._kind(path, why) from error

    def _packet(self, child: _Child, path: Path, limits: ParserLimits) -> Packet | None:
        """Return the next packet, None at the end; raise what ended the parser."""
        try:
            packet = child.next(limits)
        except TimeoutError as error:
            why = f"its reader stood still for {_STILL_S:.0f} s; is its disk there?"
            raise self._kind(path, f"can't be read: {why}") from error
        except (ValueError, LookupError, TypeError, OSError) as error:
            raise self._kind(path, f"can't be read: its reader broke down: {error}") from error
        if packet is None:
            raise self._kind(path, _end_of(child.ended(), limits))
        if "end" not in packet.facts:
            child.taken()
            return packet
        failure = packet.facts["end"]
        child.is_free = failure.get("kind") != MemoryError.__name__  # it may hold what it took
        if failure:
            raise self._error(path, failure, limits)
        return None

    def _error(self, path: Path, failure: Mapping[str, Any], limits: ParserLimits) -> Exception:
        if failure["kind"] == MemoryError.__name__:
            return self._kind(path, _too_much_memory(limits))
        kind = getattr(errors, failure["kind"], None)
        if not (isinstance(kind, type) and issubclass(kind, UndulogError)):
            return self._kind(path, f"can't be read: {failure['text']}")
        error = kind.__new__(kind)
        Exception.__init__(error, failure["text"])
        state = {k: Path(v) if k == "path" else v for k, v in failure["state"].items()}
        error.__dict__.update(state)
        return error


def _end_of(code: int | None, limits: ParserLimits) -> str:
    """Return why a child that ended without an answer did so."""
    if code == -signal.SIGXCPU:
        return (
            f"takes more than {limits.cpu_s} s of processor time to read, too much for its size: "
            f"it is damaged; {_EXPORT}"
        )
    if code in {-signal.SIGKILL, -signal.SIGTERM}:
        return "can't be read: the process that read it was ended from outside; try again"
    if code is not None and code < 0:
        return f"is damaged: its reader was ended by {_name(-code)}; {_EXPORT}"
    return "can't be read: the process that read it ended early"


def _too_much_memory(limits: ParserLimits) -> str:
    return (
        f"takes more than {limits.memory // _MIB} MiB of memory to read, too much for its size: "
        f"it is damaged; {_EXPORT}"
    )


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _end_all(children: list[_Child]) -> None:
    while children:
        children.pop().end()


class _Child:
    """One child process, and the socket to it.

    Attributes:
        is_free: Whether it waits for a request.
    """

    def __init__(self) -> None:
        self.is_free = True
        self._owner = os.getpid()
        self._link, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        alive, self._alive = os.pipe2(os.O_CLOEXEC)
        try:
            self._process = subprocess.Popen(  # noqa: S603 - this interpreter
                _command(there.fileno(), alive),
                pass_fds=(there.fileno(), alive),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the parent, which ends the child
                env=_environment(),
            )
        except BaseException:
            self._link.close()
            os.close(self._alive)
            raise
        finally:
            there.close()
            os.close(alive)

    def request(
        self, parser: str, path: Path, limits: ParserLimits, options: Mapping[str, Any]
    ) -> None:
        facts = {"parser": parser, "path": str(path), "limits": asdict(limits), "options": options}
        self.is_free = False
        send(self._link, Packet(facts))

    def next(self, limits: ParserLimits) -> Packet | None:
        """Return the next packet; None if the child has ended.

        Raises:
            TimeoutError: If the child stands still.
            ValueError: If it is no packet.
            OSError: If the socket fails.
        """
        poller = select.poll()
        poller.register(self._link, select.POLLIN)
        still_s, before = 0.0, self._work()
        while not poller.poll(_LOOK_S * 1000):
            work = self._work()
            still_s, before = (0.0 if work != before else still_s + _LOOK_S), work
            if still_s >= _STILL_S:
                raise TimeoutError
        with suppress(ConnectionResetError):
            return receive(self._link, limits.file_size)
        return None

    def _work(self) -> tuple[str, ...]:
        """Return what changes while a process computes or reads: its times and bytes."""
        folder = Path(f"/proc/{self._process.pid}")
        try:
            times = folder.joinpath("stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            return (*times[11:13], folder.joinpath("io").read_text(encoding="utf-8"))
        except OSError:
            return ()

    def taken(self) -> None:
        """Let the parser go one packet further."""
        with suppress(OSError):  # it ended: the next packet is its end
            self._link.send(TAKEN)

    def stopped(self, limits: ParserLimits) -> bool:
        """Have the parser stop if it hasn't; return whether the child is of use again."""
        if self.is_free:
            return True
        poller = select.poll()
        poller.register(self._link, select.POLLIN)
        try:
            self._link.send(STOP)
            while poller.poll(_STOP_S * 1000) and (packet := receive(self._link, limits.file_size)):
                if "end" in packet.facts:
                    self.is_free = True
                    return True
        except (ValueError, LookupError, TypeError, OSError):
            return False
        return False

    def ended(self) -> int | None:
        """Return the exit code of a child that ends; None if it doesn't."""
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return None

    def end(self) -> None:
        """End it, whatever it does."""
        self._link.close()
        if self._alive >= 0:
            os.close(self._alive)
            self._alive = -1
        if os.getpid() == self._owner:  # a forked copy of the parent has no child
            self._process.kill()
            self._process.wait()


def _command(channel: int, alive: int) -> list[str]:
    """Return the command of the child: this interpreter and its modules, nothing else.

    Neither the environment nor the site's start-up files count, so that it starts fast and the same
    everywhere.
    """
    if not sys.executable:
        raise OSError("the path of the interpreter is not set (sys.executable)")
    root = str(Path(sys.modules[__name__.partition(".")[0]].__path__[0]).parent)
    modules = [str(Path(entry).absolute()) for entry in sys.path]
    flags = ["-I", "-S", "-W", "ignore", *(["-B"] if sys.dont_write_bytecode else [])]
    return [sys.executable, *flags, "-c", _CODE, str(channel), str(alive), *modules, root]


def _environment() -> dict[str, str]:
    """Return the environment: few threads, and memory that its limit counts."""
    threads = str(min(_MOST_THREADS, len(os.sched_getaffinity(0))))
    return {
        **os.environ,
        "OMP_NUM_THREADS": threads,  # Arrow's, too
        "ARROW_IO_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "ARROW_DEFAULT_MEMORY_POOL": "system",
        "MALLOC_ARENA_MAX": threads,
    }
