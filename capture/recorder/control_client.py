"""A client of the control socket: for the command line, and for controllers that log their gait.

A controller keeps its connection::

    with ControlClient(path) as recorder:
        recorder.ask({"do": "gait", "values": {"horizontal.A": 0.4, "horizontal.omega": 3.1}})
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import stat
import tempfile
import time
import zlib
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self, cast

from ..common.errors import ControlError, SocketInUseError
from ..common.files import listen_at

_SUFFIX = ".sock"
_LONGEST_PATH = 107  # bytes of sun_path, less the closing zero
_SYSTEM_FOLDER = Path("/run/undulog")

LOCK_PATIENCE_S = 2.0
"""Longest wait for another recorder that makes its socket in the same folder [s]."""

Identity = tuple[int, int]
"""Device and inode of a socket file."""

PATIENCE_S = 10.0
"""Default time limit of a reply [s]: a recorder answers within a few ticks."""


def socket_folder(environ: Mapping[str, str]) -> Path:
    """Return the folder of the sockets of all recorders of this user.

    Returns:
        ``$RUNTIME_DIRECTORY`` (a service: below ``/run/undulog``), else
        ``$XDG_RUNTIME_DIR/undulog``, else ``undulog-UID`` among the temporary files.
    """
    if service := environ.get("RUNTIME_DIRECTORY"):
        return Path(service.split(":", 1)[0])
    session = environ.get("XDG_RUNTIME_DIR")
    if session and Path(session).is_dir():
        return Path(session) / "undulog"
    return Path(tempfile.gettempdir()) / f"undulog-{os.getuid()}"


def default_sockets(output: Path, environ: Mapping[str, str]) -> tuple[Path, Path]:
    """Return the default sockets of a recording, named after its output; make their folder.

    Returns:
        The path, e.g. ``/run/user/1000/undulog/run.sock``, and a second one in case that a recorder
        into another folder listens there, e.g. ``run-1c291ca3.sock``.

    Raises:
        ControlError: If the folder can't be made, or is another user's.
    """
    folder = socket_folder(environ)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise ControlError(f"{folder}: no folder for the control socket: {error}") from error
    if not _is_own(folder):
        raise ControlError(f"{folder}: not a folder of this user; name a socket with --socket")
    number = zlib.crc32(os.fsencode(output.absolute()))
    stem = output.stem
    return folder / f"{stem}{_SUFFIX}", folder / f"{stem}-{number:08x}{_SUFFIX}"


def find_sockets(environ: Mapping[str, str]) -> list[Path]:
    """Return the control sockets of the running recorders of this user and of services, sorted."""
    folder = socket_folder(environ)
    folders = [folder, _SYSTEM_FOLDER] if _is_own(folder) else [_SYSTEM_FOLDER]
    sockets = {path for where in folders for path in _sockets_below(where)}
    return sorted(path for path in sockets if _is_in_use(path))


def _is_own(folder: Path) -> bool:
    """Whether a folder is this user's: among the temporary files another user may have made it."""
    try:
        facts = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid()


def listen(
    path: Path, *, backlog: int, patience_s: float = LOCK_PATIENCE_S
) -> tuple[socket.socket, Identity]:
    """Make a non-blocking socket that only this user can connect to, from its first moment.

    The stale socket of a killed recorder is replaced; a lock on the folder keeps two recorders from
    replacing each other's.

    Args:
        backlog: Number of callers that may wait.
        patience_s: Longest wait for the lock [s].

    Raises:
        SocketInUseError: If another recorder listens there.
        ControlError: If another file is there, or the socket can't be made.
    """
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise ControlError(
            f"{path}: a socket's path has at most {_LONGEST_PATH} bytes; give a shorter --socket"
        )
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _locked(path.parent, patience_s):
            _remove_stale(path)
            listen_at(listener, path, backlog)
            status = path.lstat()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise ControlError(f"{path}: no control socket can be made: {error}") from error
    except ControlError:
        listener.close()
        raise
    return listener, (status.st_dev, status.st_ino)


