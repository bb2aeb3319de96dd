"""PEAK TRC: texts of CAN traces, by python-can."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from ..frame_log import FrameLog
from ..frame_reader import FrameReader
from ..packed import open_packed_text
from .format import Format


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    line = head.lstrip().partition(b"\n")[0]
    return float(line.startswith((b";$FILEVERSION", b";##########")))


@contextmanager
def _read(path: Path) -> Generator[FrameLog]:
    from can import TRCReader

    from ..python_can import python_can_log

    with python_can_log(path, lambda: TRCReader(open_packed_text(path))) as log:
        yield log


FORMAT = Format("trc", "PEAK TRC", (".trc",), _sniff, FrameReader(_read), packed=True)
