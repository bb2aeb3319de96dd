"""Draw a coupling matrix whose numbers can all be reached by mouse and keyboard.

Colour goes from one hue over the page's ground to another, in equal steps of lightness for equal
steps of value (a straight line in OKLab), and a stroke stands in every negative cell, so that the
sign needs no colour. Rows take the focus: the keyboard reaches every number, and so does a mouse.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from undulog.capture.common.arrays import FloatArray

from ..common.formats import decimals_for_values, number, short
from ..results.coupling import ComplexMatrix, Coupling, LinearCoupling, LocalCoupling
from .page_tables import color_bar, element, joined, svg_element
from .svg import Drawing

PICTURE = 560.0
"""Side of a picture, one unit is a pixel of a wide page."""

MOST_IN_CELLS = 16
"""Matrices up to this size have numbers in all cells; larger ones show those of a row."""

_FEELS = "the joint that feels the torque"


_Rows = Sequence[Sequence[float]]


@dataclass(frozen=True)
class Entries:
    """A matrix with its names.

    Attributes:
        symbol: E.g. ``P``.
        meaning: Of an entry.
        rows: Names of the responding joints, m.
        columns: Names of the commanded joints, k.
        value: Shape (m, k); NaN if unknown.
        half: Half widths of the 95 % intervals, same shape, or None.
        verb: Between the names of row and column.
        ends: Magnitude at the ends of the colours, if another matrix gives it.
    """

    symbol: str
    meaning: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    value: FloatArray
    half: FloatArray | None = None
    row: str = "the joint that responds"
    column: str = "the joint whose command is moved"
    verb: str = "follows"
    ends: float | None = None

    @property
    def limit(self) -> float:
        """The magnitude at the ends of the colours: the largest off the diagonal, else of all."""
        if self.ends is not None:
            return self.ends
        size = np.nan_to_num(np.abs(self.value))
        beside = size[~np.eye(*size.shape, dtype=np.bool_)]
        return (float(beside.max()) if beside.size else 0.0) or float(size.max()) or 1.0

    def entry_text(self, i: int, j: int, decimals: int) -> str:
        """Return an entry as text, e.g. ``-0.21 ± 0.01``."""
        text = number(float(self.value[i, j]), decimals)
        if self.half is None or not np.isfinite(self.value[i, j]):
            return text
        return f"{text} \N{PLUS-MINUS SIGN} {number(float(self.half[i, j]), decimals)}"

    @property
    def cell_decimals(self) -> int:
        """The decimals that show two digits of the entries off the diagonal."""
        return max(2, decimals_for_values([self.limit], 2))

    @property
    def decimals(self) -> int:
        """The decimals that show two digits of the typical interval, 2 to 6."""
        if self.half is None or not np.median(self.half) > 0:
            return 3
        return int(np.clip(1 - np.floor(np.log10(np.median(self.half))), 2, 6))

    def in_words(self) -> str:
        """Return the description for readers who can't see the picture."""
        m, k = self.value.shape
        return (
            f"{m} rows: {self.row}; {k} columns: {self.column}. The colours end at "
            f"{self.limit:.3g}. The table below holds every number."
        )


def entries_of(coupling: Coupling, names: tuple[str, ...]) -> tuple[Entries, ...]:
    """Return the matrices of a coupling, the main one first.

    Args:
        names: Of the driven joints, if the coupling doesn't name them itself.

    Returns:
        P, R, G and S of local kicks; of a sweep Z, if known, and H at its first tone, then the
        first of them at the others; else its one matrix; empty if it isn't identifiable.
    """
    if isinstance(coupling, LocalCoupling):
        amplitude = "log amplitude"
        matrices = (
            ("P", "phase", "phase", coupling.P),
            ("R", amplitude, "phase", coupling.R),
            ("G", amplitude, amplitude, coupling.G),
            ("S", "phase", amplitude, coupling.S),
        )
        words = "{} of the response over {} of the command".format
        return tuple(
            _entries(symbol, words(what, of), coupling.joints, matrix.value, matrix.ci95_half)
            for symbol, what, of, matrix in matrices
            if matrix is not None
        )
    if isinstance(coupling, LinearCoupling):
        return _sweep(coupling)
    if coupling.matrix is None:
        return ()
    count = len(coupling.matrix)
    rows = names if len(names) == count else tuple(str(k + 1) for k in range(count))
    return (_entries("Coupling", "response over command", rows, coupling.matrix),)


