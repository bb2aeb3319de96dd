"""Files named by URL: objects of a store or a web server, read in ranges.

Credentials are those of the environment, e.g. ``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY`` and
``AWS_ENDPOINT_URL``, as obstore reads them; ``AWS_SKIP_SIGNATURE=true`` is for public buckets.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path, PosixPath
from typing import Any
from urllib.parse import unquote

from .errors import InputFileError, MissingExtraError

HEAD_SIZE = 64 << 10
"""Bytes that are fetched when a file is opened."""

_URL = re.compile(r"(https?|s3a?|gs|az|azure|abfss?|adl):/+(?=[^/])", re.IGNORECASE)
_PARALLEL = 8
_PIECE = 8 << 20
_TIMES = {"timeout": timedelta(seconds=60), "connect_timeout": timedelta(seconds=10)}
_RETRIES = {"max_retries": 3, "retry_timeout": timedelta(seconds=30)}

_CAUSES = {
    "FileNotFoundError": "no such object",
    "NotFoundError": "no such object",
    "PermissionDeniedError": "the server refuses access; are the credentials those of its owner?",
    "UnauthenticatedError": "the server asks for credentials",
    "NotSupportedError": "the server sends no ranges of bytes; download the file first",
}
_CREDENTIALS = {
    "s": "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY; AWS_SKIP_SIGNATURE=true is for public buckets",
    "g": "GOOGLE_APPLICATION_CREDENTIALS; GOOGLE_SKIP_SIGNATURE=true is for public buckets",
    "a": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
}
_WORDS = {
    "416": "the file is empty (0 bytes)",
    "169.254.169.254": "no credentials are set: ",
    "Account must be specified": "no account is set: ",
    "error sending request": "the server can't be reached",
}


class RemotePath(PosixPath):
    """A URL as a path, for its name, stem and siblings; nothing on this computer has it.

    Attributes:
        query: What follows the path, from ``?`` on. It may be a signature, so text has none of it.
    """

    query = ""

    def __str__(self) -> str:
        """Return the URL without the query; a path has one slash behind the scheme."""
        return super().__str__().replace(":/", "://", 1)

    def open(self, mode: str = "r", *_: Any, **__: Any) -> Any:
        """Open it for reading from the first byte to the last; only mode ``rb``."""
        if mode != "rb":
            raise InputFileError(self, f"a URL can only be read, not opened as {mode!r}")
        return io.BufferedReader(_Stream(RemoteFile(self)), _PIECE)


def as_path(given: Path | str) -> Path:
    """Return a path; for a URL, also one that ``Path`` has made, a :class:`RemotePath`."""
    text = str(given)
    scheme = None if isinstance(given, RemotePath) else _URL.match(text)
    if scheme is None:
        return given if isinstance(given, Path) else Path(given)
    place, mark, query = text[scheme.end() :].partition("?")
    if not scheme[1].lower().startswith("http"):  # a key may have any character
        place, mark, query = place + mark + query, "", ""
    path = RemotePath(f"{scheme[1].lower()}:/{place}")
    path.query = mark + query
    return path


class RemoteFile:
    """An object of a store or a web server.

    Attributes:
        head: Its first bytes.
        size: In bytes.
        tag: Its ETag, or else its time of modification: another one means that it has changed.
    """

    def __init__(self, path: RemotePath) -> None:
        """Connect and fetch the first bytes.

        Raises:
            InputFileError: If there is no such object, or it can't be read in ranges.
            MissingExtraError: If obstore is not installed.
        """
        self.path = path
        self.size, self.tag = 0, ""
        try:
            import obstore
        except ImportError as error:
            raise MissingExtraError("a session named by URL", "remote", "obstore") from error
        self._obstore: Any = obstore
        try:
            self._store, self._name = _store(path)
        except Exception as error:  # of the library's own kinds, ValueError and others
            raise _failed(path, error) from error
        self.head = self.read(0, HEAD_SIZE)

    def read(self, start: int, stop: int) -> bytes:
        """Fetch the bytes [start, stop); fewer if the file ends before.

        Raises:
            InputFileError: If they can't be fetched, or the object has changed since it was opened.
        """
        try:
            response = self._obstore.get(self._store, self._name, options={"range": (start, stop)})
            data = bytes(response.bytes())
        except Exception as error:  # of the library's own kinds, FileNotFoundError and others
            raise _failed(self.path, error) from error
        size, tag = (
            response.meta["size"],
            response.meta["e_tag"] or str(response.meta["last_modified"]),
        )
        if not self.tag:
            self.size, self.tag = size, tag
        if (size, tag) != (self.size, self.tag):
            raise InputFileError(self.path, "it has changed since it was opened; open it again")
        if len(data) != min(stop, size) - start:
            raise InputFileError(self.path, f"{len(data)} bytes came for {start} to {stop}")
        return data

    def read_many(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Fetch ranges, several at a time; see :meth:`read`."""
        from concurrent.futures import ThreadPoolExecutor

        pieces = [
            (k, at, min(at + _PIECE, stop))
            for k, (start, stop) in enumerate(ranges)
            for at in range(start, stop, _PIECE)
        ]
        chunks: list[list[bytes]] = [[] for _ in ranges]
        with ThreadPoolExecutor(max(1, min(_PARALLEL, len(pieces)))) as pool:
            _, starts, stops = zip(*pieces, strict=True) if pieces else ((), (), ())
            fetched = pool.map(self.read, starts, stops)
            for (k, _, _), data in zip(pieces, fetched, strict=True):
                chunks[k].append(data)
        return [b"".join(parts) for parts in chunks]


class _Stream(io.RawIOBase):
    def __init__(self, file: RemoteFile) -> None:
        self._file, self._at = file, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        stop = min(self._at + len(buffer), self._file.size)
        data = self._file.read(self._at, stop) if stop > self._at else b""
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def _store(path: RemotePath) -> tuple[Any, str]:
    """Return the store of a URL's folder, and the name in it."""
    import obstore.store as stores

    kinds: Any = stores
    folder = str(path.parent)
    plain = folder.startswith("http:")
    client = {**_TIMES, "allow_http": plain or _plain_endpoint()}
    if folder.startswith("http"):
        store = kinds.HTTPStore(folder + path.query, client_options=client, retry_config=_RETRIES)
        return store, unquote(path.name)
    return kinds.from_url(folder, client_options=client, retry_config=_RETRIES), path.name


def _plain_endpoint() -> bool:
    """Whether the environment names an endpoint without TLS, as a server in a lab may be."""
    names = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT", "AZURE_STORAGE_ENDPOINT")
    return any(os.environ.get(name, "").startswith("http://") for name in names)


def _failed(path: RemotePath, error: Exception) -> InputFileError:
    """Return the error of a path for one of the library; never with a URL's query."""
    kind, text = type(error).__name__, str(error)
    cause = _CAUSES.get(kind) or next((why for word, why in _WORDS.items() if word in text), "")
    if cause.endswith(": "):
        cause += _CREDENTIALS.get(str(path)[0], "")
    first = re.sub(r"\?\S+", "", text.partition("\n")[0]).rstrip(" :")
    return InputFileError(path, cause or f"can't be read: {first}")
