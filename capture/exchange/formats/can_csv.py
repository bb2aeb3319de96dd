"""CAN frames in a CSV as python-can writes it, and reads it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from ..frame_log import FrameLog
from ..frame_reader import FrameReader
from ..packed import open_packed_text
from .format import Format

_HEADER = b"timestamp,arbitration_id,"
"""How such a file begins; any other CSV is a table."""


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    return float(head.removeprefix(b"\xef\xbb\xbf").startswith(_HEADER))


@contextmanager
def _read(path: Path) -> Generator[FrameLog]:
    from can import CSVReader

    from ..python_can import python_can_log

    with python_can_log(path, lambda: CSVReader(open_packed_text(path)), directions=False) as log:
        yield log


FORMAT = Format(
    "can_csv", "CAN frames by python-can", (".csv",), _sniff, FrameReader(_read), packed=True,
)  # fmt: skip
