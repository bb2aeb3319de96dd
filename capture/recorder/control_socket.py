"""Where the control socket is, and how it comes to be there with the right rights at once."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import stat
import tempfile
import time
import zlib
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from ..common.errors import ControlError, SocketInUseError

_SUFFIX = ".sock"
_LONGEST_PATH = 107  # bytes of sun_path, less the closing zero
_SYSTEM_FOLDER = Path("/run/undulog")

LOCK_PATIENCE_S = 2.0
"""Longest wait for another recorder that makes its socket in the same folder [s]."""

Identity = tuple[int, int]
"""Device and inode of a socket file."""


def socket_folder(environ: Mapping[str, str]) -> Path:
    """Where a recorder puts its socket: one folder a user, so that a client finds them all.

    Args:
        environ: The environment.

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
    """The usual sockets of a recording, named after its output; makes the folder.

    Args:
        output: The session.
        environ: The environment.

    Returns:
        The path, e.g. ``/run/user/1000/undulog/run.sock``, and the one to use where a recorder
        into another folder listens there, e.g. ``run-1c291ca3.sock``.

    Raises:
        ControlError: If the folder can't be made, or is another user's.
    """
    folder = socket_folder(environ)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ControlError(f"{folder}: no folder for the control socket: {error}") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise ControlError(f"{folder}: not a folder of this user; name a socket with --socket")
    number = zlib.crc32(os.fsencode(output.absolute()))
    stem = output.stem
    return folder / f"{stem}{_SUFFIX}", folder / f"{stem}-{number:08x}{_SUFFIX}"


def find_sockets(environ: Mapping[str, str]) -> list[Path]:
    """The control sockets of running recorders that this user can see.

    Args:
        environ: The environment.

    Returns:
        Those where somebody listens, sorted; of this user, and of services.
    """
    folder = socket_folder(environ)
    found = {path for where in (folder, _SYSTEM_FOLDER) for path in _sockets_below(where)}
    return sorted(path for path in found if _somebody_listens(path))


def listen(
    path: Path, *, backlog: int, patience_s: float = LOCK_PATIENCE_S
) -> tuple[socket.socket, Identity]:
    """Make a socket that only this user can reach, from its first moment.

    A stale one, left by a recorder that was killed, is replaced; a lock on the folder keeps two
    recorders from replacing each other's.

    Args:
        path: Where.
        backlog: How many callers may wait.
        patience_s: Longest wait for another recorder that is at it just now [s].

    Returns:
        The non-blocking socket, and what its file is, for :func:`release`.

    Raises:
        SocketInUseError: If somebody listens there.
        ControlError: If it is no socket, or it can't be made.
    """
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise ControlError(
            f"{path}: a socket's path has at most {_LONGEST_PATH} bytes; give a shorter --socket"
        )
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _locked(path.parent, patience_s):
            _remove_stale(path)
            before = os.umask(0o177)
            try:
                listener.bind(os.fspath(path))
            finally:
                os.umask(before)
            listener.listen(backlog)
            found = path.lstat()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise ControlError(f"{path}: no control socket can be made: {error}") from error
    except ControlError:
        listener.close()
        raise
    return listener, (found.st_dev, found.st_ino)


def release(path: Path, listener: socket.socket, identity: Identity) -> None:
    """Close the socket and remove its file, if that is still ours.

    Args:
        path: The file.
        listener: The socket.
        identity: What :func:`listen` said of it.
    """
    with suppress(OSError):  # a folder that has gone took the file along
        found = path.lstat()
        if (found.st_dev, found.st_ino) == identity:
            path.unlink()
    listener.close()


def _remove_stale(path: Path) -> None:
    try:
        found = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode):
        raise ControlError(f"{path} is there and no socket; name another with --socket")
    if _somebody_listens(path):
        raise SocketInUseError(
            f"{path}: another recorder listens there; end it, or name another with --socket"
        )
    path.unlink()


def _somebody_listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
        caller.setblocking(False)
        # A full backlog (EAGAIN) and another user's socket (EACCES) are somebody's too.
        return caller.connect_ex(os.fspath(path)) not in (errno.ECONNREFUSED, errno.ENOENT)


def _sockets_below(folder: Path) -> list[Path]:
    """Sockets in a folder and the folders in it (a service has one each)."""
    found: list[Path] = []
    for pattern in (f"*{_SUFFIX}", f"*/*{_SUFFIX}"):
        with suppress(OSError):  # a folder that is not there, or not ours to read
            found += [path for path in folder.glob(pattern) if path.is_socket()]
    return found


@contextmanager
def _locked(folder: Path, patience_s: float) -> Generator[None]:
    """Hold the folder's lock; it goes with the process, whatever becomes of that."""
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
