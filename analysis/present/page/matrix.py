"""A matrix of coupling as a picture: who follows whom, with every number in reach.

Colour goes from one hue over the page's ground to another, in equal steps of lightness for equal
steps of value (a straight line in OKLab), and a stroke stands in every negative cell, so that the
sign needs no colour. Rows take the focus: the keyboard reaches every number, and so does a mouse.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from markupsafe import Markup

from ...results.formats import decimals_for_values, number, short
from .entries import Entries
from .svg import Drawing
from .typeset import element, joined

PICTURE = 560.0
"""Side of a picture, one unit is a pixel of a wide page."""

MOST_IN_CELLS = 16
"""Matrices up to this size carry their numbers in the cells; larger ones show those of a row."""


class _Box(NamedTuple):
    """Place of a cell."""

    x: float
    y: float
    side: float

    @property
    def middle(self) -> tuple[float, float]:
        return self.x + self.side / 2, self.y + self.side / 2


def matrix_picture(entries: Entries, prefix: str, *, small: bool = False) -> Drawing:
    """Draw a matrix.

    Args:
        entries: What to draw.
        prefix: For identifiers, unique in the page.
        small: One of several beside a large one: no numbers in its cells, no focus on its rows.

    Returns:
        The picture.
    """
    m, k = entries.value.shape
    names = [short(name, 12) for name in entries.rows]
    left = 14.0 + 7.0 * max(map(len, names)) if not small else 26.0
    cell = (PICTURE - left) / max(m, k)
    top = 38.0 if small else 30.0
    numbers = not small and m <= MOST_IN_CELLS
    rows = [_row(entries, i, _Box(left, top + i * cell, cell), small=small) for i in range(m)]
    unit = 2.2 if small else 1.0
    width, height = left + k * cell + 2, top + m * cell + 14 + 32 * unit
    bar = _Box(left, top + m * cell + 14, min(240.0 * unit, k * cell))
    title = f"{entries.symbol}: {entries.meaning}"
    svg = element(
        "svg",
        element("title", title, id=f"{prefix}-title"),
        element("desc", entries.in_words(), id=f"{prefix}-desc"),
        _column_names(entries, left, top, cell, small=small),
        element("g", *rows, class_=f"cells{' numbers' if numbers else ''}"),
        _color_bar(entries.limit, bar, unit),
        viewBox=f"0 0 {width:.0f} {height:.0f}",
        role="img" if small else "group",
        class_=f"matrix{' small' if small else ''}",
        aria_labelledby=f"{prefix}-title",
        aria_describedby=f"{prefix}-desc",
    )
    return Drawing(
        str(svg),
        _caption(entries) if not small else f"{title}; joints numbered as in the large picture.",
    )


def _row(entries: Entries, i: int, first: _Box, *, small: bool) -> Markup:
    k = entries.value.shape[1]
    left, y, cell = first
    boxes = (_Box(left + j * cell, y, cell) for j in range(k))
    parts = [_cell(entries, i, j, box, small=small) for j, box in enumerate(boxes)]
    label = element(
        "text",
        str(i + 1) if small else short(entries.rows[i], 12),
        x=left - 6,
        y=first.middle[1],
        text_anchor="end",
        class_="name" if not small or _stands(i, len(entries.rows)) else "no",
    )
    if small:
        return element("g", label, *parts)
    words = ", ".join(
        f"{name} {entries.told(i, j, entries.decimals)}" for j, name in enumerate(entries.columns)
    )
    frame = element(
        "rect", x=left - 1, y=y - 1, width=k * cell + 2, height=cell + 2, class_="frame"
    )
    told = f"{entries.rows[i]} {entries.verb}: {words}"
    return element("g", label, *parts, frame, class_="row", tabindex=0, role="img", aria_label=told)


def _cell(entries: Entries, i: int, j: int, box: _Box, *, small: bool) -> Markup:
    value = float(entries.value[i, j])
    if not math.isfinite(value):
        return Markup()
    level = min(1.0, abs(value) / entries.limit)
    sign = "plus" if value >= 0 else "minus"
    edge = 0.5 if box.side > 12 else 0.0
    parts = [
        element(
            "rect",
            x=box.x + edge,
            y=box.y + edge,
            width=box.side - 2 * edge,
            height=box.side - 2 * edge,
            class_=f"{sign}{' own' if i == j else ''}",
            style=f"--v:{100 * level:.0f}%",
        )
    ]
    if value < 0 and level > 0.08:
        x, y = box.middle
        if not small and len(entries.rows) <= MOST_IN_CELLS:
            y = box.y + box.side * 0.86  # below the number
        reach = box.side * 0.16
        parts.append(element("line", class_="below", x1=x - reach, x2=x + reach, y1=y, y2=y))
    if small:
        return joined(parts)
    who = f"{entries.rows[i]} {entries.verb} {entries.columns[j]}"
    hint = f"{who}: {entries.told(i, j, entries.decimals)}"
    return element("g", element("title", hint), *parts, *_numbers(entries, i, j, box))


def _numbers(entries: Entries, i: int, j: int, box: _Box) -> list[Markup]:
    """The value, and its half width, which the row's focus uncovers."""
    size = min(13.0, box.side * 0.33)
    x, y = box.middle
    value = float(entries.value[i, j])
    half = None if entries.half is None else float(entries.half[i, j])
    unsure = half is not None and abs(value) <= half
    place = {"x": x, "text_anchor": "middle"}
    kind = "value unsure" if unsure else "value"
    parts = [
        element(
            "text", number(value, entries.cell_decimals), y=y, font_size=size, class_=kind, **place
        )
    ]
    if half is not None and len(entries.rows) <= MOST_IN_CELLS:
        told = f"\N{PLUS-MINUS SIGN}{number(half, entries.decimals)}"
        small = {"y": y + size * 0.95, "font_size": size * 0.72}
        parts.append(element("text", told, class_="half", **small, **place))
    return parts


