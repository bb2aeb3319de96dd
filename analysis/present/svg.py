"""Matplotlib figures as inline SVG, and the style that all figures of the report share.

Colours that must follow the reader's light or dark scheme are drawn in sentinel colours and
become CSS variables here. Text stays text, in the page's own font. Nothing in the result depends
on the time, the machine or other figures on the page: identifiers carry the figure's own prefix.

Every figure is a pure function of results. A joint keeps its colour, horizontal joints are
circles and vertical ones squares, references and nulls are dashed grey, estimates carry their
95 % interval, the segment axis runs head to tail from left to right.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, TypeAlias
from xml.etree import ElementTree as ET

import matplotlib as mpl
import numpy as np
from matplotlib import dates, lines, ticker
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as _Figure

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import plain

from ..common.estimate import Estimate
from ..common.formats import short

Figure: TypeAlias = Any
Axes: TypeAlias = Any
Handle: TypeAlias = Any
"""Matplotlib's own annotations leave keyword arguments unknown, so its objects are untyped."""

_mpl: Any = mpl
_FIXED: Any = (ticker.FixedLocator, dates.DateLocator)

INK = "#010101"
"""Sentinel: text and outlines."""
MUTED = "#020202"
"""Sentinel: axes, ticks, secondary text."""
GRID = "#030303"
"""Sentinel: grid lines."""
REFERENCE = "#040404"
"""Sentinel: commands, nulls and references."""
PAPER = "#050505"
"""Sentinel: the page's background, for hollow markers."""

CSS_VARIABLES: dict[str, str] = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--grid)",
    REFERENCE: "var(--reference)",
    PAPER: "var(--paper)",
}

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "undulog",
    "text.parse_math": False,  # a "$" in a joint's name is a "$"
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # ships with matplotlib: same layout on every machine
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelsize": 8.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
    "figure.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "path.simplify": True,
    "text.color": INK,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "xtick.major.width": 0.6,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "ytick.major.width": 0.6,
}
"""What a figure is drawn with; see :func:`drawing`."""

ABOVE = "above-"
"""Begin of the ``gid`` of a text above a panel that belongs to a value in it."""

WIDTH_IN = 8.0
"""Width of every figure [inch]; the page scales it."""

_SVG = "http://www.w3.org/2000/svg"
_XLINK = "{http://www.w3.org/1999/xlink}href"
_NUMBER = re.compile(r"-?\d+\.\d+")
_URL = re.compile(r"url\(#([^)]+)\)")
_FONT_SIZE = re.compile(r"font-size: ([\d.]+)px")
_FONT_WEIGHT = re.compile(r"font(?:-weight)?: (bold|[6-9]00)\b")
_ANCHOR = re.compile(r"text-anchor: (\w+)")
_TICK = re.compile(r"([xy])tick_")
_FILL = re.compile(r"(?:^|; ?)fill: ([^;]+)")

DASHED = (0, (5, 3))
"""Line style of margins, means and nulls."""

COMMAND: dict[str, Any] = {"color": REFERENCE, "linewidth": 2.4, "linestyle": (0, (2.2, 0.9))}
"""Line behind that of a joint, whose colour some readers can't tell from grey."""


_kept: ContextVar[dict[str, Figure] | None] = ContextVar("figures", default=None)


@contextmanager
def drawing(height_in: float, width_in: float = WIDTH_IN) -> Generator[Figure]:
    """Open an empty figure in the page's own style, whatever the caller's matplotlib is set to.

    Panels and legend share its space. It belongs to no window, so that nothing must close it.
    """
    with _mpl.rc_context():
        _mpl.rcdefaults()
        _mpl.rcParams.update(STYLE)
        yield _Figure(figsize=(width_in, height_in), layout="constrained")


@contextmanager
def kept_figures() -> Generator[dict[str, Figure]]:
    """Keep the figures that :func:`inline_svg` writes meanwhile, by their prefix."""
    figures: dict[str, Figure] = {}
    token = _kept.set(figures)
    try:
        yield figures
    finally:
        _kept.reset(token)


