"""The figures of a page as files: SVG, PNG or PDF, on paper.

An SVG file is the page's own element. For PNG and PDF a figure that matplotlib drew is drawn once
more with colours instead of the page's variables; maps and matrices, which the page writes as
rectangles, paths and text, are drawn from these.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree as ET

import matplotlib as mpl
import numpy as np
from matplotlib import colors, patches
from matplotlib.backends.backend_agg import FigureCanvasAgg

from undulog.capture.common.console import refuse_existing
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import part_file, write_text

from .result_files import Picture, paper_colors
from .svg import CSS_VARIABLES, STYLE, Axes, Figure, drawing

Format = Literal["svg", "png", "pdf"]

_DPI = 200
_PX_PER_IN = 96.0
_FIGURE = re.compile(r'<svg\b[^>]*aria-labelledby="([\w-]+)-title".*?</svg>', re.DOTALL)
_PATH = re.compile(r"([MHVhvz])([-\d. ]*)")
_MPL: Any = mpl  # its annotations leave keyword arguments unknown
_COLORS: Any = colors
_PATCHES: Any = patches

_PROPERTIES = ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor")

_TO_LMS = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_TO_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
"""B. Ottosson, "A perceptual color space for image processing", 2020; W3C CSS Color 4."""


def check_plots(folder: Path, kind: Format, *, force: bool) -> None:
    """Check the folder of figures before any work is done.

    Raises:
        OutputExistsError: If there are files of the format in it and ``force`` is not given.
        UsageError: If it is a file, or its own folder doesn't exist.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; name a folder for the figures")
    if not folder.exists():
        refuse_existing(folder, force=force)
    for pattern in (f"*.{kind}", f"*/*.{kind}"):  # of one page, or of several
        if path := next(folder.glob(pattern), None):
            refuse_existing(path, force=force)


def figures_of(page: str) -> dict[str, str]:
    """Return the figures of a page, in their order.

    Returns:
        Name, such as ``segments``, to the ``<svg>`` element.
    """
    return {match[1].removesuffix("-figure"): match[0] for match in _FIGURE.finditer(page)}


def save_plots(
    page: str,
    drawn: Mapping[str, Figure],
    folder: Path,
    kind: Format = "svg",
    *,
    force: bool = False,
) -> list[Path]:
    """Write each figure of a page to a file.

    Args:
        page: The HTML page.
        drawn: The page's figures by matplotlib, from :func:`..page.svg.kept_figures`.
        folder: Made if it isn't there.
        force: Replace files.

    Returns:
        The files, named after the figures.

    Raises:
        OutputExistsError: If a file is there and ``force`` is not given; none is written then.
        LogWriteError: If one can't be written.
    """
    named = {prefix.removesuffix("-figure"): figure for prefix, figure in drawn.items()}
    figures = figures_of(page)
    folder.mkdir(exist_ok=True)
    paths = {name: folder / f"{name}.{kind}" for name in figures}
    for path in paths.values():
        refuse_existing(path, force=force)
    for name, svg in figures.items():
        if kind == "svg":
            write_text(paths[name], Picture(svg, "").to_svg())
            continue
        nothing = {"Software": None} if kind == "png" else {"CreationDate": None}
        style = STYLE | {k: _on_paper(v) for k, v in STYLE.items() if isinstance(v, str)}
        with part_file(paths[name]) as part, _MPL.rc_context(style):  # of ticks that are added
            figure = recolored(named[name]) if name in named else figure_of(svg)
            FigureCanvasAgg(figure)
            paper = paper_colors()["paper"]
            figure.savefig(part, format=kind, dpi=_DPI, facecolor=paper, metadata=nothing)
    return list(paths.values())


def _on_paper(color: str) -> str:
    """Return a colour, those of the page's variables as they are on paper."""
    variable = CSS_VARIABLES.get(color)
    return color if variable is None else paper_colors()[variable[6:-1]]


def recolored(figure: Figure) -> Figure:
    """Replace the page's variables by the colours of paper, in place, and return the figure."""
    paper = {
        _COLORS.to_rgb(variable): _COLORS.to_rgb(_on_paper(variable)) for variable in CSS_VARIABLES
    }
    for artist in figure.findobj():
        for name in _PROPERTIES:
            read = getattr(artist, f"get_{name}", None)
            write = getattr(artist, f"set_{name}", None)
            if read is None or write is None:
                continue
            now = read()
            if isinstance(now, str) and now in {"none", "auto"}:
                continue
            rgba = np.atleast_2d(_COLORS.to_rgba_array(now))
            new = np.array([(*paper.get(tuple(c[:3]), tuple(c[:3])), c[3]) for c in rgba.tolist()])
            if new.size and not np.array_equal(new, rgba):
                write(tuple(new[0]) if len(new) == 1 else new)
    return figure


