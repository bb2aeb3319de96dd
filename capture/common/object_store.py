"""Stores of files: a folder of this computer or of an object store.

A file that is written by :meth:`ObjectStore.write_checked` carries the SHA-256 of its bytes in its
name, ``STEM-CHECKSUM.ENDING``, and is never changed. So one file is whole or absent, whatever ends
its writer, and a byte that differs later is found before anything else reads the file. A Parquet
file without a checksum, as earlier versions wrote them, is first read by another process
(:mod:`.parquet_trial`), since a damaged one may end the process that reads it.

Credentials of object stores are those of the environment, e.g. ``AWS_ACCESS_KEY_ID``,
``AWS_SECRET_ACCESS_KEY`` and ``AWS_ENDPOINT_URL``, as pyarrow reads them.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from .errors import (
    DamagedFileError,
    InputFileError,
    LogWriteError,
    MissingExtraError,
    raised_as,
)
from .files import is_file
from .parquet_trial import ParquetTrial

_DIGITS = 32
"""Hexadecimal digits of a checksum, 128 bits: enough against damage; forgery isn't its subject."""
_CHECKSUM = re.compile(rf"-([0-9a-f]{{{_DIGITS}}})\.[a-z]+$")
_PIECE = 1 << 20
"""Bytes that are read at a time where only the checksum is wanted."""


@dataclass(frozen=True)
class StoredFile:
    """One file of a store.

    Attributes:
        name: Path relative to the store, with ``/`` between its parts.
        size: In bytes.
        modified_ns: Time of the last change [Unix ns], 0 where the store has none.
    """

    name: str
    size: int
    modified_ns: int


def checksum_in(name: str) -> str | None:
    """Return the checksum that a file's name carries, or None."""
    match = _CHECKSUM.search(name)
    return match[1] if match else None


