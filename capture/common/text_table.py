"""Tables of plain text for a terminal: columns of one width, words to the left, numbers right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.cells import cell_len
from rich.text import Text

from .console import plain

Cells = Sequence[tuple[str, str]]
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
        spare: Where the table is too wide, columns of the same number are left out together, the
            least number first; 0 stays.
    """

    title: str
    width: int = 0
    left: bool = False
    spare: int = 0


def table(
    columns: Sequence[Column], rows: Sequence[Cells], width: int, *, cropped: bool = False
) -> tuple[list[Text], list[str]]:
    """Lay out a table, without columns that it can spare where the terminal is too narrow.

    Args:
        columns: The columns.
        rows: A cell for each column, also for those that may not be shown.
        width: Characters in a line.
        cropped: Whether no line may be longer, whatever it takes: the last columns go too, and the
            first gives way.

    Returns:
        The head and one line a row; the titles of the columns left out, in the order they went.
    """
    texts = [[_printable(text) for text, _ in row] for row in rows]
    needed = [
        max(column.width, cell_len(plain(column.title)), *(cell_len(row[k]) for row in texts), 0)
        for k, column in enumerate(columns)
    ]
    shown, left_out = list(range(len(columns))), list[str]()

    def excess() -> int:
        return sum(needed[k] + _GAP for k in shown) - _GAP - width

    for number in sorted({column.spare for column in columns} - {0}):
        if excess() <= 0:
            break
        left_out += [columns[k].title for k in shown if columns[k].spare == number]
        shown = [k for k in shown if columns[k].spare != number]
    if cropped:
        while len(shown) > 1 and excess() > needed[shown[0]] - _NARROWEST:
            shown.pop()
        needed[shown[0]] = max(_NARROWEST, needed[shown[0]] - max(excess(), 0))
    heads = [plain(column.title) for column in columns]
    lines: list[Text] = []
    for cells, styles in (
        (heads, ["bold"] * len(heads)),
        *zip(texts, ([style for _, style in row] for row in rows), strict=True),
    ):
        line = Text(no_wrap=True)
        for k in shown:
            text = cut(cells[k], needed[k])
            space = " " * (needed[k] - cell_len(text))
            line.append(" " * _GAP if k != shown[0] else "")
            line.append("" if columns[k].left else space)
            line.append(text, styles[k])
            line.append(space if columns[k].left else "")
        line.rstrip()
        if cropped:
            line.truncate(width)
        lines.append(line)
    return lines, list(dict.fromkeys(left_out))


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
    clean = Text(_printable(text))
    clean.truncate(max(width, 1), overflow="ellipsis")
    return clean.plain


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in plain(text))  # odd spaces
