"""Files: read whole, written whole or not at all, and those that come with the package.

A spreadsheet takes text in a CSV that begins with ``=``, ``+``, ``-`` or ``@`` for a formula. So in
every CSV file text that begins with such a character, with a tab, a line end or an apostrophe has
an apostrophe before it, and only there: take one leading apostrophe away to have the text. Numbers
are never changed.
"""

from __future__ import annotations

import csv
import errno
import math
import os
import stat
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO

from .console import refuse_existing
from .errors import (
    DescriptionFault,
    FaultyFileError,
    InputFileError,
    LogWriteError,
    OutputExistsError,
    UndulogError,
    UsageError,
)
from .part_files import claimed_part, publish_durably

if TYPE_CHECKING:
    import socket
    from importlib.resources.abc import Traversable

    from .arrays import FloatArray
    from .process import StopRequest

_KINDS = (
    (stat.S_ISFIFO, "named pipe"),
    (stat.S_ISSOCK, "socket"),
    (stat.S_ISCHR, "device"),
    (stat.S_ISBLK, "device"),
)

_OPEN_PIPES = ("/dev/stdin", "/dev/fd/", "/proc/self/fd/")
"""Paths of descriptors that are open already, as a shell passes them: ``<(command)``."""

_FORMULA = tuple("=+-@\t\r\n'＝＋－＠")
"""How text begins that a spreadsheet may run, and the apostrophe that marks it as text."""


def is_file(path: Path) -> bool:
    """Return whether a path is that of a file, also if the file system rejects its name."""
    try:
        return path.is_file()
    except OSError:  # too long
        return False


def check_regular(path: Path | str) -> None:
    """Refuse what is neither file nor folder, before it is opened.

    A pipe without a writer is waited for without end, and a device may have no end.

    Raises:
        OSError: If it is none; its text says what it is. Also if it isn't there.
    """
    mode = os.stat(path).st_mode  # noqa: PTH116 - of a text, too
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), None)
    if kind is not None:
        raise OSError(errno.EINVAL, f"it is a {kind}, not a file", str(path))


def why_no_file(path: Path) -> str:
    """Return what to report of a path at which no file can be read."""
    try:
        check_regular(path)
    except FileNotFoundError:
        return "no such file"
    except (OSError, ValueError) as error:
        return f"can't be read: {getattr(error, 'strerror', None) or error}"
    return "no such file"


def read_input(path: Path) -> bytes:
    """Read a file that the user named, or a pipe that a shell opened for it.

    Raises:
        InputFileError: If it isn't there or can't be read.
    """
    try:
        if not (str(path).startswith(_OPEN_PIPES) and path.is_fifo()):
            check_regular(path)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputFileError(path, "no such file") from error
    except OSError as error:
        raise InputFileError(path, f"can't be read: {error.strerror or error}") from error


@dataclass(frozen=True)
class Description:
    """The text of a description and where it comes from."""

    text: str
    source: Path
    folder: Traversable


@dataclass(frozen=True)
class Shelf:
    """One kind of description.

    Attributes:
        kind: What it is called in messages, e.g. ``robot``.
        package: The package that ships them.
        folder: The folder in that package.
        error: Raised for a file that is no text.
    """

    kind: str
    package: str
    folder: str
    error: type[FaultyFileError]

    def names(self) -> tuple[str, ...]:
        """Return names of the shipped ones, sorted."""
        entries = (Path(entry.name) for entry in self._place().iterdir())
        return tuple(sorted(entry.stem for entry in entries if entry.suffix == ".toml"))

    def read(self, name_or_path: str | Path) -> Description:
        """Read a shipped description by name, or a file by path.

        Raises:
            UsageError: If there is none of that name.
            InputFileError: If it is a path, and the file isn't there or can't be read.
            FaultyFileError: If the file is not UTF-8 (the shelf's own kind of it).
        """
        if str(name_or_path) in self.names():
            place = self._place()
            text = (place / f"{name_or_path}.toml").read_text(encoding="utf-8")
            return Description(text, Path(f"{name_or_path}.toml"), place)
        path = Path(name_or_path)
        is_path = bool(path.suffix) or len(path.parts) > 1
        if not is_path and not is_file(path):
            from .strict_table import listed

            near = listed(self.names(), str(name_or_path))
            raise UsageError(f"no {self.kind} {str(name_or_path)!r}: not a file, nor one of {near}")
        try:
            return Description(read_input(path).decode("utf-8"), path, path.parent)
        except UnicodeDecodeError as error:
            fault = DescriptionFault(f"byte {error.start}", "not UTF-8", "TOML is UTF-8 text")
            raise self.error(path, [fault]) from error

    def _place(self) -> Traversable:
        from importlib import resources

        return resources.files(self.package) / self.folder


class Closing:
    """What is closed when its ``with`` block is left, also by an exception."""

    def __enter__(self) -> Self:
        """Return the object itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Release what it holds."""
        raise NotImplementedError