class ObjectStore:
    """A folder of this computer or of an object store."""

    def __init__(self, where: str) -> None:
        """Connect; nothing is made.

        Args:
            where: A folder, or a URL.

        Raises:
            InputFileError: If the address is none, or can't be reached.
            MissingExtraError: If pyarrow is not installed.
        """
        try:
            import pyarrow as pa
            import pyarrow.fs as pafs
            import pyarrow.parquet as pq
        except ImportError as error:
            raise MissingExtraError("a store of Parquet files", "parquet", "pyarrow") from error
        self._arrow: Any = pa
        self._fs_module: Any = pafs
        self._parquet: Any = pq
        self._trial = ParquetTrial()
        self._read_before: dict[str, str] = {}  # checksums of files whose names have none
        self.where = where
        self.is_local = "://" not in where
        with raised_as(InputFileError, where, "", OSError, ValueError):
            if self.is_local:
                self.filesystem: Any = self._fs_module.LocalFileSystem()
                self.base = Path(where).resolve().as_posix()
            else:
                self.filesystem, self.base = self._fs_module.FileSystem.from_uri(where)

    def path(self, name: str) -> str:
        """Return the path of a file in its file system."""
        return f"{self.base}/{name}" if name else self.base

    def make_folders(self, *names: str) -> None:
        """Make folders that are not there.

        Raises:
            InputFileError: If one can't be made.
        """
        with raised_as(InputFileError, self.where, "", OSError):
            for name in names:
                self.filesystem.create_dir(self.path(name), recursive=True)

    # -- reading ---------------------------------------------------------------------------------

    def files(
        self, folder: str = "", endings: Sequence[str] = ("",), *, recursive: bool = False
    ) -> list[StoredFile]:
        """List files, in order of their names; none where the folder isn't there.

        Args:
            endings: Of the names that are wanted.
            recursive: Also list those of folders in the folder.

        Raises:
            InputFileError: If it can't be listed.
        """
        infos = self._listed(folder, recursive=recursive)
        start = len(self.base) + 1
        files = [
            StoredFile(info.path[start:], info.size or 0, info.mtime_ns or 0)
            for info in infos
            if info.is_file and info.path.endswith(tuple(endings))
        ]
        return sorted(files, key=lambda file: file.name)

    def not_files(self, folder: str, ending: str) -> list[str]:
        """List what is named like a file and is none: a folder, a link to nothing.

        Raises:
            InputFileError: If the folder can't be listed.
        """
        if not self.is_local:
            return []  # an object is nothing else
        with raised_as(InputFileError, self.where, "", OSError):
            try:
                entries = [*os.scandir(self.path(folder))]
            except FileNotFoundError:
                return []
        names = (e.name for e in entries if e.name.endswith(ending) and _is_no_file(e))
        return sorted(f"{folder}/{name}" for name in names)

    def _listed(self, folder: str, *, recursive: bool = False) -> list[Any]:
        selector = self._fs_module.FileSelector(
            self.path(folder), allow_not_found=True, recursive=recursive
        )
        with raised_as(InputFileError, self.where, "", OSError):
            return self.filesystem.get_file_info(selector)

    def read(self, name: str) -> bytes:
        """Read a whole file, and compare it with the checksum that its name may carry.

        Raises:
            DamagedFileError: If its bytes aren't those that were written.
            InputFileError: If it can't be read.
        """
        try:
            if self.is_local:
                data = Path(self.path(name)).read_bytes()
            else:
                with self.filesystem.open_input_stream(self.path(name)) as stream:
                    data = stream.read()
        except OSError as error:
            raise self._unreadable(name, error) from error
        self._compare(name, hashlib.sha256(data).hexdigest())
        return data

    def check_parquet(self, name: str) -> None:
        """Check that a Parquet file can be read, without holding it in memory.

        Raises:
            DamagedFileError: If its bytes aren't those that were written, or it has no checksum
                and can't be read.
            InputFileError: If it can't be read at all.
        """
        has_checksum = checksum_in(name) is not None or name in self._read_before
        if not (has_checksum and self.is_local):
            data = self.read(name)
            if not has_checksum:
                self._try(name, data)
            return
        digest = hashlib.sha256()
        try:
            with Path(self.path(name)).open("rb") as stream:
                while piece := stream.read(_PIECE):
                    digest.update(piece)
        except OSError as error:
            raise self._unreadable(name, error) from error
        self._compare(name, digest.hexdigest())

    def read_table(
        self, name: str, columns: Sequence[str] | None = None, *, tried: bool = False
    ) -> Any:
        """Read a Parquet file.

        Args:
            columns: Those that are wanted, of which a file need not have all; all by default.
            tried: Have another process read it first, even if its name carries a checksum.

        Returns:
            A ``pyarrow.Table``.

        Raises:
            DamagedFileError: If its bytes aren't those that were written, or are no Parquet.
            InputFileError: If it can't be read.
        """
        data = self.read(name)
        if tried or checksum_in(name) is None:
            self._try(name, data)
        try:
            # In this thread alone: a thread of Arrow's could still hold the bytes while the
            # interpreter ends, which aborts the process.
            source = self._arrow.BufferReader(data)
            file = self._parquet.ParquetFile(source, pre_buffer=False)
            names = file.schema_arrow.names
            chosen = None if columns is None else [n for n in columns if n in names]
            return file.read(chosen, use_threads=False)
        except (self._arrow.ArrowException, OSError) as error:
            raise DamagedFileError(f"{self.where}/{name}", str(error)) from error

    def _try(self, name: str, data: bytes) -> None:
        """Have a Parquet file read by another process, once."""
        if name not in self._read_before:
            if why := self._trial.fault(data):
                raise DamagedFileError(f"{self.where}/{name}", why)
            self._read_before[name] = hashlib.sha256(data).hexdigest()[:_DIGITS]

    def _compare(self, name: str, digest: str) -> None:
        expected = checksum_in(name) or self._read_before.get(name)
        if expected is not None and not digest.startswith(expected):
            why = "its bytes are not those that were written (checksum)"
            raise DamagedFileError(f"{self.where}/{name}", why)

    def _unreadable(self, name: str, error: OSError) -> InputFileError:
        path = f"{self.where}/{name}"
        if isinstance(error, FileNotFoundError):
            return InputFileError(path, "no such file")
        if isinstance(error, IsADirectoryError):
            return DamagedFileError(path, "is a folder where a file was")
        why = error.strerror if self.is_local and error.strerror else str(error)
        return InputFileError(path, f"can't be read: {why}; make it readable, or move it away")

    # -- writing ---------------------------------------------------------------------------------

    def write(self, name: str, data: bytes) -> None:
        """Write a file whole or not at all; one that is there is replaced.

        Raises:
            LogWriteError: If it can't be written.
        """
        path = self.path(name)
        with raised_as(LogWriteError, f"{self.where}/{name}", "", OSError):
            if self.is_local:
                part = Path(f"{path}.{os.getpid()}-{os.urandom(4).hex()}.part")
                try:
                    part.write_bytes(data)
                    part.replace(path)
                finally:
                    part.unlink(missing_ok=True)
            else:
                with self.filesystem.open_output_stream(path) as stream:
                    stream.write(data)

    def write_checked(self, stem: str, ending: str, data: bytes) -> str:
        """Write a file whose name carries the checksum of its bytes.

        Args:
            stem: Folder and name up to the checksum.
            ending: Of its name, with the dot.

        Returns:
            Its name.

        Raises:
            LogWriteError: If it can't be written.
        """
        name = f"{stem}-{hashlib.sha256(data).hexdigest()[:_DIGITS]}{ending}"
        self.write(name, data)
        return name

    def write_table(self, stem: str, table: Any) -> str:
        """Write a ``pyarrow.Table`` as Parquet, its checksum in the name; see `write_checked`."""
        sink = self._arrow.BufferOutputStream()
        self._parquet.write_table(table, sink)
        return self.write_checked(stem, ".parquet", sink.getvalue().to_pybytes())

    def set_aside(self, name: str, folder: str) -> str:
        """Move a damaged file into a folder of such files, under a name that nothing reads.

        Returns:
            Its new name; empty if another process moved or removed it before.

        Raises:
            LogWriteError: If it can't be moved.
        """
        self.make_folders(folder)
        self._read_before.pop(name, None)
        mark = os.urandom(4).hex()  # a file of that name may have been damaged before
        goal = f"{folder}/{PurePosixPath(name).name}.{mark}.damaged"
        with raised_as(LogWriteError, f"{self.where}/{name}", "", OSError):
            try:
                if self.is_local:
                    Path(self.path(name)).rename(self.path(goal))
                else:
                    self.filesystem.move(self.path(name), self.path(goal))
            except FileNotFoundError:
                return ""
        return goal

    def remove(self, name: str) -> None:
        """Remove a file; one that isn't there is no error.

        Raises:
            LogWriteError: If it can't be removed.
        """
        with (
            raised_as(LogWriteError, f"{self.where}/{name}", "", OSError),
            suppress(FileNotFoundError),
        ):
            self.filesystem.delete_file(self.path(name))


def _is_no_file(entry: os.DirEntry[str]) -> bool:
    """Whether it is there and no file; one that was removed since the listing is neither."""
    if entry.is_file(follow_symlinks=False) or is_file(Path(entry)):
        return False
    return os.path.lexists(entry)