def release(path: Path, listener: socket.socket, identity: Identity) -> None:
    """Close the socket and remove its file, unless that was replaced."""
    with suppress(OSError):  # removed with its folder
        status = path.lstat()
        if (status.st_dev, status.st_ino) == identity:
            path.unlink()
    listener.close()


def _remove_stale(path: Path) -> None:
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(status.st_mode):
        raise ControlError(f"{path} is there and no socket; name another with --socket")
    if _is_in_use(path):
        raise SocketInUseError(
            f"{path}: another recorder listens there; end it, or name another with --socket"
        )
    path.unlink()


def _is_in_use(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
        caller.setblocking(False)
        # A full backlog (EAGAIN) and another user's socket (EACCES) are in use too.
        return caller.connect_ex(os.fspath(path)) not in (errno.ECONNREFUSED, errno.ENOENT)


def _sockets_below(folder: Path) -> list[Path]:
    """Return the sockets in a folder and in its folders (of services)."""
    paths: list[Path] = []
    for pattern in (f"*{_SUFFIX}", f"*/*{_SUFFIX}"):
        with suppress(OSError):  # no such folder, or not readable
            paths += [path for path in folder.glob(pattern) if path.is_socket()]
    return paths


@contextmanager
def _locked(folder: Path, patience_s: float) -> Generator[None]:
    """Hold the folder's lock, which the kernel releases if the process dies."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        deadline = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.01)
        yield
    finally:
        os.close(handle)


class ControlClient:
    """One connection to a running recorder."""

    def __init__(self, path: Path, *, patience_s: float = PATIENCE_S) -> None:
        """Connect.

        Args:
            patience_s: Longest wait for a reply [s].

        Raises:
            ControlError: If no recorder listens there, or the socket is another user's.
        """
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(patience_s)
        self._buffer = bytearray()
        try:
            self._socket.connect(os.fspath(path))
        except OSError as error:
            self._socket.close()
            absent = isinstance(error, FileNotFoundError | ConnectionRefusedError)
            reason = "no recorder listens there" if absent else f"can't be reached: {error}"
            raise ControlError(f"{path}: {reason}") from error

    def __enter__(self) -> Self:
        """Return the connected client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.close()

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send one request and wait for its reply.

        Args:
            request: See :mod:`.capture.recorder.control_requests`.

        Returns:
            The reply without its ``ok``.

        Raises:
            ControlError: If the recorder refuses, exceeds the time limit, or ends before its reply.
        """
        return self.ask_all([request])[0]

    def ask_all(self, requests: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Send several requests at once, as a recorder answers once a tick, and wait.

        Args:
            requests: As for :meth:`ask`; some 100 at most, so that neither side's buffer is full
                before the other one reads.

        Returns:
            The replies without their ``ok``, in order.

        Raises:
            ControlError: As :meth:`ask`.
        """
        lines = [json.dumps(request, allow_nan=False).encode() + b"\n" for request in requests]
        try:
            self._socket.sendall(b"".join(lines))
            while self._buffer.count(b"\n") < len(lines):
                data = self._socket.recv(65536)
                if not data:
                    raise ControlError(f"{self.path}: the recorder went before it had answered")
                self._buffer += data
        except TimeoutError as error:
            patience_s = self._socket.gettimeout()
            self.close()  # a late answer would be taken for that to the next request
            raise ControlError(f"{self.path}: no answer in {patience_s:g} s") from error
        except OSError as error:
            raise ControlError(f"{self.path}: the recorder went: {error}") from error
        *answers, rest = bytes(self._buffer).split(b"\n", len(lines))
        self._buffer = bytearray(rest)
        replies = [self._read(answer) for answer in answers]
        for reply in replies:
            if not reply.pop("ok"):
                raise ControlError(str(reply.get("error", "refused")))
        return replies

    def _read(self, line: bytes) -> dict[str, Any]:
        """Parse a reply."""
        try:
            reply = cast("dict[str, Any]", json.loads(line))
            reply["ok"] = bool(reply["ok"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise ControlError(f"{self.path}: what answers there is no recorder") from error
        return reply

    def close(self) -> None:
        """Disconnect; safe to call twice."""
        self._socket.close()
