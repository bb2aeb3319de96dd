"""Head, middle and tail over one gait cycle, beside the perfect-tracking nulls."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_hex

from ...results.analysis import BodyPoint, BodyResult
from ...results.comparison import Comparison
from ...results.formats import degrees, estimate, scaled, short
from .svg import REFERENCE, WIDTH_IN, Axes, Drawing, drawing, inline_svg, key, legend, new_figure

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


_NULL_STYLES = ((0, (5, 3)), (0, (1.5, 2)), (0, (7, 2, 1.5, 2)))


def body_motion(body: BodyResult, prefix: str) -> Drawing:
    """Head, middle and tail over one gait cycle, with the perfect-tracking nulls dashed.

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
        for k, point in enumerate(points):
            axes: Axes = grid[0, k]
            for style, points_of_null in zip(_NULL_STYLES, body.null.values(), strict=False):
                for null in points_of_null:
                    if null.place == point.place:
                        _harmonic(axes, null, cycle, REFERENCE, style)
            _harmonic(axes, point, cycle, colors[k], "-")
            axes.set_title(short(f"{point.place} ({point.link})", 28))
            axes.set_xticks([0.0, 90.0, 180.0, 270.0, 360.0])
        sideways = body.plane != "vertical"
        grid[0, 0].set_ylabel("left of the heading [mm]" if sideways else "up [mm]")
        figure.supxlabel("phase of the gait [°], zero at the head link's peak", fontsize=8.0)
        measured = key([], [], color=colors[len(colors) // 2], label="measured, 95 %")
        nulls = [
            key([], [], color=REFERENCE, linestyle=style, label=short(f"perfect tracking, {name}"))
            for style, name in zip(_NULL_STYLES, body.null, strict=False)
        ]
        legend(figure, [measured, *nulls])
        svg = inline_svg(
            figure,
            prefix=prefix,
            title=f"Motion of {', '.join(p.place for p in points)} over one gait cycle",
            description="; ".join(_point_in_words(p) for p in points)
            + ". Dashed grey: the same body with every joint exactly on its command.",
        )
    caption = (
        "Motion of the links at the gait frequency, across the mean heading. Dashed grey is a "
        "perfect-tracking null: the same body with every joint exactly on its command. Head, "
        "middle and tail differ there already, by kinematics alone, so only what departs from the "
        "dashed line speaks of the joints."
    )
    return Drawing(svg, caption)


def _harmonic(axes: Axes, point: BodyPoint, cycle: FloatArray, color: str, style: object) -> None:
    amplitude = scaled(point.amplitude_m, 1000.0)
    if amplitude.value is None or point.phase_rad.value is None:
        return
    x = np.degrees(cycle)
    if style == "-":
        low_a, high_a = amplitude.ci95 or (amplitude.value, amplitude.value)
        low_p, high_p = point.phase_rad.ci95 or (point.phase_rad.value, point.phase_rad.value)
        family = np.stack(
            [a * np.cos(cycle + p) for a in (low_a, high_a) for p in np.linspace(low_p, high_p, 9)]
        )
        axes.fill_between(x, family.min(0), family.max(0), color=color, alpha=0.3, linewidth=0)
    axes.plot(
        x,
        amplitude.value * np.cos(cycle + point.phase_rad.value),
        color=color,
        linestyle=style,
        linewidth=2.0 if style == "-" else 1.4,
        zorder=3 if style == "-" else 2,
    )


def _point_in_words(point: BodyPoint) -> str:
    amplitude = estimate(scaled(point.amplitude_m, 1000.0), " mm")
    phase = estimate(degrees(point.phase_rad), "°")
    return f"{point.place}: amplitude {amplitude}, phase {phase}"
