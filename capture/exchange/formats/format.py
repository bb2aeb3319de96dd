"""What a format is: one file that recognises, reads and writes the logs of one make.

A format's module defines ``FORMAT`` and its functions, and imports no library before a file is read
or written: all of them are imported to choose the one that fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ..frame_export import FrameWriter
from ..frame_reader import FrameReader
from ..table_format import TableReader, TableWriter, WideTableWriter

if TYPE_CHECKING:
    from ..import_options import ImportOptions
    from ..reports import ExportReport, ImportReport

Sniff: TypeAlias = Callable[[bytes, Path], float]
"""Returns how well the first bytes of a file, or a folder, fit a format: 0 not, 1 without doubt.

The bytes are those behind the compression where a file is compressed; a folder has none.
"""


@dataclass(frozen=True)
class DirectReader:
    """Reads a log straight into sessions, by a function of its format.

    Attributes:
        read: Called with log, output and options; returns the report of each session.
        holds: What such a log is, as in ``BAG is a bag of ROS``.
        options: Options of ``undulog import`` that it takes.
        several: Whether a log gives several sessions, which go into a folder.
    """

    read: Callable[[Path, Path, ImportOptions], list[ImportReport]]
    holds: str
    options: tuple[str, ...] = ()
    several: bool = False

    def into_session(
        self, source: Path, output: Path, options: ImportOptions
    ) -> list[ImportReport]:
        """Write the session, or the sessions, of a log."""
        return self.read(source, output, options)


@dataclass(frozen=True)
class DirectWriter:
    """Writes a session by a function of its format, which ``--to`` names.

    Attributes:
        export: Called with the session, or several, the output and the options.
        holds: What such an output has.
        options: Options of ``undulog log export`` that it takes.
        several: Whether it takes several sessions.
    """

    export: Callable[..., ExportReport]
    holds: str
    options: tuple[str, ...] = ()
    several: bool = False

    by_suffix: bool = field(default=False, init=False)

    def out_of_session(self, sources: Sequence[Path], output: Path, **options: Any) -> ExportReport:
        """Write a file or a folder."""
        return self.export(sources if self.several else sources[0], output, **options)


Reader: TypeAlias = FrameReader | TableReader | DirectReader
"""Reads a log into a session.

``holds`` is what such a log is, as in ``trace.log holds CAN frames``, ``options`` are those of
``undulog import`` that it takes besides those of all, ``several`` is whether a log gives several
sessions, which go into a folder. ``into_session`` writes them.
"""

Writer: TypeAlias = FrameWriter | TableWriter | WideTableWriter | DirectWriter
"""Writes a session in a format.

``holds`` is what such an output has, ``options`` are those of ``undulog log export`` that it takes,
``several`` is whether it takes several sessions, and ``by_suffix`` whether the suffix of the output
chooses it; else ``--to`` does. ``out_of_session`` writes the output.
"""


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes:
        name: Small letters, digits, - and _.
        title: What a file of it is called, as in ``x.blf is no Vector BLF``.
        suffixes: In small letters, with their dot; the first one is written.
        sniff: Returns how well a file fits.
        read: Reads it; None if it is only written.
        write: Writes it; None if it is only read.
        packed: Whether it is also read with ``.gz`` behind the suffix.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    sniff: Sniff
    read: Reader | None = None
    write: Writer | None = None
    packed: bool = False


def not_read(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    """Return 0: the sniff of formats that are only written."""
    return 0.0
