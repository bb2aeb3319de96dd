"""Reading and writing tables, whatever their format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .column_blocks import OpenTable
    from .import_options import ImportOptions
    from .reports import ExportReport, ImportReport
    from .table_file import TableFile

TABLE_OPTIONS = ("--commands", "--columns", "--map", "--unit", "--write-map", "--fps")
"""Options of an import that are for tables alone."""


@dataclass(frozen=True)
class TableReader:
    """Reads a file as a table of columns.

    Attributes:
        open: Returns the table. Raises ImportFormatError if the file isn't what its format says,
            also while it is read.
    """

    open: Callable[[Path], TableFile]

    holds: str = field(default="holds a table", init=False)
    options: tuple[str, ...] = field(default=TABLE_OPTIONS, init=False)
    several: bool = field(default=False, init=False)

    def into_session(
        self, source: Path, output: Path, options: ImportOptions
    ) -> list[ImportReport]:
        """Write the session of a table; see :func:`.table_import.import_tables`."""
        from .table_import import of_files, with_options

        return [with_options(of_files(self.open(source), options.commands), output, options)]


@dataclass(frozen=True)
class TableWriter:
    """Writes a table.

    Attributes:
        open: Creates a file with columns of some names and kinds, ``int64``, ``float64`` or
            ``text``; gives a context of a function that writes rows. Raises OSError if it can't be
            written.
    """

    open: OpenTable

    holds: str = field(default="has joint columns", init=False)
    options: tuple[str, ...] = field(default=("topics",), init=False)
    several: bool = field(default=False, init=False)
    by_suffix: bool = field(default=True, init=False)

    def out_of_session(self, sources: Sequence[Path], output: Path, **options: Any) -> ExportReport:
        """Write joint columns, a row a sample; see :func:`.long_table.export_columns`."""
        from .long_table import export_columns

        return export_columns(self.open, sources[0], output, **options)


@dataclass(frozen=True)
class WideTableWriter:
    """Writes a table with a column for each joint and quantity.

    Attributes:
        table: Writes the file.
    """

    table: TableWriter

    holds: str = field(default="has joint columns", init=False)
    options: tuple[str, ...] = field(default=("topics",), init=False)
    several: bool = field(default=False, init=False)
    by_suffix: bool = field(default=False, init=False)

    def out_of_session(self, sources: Sequence[Path], output: Path, **options: Any) -> ExportReport:
        """Write joint columns side by side; see :func:`.wide_table.export_wide`."""
        from .wide_table import export_wide

        return export_wide(self.table.open, sources[0], output, **options)
