"""A matrix of coupling as a picture: who follows whom, with every number in reach.

Colour goes from one hue over the page's ground to another, in equal steps of lightness for equal
steps of value (a straight line in OKLab), and a stroke stands in every negative cell, so that the
sign needs no colour. Rows take the focus: the keyboard reaches every number, and so does a mouse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from undulog.capture.common.arrays import FloatArray

from ...results.coupling import ComplexMatrix, Coupling, LinearCoupling, LocalCoupling, Matrix
from ...results.formats import decimals_for_values, number, short
from .svg import Drawing
from .tables import element, joined


@dataclass(frozen=True)
class Entries:
    """A matrix with its names.

    Attributes:
        symbol: E.g. ``P``.
        meaning: What an entry is, in words.
        rows: Names of the responding joints, m.
        columns: Names of the commanded joints, k.
        value: Shape (m, k); NaN where nothing is known.
        half: Half widths of the 95 % intervals, same shape; None where they are not known.
        verb: What the one does to the other.
        ends: Magnitude at the ends of the colours, where it is given by what stands beside it.
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
        """Magnitude at the ends of the colours: the largest beside the diagonal, else of all."""
        if self.ends is not None:
            return self.ends
        size = np.nan_to_num(np.abs(self.value))
        beside = size[~np.eye(*size.shape, dtype=np.bool_)]
        largest = float(beside.max()) if beside.size else 0.0
        return largest or float(size.max()) or 1.0

    def entry_text(self, i: int, j: int, decimals: int) -> str:
        """One entry in words.

        Args:
            decimals: Digits after the point.

        Returns:
            For example ``-0.21 ± 0.01``.
        """
        text = number(float(self.value[i, j]), decimals)
        if self.half is None or not np.isfinite(self.value[i, j]):
            return text
        return f"{text} \N{PLUS-MINUS SIGN} {number(float(self.half[i, j]), decimals)}"

    @property
    def cell_decimals(self) -> int:
        """Digits after the point that show two digits of the entries beside the diagonal."""
        return max(2, decimals_for_values([self.limit], 2))

    @property
    def decimals(self) -> int:
        """Digits after the point that show two digits of the typical interval, 2 to 6."""
        if self.half is None or not np.median(self.half) > 0:
            return 3
        return int(np.clip(1 - np.floor(np.log10(np.median(self.half))), 2, 6))

    def in_words(self) -> str:
        """What a reader who can't see the picture should know."""
        m, k = self.value.shape
        return (
            f"{m} rows: {self.row}; {k} columns: {self.column}. The colours end at "
            f"{self.limit:.3g}. The table below holds every number."
        )


def entries_of(coupling: Coupling, names: tuple[str, ...]) -> tuple[Entries, ...]:
    """The matrices that a coupling holds, the main one first.

    Args:
        coupling: Of a session or an experiment.
        names: Of the driven joints, where the coupling doesn't name them itself.

    Returns:
        None where it isn't identifiable; P, R, G and S of local kicks; of a sweep Z, where it is
        known, and H at its first tone, then the first of them at the others; else its one matrix.
    """
    if isinstance(coupling, LocalCoupling):
        known = (
            ("P", "phase of the response over phase of the command", coupling.P),
            ("R", "log amplitude of the response over phase of the command", coupling.R),
            ("G", "log amplitude of the response over log amplitude of the command", coupling.G),
            ("S", "phase of the response over log amplitude of the command", coupling.S),
        )
        return tuple(
            _local(symbol, meaning, matrix, coupling.joints)
            for symbol, meaning, matrix in known
            if matrix is not None
        )
    if isinstance(coupling, LinearCoupling):
        return _sweep(coupling)
    if coupling.matrix is None:
        return ()
    value = np.array(coupling.matrix, dtype=np.float64)
    rows = names if len(names) == len(value) else tuple(str(k + 1) for k in range(len(value)))
    return (Entries("Coupling", "response over command", rows, rows, value),)


def _local(symbol: str, meaning: str, matrix: Matrix, names: tuple[str, ...]) -> Entries:
    value, half = (np.array(one, dtype=np.float64) for one in (matrix.value, matrix.ci95_half))
    return Entries(symbol, meaning, names, names, value, half)


def _sweep(coupling: LinearCoupling) -> tuple[Entries, ...]:
    """What the answer speaks of comes first: Z, or H where Z isn't known."""
    several = len(coupling.tones) > 1
    found: list[Entries] = []
    for k, tone in enumerate(coupling.tones):
        at = f"{tone.frequency_hz:.4g} Hz"
        symbol = f" at {at}" if several and k else ""
        if tone.Z is not None:
            found += _parts(_torques(f"Z{symbol}", at, coupling.joints, tone.Z), tone.Z)
        if tone.Z is None or k == 0:
            found += _parts(_responses(f"H{symbol}", at, coupling.joints, tone.H), tone.H)
    return tuple(found)


def _torques(symbol: str, at: str, names: tuple[str, ...], matrix: ComplexMatrix) -> Entries:
    meaning = f"torque over angle at {at} [N m/rad]"
    who = ("the joint that feels the torque", "the joint that is moved", "feels")
    return Entries(symbol, meaning, names, names, *_real(matrix), *who)


def _responses(symbol: str, at: str, names: tuple[str, ...], matrix: ComplexMatrix) -> Entries:
    meaning = f"response over command at {at} [rad/rad]"
    return Entries(symbol, meaning, names, names, *_real(matrix))


def _real(matrix: ComplexMatrix) -> tuple[FloatArray, FloatArray]:
    return np.array(matrix.real, dtype=np.float64), np.array(matrix.ci95_half, dtype=np.float64)


def _parts(real: Entries, matrix: ComplexMatrix) -> tuple[Entries, Entries]:
    """Real and imaginary part, in the same colours: what is small beside the other looks small."""
    imag = replace(real, value=np.array(matrix.imag, dtype=np.float64))
    ends = max(real.limit, imag.limit)
    return (
        replace(real, symbol=f"Re {real.symbol}", ends=ends),
        replace(imag, symbol=f"Im {real.symbol}", ends=ends),
    )


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
        prefix: For identifiers, unique in the page.
        small: One of several beside a large one: no numbers in its cells, no focus on its rows.
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
        f"{name} {entries.entry_text(i, j, entries.decimals)}"
        for j, name in enumerate(entries.columns)
    )
    frame = element(
        "rect", x=left - 1, y=y - 1, width=k * cell + 2, height=cell + 2, class_="frame"
    )
    text = f"{entries.rows[i]} {entries.verb}: {words}"
    return element("g", label, *parts, frame, class_="row", tabindex=0, role="img", aria_label=text)


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
    hint = f"{who}: {entries.entry_text(i, j, entries.decimals)}"
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
        half_text = f"\N{PLUS-MINUS SIGN}{number(half, entries.decimals)}"
        small = {"y": y + size * 0.95, "font_size": size * 0.72}
        parts.append(element("text", half_text, class_="half", **small, **place))
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
        text += " Numbers in italics do not differ significantly from 0 (95 %, one by one)."
    hint = "its intervals" if len(entries.rows) <= MOST_IN_CELLS else "its numbers"
    return f"{text} Point at a row, or reach it with the tab key, for {hint}."
