"""Draw mean cycles of joints, and head, middle and tail over one gait cycle."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_hex

from ...results.analysis import BodyPoint, BodyResult
from ...results.comparison import Comparison
from ...results.formats import degrees, estimate, scaled, short
from .svg import (
    DASHED,
    REFERENCE,
    WIDTH_IN,
    Axes,
    Drawing,
    drawing,
    inline_svg,
    key,
    legend,
    new_figure,
)

MOST = 4
"""Joints drawn: those whose cycles differ most."""


def waveforms_drawing(comparison: Comparison, prefix: str) -> Drawing:
    """Draw the mean cycles that differ most: both sides on the left, B minus A on the right.

    Args:
        comparison: With at least one waveform.
        prefix: For identifiers, unique in the page.
    """
    every = joint_hex(len(comparison.waveforms))
    worst = sorted(comparison.waveforms, key=lambda one: -one.rms_rad)[:MOST]
    pairs = zip(comparison.waveforms, every, strict=True)
    shown = [(one, color) for one, color in pairs if one in worst]
    phase = np.degrees(comparison.phase_rad)
    with drawing():
        figure = new_figure(WIDTH_IN, 0.8 + 1.4 * len(shown))
        grid = figure.subplots(len(shown), 2, sharex=True, squeeze=False)
        for (both, right), (one, color) in zip(grid, shown, strict=True):
            both.plot(phase, np.degrees(one.a_rad), color=REFERENCE, linewidth=2.4)
            both.plot(phase, np.degrees(one.b_rad), color=color)
            both.set_title(short(one.name))
            middle, half = np.degrees(one.difference_rad), np.degrees(one.half_rad)
            right.axhline(0.0, color=REFERENCE, linestyle=DASHED, linewidth=0.8)
            band = {"color": color, "alpha": 0.25, "linewidth": 0}
            right.fill_between(phase, middle - half, middle + half, **band)
            right.plot(phase, middle, color=color)
            right.set_title("B − A")
        grid[-1, 0].set_xticks(range(0, 361, 90))
        for axes in grid[-1]:
            axes.set_xlabel("gait phase [°]")
        figure.supylabel("joint angle [°]", fontsize=8.0)
        color = shown[0][1]
        legend(
            figure,
            key(color=REFERENCE, linewidth=2.4, label="A"),
            key(color=color, label="B"),
            key(color=color, linewidth=6, alpha=0.25, label="95 %, each phase"),
        )
        description = "Joints: " + ", ".join(short(one.name) for one, _ in shown) + "."
        svg = inline_svg(figure, prefix, "Mean cycles by gait phase", description)
    caption = (
        "Mean cycle of the joints that differ most, by the phase of the commands: A in grey, B in "
        "the joint's colour, and their difference with its 95 % interval at each phase."
    )
    return Drawing(svg, caption)


_NULL_STYLES = (DASHED, (0, (1.5, 2)), (0, (7, 2, 1.5, 2)))


def body_motion(body: BodyResult, prefix: str) -> Drawing:
    """Draw head, middle and tail over one gait cycle, with the perfect-tracking nulls dashed.

    The curve of a place is A cos(Phi + phase), A and phase with respect to the head link; the
    band is what amplitude and phase may do within their intervals.

    Args:
        body: With one or more observed points.
        prefix: For identifiers, unique in the page.
    """
    points = body.observed
    colors = joint_hex(len(points))
    cycle = np.linspace(0.0, 2.0 * np.pi, 121)
    with drawing():
        figure = new_figure(WIDTH_IN, 2.7)
        grid = figure.subplots(1, len(points), sharex=True, sharey=True, squeeze=False)
        for axes, point, color in zip(grid[0], points, colors, strict=True):
            for style, points_of_null in zip(_NULL_STYLES, body.null.values(), strict=False):
                for null in points_of_null:
                    if null.place == point.place:
                        _harmonic(axes, null, cycle, REFERENCE, style)
            _harmonic(axes, point, cycle, color, "-")
            axes.set_title(short(f"{point.place} ({point.link})", 28))
            axes.set_xticks([0.0, 90.0, 180.0, 270.0, 360.0])
        sideways = body.plane != "vertical"
        grid[0, 0].set_ylabel("left of the heading [mm]" if sideways else "up [mm]")
        figure.supxlabel("phase of the gait [°], zero at the head link's peak", fontsize=8.0)
        nulls = [
            key(color=REFERENCE, linestyle=style, label=short(f"perfect tracking, {name}"))
            for style, name in zip(_NULL_STYLES, body.null, strict=False)
        ]
        legend(figure, key(color=colors[len(colors) // 2], label="measured, 95 %"), *nulls)
        title = f"Motion of {', '.join(p.place for p in points)} over one gait cycle"
        dashed = ". Dashed grey: the same body with every joint exactly on its command."
        description = "; ".join(map(_point_in_words, points)) + dashed
        svg = inline_svg(figure, prefix, title, description)
    caption = (
        "Motion of the links at the gait frequency, across the mean heading. Dashed grey is a "
        "perfect-tracking null: the same body with every joint exactly on its command. Head, "
        "middle and tail differ there already, by kinematics alone, so only what departs from the "
        "dashed line speaks of the joints."
    )
    return Drawing(svg, caption)


def _harmonic(axes: Axes, point: BodyPoint, cycle: FloatArray, color: str, style: object) -> None:
    amplitude, phase = scaled(point.amplitude_m, 1000.0), point.phase_rad
    if amplitude.value is None or phase.value is None:
        return
    x = np.degrees(cycle)
    width, zorder = 1.4, 2
    if style == "-":
        width, zorder = 2.0, 3
        low, high = phase.ci95 or (phase.value, phase.value)
        sizes = amplitude.ci95 or (amplitude.value, amplitude.value)
        family = np.stack([a * np.cos(cycle + p) for a in sizes for p in np.linspace(low, high, 9)])
        axes.fill_between(x, family.min(0), family.max(0), color=color, alpha=0.3, linewidth=0)
    y = amplitude.value * np.cos(cycle + phase.value)
    axes.plot(x, y, color=color, linestyle=style, linewidth=width, zorder=zorder)


def _point_in_words(point: BodyPoint) -> str:
    amplitude = estimate(scaled(point.amplitude_m, 1000.0), " mm")
    phase = estimate(degrees(point.phase_rad), "°")
    return f"{point.place}: amplitude {amplitude}, phase {phase}"