def inline_svg(
    figure: Figure,
    prefix: str,
    title: str,
    description: str,
    tooltips: Mapping[str, str | Sequence[str]] = {},
) -> str:
    """Write a figure as an ``<svg>`` element for any HTML page.

    Args:
        figure: Drawn with the sentinel colours of this module.
        prefix: Unique in the page; every identifier begins with it.
        title: Its accessible name (WAI-ARIA ``img``; W3C SVG Accessibility API Mappings).
        description: Text for readers who cannot see the figure.
        tooltips: Group identifier (``gid`` of an artist) to the text shown when it is pointed at;
            of a line its name, or a text for each of its points.

    Returns:
        The element, without XML declaration, document type, metadata, date or outside reference.
    """
    for k, axes in enumerate(figure.axes):
        axes.set_gid(f"panel-{k}")
    root = _drawn(figure)
    if (kept := _kept.get()) is not None:
        kept[prefix] = figure
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"):
                parent.remove(child)
    for group in root.iter(f"{{{_SVG}}}g"):
        text = tooltips.get(group.get("id", ""))
        if isinstance(text, str):
            group.insert(0, _text_element("title", text))
        elif text is not None:
            group.set("data-tips", "\n".join(map(plain, text)))
    _describe_panels(root, figure)
    _rename_identifiers(root, prefix)
    for element in root.iter():
        _tidy(element)
    root.insert(0, _text_element("title", title, f"{prefix}-title"))
    root.insert(1, _text_element("desc", description, f"{prefix}-desc"))
    labels = {"aria-labelledby": f"{prefix}-title", "aria-describedby": f"{prefix}-desc"}
    root.attrib.update({"role": "img", **labels, "class": "figure"})
    # Inline in HTML the default namespace is implied, and the parser wants plain tags.
    for element in root.iter():
        element.tag = element.tag.removeprefix(f"{{{_SVG}}}")
    return ET.tostring(root, encoding="unicode")


def _describe_panels(root: ET.Element, figure: Figure) -> None:
    """Give each panel its box, scales and labels, and mark its ticks, for the page's script."""
    size = 72 * figure.get_size_inches()
    for k, axes in enumerate(figure.axes):
        group = next(element for element in root.iter() if element.get("id") == f"panel-{k}")
        low, high = axes.get_position().get_points() * size
        box = [low[0], size[1] - high[1], high[0] - low[0], high[1] - low[1]]
        facts = {
            "box": [round(float(value), 2) for value in box],
            "x": _scale(figure, axes, "x"),
            "y": _scale(figure, axes, "y"),
        }
        group.set("data-panel", plain(json.dumps(facts, ensure_ascii=False)))
        for element in group.iter(f"{{{_SVG}}}g"):
            name = element.get("id", "")
            if match := _TICK.match(name):
                element.set("class", f"tick {match[1]}")
            elif name.startswith(ABOVE):
                element.set("class", "above")


def _scale(figure: Figure, axes: Axes, name: str) -> list[object]:
    """Return ends, kind, group of panels that share it, and label of an axis."""
    axis = getattr(axes, f"{name}axis")
    shared = getattr(axes, f"get_shared_{name}_axes")()
    together = [
        k for k, axis in enumerate(figure.axes) if axis is axes or shared.joined(axes, axis)
    ]
    labels: list[str] = [getattr(figure.axes[k], f"get_{name}label")() for k in together]
    labels.append(getattr(figure, f"get_sup{name}label")())
    label = next((label for label in labels if label), "")
    fixed = isinstance(axis.get_major_locator(), _FIXED)
    kind = "fixed" if fixed else axis.get_scale()
    return [*map(float, getattr(axes, f"get_{name}lim")()), kind, together[0], label]