def _entries(
    symbol: str, meaning: str, names: tuple[str, ...], value: _Rows, half: _Rows | None = None
) -> Entries:
    errors = None if half is None else np.array(half, dtype=np.float64)
    return Entries(symbol, meaning, names, names, np.array(value, dtype=np.float64), errors)


def _sweep(coupling: LinearCoupling) -> tuple[Entries, ...]:
    """Return Z, if known, and H at the first tone, then the first of them at the others."""
    entries: list[Entries] = []
    for k, tone in enumerate(coupling.tones):
        at = f"at {tone.frequency_hz:.4g} Hz"
        torque = f"torque over angle {at} [N m/rad]"
        response = f"response over command {at} [rad/rad]"
        suffix = f" {at}" if k else ""
        if tone.Z is not None:
            entries += _parts(f"Z{suffix}", torque, coupling.joints, tone.Z)
        if tone.Z is None or k == 0:
            entries += _parts(f"H{suffix}", response, coupling.joints, tone.H)
    return tuple(entries)


def _parts(
    symbol: str, meaning: str, names: tuple[str, ...], matrix: ComplexMatrix
) -> Iterable[Entries]:
    """Return real and imaginary part with the same ends of the colours."""
    parts = [
        _entries(f"{name} {symbol}", meaning, names, value, matrix.ci95_half)
        for name, value in (("Re", matrix.real), ("Im", matrix.imag))
    ]
    ends = max(part.limit for part in parts)
    words = {"row": _FEELS, "column": "the joint that is moved", "verb": "feels"}
    if symbol.startswith("H"):
        words = {}
    return (replace(part, ends=ends, **words) for part in parts)


class _Box(NamedTuple):
    """Position of a cell."""

    x: float
    y: float
    side: float

    @property
    def middle(self) -> tuple[float, float]:
        return self.x + self.side / 2, self.y + self.side / 2


def matrix_picture(entries: Entries, prefix: str, *, small: bool = False) -> Drawing:
    """Draw a matrix.

    Args:
        prefix: For identifiers, unique in the page.
        small: One of several beside a large one: no numbers in its cells, no focus on its rows.
    """
    m, k = entries.value.shape
    names = [short(name, 12) for name in entries.rows]
    left = 32.0 + 7.0 * max(map(len, names)) if not small else 54.0
    cell = (PICTURE - left) / max(m, k)
    top = 64.0 if small else 48.0
    numbers = not small and m <= MOST_IN_CELLS
    rows = [_row(entries, i, _Box(left, top + i * cell, cell), small=small) for i in range(m)]
    unit = 2.2 if small else 1.0
    width, height = left + k * cell + 2, top + m * cell + 14 + 32 * unit
    bar = _Box(left, top + m * cell + 14, min(240.0 * unit, k * cell))
    title = f"{entries.symbol}: {entries.meaning}"
    svg = svg_element(
        prefix,
        title,
        entries.in_words(),
        *_axis_titles(entries, _Box(left, top, cell)),
        _column_names(entries, left, top, cell, small=small),
        element("g", *rows, class_=f"cells{' numbers' if numbers else ''}"),
        _color_bar(entries.limit, bar, unit),
        viewBox=f"0 0 {width:.0f} {height:.0f}",
        role="img" if small else "group",
        class_=f"matrix{' small' if small else ''}",
    )
    caption = f"{title}; joints numbered as in the large picture." if small else _caption(entries)
    return Drawing(str(svg), caption)


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
        class_="name" if not small or i % _every(len(entries.rows)) == 0 else "no",
    )
    if small:
        return element("g", label, *parts)
    words = ", ".join(
        f"{name} {entries.entry_text(i, j, entries.decimals)}"
        for j, name in enumerate(entries.columns)
    )
    size = {"width": k * cell + 2, "height": cell + 2}
    frame = element("rect", x=left - 1, y=y - 1, **size, class_="frame")
    text = f"{entries.rows[i]} {entries.verb}: {words}"
    return element("g", label, *parts, frame, class_="row", tabindex=0, role="img", aria_label=text)


