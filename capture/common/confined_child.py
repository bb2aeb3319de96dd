"""The child process of :mod:`.capture.common.confined`: runs parsers under limits.

It ends when its parent does: it holds the end of a pipe that the parent never writes to, and the
kernel sends it SIGKILL when the other end is closed. (PR_SET_PDEATHSIG would end it with the thread
that started it.)
"""

from __future__ import annotations

import fcntl
import os
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

from .errors import UndulogError
from .packets import Packet, receive, send

Send: TypeAlias = Callable[[Packet], None]
"""Hands a packet to the parent; waits while :data:`AHEAD` of them are not taken."""

TAKEN, STOP = b"+", b"x"
"""Messages of the parent: a packet was taken; no more are wanted."""

AHEAD = 2
"""Packets that a parser may be ahead of the parent: one to take, one to fill meanwhile."""

LARGEST_REQUEST = 1 << 24
"""Bytes of a request: a path, and the names of a few thousand columns."""

_F_SETSIG = 10  # <fcntl.h>; the module has no name for it


def serve(channel: int, alive: int) -> None:
    """Run the parsers that the parent requests, until it closes its end.

    Args:
        channel: Descriptor of the socket for packets.
        alive: Descriptor of the end of a pipe that the parent holds open.
    """
    _end_with(alive)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with socket.socket(fileno=channel) as link:
        while (request := receive(link, LARGEST_REQUEST, skip=True)) is not None:
            send(link, Packet({"end": _answer(request.facts, _Sender(link))}))


def _end_with(alive: int) -> None:
    """Have the kernel end this process when the other end of a pipe is closed."""
    fcntl.fcntl(alive, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(alive, _F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(alive, fcntl.F_SETFL, fcntl.fcntl(alive, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([alive], [], [], 0)[0]:  # it was closed before
        sys.exit()


class _Stopped(BaseException):
    """The parent wants no more packets; not to be caught by a parser."""


class _Sender:
    """Sends packets, a few ahead of those that the parent has taken."""

    def __init__(self, link: socket.socket) -> None:
        self._link, self._left = link, AHEAD

    def __call__(self, packet: Packet) -> None:
        while not self._left:
            if self._link.recv(1) != TAKEN:
                raise _Stopped
            self._left += 1
        self._left -= 1
        send(self._link, packet)


def _answer(facts: Any, sender: _Sender) -> dict[str, Any]:
    """Run a parser; return its error for the parent, empty if there was none."""
    _limit(facts["limits"])
    module, _, name = facts["parser"].partition(":")
    failure: dict[str, Any] = {}
    try:
        getattr(import_module(module), name)(Path(facts["path"]), sender, **facts["options"])
    except MemoryError:
        failure = {"kind": MemoryError.__name__}
    except UndulogError as error:
        if isinstance(error.__cause__, MemoryError):
            return {"kind": MemoryError.__name__}
        kept = {k: str(v) for k, v in vars(error).items() if isinstance(v, str | Path)}
        failure = {"kind": type(error).__name__, "text": str(error), "state": kept}
    except Exception as error:  # noqa: BLE001 - libraries raise anything; the parent reports it
        text = " ".join(str(error).split())
        failure = {"kind": "", "text": f"{type(error).__name__}: {text}"}
    except _Stopped:
        pass
    return failure


def _limit(limits: Any) -> None:
    """Set the limits of a request: memory [byte], processor time [s], size of a file [byte]."""
    spent = time.clock_gettime(time.CLOCK_PROCESS_CPUTIME_ID)
    _lower(resource.RLIMIT_DATA, limits["memory"])
    _lower(resource.RLIMIT_CPU, int(spent) + 1 + limits["cpu_s"])
    _lower(resource.RLIMIT_FSIZE, limits["file_size"])


def _lower(which: int, value: int) -> None:
    _, hard = resource.getrlimit(which)
    resource.setrlimit(which, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
