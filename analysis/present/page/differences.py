"""Differences of every joint with their intervals, and the margins that count as none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from undulog.capture.common.palette import joint_hex

from ...results.estimate import Estimate
from .drawn import WIDTH_IN, Drawing, joint_ticks, key, legend
from .svg import INK, REFERENCE, Axes, drawing, inline_svg, new_figure

_DASHED = (0, (5, 3))


@dataclass(frozen=True)
class Panel:
    """One quantity.

    Attributes:
        label: With its unit.
        values: Of the joints, in that unit; those without a value are left out.
        margin: In that unit.
    """

    label: str
    values: Sequence[Estimate]
    margin: float


def differences_drawing(
    names: Sequence[str], panels: Sequence[Panel], *, title: str, prefix: str
) -> Drawing:
    """Differences of every joint, head to tail, one panel a quantity.

    Args:
        names: Of the joints.
        panels: At least one.
        title: What is subtracted from what.
        prefix: For identifiers, unique in the page.

    Returns:
        The figure.
    """
    colors = joint_hex(len(names))
    with drawing():
        figure = new_figure(WIDTH_IN, 0.8 + 1.6 * len(panels))
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
        for row, panel in enumerate(panels):
            _panel(grid[row, 0], panel, colors)
        last: Axes = grid[-1, 0]
        joint_ticks(last, names)
        last.set_xlabel("joint, head on the left")
        figure.align_ylabels()
        middle = colors[len(colors) // 2]
        legend(
            figure,
            [
                key([], [], color=middle, marker="o", label="difference, 95 %"),
                key([], [], color=REFERENCE, linestyle=_DASHED, label="margins"),
            ],
        )
        told = ", ".join(panel.label for panel in panels)
        svg = inline_svg(
            figure,
            prefix=prefix,
            title=title,
            description=f"{len(names)} joints; panels: {told}.",
        )
    return Drawing(svg, f"{title}. The intervals hold together at 95 %; dashed: the margins.")


def _panel(axes: Axes, panel: Panel, colors: Sequence[str]) -> None:
    axes.axhline(0.0, color=REFERENCE, linewidth=0.8, zorder=1)
    for margin in (-panel.margin, panel.margin):
        axes.axhline(margin, color=REFERENCE, linestyle=_DASHED, linewidth=0.8, zorder=1)
    for place, (value, color) in enumerate(zip(panel.values, colors, strict=True), start=1):
        if value.value is None:
            continue
        if value.ci95 is not None:
            axes.plot([place, place], value.ci95, color=color, linewidth=1.6, zorder=2)
        axes.plot(
            [place],
            [value.value],
            "o",
            markersize=5.2,
            markerfacecolor=color,
            markeredgecolor=INK,
            markeredgewidth=0.5,
            zorder=3,
        )
    axes.set_ylabel(panel.label)
    axes.margins(y=0.15)
