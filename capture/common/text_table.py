"""Tables of plain text for a terminal: columns of one width, words to the left, numbers right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

from .console import plain

Cells = list[tuple[str, str]]
"""Text and style of each cell of a row."""

_GAP = 2
_NARROWEST = 6


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: Its head, with the unit.
        width: Least width in characters.
        left: Whether it holds words; numbers go to the right.
        wide: Shown only where there is room for all columns.
    """

    title: str
    width: int
    left: bool = False
    wide: bool = False


def table(columns: Sequence[Column], rows: Sequence[Cells], width: int) -> list[Text]:
    """A table no wider than the terminal; the first column gives way.

    Args:
        columns: The columns.
        rows: A cell for each column, also for those that may not be shown.
        width: Characters in a line.

    Returns:
        The head and one line a row.
    """
    needed = [
        max(column.width, *(len(row[k][0]) for row in rows)) if rows else column.width
        for k, column in enumerate(columns)
    ]
    whole = sum(needed) + _GAP * (len(needed) - 1) <= width
    shown = [k for k, column in enumerate(columns) if whole or not column.wide]
    first = needed[shown[0]]
    while (
        len(shown) > 1 and sum(needed[k] + _GAP for k in shown) - _GAP - width > first - _NARROWEST
    ):
        shown.pop()  # a narrow terminal loses the last columns
    widths = {k: needed[k] for k in shown}
    spare = width - sum(widths.values()) - _GAP * (len(shown) - 1)
    widths[shown[0]] = max(_NARROWEST, widths[shown[0]] + min(spare, 0))
    titles: Cells = [(column.title, "bold") for column in columns]
    lines: list[Text] = []
    for cells in (titles, *rows):
        line = Text(no_wrap=True)
        for k in shown:
            text, style = cells[k]
            padded = cut(text, widths[k])
            before = 0 if columns[k].left else widths[k] - len(padded)
            line.append(" " * (before + (_GAP if k != shown[0] else 0)))
            line.append(padded, style)
            if columns[k].left:
                line.append(" " * (widths[k] - len(padded)))
        line.rstrip()
        line.truncate(width)
        lines.append(line)
    return lines


def fit(text: str, width: int) -> str:
    """Text of exactly this many characters.

    Args:
        text: Any text.
        width: Characters.
    """
    return cut(text, width).ljust(width)


def cut(text: str, width: int) -> str:
    """Text with control characters escaped, no longer than there is room.

    Args:
        text: Any text; a device may have put anything into it.
        width: Characters.
    """
    clean = "".join(c if c.isprintable() else " " for c in plain(text))  # odd spaces
    return clean if len(clean) <= width else clean[: max(width - 1, 0)] + "…"
