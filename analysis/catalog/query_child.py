"""The process that runs queries over catalogues, under limits of memory and processor time."""

from __future__ import annotations

import os
import pickle
import resource
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from undulog.capture.common.errors import UndulogError, UsageError

from .catalog import Catalog
from .queries import CPU_S, TOO_LARGE, Refused

_ROOM = 1000 << 20
"""Address space beyond what the process takes at its start [byte]; a database takes 400 MB of it
without using them."""


def main(handle: int) -> None:
    """Run the queries that come over a connection, until it ends."""
    import duckdb

    duckdb.execute("select 1").df()  # imports what the limits needn't hold
    _limit_memory()
    connection = Connection(handle)
    catalogs: dict[str, Catalog] = {}
    while True:
        try:
            request = pickle.loads(connection.recv_bytes())  # noqa: S301  of our own process
        except (EOFError, OSError):
            return
        where, query, environment = request
        if environment != os.environ:  # a catalogue's server and keys may be others now
            os.environ.clear()
            os.environ.update(environment)
            catalogs.clear()
        answer: Any
        try:
            if where not in catalogs:
                catalogs[where] = Catalog(where)
            _limit_time()
            answer = catalogs[where].sql_here(query)
            packed = pickle.dumps(answer, protocol=5)
        except MemoryError:
            packed = pickle.dumps(Refused(UsageError.__name__, "", f"DuckDB: {TOO_LARGE}"))
        except UndulogError as error:
            path = str(getattr(error, "path", ""))
            packed = pickle.dumps(Refused(type(error).__name__, path, str(error)))
        connection.send_bytes(packed)


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    size = pages * resource.getpagesize() + _ROOM
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    size = size if most == resource.RLIM_INFINITY else min(size, most)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _limit_time() -> None:
    used = os.times()
    until = int(used.user + used.system) + 1 + CPU_S
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    until = until if most == resource.RLIM_INFINITY else min(until, most)
    resource.setrlimit(resource.RLIMIT_CPU, (until, most))
