"""Whether a Parquet file of unknown state can be read: another process tries first.

A damaged file may end the process that reads it (an uncaught exception or a signal in pyarrow), or
ask for any amount of memory. The other process has limits and is kept for further files.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

_ROOM = 512 << 20
"""Address space of the process beyond what its imports take [byte]; batches take a fraction."""
_PATIENCE_S = 120.0
"""A file that takes longer is none that can be read [s]."""
_ROWS = 4096
"""Rows that are decoded at a time."""
_MOST_TEXT = 300
"""Characters of pyarrow's reason."""


class ParquetTrial:
    """A process that reads Parquet files to find out whether they can be read."""

    def __init__(self) -> None:
        """Start none yet: it starts with the first file."""
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    def __del__(self) -> None:
        """End the process."""
        with suppress(Exception):
            self._end()

    def fault(self, data: bytes) -> str:
        """Return why a Parquet file can't be read, or an empty text.

        Args:
            data: Its bytes.
        """
        is_new = self._connection is None
        why = self._answer(data)
        if why and not is_new:  # a file before it may have damaged the process
            why = self._answer(data)
        return why

    def _answer(self, data: bytes) -> str:
        """Return the fault of a file; a process that found one is not used again."""
        connection = self._connection or self._start()
        try:
            connection.send_bytes(data)
            if not connection.poll(_PATIENCE_S):
                why = f"reading it takes over {_PATIENCE_S:.0f} s"
            else:
                why = connection.recv_bytes().decode(errors="replace")
        except (EOFError, OSError):
            why = "reading it ends the process that does"
        if why:
            self._end()
        return why

    def _start(self) -> Connection:
        connection, other = Pipe()
        self._connection = connection
        # The system's allocator takes what is asked for, not a large piece in advance.
        environment = os.environ | {"ARROW_DEFAULT_MEMORY_POOL": "system"}
        with other:
            self._process = subprocess.Popen(  # noqa: S603  our own arguments
                [sys.executable, "-P", "-m", __name__, str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # the last words of a process that a file ended
                pass_fds=[other.fileno()],
                env=environment,
                process_group=0,  # a Ctrl-C ends it through us
            )
        return connection

    def _end(self) -> None:
        connection, process = self._connection, self._process
        self._connection = self._process = None
        if connection is not None:
            connection.close()
        if process is not None:
            process.kill()
            process.wait()


def main(handle: int) -> None:
    """Read files that come over a connection, and answer each with its fault."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrow: Any = pa
    parquet: Any = pq
    arrow.set_cpu_count(1)
    arrow.set_io_thread_count(1)
    connection = Connection(handle)
    while True:
        try:
            data = connection.recv_bytes()
        except (EOFError, OSError):
            return
        _limit(2 * len(data) + _ROOM)
        try:
            _read(arrow, parquet, data)
            why = ""
        except (arrow.ArrowException, OSError, ValueError, MemoryError) as error:
            why = " ".join(str(error).split())[:_MOST_TEXT] or type(error).__name__
        connection.send_bytes(why.encode())


def _limit(room: int) -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    size, most = pages * resource.getpagesize() + room, resource.getrlimit(resource.RLIMIT_AS)[1]
    size = size if most == resource.RLIM_INFINITY else min(size, most)
    resource.setrlimit(resource.RLIMIT_AS, (size, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _read(arrow: Any, parquet: Any, data: bytes) -> None:
    file = parquet.ParquetFile(arrow.BufferReader(data))
    for batch in file.iter_batches(_ROWS, use_threads=False):
        batch.validate(full=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