def _stands(i: int, count: int) -> bool:
    """Whether the number of a joint has room beside a small picture."""
    return i % max(1, -(-count // 9)) == 0


def _column_names(entries: Entries, left: float, top: float, cell: float, *, small: bool) -> Markup:
    names = entries.columns
    size = 12.0
    wide = max(len(short(name, 12)) for name in names) * size * 0.62 > cell
    step = max(1, -(-len(names) // 9)) if small else 1
    texts = [
        element(
            "text",
            str(j + 1) if small else (short(name, 12) if not wide else _tail(name)),
            x=left + (j + 0.5) * cell,
            y=top - (20 if small else 10),
            text_anchor="middle",
            class_="name",
        )
        for j, name in enumerate(names)
        if j % step == 0
    ]
    return element("g", *texts)


def _tail(name: str) -> str:
    """The number at a name's end, which tells joints apart, or else the end of the name."""
    digits = name[len(name.rstrip("0123456789")) :]
    return digits or short(name, 5)


def _color_bar(limit: float, box: _Box, unit: float) -> Markup:
    steps = 24
    left, top, width = box
    bars = [
        element(
            "rect",
            x=left + width * n / (2 * steps + 1),
            y=top,
            width=width / (2 * steps + 1) + 0.4,
            height=9 * unit,
            class_="minus" if n < steps else "plus",
            style=f"--v:{abs(n - steps) / steps:.0%}",
        )
        for n in range(2 * steps + 1)
    ]
    digits = decimals_for_values([limit], 2)
    ticks = [
        element(
            "text",
            number(value, digits) if value else "0",
            x=x,
            y=top + 20 * unit,
            text_anchor=anchor,
            class_="name",
        )
        for value, x, anchor in (
            (-limit, left, "start"),
            (0.0, left + width / 2, "middle"),
            (limit, left + width, "end"),
        )
    ]
    return element("g", *bars, *ticks)


def _caption(entries: Entries) -> str:
    text = (
        f"{entries.symbol}: {entries.meaning}. Row: {entries.row}; column: {entries.column}. "
        "Colours end at the largest entry beside the diagonal, which is framed and may go beyond. "
        "A stroke stands in negative cells."
    )
    if entries.half is not None:
        text += " Numbers in italics can't be told from 0 (95 %, one by one)."
    hint = "its intervals" if len(entries.rows) <= MOST_IN_CELLS else "its numbers"
    return f"{text} Point at a row, or reach it with the tab key, for {hint}."
