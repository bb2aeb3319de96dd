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

from ...results.formats import short
from .svg import Axes, Figure, Handle

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


def joint_ticks(axes: Axes, names: Sequence[str]) -> None:
    """Joint names along the axis where they fit, else every second, third ... of them.

    Args:
        axes: Joints stand at 1, 2, ... from head to tail.
        names: Of all joints.
    """
    shown = [short(name, 14) for name in names]
    room = 95  # characters of 8 points that stand beside one another over the width
    step = max(1, -(-sum(len(name) + 2 for name in shown) // room))
    axes.set_xlim(0.4, len(names) + 0.6)
    axes.set_xticks(range(1, len(names) + 1, step), shown[::step])
