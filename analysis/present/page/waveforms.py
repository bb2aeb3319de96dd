"""The mean cycle of a few joints on both sides, and their difference by gait phase."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.palette import joint_hex

from ...results.comparison import Comparison
from ...results.formats import short
from .drawn import WIDTH_IN, Drawing, key, legend
from .svg import REFERENCE, Axes, drawing, inline_svg, new_figure

MOST = 4
"""Joints drawn: those whose cycles differ most."""


def waveforms_drawing(comparison: Comparison, prefix: str) -> Drawing:
    """Draw the mean cycles that differ most.

    Args:
        comparison: With at least one waveform.
        prefix: For identifiers, unique in the page.

    Returns:
        The figure: for each joint both sides on the left, B minus A on the right.
    """
    colors = dict(
        zip(
            (one.name for one in comparison.waveforms),
            joint_hex(len(comparison.waveforms)),
            strict=True,
        )
    )
    worst = sorted(comparison.waveforms, key=lambda one: -one.rms_rad)[:MOST]
    shown = [one for one in comparison.waveforms if one in worst]
    phase = np.degrees(comparison.phase_rad)
    with drawing():
        figure = new_figure(WIDTH_IN, 0.8 + 1.4 * len(shown))
        grid = figure.subplots(len(shown), 2, sharex=True, squeeze=False)
        for row, one in enumerate(shown):
            both: Axes = grid[row, 0]
            both.plot(phase, np.degrees(one.a_rad), color=REFERENCE, linewidth=2.4)
            both.plot(phase, np.degrees(one.b_rad), color=colors[one.name])
            both.set_title(short(one.name))
            right: Axes = grid[row, 1]
            middle, half = np.degrees(one.difference_rad), np.degrees(one.half_rad)
            right.axhline(0.0, color=REFERENCE, linestyle=(0, (5, 3)), linewidth=0.8)
            right.fill_between(
                phase, middle - half, middle + half, color=colors[one.name], alpha=0.25, linewidth=0
            )
            right.plot(phase, middle, color=colors[one.name])
            right.set_title("B − A")
        grid[-1, 0].set_xticks(range(0, 361, 90))
        for axes in grid[-1]:
            axes.set_xlabel("gait phase [°]")
        figure.supylabel("joint angle [°]", fontsize=8.0)
        color = colors[shown[0].name]
        legend(
            figure,
            [
                key([], [], color=REFERENCE, linewidth=2.4, label="A"),
                key([], [], color=color, label="B"),
                key([], [], color=color, linewidth=6, alpha=0.25, label="95 %, each phase"),
            ],
        )
        svg = inline_svg(
            figure,
            prefix=prefix,
            title="Mean cycles by gait phase",
            description="Joints: " + ", ".join(short(one.name) for one in shown) + ".",
        )
    return Drawing(
        svg,
        "Mean cycle of the joints that differ most, by the phase of the commands: A in grey, B in "
        "the joint's colour, and their difference with its 95 % interval at each phase.",
    )
