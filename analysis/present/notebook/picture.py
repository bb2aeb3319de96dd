"""A picture that a notebook shows and that goes to a file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from undulog.capture.common.console import plain
from undulog.capture.common.part_file import check_output, write_text

if TYPE_CHECKING:
    from ..page.drawn import Drawing


_ROOT = re.compile(r":root\s*\{([^}]*)\}")
_VARIABLE = re.compile(r"--([\w-]+):\s*([^;]+);")


@dataclass(frozen=True, repr=False)
class Picture:
    """A figure of the report by itself.

    Attributes:
        svg: The ``<svg>`` element; its colours are the page's variables.
        caption: One or two sentences, plain text.
    """

    svg: str
    caption: str

    def __repr__(self) -> str:
        """The caption."""
        return f"<Picture: {plain(self.caption)}>"

    def _repr_html_(self) -> str:
        """The figure on paper, whatever the notebook's theme, and its caption."""
        colors = "".join(f"--{name}:{value};" for name, value in paper_colors().items())
        rules = f"<style>{figure_rules()}</style>"
        style = f"{colors}background:var(--paper);color:var(--ink);max-width:60rem;padding:.5rem"
        return (
            f'<figure style="{style};margin:0">{rules}{self.svg}<figcaption>{escape(self.caption)}'
            "</figcaption></figure>"
        )

    def to_svg(self) -> str:
        """The figure as a file of its own.

        Returns:
            SVG with colours in the place of variables, on paper.
        """
        name = 'xmlns="http://www.w3.org/2000/svg"'
        svg = self.svg.replace("<svg ", f"<svg {name} ", 1)
        inside = svg.index(">") + 1
        paper = '<rect width="100%" height="100%" style="fill: var(--paper)"/>'
        svg = f"{svg[:inside]}<style>{figure_rules()}</style>{paper}{svg[inside:]}\n"
        for name, value in paper_colors().items():
            svg = svg.replace(f"var(--{name})", value)
        return svg

    def save(self, path: Path | str, *, force: bool = False) -> Path:
        """Write the figure.

        Args:
            path: A name that ends in .svg.
            force: Replace the file if it exists.

        Returns:
            The path.

        Raises:
            UsageError: If the name ends in anything else.
            OutputExistsError: If it is there and ``force`` is not given.
            LogWriteError: If it can't be written.
        """
        path = Path(path)
        check_output(path, (".svg",), "pictures are SVG; end the name in .svg", force=force)
        write_text(path, self.to_svg())
        return path


def of(drawing: Drawing) -> Picture:
    """A figure of the report as a picture.

    Args:
        drawing: The figure.

    Returns:
        The picture.
    """
    return Picture(drawing.svg, drawing.caption)


@cache
def paper_colors() -> dict[str, str]:
    """The report's colours on light ground.

    Returns:
        Name of a variable to colour.
    """
    light = _ROOT.search(_style())
    return dict(_VARIABLE.findall(light[1])) if light is not None else {}


@cache
def figure_rules() -> str:
    """The report's rules for what is inside its figures.

    Returns:
        CSS whose selectors all begin with ``svg.``.
    """
    return "\n".join(line for line in _style().splitlines() if line.startswith("svg."))


def _style() -> str:
    return (
        files("undulog.analysis.present.page")
        .joinpath("templates/style.css")
        .read_text(encoding="utf-8")
    )
