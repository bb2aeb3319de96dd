"""The coupling matrix as a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.ticker import MaxNLocator

from capture.palette import joint_hex

from ..formats import number
from .drawn import WIDTH_IN, Drawing
from .svg import GRID, drawing, inline_svg, new_figure


def coupling_matrix(
    matrix: Sequence[Sequence[float]], names: Sequence[str], prefix: str
) -> Drawing:
    """A coupling matrix as squares whose side goes with the square root of the magnitude.

    Filled squares are positive, hollow ones negative, so that the sign needs no colour (after
    Hinton & Shallice 1991, Psychological Review 98, 74).

    Args:
        matrix: Rows of responding joints, columns of commanded joints, m by m.
        names: Joint names, m.
        prefix: For identifiers, unique in the page.

    Returns:
        The figure.
    """
    values = np.array(matrix, dtype=np.float64)
    count = len(values)
    largest = float(np.max(np.abs(values))) or 1.0
    colors = joint_hex(count)
    with drawing():
        figure = new_figure(WIDTH_IN, WIDTH_IN * 0.62)
        axes = figure.subplots()
        axes.set_aspect("equal")
        axes.grid(visible=False)
        side = 0.9 * np.sqrt(np.abs(values) / largest)
        for (i, j), width in np.ndenumerate(side):
            x, y = j + 1 - width / 2, i + 1 - width / 2
            corners = ([x, x + width, x + width, x], [y, y, y + width, y + width])
            positive = values[i, j] >= 0
            axes.fill(
                *corners,
                facecolor=colors[i] if positive else "none",
                edgecolor=colors[i],
                linewidth=1.0,
            )
        axes.set_xlim(0.4, count + 0.6)
        axes.set_ylim(count + 0.6, 0.4)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(nbins=14, integer=True, steps=[1, 2, 5, 10]))
        axes.set_xlabel("commanded joint, head to tail")
        axes.set_ylabel("responding joint, head at the top")
        axes.spines[:].set_color(GRID)
        svg = inline_svg(
            figure,
            prefix=prefix,
            title="Coupling matrix",
            description=f"{count} by {count} entries between joints {', '.join(names)}; "
            f"largest magnitude {largest:.3g}. The table beside it holds every number.",
        )
    caption = (
        "Area of a square: magnitude; filled: positive, hollow: negative. "
        f"The largest square is {number(largest, 3)}."
    )
    return Drawing(svg, caption)