def _cell(entries: Entries, i: int, j: int, box: _Box, *, small: bool) -> Markup:
    value = float(entries.value[i, j])
    if not math.isfinite(value):
        return Markup()
    level = min(1.0, abs(value) / entries.limit)
    sign = "plus" if value >= 0 else "minus"
    edge = 0.5 if box.side > 12 else 0.0
    side = box.side - 2 * edge
    kind = {"class_": f"{sign}{' own' if i == j else ''}", "style": f"--v:{100 * level:.0f}%"}
    parts = [element("rect", x=box.x + edge, y=box.y + edge, width=side, height=side, **kind)]
    if value < 0 and level > 0.08:
        x, y = box.middle
        if not small and len(entries.rows) <= MOST_IN_CELLS:
            y = box.y + box.side * 0.86  # below the number
        reach = box.side * 0.16
        parts.append(element("line", class_="below", x1=x - reach, x2=x + reach, y1=y, y2=y))
    if small:
        return joined(parts)
    who = f"{entries.rows[i]} {entries.verb} {entries.columns[j]}"
    hint = f"{who}: {entries.entry_text(i, j, entries.decimals)}"
    return element("g", element("title", hint), *parts, *_numbers(entries, i, j, box))


def _numbers(entries: Entries, i: int, j: int, box: _Box) -> list[Markup]:
    """Return the value, and its half width, which is visible when the row has the focus."""
    size = min(13.0, box.side * 0.33)
    x, y = box.middle
    value = float(entries.value[i, j])
    half = None if entries.half is None else float(entries.half[i, j])
    place = {"x": x, "text_anchor": "middle"}
    kind = "value unsure" if half is not None and abs(value) <= half else "value"
    text = number(value, entries.cell_decimals)
    parts = [element("text", text, y=y, font_size=size, class_=kind, **place)]
    if half is not None and len(entries.rows) <= MOST_IN_CELLS:
        half_text = f"\N{PLUS-MINUS SIGN}{number(half, entries.decimals)}"
        small = {"y": y + size * 0.95, "font_size": size * 0.72}
        parts.append(element("text", half_text, class_="half", **small, **place))
    return parts


def _every(count: int) -> int:
    """Return the step of joint numbers that have room beside a small picture."""
    return max(1, -(-count // 9))


def _column_names(entries: Entries, left: float, top: float, cell: float, *, small: bool) -> Markup:
    names = entries.columns
    size = 12.0
    wide = max(len(short(name, 12)) for name in names) * size * 0.62 > cell
    step = _every(len(names)) if small else 1
    y = top - (20 if small else 10)
    texts: list[Markup] = []
    for j in range(0, len(names), step):
        text = str(j + 1) if small else _tail(names[j]) if wide else short(names[j], 12)
        style = {"text_anchor": "middle", "class_": "name"}
        texts.append(element("text", text, x=left + (j + 0.5) * cell, y=y, **style))
    return element("g", *texts)


def _axis_titles(entries: Entries, first: _Box) -> list[Markup]:
    """Return the titles of columns and rows, centred over them and beside them.

    Args:
        first: The cell at the top left.
    """
    m, k = entries.value.shape
    middle_x, middle_y = first.x + k * first.side / 2, first.y + m * first.side / 2
    style = {"text_anchor": "middle", "class_": "name"}
    turned = f"rotate(-90 12 {middle_y:.2f})"
    return [
        element("text", f"column: {entries.column}", x=middle_x, y=12, **style),
        element("text", f"row: {entries.row}", x=12, y=middle_y, transform=turned, **style),
    ]


def _tail(name: str) -> str:
    """Return the number at a name's end, or else a short form of the name."""
    return name[len(name.rstrip("0123456789")) :] or short(name, 5)


def _color_bar(limit: float, box: _Box, unit: float) -> Markup:
    left, top, width = box
    digits = decimals_for_values([limit], 2)
    ticks = [
        element("text", text, x=x, y=top + 20 * unit, text_anchor=anchor, class_="name")
        for text, x, anchor in (
            (number(-limit, digits), left, "start"),
            ("0", left + width / 2, "middle"),
            (number(limit, digits), left + width, "end"),
        )
    ]
    return element("g", *color_bar(left, top, width, 9 * unit, signed=True), *ticks)


def _caption(entries: Entries) -> str:
    text = (
        f"{entries.symbol}: {entries.meaning}. "
        "Colours end at the largest entry beside the diagonal, which is framed and may go beyond. "
        "A stroke stands in negative cells."
    )
    if entries.half is not None:
        text += " Numbers in italics do not differ significantly from 0 (95 %, one by one)."
    what = "the numbers" if entries.half is None else "the intervals"
    return f"{text} The table below has {what}."
