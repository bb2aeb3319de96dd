"""Part files: what a file is written as until it is whole.

``OUTPUT.part`` lies beside its output and gets the output's name when it is whole, so that a kill
leaves nothing torn under a final name. The part file of a recorder is the data itself and is never
replaced by other commands; the one of any other command can be made again.

In a folder that others may write to, a link may be planted under the name of a part file. So it is
created exclusively, and no link is followed.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SUFFIX = ".part"
"""Appended to the name of the output."""

NEW_FILE = os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
"""Flags of ``open`` for a file that must not be there, nor a link of its name."""

_SESSION = ".mcap"
_WAL = ".wal"
_NUMBERED = re.compile(r".+(_(mark)?\d{4,}|\.rescued-[0-9a-f]{8})", re.DOTALL)
"""Stems that a recorder gives to later parts, to marks and to rescue files."""

_TRIES = 8
"""Names that are tried; all but the first are random."""

_AT_FDCWD = -100
_RENAME_NOREPLACE = 1
_NOT_SUPPORTED = frozenset({errno.EINVAL, errno.ENOSYS, errno.ENOTSUP})


def unfinished_path(output: Path) -> Path:
    """Return the part file of an output, e.g. ``run.mcap.part``."""
    return output.with_name(output.name + SUFFIX)


def finished_path(path: Path) -> Path:
    """Return the output of a part file; any other path as it is."""
    return path.with_name(path.name.removesuffix(SUFFIX))


def stored_path(output: Path) -> Path:
    """Return the file that has an output's data: the output, or its part file if only that exists.

    Neither need exist: then it is the output.
    """
    part = unfinished_path(output)
    return part if not output.exists() and part.is_file() else output


def is_recorders(part: Path) -> bool:
    """Return whether the name of a part file is that of a recorder's: a session, part or mark.

    Others can be made again. A recorder's has a write-ahead log beside it, or a number.
    """
    output = finished_path(part)
    if output == part or output.suffix.lower() != _SESSION:
        return False
    return bool(_NUMBERED.fullmatch(output.stem)) or output.with_name(output.name + _WAL).is_dir()


def recording_left(output: Path) -> Path | None:
    """Return what an unfinished recording of this name has left; None if there is nothing."""
    part, wal = unfinished_path(output), output.with_name(output.name + _WAL)
    if not is_recorders(part):
        return None
    return part if part.exists() else wal if wal.is_dir() else None


def present_path(opened: int, path: Path) -> Path | None:
    """Return where an open file is now; None if no name leads to it any more.

    Args:
        opened: Its descriptor.
        path: Where it was made, which is asked first.
    """
    facts = os.fstat(opened)
    with suppress(OSError):
        if os.path.samestat(path.lstat(), facts):
            return path
    with suppress(OSError):  # without /proc only its own place is looked at
        now = Path(os.readlink(f"/proc/self/fd/{opened}"))  # noqa: PTH115 - as it is
        if os.path.samestat(now.lstat(), facts):
            return now
    return None


def remove_opened(opened: int, path: Path) -> None:
    """Remove an open file where it is now, and no other that has its name."""
    where = present_path(opened, path)
    if where is not None:
        with suppress(OSError):  # another program may have removed it
            where.unlink()


def rescue_folders(folder: Path) -> Iterator[Path]:
    """Yield where a rescue file may go if a folder is lost: above it, then the temporary files.

    Args:
        folder: Its absolute path.
    """
    above = next((parent for parent in folder.parents if parent.is_dir()), None)
    if above is not None:
        yield above
    with suppress(OSError):  # there is none that can be written
        yield Path(tempfile.gettempdir())


def sync_folder(folder: Path) -> None:
    """Write a folder's entries to the disk, so that a new file's name survives power loss.

    Raises:
        OSError: If the disk fails.
    """
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def publish(part: Path, output: Path, *, replace: bool) -> None:
    """Give a synced part file its final name, and sync the folder.

    Args:
        replace: Whether a file of that name is replaced.

    Raises:
        FileExistsError: If there is one and it may not be replaced; the part file stays.
        OSError: If the disk fails.
    """
    if replace:
        part.replace(output)
    else:
        _rename_new(part, output)
    sync_folder(output.parent)


def publish_durably(part: Path, output: Path, *, replace: bool) -> None:
    """Sync a part file that is closed, then :func:`publish` it."""
    opened = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
    publish(part, output, replace=replace)


@contextmanager
def claimed_part(output: Path) -> Generator[Path]:
    """Create an empty part file that no other process uses, for writers that open it by name.

    It is ``OUTPUT.part``, or ``OUTPUT.RANDOM.part`` where another process writes that one, it is a
    recorder's, or it is not this user's. One that a killed command left is replaced.

    Yields:
        The part file; it is not removed.

    Raises:
        OSError: If none can be created.
    """
    part, opened = _claimed(output)
    try:
        yield part
    finally:
        os.close(opened)


def _claimed(output: Path) -> tuple[Path, int]:
    """Create and lock a part file; return it and its descriptor."""
    part, failure = unfinished_path(output), None
    for _ in range(_TRIES):
        try:
            opened = os.open(part, os.O_RDWR | NEW_FILE, 0o666)
        except FileExistsError as error:
            failure = error
            if part == unfinished_path(output) and _removed_abandoned(part, output):
                continue
        else:
            if _is_ours(part, opened):
                return part, opened
            os.close(opened)
        part = output.with_name(f"{output.name}.{os.urandom(4).hex()}{SUFFIX}")
    raise failure or FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(part))


def _is_ours(part: Path, opened: int) -> bool:
    """Lock a new part file; False if another process took it for an abandoned one before."""
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: the exclusive creation has to do
        return True
    with suppress(OSError):
        return os.path.samestat(part.lstat(), os.fstat(opened))
    return False


def _removed_abandoned(part: Path, output: Path) -> bool:
    """Remove a part file that a killed command of this user left; return whether it was one."""
    if recording_left(output) == part:
        return False
    try:
        opened = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        facts = os.fstat(opened)
        if not stat.S_ISREG(facts.st_mode) or facts.st_uid != os.geteuid():
            return False
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(part.lstat(), facts):
            part.unlink()
    except OSError:  # locked: its writer is alive; or gone, or without locks
        return False
    finally:
        os.close(opened)
    return True


def _rename_new(source: Path, target: Path) -> None:
    """Rename a file to a name that must not be there."""
    import ctypes  # takes a tenth of the start of a command

    libc = ctypes.CDLL(None, use_errno=True)
    rename = getattr(libc, "renameat2", None)  # glibc 2.28; not every C library has it
    if rename is not None:
        names = os.fsencode(source), os.fsencode(target)
        if not rename(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_NOREPLACE):
            return
        code = ctypes.get_errno()
        if code not in _NOT_SUPPORTED:
            raise OSError(code, os.strerror(code), str(source), None, str(target))
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
    source.rename(target)