def figure_of(svg: str) -> Figure:
    """Draw a map or a matrix of the page by matplotlib."""
    root = ET.fromstring(svg)  # noqa: S314  our own output of a moment ago
    _, _, width, height = map(float, root.attrib["viewBox"].split())
    with drawing(height / _PX_PER_IN, width / _PX_PER_IN) as figure:
        figure.set_layout_engine("none")
        axes: Axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, width), ylim=(height, 0))
        axes.axis("off")
        kind = frozenset(_classes(root))
        for element, classes in _shown(root, kind):
            _draw(axes, element, classes, kind)
    return figure


def _classes(element: ET.Element) -> list[str]:
    return element.get("class", "").split()


def _shown(element: ET.Element, around: frozenset[str]) -> Iterator[tuple[ET.Element, list[str]]]:
    """Yield the visible shapes and texts, as the page's style has them."""
    for child in element:
        classes = _classes(child)
        hidden = {"half", "no"} if "numbers" in around else {"half", "no", "value"}
        if child.tag == "g":
            yield from _shown(child, around | {*classes})
        elif child.tag in {"rect", "path", "line", "text"} and not hidden & {*classes}:
            yield child, classes


def _draw(axes: Axes, element: ET.Element, classes: list[str], kind: frozenset[str]) -> None:
    """Draw a shape or a text of a figure of a kind, which is the class of its root."""
    ink, muted = paper_colors()["ink"], paper_colors()["muted"]
    if element.tag == "text":
        size = 22.0 if "small" in kind else 12.0
        axes.text(
            float(element.attrib["x"]),
            float(element.attrib["y"]),
            "".join(element.itertext()),
            fontsize=float(element.get("font-size", size)) * 72 / _PX_PER_IN,
            fontstyle="italic" if "unsure" in classes else "normal",
            ha={"middle": "center", "end": "right"}.get(element.get("text-anchor", ""), "left"),
            va="center_baseline",
            rotation=90 if "rotate" in element.get("transform", "") else 0,
            rotation_mode="anchor",
            color=ink,
        )
    elif element.tag == "line":
        ends = [[float(element.attrib[f"{axis}{k}"]) for k in (1, 2)] for axis in "xy"]
        axes.plot(*ends, color=ink, linewidth=0.9)
    elif element.tag == "path":
        for corners in _corners(element.attrib["d"]):
            if "tick" in classes:
                axes.plot(*zip(*corners, strict=True), color=muted, linewidth=0.75)
                continue
            holed = "holed" in classes
            style = {"hatch": "////", "edgecolor": ink} if holed else {"edgecolor": "none"}
            fill = "none" if holed else _fill(element, classes)
            axes.add_patch(_PATCHES.Polygon(corners, facecolor=fill, linewidth=0, **style))
    elif "frame" not in classes or "map" in kind:
        x, y, width, height = (float(element.attrib[k]) for k in ("x", "y", "width", "height"))
        framed = "frame" in classes
        line = muted if framed else ink if "own" in classes else "none"
        fill = "none" if framed else _fill(element, classes)
        axes.add_patch(
            _PATCHES.Rectangle((x, y), width, height, facecolor=fill, edgecolor=line, linewidth=0.7)
        )


def _corners(path: str) -> Iterator[list[tuple[float, float]]]:
    """Yield the corners of each part of a path of horizontal and vertical lines."""
    corners: list[tuple[float, float]] = []
    for command, numbers in _PATH.findall(path):
        values = [float(number) for number in numbers.split()]
        if command == "M":
            if corners:
                yield corners
            corners = [(values[0], values[1])]
            continue
        for value in values:
            x, y = corners[-1]
            moved = {"H": (value, y), "h": (x + value, y), "V": (x, value), "v": (x, y + value)}
            corners.append(moved[command])
    if corners:
        yield corners


def _fill(element: ET.Element, classes: list[str]) -> Any:
    """Return the colour of a cell: a share of one colour in another, mixed in Oklab (CSS)."""
    paper = paper_colors()
    share = float(element.get("style", "--v:100%").partition("--v:")[2].rstrip("%; ") or 100) / 100
    if "q" in classes:
        return _mixed(paper["high"], paper["low"], share)
    return _mixed(paper["plus" if "plus" in classes else "minus"], paper["paper"], share)


def _mixed(color: str, other: str, share: float) -> Any:
    """Return ``color-mix(in oklab, color share, other)``."""
    linear = [
        np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        for rgb in (np.array(_COLORS.to_rgb(shade)) for shade in (color, other))
    ]
    first, second = (_TO_LAB @ np.cbrt(_TO_LMS @ channels) for channels in linear)
    lab = share * first + (1 - share) * second
    rgb = np.linalg.solve(_TO_LMS, np.linalg.solve(_TO_LAB, lab) ** 3)
    rgb = np.clip(rgb, 0.0, 1.0)
    return np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
