"""Files under a folder, or objects under a URL of an object store such as ``s3://bucket/lab``.

Credentials and the endpoint of an object store are those that pyarrow finds, e.g. in
``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY`` and ``AWS_ENDPOINT_URL``.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import InputFileError, LogWriteError, MissingExtraError


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
            import pyarrow.fs as pafs
            import pyarrow.parquet as pq
        except ImportError as error:
            raise MissingExtraError("a store of Parquet files", "parquet", "pyarrow") from error
        self._fs_module: Any = pafs
        self._parquet: Any = pq
        self.where = where
        self.is_local = "://" not in where
        with _errors(InputFileError, where, (OSError, ValueError)):
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
        with _errors(InputFileError, self.where):
            for name in names:
                self.filesystem.create_dir(self.path(name), recursive=True)

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
        selector = self._fs_module.FileSelector(
            self.path(folder), allow_not_found=True, recursive=recursive
        )
        with _errors(InputFileError, self.where):
            found = self.filesystem.get_file_info(selector)
        start = len(self.base) + 1
        files = [
            StoredFile(info.path[start:], info.size or 0, info.mtime_ns or 0)
            for info in found
            if info.is_file and info.path.endswith(tuple(endings))
        ]
        return sorted(files, key=lambda file: file.name)

    def read(self, name: str) -> bytes:
        """Read a whole file.

        Raises:
            InputFileError: If it can't be read.
        """
        with (
            _errors(InputFileError, f"{self.where}/{name}"),
            self.filesystem.open_input_stream(self.path(name)) as stream,
        ):
            return stream.read()

    def read_table(self, name: str, columns: Sequence[str] | None = None) -> Any:
        """Read a Parquet file.

        Args:
            columns: Those that are wanted; all by default.

        Returns:
            A ``pyarrow.Table``.

        Raises:
            InputFileError: If it can't be read.
        """
        path, files = self.path(name), self.filesystem
        with _errors(InputFileError, f"{self.where}/{name}", (OSError, ValueError)):
            return self._parquet.read_table(path, columns=columns, filesystem=files)

    def write(self, name: str, data: bytes) -> None:
        """Write a file whole or not at all; one that is there is replaced.

        Raises:
            LogWriteError: If it can't be written.
        """
        path = self.path(name)
        with _errors(LogWriteError, f"{self.where}/{name}"):
            if self.is_local:
                part = Path(f"{path}.{os.getpid()}-{uuid.uuid4().hex[:8]}.part")
                try:
                    part.write_bytes(data)
                    part.replace(path)
                finally:
                    part.unlink(missing_ok=True)
            else:
                with self.filesystem.open_output_stream(path) as stream:
                    stream.write(data)

    def write_table(self, name: str, table: Any) -> None:
        """Write a ``pyarrow.Table`` as Parquet, whole or not at all.

        Raises:
            LogWriteError: If it can't be written.
        """
        import pyarrow as pa

        arrow: Any = pa
        sink = arrow.BufferOutputStream()
        self._parquet.write_table(table, sink)
        self.write(name, sink.getvalue().to_pybytes())

    def remove(self, name: str) -> None:
        """Remove a file; one that isn't there is no error.

        Raises:
            LogWriteError: If it can't be removed.
        """
        with _errors(LogWriteError, f"{self.where}/{name}"), suppress(FileNotFoundError):
            self.filesystem.delete_file(self.path(name))


@contextmanager
def _errors(
    kind: type[InputFileError | LogWriteError],
    where: str,
    caught: tuple[type[Exception], ...] = (OSError,),
) -> Generator[None]:
    """Turn errors of a file system into one that names the file."""
    try:
        yield
    except caught as error:
        raise kind(where, str(error)) from error
