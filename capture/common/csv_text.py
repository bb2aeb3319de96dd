"""Cells of CSV files for pandas and for spreadsheets.

A spreadsheet takes text in a CSV that begins with ``=``, ``+``, ``-`` or ``@`` for a formula. So
text that begins with such a character, with a tab, a line end or an apostrophe has an apostrophe
before it, and only there: take one leading apostrophe away to have the text. Numbers are never
changed.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from typing import Any, TextIO

import numpy as np

from .arrays import FloatArray

_FORMULA = tuple("=+-@\t\r\n'＝＋－＠")
"""How text begins that a spreadsheet may run, and the apostrophe that marks it as text."""


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
    cells: list[object] = values.tolist()
    for row in np.flatnonzero(np.isnan(values)).tolist():
        cells[row] = ""
    return cells
