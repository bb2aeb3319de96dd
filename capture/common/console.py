"""Output of all commands: lines, errors, progress and JSON.

All text for a terminal passes :func:`plain`: names in a log are untrusted and may contain control
characters.
"""

from __future__ import annotations

import json
import sys
import unicodedata
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import OutputExistsError, UsageError
from .part_files import recording_left

if TYPE_CHECKING:
    from rich.text import Text

_UNSAFE = ("Cc", "Cf", "Cs", "Cn", "Co", "Zl", "Zp")
"""Unicode categories: control, format (also text direction), surrogate, unassigned, private, line
and paragraph ends. All characters that XML forbids are among them."""

UNLIMITED = 10_000
"""A width at which nothing wraps."""

_GAP = 2
_NARROWEST = 6


Warn = Callable[[str], None]

Cells = Sequence[tuple[str, str]]
"""Text and style of each cell of a row."""


def plain(text: str) -> str:
    r"""Escape the control characters of a text.

    Returns:
        One line: control and format characters, line breaks and lone surrogates as escapes, e.g.
        ``\x1b``, ``\n``, ``\u202e``; the rest unchanged.
    """
    if text.isprintable():
        return text
    return "".join(
        c.encode("unicode_escape").decode("ascii") if unicodedata.category(c) in _UNSAFE else c
        for c in text
    )


def echo(*lines: str) -> None:
    """Print lines on stdout.

    Args:
        lines: Any text; what would end a line or control a terminal is escaped (:func:`plain`).
    """
    sys.stdout.write("".join(f"{plain(line)}\n" for line in lines))
    sys.stdout.flush()


def complain(message: str) -> None:
    """Print an error or a warning on stderr.

    Args:
        message: Any text, escaped as by :func:`plain` except for line feeds; a line behind the
            first is indented, so that a name with a line feed can't pass for another message.
    """
    first, *rest = (plain(line) for line in message.split("\n"))
    indented = (line if line.startswith("  ") else f"  {line}" for line in rest)
    sys.stdout.flush()
    sys.stderr.write("".join(f"{line}\n" for line in (first, *indented)))
    sys.stderr.flush()


class Progress:
    """Receiver of the progress of a long task; this one shows nothing."""

    def update(self, done: float, note: str = "") -> None:
        """Show the progress.

        Args:
            done: In the units of the total.
            note: A few words, e.g. the real-time factor.
        """


@contextmanager
def progress(description: str, total: float) -> Generator[Progress]:
    """Show a progress bar on stderr if it is a terminal; ``total`` is the last ``done``."""
    if not sys.stderr.isatty():
        yield Progress()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(plain(description), total=total, note="")

        class _Bar(Progress):
            def update(self, done: float, note: str = "") -> None:
                bars.update(task, completed=done, note=plain(note))

        yield _Bar()


def emit(facts: Any, lines: Iterable[str], *, as_json: bool) -> None:
    """Print a result on stdout, as one JSON value or as lines of text."""
    if as_json:
        emit_json(facts)
    else:
        echo(*lines)


def emit_json(value: Any) -> None:
    """Print one JSON value on stdout; NaN is an error."""
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def refuse_existing(path: Path, *, force: bool) -> None:
    """Check an output path before any work is done.

    Args:
        path: Where the output will go.
        force: Whether an existing file may be replaced.

    Raises:
        OutputExistsError: If it is there, or what a killed recorder left of it, and ``force`` is
            not given.
        UsageError: If it is a folder, or its folder doesn't exist.
    """
    if path.is_dir():
        raise UsageError(f"{path} is a folder; name a file in it")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: the folder {path.parent} doesn't exist")
    there = path if path.exists() else recording_left(path)
    if there is not None and not force:
        raise OutputExistsError(there)


def output_width() -> int:
    """Return the width of the terminal that the output goes to [cells], unlimited if it is none."""
    from shutil import get_terminal_size

    return get_terminal_size().columns if sys.stdout.isatty() else UNLIMITED


@dataclass(frozen=True)
class TerminalColumn:
    """A column of a table.

    Attributes:
        title: Its head, with the unit.
        left: Whether it holds words; numbers go to the right.
        spare: Where the table is too wide, columns of the same number are left out together, the
            least number first; 0 stays.
    """

    title: str
    width: int = 0
    left: bool = False
    spare: int = 0


def table(
    columns: Sequence[TerminalColumn], rows: Sequence[Cells], width: int, *, cropped: bool = False
) -> tuple[list[Text], list[str]]:
    """Lay out a table, without columns that it can spare where the terminal is too narrow.

    Args:
        rows: A cell for each column, also for those that may not be shown.
        cropped: Whether no line may be longer, whatever it takes: the last columns go too, and the
            first gives way.

    Returns:
        The head and one line a row; the titles of the columns left out, in the order they went.
    """
    from rich.cells import cell_len
    from rich.text import Text

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
    """Cut or pad a text to a width in cells of a terminal."""
    from rich.cells import cell_len

    short = cut(text, width)
    return short + " " * (width - cell_len(short))


def cut(text: str, width: int) -> str:
    """Escape control characters and cut a text to a width in cells of a terminal."""
    from rich.text import Text

    clean = Text(_printable(text))
    clean.truncate(max(width, 1), overflow="ellipsis")
    return clean.plain


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in plain(text))  # odd spaces
