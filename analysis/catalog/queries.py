"""Queries of a catalogue in a process of their own, with limits of memory and processor time.

A query is text of any origin. DuckDB bounds what it sorts and joins, but not single values
(``repeat('x', 2000000000)``), and can't be interrupted in them; so the operating system bounds the
process. In it nothing but the catalogue's files can be read, and nothing written.
"""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection, Pipe
from threading import Lock
from typing import Any

from undulog.capture.common import errors
from undulog.capture.common.errors import InputFileError, UndulogError, UsageError

CPU_S = 15
"""Processor time of a query [s]; one over a million sessions takes less than one."""
_RELEASE_S = 30.0
"""Longest wait for a process that the kernel is ending [s]."""
_LONGEST = 100_000
"""Characters of a query."""
_PROGRAM = f"import sys; from {__package__}.query_child import main; main(int(sys.argv[1]))"
"""Of the process: it imports this package anew, and so no state of this process."""
TOO_LARGE = "the query takes too much memory; ask for fewer rows or columns"
_TOO_LONG = f"the query takes over {CPU_S} s of processor time; make it simpler"


@dataclass(frozen=True)
class Refused:
    """An error of the process, which as such can't travel between processes.

    Attributes:
        kind: Name of its class.
        path: Of the file that it is about, or empty.
    """

    kind: str
    path: str
    text: str

    def error(self) -> UndulogError:
        """Return it as it was raised, as far as a caller tells errors apart."""
        kind: Any = getattr(errors, self.kind, UndulogError)
        if issubclass(kind, InputFileError):
            return kind(self.path, self.text.removeprefix(f"{self.path}: "))
        return UsageError(self.text) if issubclass(kind, UsageError) else UndulogError(self.text)


class QueryProcess:
    """The process that runs queries; one for this process, started with the first query."""

    def __init__(self) -> None:
        """Start none yet."""
        self._lock = Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    def run(self, where: str, query: str) -> Any:
        """Run a query over a catalogue.

        Args:
            where: The catalogue's folder or URL.

        Returns:
            A ``pandas.DataFrame``.

        Raises:
            UsageError: If it isn't one query, DuckDB can't run it, or it takes too much memory or
                time.
            UndulogError: As :meth:`.catalog.Catalog.sql`.
        """
        if len(query) > _LONGEST:
            raise UsageError(f"DuckDB: a query of {len(query)} characters, over {_LONGEST}")
        with self._lock:
            # Names of servers and keys may have changed since the last one.
            answer = self._ask(pickle.dumps((where, query, dict(os.environ))))
            if isinstance(answer, Refused) and TOO_LARGE in answer.text:
                self._end()  # it may not return the memory that it has taken
        if isinstance(answer, Refused):
            raise answer.error()
        return answer

    def end(self) -> None:
        """End the process; another one starts with the next query."""
        self._end()

    def _ask(self, request: bytes) -> Any:
        connection, whole = self._connection or self._start(), False
        try:
            connection.send_bytes(request)
            answer = connection.recv_bytes()
            whole = True
        except (EOFError, OSError):
            # It is ending; on a busy computer the kernel takes its time to release its memory.
            return Refused(UsageError.__name__, "", f"DuckDB: {self._end(_RELEASE_S)}")
        finally:
            if not whole:  # also where the user ends it
                self._end()
        return pickle.loads(answer)  # noqa: S301  of our own process

    def _start(self) -> Connection:
        connection, other = Pipe()
        self._connection = connection
        with other:
            self._process = subprocess.Popen(  # noqa: S603  our own arguments
                [sys.executable, "-P", "-c", _PROGRAM, str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # of a process that a limit ended
                pass_fds=[other.fileno()],
                process_group=0,  # a Ctrl-C ends it through us
            )
        return connection

    def _end(self, patience_s: float = 1.0) -> str:
        """End the process, which has some time to do so itself; return why it has ended."""
        connection, process = self._connection, self._process
        self._connection = self._process = None
        if connection is not None:
            connection.close()
        if process is None:
            return TOO_LARGE
        try:
            code = process.wait(patience_s)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        return _TOO_LONG if code == -signal.SIGXCPU else TOO_LARGE


@cache
def query_process() -> QueryProcess:
    """Return the process that runs the queries of this process."""
    process = QueryProcess()
    atexit.register(process.end)
    return process
