"""What all figures of the report share: width, markers, keys.

Every figure is a pure function of results. A joint keeps its colour, horizontal joints are
circles and vertical ones squares, references and nulls are dashed grey, estimates carry their
95 % interval, the segment axis runs head to tail from left to right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib import lines

from .svg import Figure, Handle

WIDTH_IN = 8.0
"""Width of every figure [inch]; the page scales it."""

MARKERS: dict[str | None, str] = {"horizontal": "o", "vertical": "s", None: "^"}
"""Marker by plane; a triangle where no robot description says."""

key: Any = lines.Line2D
"""A line or marker of a legend, drawn nowhere else."""


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
    """Matplotlib marker of a joint of this plane.

    Args:
        plane: ``horizontal``, ``vertical`` or None.

    Returns:
        Circle, square, or triangle for anything else.
    """
    return MARKERS.get(plane, "^")


def legend(figure: Figure, handles: Sequence[Handle]) -> None:
    """One line of keys above all panels, from the left edge.

    Args:
        figure: Laid out by the constrained engine.
        handles: What is explained.
    """
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncols=len(handles),
        borderaxespad=0.2,
        columnspacing=1.6,
        handletextpad=0.5,
        handlelength=1.8,
    )
