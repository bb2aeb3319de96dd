"""A table and a figure of a result as data, from which text, page, data frames and CSV are made.

A part of the analysis describes its tables and figures here and draws nothing itself: the terminal
(:mod:`.analysis.present.text`) and the page lay them out, and each table's rows are a data frame
with all their fields, in SI units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, Literal, TypeVar

from ..common import formats
from ..common.estimate import Estimate

Row = TypeVar("Row")
Digits = int | Callable[[Sequence[Estimate]], int]
"""Digits after the point: fixed, or from all numbers of the column."""

TERMINAL, PAGE = 0, 1


@dataclass(frozen=True)
class ShownNumber:
    """A number with its digits after the point and its unit, which has its own space."""

    estimate: Estimate
    decimals: int
    unit: str = ""


@dataclass(frozen=True)
class Ends:
    """An interval in a cell of its own."""

    low: ShownNumber
    high: ShownNumber


class PValue(float):
    """A p-value."""


Cell = str | int | ShownNumber | Ends | PValue | None
"""What stands in a cell; None is printed as a dash."""


@dataclass(frozen=True)
class Column(Generic[Row]):
    """A column of a table.

    Attributes:
        text: Heading on a terminal, with the unit; None: not shown there.
        page: Heading on the page, with the unit; None: not shown there.
        of: The cell of a row, or a number in the unit of the heading.
        digits: Of numbers, on a terminal and on the page.
        kind: Numbers are set to the right; sentences wrap on the page.
        spare: A narrow terminal goes without the columns of the least number first; 0 stays.
    """

    text: str | None
    page: str | None
    of: Callable[[Row], Cell | Estimate | float]
    digits: tuple[Digits, Digits] = (0, 0)
    kind: Literal["number", "word", "sentence", "code"] = "number"
    spare: int = 0

    def cells(self, rows: Sequence[Row], where: int) -> list[Cell]:
        """Return the cells of the column.

        Args:
            where: ``TERMINAL`` or ``PAGE``.
        """
        values = [_number(self.of(row)) for row in rows]
        digits = self.digits[where]
        if not isinstance(digits, int):
            digits = digits([value for value in values if isinstance(value, Estimate)])
        return [
            ShownNumber(value, digits) if isinstance(value, Estimate) else value for value in values
        ]


@dataclass(frozen=True)
class Table(Generic[Row]):
    """A table of a result.

    Attributes:
        columns: The columns; the first one on the page names the row.
        rows: What each row is about.
        bold: Whether a row is set in bold.
        numbered: Whether rows are counted on the page.
        about: Page heading of a column to what it is, shown above the table on the page.
    """

    columns: Sequence[Column[Row]]
    rows: Sequence[Row]
    bold: Callable[[Row], bool] = lambda _: False
    numbered: bool = False
    about: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def notes(self) -> str:
        """The notes on columns, for the page."""
        heads = [str(column.page) for column in self.columns if column.page in self.about]
        return "; ".join(f"{head.split(' [')[0]}: {self.about[head]}" for head in heads)


def _number(value: Cell | Estimate | float) -> Cell | Estimate:
    """A value; a bare number as an estimate without interval."""
    if isinstance(value, float) and not isinstance(value, PValue):
        return Estimate(value)
    return value


AnyTable = Table[Any]


def p_cell(p: float | None) -> PValue | None:
    """Return the cell of a p-value; empty without one."""
    return None if p is None else PValue(p)


def typical(text: int, page: int) -> tuple[Digits, Digits]:
    """Return the digits that the typical interval of the column deserves, at most so many.

    Args:
        text: On a terminal.
        page: On the page.
    """
    return partial(formats.decimals_for, most=text), partial(formats.decimals_for, most=page)


@dataclass(frozen=True)
class Curve:
    """A line of a figure.

    Attributes:
        name: In the legend.
        x: Shape (n,).
        y: Shape (n,); None where there is no value.
        ci95: Interval of each, or None; empty without intervals.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float | None]
    ci95: Sequence[tuple[float, float] | None] = ()


@dataclass(frozen=True)
class Figure:
    """Lines over one axis.

    Attributes:
        caption: One or two sentences.
        x_label: Name and unit of the axis, e.g. ``time [s]``.
        y_label: The same of the other one.
        curves: At most as many as there are markers that can be told apart, six.
    """

    caption: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True)
class Shown:
    """What is shown of the result of a part.

    Attributes:
        title: Heading of its section on the page, and name of its tables on a terminal.
        tables: Their rows are frozen dataclasses of one kind each, whose fields become the columns
            of a data frame and of a CSV file.
        figures: On the page.
    """

    title: str
    tables: tuple[AnyTable, ...] = ()
    figures: tuple[Figure, ...] = ()
