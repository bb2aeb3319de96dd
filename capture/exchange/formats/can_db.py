"""CAN frames in an SQLite database as python-can writes it, and reads it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from ..confined_log import confined
from ..frame_log import FrameLog
from ..frame_reader import FrameReader
from .format import Format


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    """Find the schema, which is in the first page of what python-can writes."""
    if not head.startswith(b"SQLite format 3"):
        return 0.0
    return 1.0 if b"arbitration_id" in head else 0.1


@contextmanager
def open_database_log(path: Path, scratch: Path) -> Generator[FrameLog]:  # noqa: ARG001 - as all openers
    """Open a database; runs in the child process.

    Raises:
        ImportFormatError: If it is no database of frames; also while its blocks are taken.
    """
    from can import SqliteReader

    from ..python_can import python_can_log

    def opened() -> SqliteReader:
        _check(path)
        return SqliteReader(path)

    with python_can_log(path, opened, directions=False) as log:
        yield log


def _check(path: Path) -> None:
    """Refuse what isn't plain, and data that is a number: it would count as a number of bytes."""
    from ...common.databases import check_pages, open_database

    with open_database(path, ["messages"], immutable=False) as base:
        check_pages(base)
        number = "typeof(data) IN ('integer', 'real')"
        count = base.execute(f"SELECT count(*) FROM messages WHERE {number}").fetchone()[0]  # noqa: S608
    if count:
        raise ValueError(f"{count} rows have a number as data")


FORMAT = Format(
    "can_db", "CAN frames by python-can, in SQLite", (".db",), _sniff,
    FrameReader(confined(f"{__name__}:open_database_log")),
)  # fmt: skip
