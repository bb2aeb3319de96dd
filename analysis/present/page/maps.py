"""Draw maps of joints against cycles: gain, lag and power over time.

Colours run in a straight line through OKLab, in equal steps of lightness for equal steps of value,
and from one hue over the ground to another where the sign matters.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from undulog.capture.common.arrays import BoolArray, FloatArray

from ...results.formats import decimals_for_values, number, short
from ...session.cycles import CycleMaps
from .svg import Drawing
from .tables import LEVELS, color_bar, element, hue, svg_element

MOST_COLUMNS = 150
"""Columns of a map; more cycles are averaged, with a note."""

WIDTH = 960.0
"""One unit is a pixel of a wide page."""

_RIGHT = 8.0


@dataclass(frozen=True)
class Map:
    """A map.

    Attributes:
        names: Of the rows, head at the top, m.
        value: Means of the columns, NaN where all their cycles are missing, shape (m, k).
        holed: Whether any cycle of a column is missing, shape (m, k).
        edges_s: Limits of the columns from the session's start [s], shape (k + 1,).
        signed: Whether colours part at zero.
        least: Smallest span of the colours, so that noise isn't magnified.
    """

    title: str
    names: tuple[str, ...]
    value: FloatArray
    holed: BoolArray
    edges_s: FloatArray
    signed: bool
    least: float

    @property
    def limits(self) -> tuple[float, float]:
        """The values at the ends of the colours."""
        low, high = float(np.nanmin(self.value)), float(np.nanmax(self.value))
        if self.signed:
            high = max(abs(low), abs(high), self.least / 2)
            return -high, high
        short_by = max(0.0, self.least - (high - low)) / 2
        return low - short_by, high + short_by


def cycle_drawings(cycles: CycleMaps, prefix: str) -> tuple[Drawing, ...]:
    """Draw gain, lag and power, as far as any cycle has them.

    Args:
        prefix: For identifiers, unique in the page.
    """
    shown = (
        ("Gain", cycles.driven, cycles.gain, False, 0.02),
        ("Lag [°]", cycles.driven, np.degrees(cycles.lag_rad), False, 1.0),
        ("Mean mechanical power [mW]", cycles.powered, 1000 * cycles.power_w, True, 1.0),
    )
    drawings: list[Drawing] = []
    for title, names, value, signed, least in shown:
        if np.isfinite(value).any():
            one = Map(title, names, *_thinned(cycles, value), signed, least)
            drawings.append(_draw(one, f"{prefix}-{len(drawings)}", _caption(cycles, one)))
    return tuple(drawings)


def _thinned(cycles: CycleMaps, value: FloatArray) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return means over as few cycles as fit into the map's columns."""
    count = cycles.start_s.size
    first = np.arange(0, count, -(-count // MOST_COLUMNS))
    known = np.isfinite(value)
    total = np.add.reduceat(np.where(known, value, 0.0), first, axis=1)
    seen = np.add.reduceat(known.astype(np.float64), first, axis=1)
    mean = np.divide(total, seen, out=np.full_like(total, np.nan), where=seen > 0)
    width = np.diff(np.append(first, count))
    end_s = cycles.start_s[-1] + cycles.period_s
    return mean, seen < width, np.append(cycles.start_s[first], end_s)


def _draw(shown: Map, prefix: str, caption: str) -> Drawing:
    m = len(shown.names)
    side = 18.0 if m <= 13 else 12.0
    left, top = 14.0 + 7.0 * max(len(short(name, 12)) for name in shown.names), 6.0
    width, height = WIDTH - left - _RIGHT, side * m
    at_s = (shown.edges_s - shown.edges_s[0]) / (shown.edges_s[-1] - shown.edges_s[0])
    edges = left + width * at_s
    low, high = shown.limits
    share = (shown.value - low) / (high - low)
    level = np.where(np.isfinite(share), np.rint(share * LEVELS), -1).astype(np.int64)
    paths = [
        element("path", d=_cells(level == n, edges, top, side), **hue(n, signed=shown.signed))
        for n in range(LEVELS + 1)
        if (level == n).any()
    ]
    parts = [element("g", *paths, class_="cells")]
    if shown.holed.any():
        line = element("path", d="M0 0V6", class_="hatch")
        pattern = {
            "id": f"{prefix}-missing",
            "width": 6,
            "height": 6,
            "patternUnits": "userSpaceOnUse",
            "patternTransform": "rotate(45)",
        }
        holes = _cells(shown.holed, edges, top, side)
        parts.append(element("pattern", line, **pattern))
        parts.append(element("path", d=holes, fill=f"url(#{prefix}-missing)", class_="holed"))
    foot = top + height
    svg = svg_element(
        prefix,
        f"{shown.title} of every joint in every cycle",
        _in_words(shown),
        *parts,
        element("rect", x=left, y=top, width=width, height=height, class_="frame"),
        *_names(shown.names, left, top, side),
        *_times(shown.edges_s, left, width, foot),
        *_bar(shown, left, foot + 40),
        viewBox=f"0 0 {WIDTH:.0f} {foot + 74:.0f}",
        role="img",
        class_="map",
        data_map=_cell_values(shown, edges, top, side),
    )
    return Drawing(str(svg), caption)


def _cell_values(shown: Map, edges: FloatArray, top: float, side: float) -> str:
    """Return places and values of all cells for the page's script, with three digits."""
    low, high = shown.limits
    decimals = decimals_for_values([low, high], 3)
    values = [
        [round(value, decimals) if math.isfinite(value) else None for value in row]
        for row in shown.value.tolist()
    ]
    facts = {
        "top": top,
        "side": side,
        "edges": edges.round(1).tolist(),
        "times": shown.edges_s.round(2).tolist(),
        "names": shown.names,
        "values": values,
        "label": shown.title[0].lower() + shown.title[1:],
    }
    return json.dumps(facts, ensure_ascii=False, separators=(",", ":"))


def _cells(chosen: BoolArray, edges: FloatArray, top: float, side: float) -> str:
    """Path around the chosen cells, those beside one another in a row as one."""
    turns = np.diff(np.pad(chosen.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(turns == 1)
    _, stops = np.nonzero(turns == -1)
    return "".join(
        f"M{edges[i]:.1f} {top + side * row:g}H{edges[j]:.1f}v{side:g}H{edges[i]:.1f}z"
        for row, i, j in zip(rows, starts, stops, strict=True)
    )


def _names(names: Sequence[str], left: float, top: float, side: float) -> list[Markup]:
    step = 1 if side > 14 else 2
    return [
        element("text", short(name, 12), x=left - 6, y=top + side * (i + 0.5), text_anchor="end")
        for i, name in enumerate(names)
        if i % step == 0
    ]


def _times(edges_s: FloatArray, left: float, width: float, foot: float) -> list[Markup]:
    start, stop = float(edges_s[0]), float(edges_s[-1])
    rough = (stop - start) / 8
    power = 10.0 ** math.floor(math.log10(rough))
    step = float(power * next(n for n in (1, 2, 5, 10) if n * power >= rough))
    digits = decimals_for_values([step], 1)
    ticks = [n * step for n in range(math.ceil(start / step), math.floor(stop / step) + 1)]
    parts: list[Markup] = []
    for tick in ticks:
        x = left + width * (tick - start) / (stop - start)
        parts.append(element("path", d=f"M{x:.1f} {foot:g}v4", class_="tick"))
        parts.append(element("text", number(tick, digits), x=x, y=foot + 13, text_anchor="middle"))
    label = "time from the session's start [s]"
    parts.append(element("text", label, x=left + width, y=foot + 30, text_anchor="end"))
    return parts


def _bar(shown: Map, left: float, top: float) -> list[Markup]:
    low, high = shown.limits
    digits = decimals_for_values([low, high], 3)
    width = 240.0
    ends = ((low, 0.0, "start"), ((low + high) / 2, 0.5, "middle"), (high, 1.0, "end"))
    texts = [
        element("text", number(v, digits), x=left + width * f, y=top + 20, text_anchor=anchor)
        for v, f, anchor in ends
    ]
    title = element("text", shown.title, x=left + width + 14, y=top + 5)
    return [*color_bar(left, top, width, 9, signed=shown.signed), *texts, title]


def _in_words(shown: Map) -> str:
    m, k = shown.value.shape
    low, high = float(np.nanmin(shown.value)), float(np.nanmax(shown.value))
    digits = decimals_for_values([low, high], 3)
    missing = int(np.count_nonzero(shown.holed))
    return (
        f"{m} joints in rows, head at the top, {k} columns of time; values from "
        f"{number(low, digits)} to {number(high, digits)}; {missing or 'no'} cells miss cycles."
    )


def _caption(cycles: CycleMaps, shown: Map) -> str:
    count = cycles.start_s.size
    step = -(-count // MOST_COLUMNS)
    name = shown.title.partition(" [")[0].capitalize()
    text = f"{name}: each column is one of {count} cycles."
    if step > 1:
        many = f"{count} cycles are too many to show one by one"
        text = f"{name}: {many}; each column is the mean of {step}."
    if shown.signed:
        text += " Negative: driven by the rest of the body."
    if shown.holed.any():
        text += " Hatched: cycles are missing there, or falsified by a sensor."
    return text