def check_output(output: Path, endings: Iterable[str], why: str, *, force: bool) -> None:
    """Check an output path before any work is done.

    Args:
        endings: Any of which its name must have.
        why: Message if it has none of them.
        force: Whether an existing file may be replaced.

    Raises:
        UsageError: If the name ends otherwise or its folder does not exist.
        OutputExistsError: If it exists and ``force`` is not given.
    """
    if output.suffix.lower() not in tuple(endings):
        raise UsageError(f"{output}: {why}")
    refuse_existing(output, force=force)


@contextmanager
def part_file(output: Path, *, durable: bool = False) -> Generator[Path]:
    """Write ``OUTPUT.part``, and rename it on leaving without an exception.

    Two processes that write one output at the same time have part files of their own: the output is
    that of the last one, whole.

    Args:
        output: The file wanted; one of that name is replaced, so callers that must not replace it
            ask :func:`.capture.common.console.refuse_existing` before they start.
        durable: Whether it survives power loss: the file and its name are synced.

    Yields:
        The part file, which is there, empty.

    Raises:
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    try:
        with claimed_part(output) as part:
            try:
                yield part
                if durable:
                    publish_durably(part, output, replace=True)
                else:
                    part.replace(output)
            except BaseException:
                with suppress(OSError):  # what stopped the writing may stop this too
                    part.unlink(missing_ok=True)
                raise
    except OSError as error:
        if isinstance(error, UndulogError):
            raise
        raise LogWriteError(output, f"can't be written: {error.strerror or error}") from error


@contextmanager
def part_folder(output: Path, *, marker: Path, force: bool) -> Generator[Path]:
    """Make ``OUTPUT.part``, and rename it on leaving without an exception.

    Args:
        output: The folder wanted.
        marker: A file, relative to the folder, by which it is one of its kind: no other folder is
            replaced.
        force: Replace an existing one.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        UsageError: If it may not be replaced, its folder doesn't exist, or ``OUTPUT.part`` is
            there.
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    import shutil

    if not output.name:
        raise UsageError(f"{output}: name a folder to be made")
    part = output.with_name(f"{output.name}.part")
    if not output.is_dir():
        if output.exists():
            raise UsageError(f"{output} is a file; name a folder")
        refuse_existing(output, force=force)
    elif any(output.iterdir()):
        if not (output / marker).is_file():
            raise UsageError(
                f"{output} has files but no {marker}: it is not replaced; name another"
            )
        if not force:
            raise OutputExistsError(output)
    if part.exists():
        raise UsageError(f"{part} is left of an export that was ended; remove it first")
    try:
        part.mkdir()
        yield part
        if output.exists():
            shutil.rmtree(output)
        part.rename(output)
    except OSError as error:
        if isinstance(error, UndulogError):
            raise
        raise LogWriteError(output, f"can't be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def write_text(output: Path, text: str) -> None:
    """Write a text file, which appears only when it is whole.

    Args:
        output: The file wanted; one of that name is replaced, as by :func:`part_file`.
        text: Its content, for UTF-8.

    Raises:
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    with part_file(output) as part:
        part.write_text(text, encoding="utf-8")


def check_stop(output: Path, stop: StopRequest | None) -> None:
    """End the writing of a part file if a stop was requested.

    Raises:
        LogWriteError: If a stop was requested.
    """
    if stop is not None and stop.requested:
        raise LogWriteError(output, "stopped on request, nothing is written")


def listen_at(listener: socket.socket, path: Path, backlog: int) -> None:
    """Give a socket its name and listen; only its owner may connect.

    Between ``bind`` and ``listen`` a connection is refused, so the socket is bound under another
    name, and gets this one when it listens: a client that sees the file can connect.

    Args:
        listener: A stream or seqpacket socket, not bound.
        path: Where nothing is yet.
        backlog: How many may wait to be accepted.

    Raises:
        OSError: If something is at the path, or no socket can be made there.
    """
    os.fchmod(listener.fileno(), 0o600)  # before it has a name: no moment without
    # As long as the path itself, whose length is bounded (sun_path).
    length = len(os.fsencode(path.name))
    draft = path.with_name(("~" + os.urandom(8).hex()).ljust(length, "~")[:length])
    listener.bind(os.fspath(draft))
    try:
        listener.listen(backlog)
        path.hardlink_to(draft)
    finally:
        draft.unlink(missing_ok=True)


def csv_writer(stream: TextIO, texts: Sequence[str]) -> Any:
    """Return a writer of rows with some texts, quoted if one has a carriage return."""
    odd = any("\r" in text for text in texts)  # the module doesn't quote for it
    quoting = csv.QUOTE_NONNUMERIC if odd else csv.QUOTE_MINIMAL
    return csv.writer(stream, lineterminator="\n", quoting=quoting)


def as_text(name: str) -> str:
    """Escape a text that a spreadsheet takes for a formula."""
    return f"'{name}" if name.startswith(_FORMULA) else name


def number_cells(values: FloatArray) -> list[object]:
    """Return numbers for cells, all digits kept; NaN is an empty cell."""
    return ["" if math.isnan(value) else value for value in values.tolist()]