def _drawn(figure: Figure) -> ET.Element:
    """Return the figure as matplotlib writes it, parsed."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Text is set in the reader's fonts, so a glyph that our layout font lacks is no loss.
        warnings.filterwarnings("ignore", message=".*[Gg]lyph.*missing from", category=UserWarning)
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(buffer, metadata=nothing)
    return ET.fromstring(buffer.getvalue())  # noqa: S314  our own output of a moment ago


def _text_element(tag: str, text: str, identifier: str | None = None) -> ET.Element:
    element = ET.Element(f"{{{_SVG}}}{tag}", {} if identifier is None else {"id": identifier})
    element.text = plain(text)
    return element


def _rename_identifiers(root: ET.Element, prefix: str) -> None:
    """Prefix the identifiers that are referred to, in order of appearance; drop the others."""
    used: dict[str, str] = {}
    for element in root.iter():
        for key, value in element.attrib.items():
            references = [value.removeprefix("#")] if key == _XLINK else _URL.findall(value)
            for name in references:
                used.setdefault(name, f"{prefix}-{len(used)}")
    for element in root.iter():
        name = element.attrib.pop("id", None)
        if name in used:
            element.set("id", used[name])
        target = element.attrib.pop(_XLINK, None)
        if target is not None:
            element.set("href", "#" + used[target.removeprefix("#")])
        for key, value in element.attrib.items():
            element.set(key, _URL.sub(lambda m: f"url(#{used[m[1]]})", value))


def _tidy(element: ET.Element) -> None:
    """Sentinels to variables, two decimals, no fonts of our own, no white space."""
    if element.tag == f"{{{_SVG}}}text":
        _plain_text_style(element)
    if element.text is not None and not element.text.strip():
        element.text = None
    element.tail = None
    for key, value in element.attrib.items():
        new = value
        if key in ("d", "x", "y", "width", "height", "transform", "points"):
            new = _NUMBER.sub(lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), new)
            new = " ".join(new.split())
        elif key == "style":
            for sentinel, variable in CSS_VARIABLES.items():
                new = new.replace(sentinel, variable)
        element.set(key, new)


def _plain_text_style(text: ET.Element) -> None:
    """Keep size, weight, anchor and colour of a text; its family is the page's business."""
    style = text.attrib.pop("style", "")
    for attribute, pattern in (
        ("font-size", _FONT_SIZE),
        ("font-weight", _FONT_WEIGHT),
        ("text-anchor", _ANCHOR),
    ):
        match = pattern.search(style)
        if match is not None:
            text.set(attribute, match[1])
    fill = _FILL.search(style)
    text.set("style", f"fill: {fill[1] if fill is not None else INK}")
    if text.get("transform", "").startswith("rotate(-0 "):
        del text.attrib["transform"]


@dataclass(frozen=True)
class Drawing:
    """A figure ready for the page.

    Attributes:
        svg: The ``<svg>`` element.
        caption: One or two sentences, plain text.
    """

    svg: str
    caption: str


def marker(plane: str | None) -> str:
    """Return the matplotlib marker of a plane: circle, square, or triangle if it is unknown."""
    return {"horizontal": "o", "vertical": "s"}.get(plane or "", "^")


def key(**style: Any) -> Handle:
    """Return a line or marker for a legend."""
    return lines.Line2D([], [], **style)


def plot_estimate(
    axes: Axes,
    place: float,
    quantity: Estimate,
    color: str,
    *,
    bar: float = 1.6,
    zorder: int = 2,
    **style: Any,
) -> None:
    """Plot a value as a marker, and its 95 % interval, if it has one, as a vertical bar.

    Args:
        bar: Width of the bar [points].
        zorder: Of the bar; the marker lies above it.
        **style: Of the marker, instead of a circle of that colour.
    """
    if quantity.ci95 is not None:
        axes.plot([place, place], quantity.ci95, color=color, linewidth=bar, zorder=zorder)
    solid = {"marker": "o", "markersize": 5.2, "markerfacecolor": color, "markeredgecolor": INK}
    style = solid | {"markeredgewidth": 0.5} | style
    axes.plot([place], [quantity.value], linestyle="none", zorder=zorder + 1, **style)


def band(axes: Axes, x: FloatArray, low: FloatArray, high: FloatArray, **style: Any) -> None:
    """Fill the area between two curves, each of shape (n,), as one path that zooms like a line."""
    axes.fill(np.append(x, x[::-1]), np.append(low, high[::-1]), linewidth=0, **style)


def legend(figure: Figure, *handles: Handle) -> None:
    """Draw one line of keys above all panels of a constrained layout, from the left edge."""
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncols=len(handles),
        borderaxespad=0.2,
        columnspacing=1.6,
        handletextpad=0.5,
        handlelength=1.8,
    )


def joint_ticks(axes: Axes, names: Sequence[str]) -> None:
    """Label joints 1, 2, ... along the axis; every second, third ... if not all names fit."""
    shown = [short(name, 14) for name in names]
    room = 95  # characters of 8 points that stand beside one another over the width
    step = max(1, -(-sum(len(name) + 2 for name in shown) // room))
    axes.set_xlim(0.4, len(names) + 0.6)
    axes.set_xticks(range(1, len(names) + 1, step), shown[::step])
