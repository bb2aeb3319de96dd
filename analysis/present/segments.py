"""Draw a session along its body: gain, lag and energy of joints, motion of head, middle, tail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_hex

from ..common.estimate import Estimate
from ..common.formats import degrees, estimate, number, scaled, short
from ..parts.body.result import BodyPoint, BodyResult
from ..parts.joints.result import JointResult
from ..parts.tracking.result import JointTracking
from .page_tables import is_driven
from .svg import (
    ABOVE,
    DASHED,
    INK,
    MUTED,
    PAPER,
    REFERENCE,
    Axes,
    Drawing,
    Figure,
    Handle,
    band,
    drawing,
    inline_svg,
    key,
    legend,
    marker,
    plot_estimate,
)

_SOLID: dict[str, Any] = {"markersize": 5.2, "markeredgecolor": INK, "markeredgewidth": 0.5}
_HOLLOW: dict[str, Any] = {"markersize": 5.2, "markeredgewidth": 1.2, "markerfacecolor": PAPER}
_PLANES = ("horizontal", "vertical", None)

_NULL_STYLES = (DASHED, (0, (1.5, 2)), (0, (7, 2, 1.5, 2)))


@dataclass(frozen=True)
class _Shown:
    """What a panel of gains or lags shows.

    Attributes:
        unit: As text behind a number.
        of: Value of a joint in this unit.
        circular: Whether whole turns are alike.
        least: Span of the panel.
    """

    unit: str
    of: Callable[[JointResult], Estimate]
    circular: bool
    least: float


_ANGLES = _Shown("°", lambda joint: degrees(joint.lag_rad), circular=True, least=1.0)


def segments(
    joints: Sequence[JointResult], prefix: str, tracking: Sequence[JointTracking] = ()
) -> Drawing:
    """Draw gain, lag and energy of every joint, head to tail, in three panels on one axis.

    Joints without a command are in the energy panel only, with hollow markers. Where no joint has a
    gait, gain and lag are those of any motion, the lag in ms.

    Args:
        joints: In chain order, at least one.
        prefix: For identifiers, unique in the page.
        tracking: How joints follow commands that are no gait.
    """
    lags = _ANGLES
    if tracking and all(joint.gain.value is None for joint in joints):
        by_name = {joint.joint: joint for joint in tracking}
        delays = {name: scaled(joint.lag_s, 1e3) for name, joint in by_name.items()}
        lags = _Shown(" ms", lambda joint: delays.get(joint.name, Estimate()), False, 1.0)
        joints = [
            replace(joint, gain=by_name[joint.name].gain) if joint.name in by_name else joint
            for joint in joints
        ]
    return _drawn(joints, prefix, lags)


def _drawn(joints: Sequence[JointResult], prefix: str, lags: _Shown) -> Drawing:
    colors = joint_hex(len(joints))
    tooltips: dict[str, str] = {}
    with drawing(5.8) as figure:
        gain_axes, lag_axes, energy_axes = figure.subplots(3, 1, sharex=True)
        gains = _Shown("", lambda joint: joint.gain, circular=False, least=0.02)
        _estimates(gain_axes, joints, colors, tooltips, what="gain", shown=gains)
        _estimates(lag_axes, joints, colors, tooltips, what="lag", shown=lags)
        _energies(energy_axes, joints, colors, tooltips)
        gain_axes.set_ylabel("gain [1]")
        lag_axes.set_ylabel(f"lag [{lags.unit.strip()}]")
        energy_axes.set_ylabel("energy [J]")
        _flag_marks(gain_axes, joints)
        _segment_axis(energy_axes, len(joints))
        _legend(figure, joints)
        figure.align_ylabels()
        title = "Gain, lag and energy of every joint, head to tail"
        svg = inline_svg(figure, prefix, title, _in_words(joints, lags), tooltips)
    return Drawing(svg, _segments_caption(joints, lags))


def _estimates(
    axes: Axes,
    joints: Sequence[JointResult],
    colors: Sequence[str],
    tooltips: dict[str, str],
    *,
    what: str,
    shown: _Shown,
) -> None:
    """Draw a panel of values with their intervals, and the mean of each plane, dashed."""
    drawn = False
    for i, joint in enumerate(joints):
        quantity = shown.of(joint)
        if quantity.value is not None:
            drawn = True
            gid = f"{what}-{i}"
            plot_estimate(axes, i + 1, quantity, colors[i], marker=marker(joint.plane), gid=gid)
            tooltips[gid] = _tooltip(joint, f"{what} {estimate(quantity, shown.unit)}")
    _mean_lines(axes, joints, shown.of, circular=shown.circular)
    if drawn:
        _keep_span(axes, least=shown.least)
    else:
        _empty(axes, f"no {what}: see the warnings")


def _mean_lines(
    axes: Axes,
    joints: Sequence[JointResult],
    of: Callable[[JointResult], Estimate],
    *,
    circular: bool,
) -> None:
    """Draw the mean over the joints of each plane: the position of all if they moved alike."""
    for plane in _PLANES:
        members = [(i + 1, of(j).value) for i, j in enumerate(joints) if j.plane == plane]
        points = [(place, value) for place, value in members if value is not None]
        if len(points) > 1:
            values = [value for _, value in points]
            # Mean direction (Fisher, Statistical Analysis of Circular Data, Eq. 2.9).
            turn = np.angle(np.mean(np.exp(1j * np.radians(values))))
            mean = float(np.degrees(turn)) if circular else fmean(values)
            ends = [points[0][0] - 0.4, points[-1][0] + 0.4]
            axes.plot(ends, [mean, mean], color=REFERENCE, linestyle=DASHED, zorder=1)


def _energies(
    axes: Axes, joints: Sequence[JointResult], colors: Sequence[str], tooltips: dict[str, str]
) -> None:
    """Draw net energy as a marker on a stem, absolute energy as a bar across it."""
    for i, (joint, color) in enumerate(zip(joints, colors, strict=True)):
        place, whole, net = i + 1, joint.energy_abs_j, joint.energy_net_j
        if whole is not None:
            bar = {"linewidth": 1.2, "solid_capstyle": "butt"}
            axes.plot([place - 0.3, place + 0.3], [whole, whole], color=MUTED, **bar)
        if net is not None:
            style: dict[str, Any] = {"marker": marker(joint.plane), "gid": f"energy-{i}"}
            if not is_driven(joint):
                style |= _HOLLOW | {"markeredgecolor": color}
            plot_estimate(axes, place, Estimate(net, (0.0, net)), color, **style)
            values = f"E_net {number(net, 4)} J, E_abs {number(whole, 4)} J"
            tooltips[f"energy-{i}"] = _tooltip(joint, values)
    if any(j.energy_abs_j is not None or j.energy_net_j is not None for j in joints):
        axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=1)
    else:
        _empty(axes, "no energy: see the notes")


def _tooltip(joint: JointResult, values: str) -> str:
    flags = f"; flags: {', '.join(joint.flags)}" if joint.flags else ""
    return f"{joint.name}: {values}{flags}"


def _empty(axes: Axes, text: str) -> None:
    axes.set_yticks([])
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED)


def _keep_span(axes: Axes, least: float) -> None:
    """Let the panel span at least ``least`` of its unit, so that noise isn't magnified."""
    low, high = axes.get_ylim()
    if high - low < least:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * least, middle + 0.5 * least)


def _flag_marks(axes: Axes, joints: Sequence[JointResult]) -> None:
    style = {"ha": "center", "va": "bottom", "fontweight": "bold"}
    for i, joint in enumerate(joints):
        if joint.flags:
            place: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "gid": f"{ABOVE}{i}"}
            axes.text(i + 1, 1.0, "!", **place, **style)


def _segment_axis(axes: Axes, count: int) -> None:
    axes.set_xlim(0.25, count + 0.75)
    step = next(step for step in (1, 2, 5, 10, 20, 50, count) if count / step <= 30)
    axes.set_xticks([1, *range(max(step, 2), count + 1, step)] if count > 1 else [1])
    axes.set_xlabel("segment, joint number along the body: head on the left, tail on the right")


def _legend(figure: Figure, joints: Sequence[JointResult]) -> None:
    handles: list[Handle] = []
    middle = joint_hex(3)[1]
    driven = {j.plane for j in joints if is_driven(j)}
    passive = {j.plane for j in joints if not is_driven(j) and j.energy_net_j is not None}
    for planes, note, style in (
        (driven, "95 %", _SOLID),
        (passive, "no command", {**_HOLLOW, "linestyle": "none"}),
    ):
        for plane in _PLANES:
            if plane in planes:
                label = f"{plane or 'plane unknown'}, {note}"
                handles.append(key(color=middle, marker=marker(plane), label=label, **style))
    if sum(j.gain.value is not None for j in joints) > 1:
        handles.append(key(color=REFERENCE, linestyle=DASHED, label="mean of the plane"))
    if any(j.energy_abs_j is not None for j in joints):
        handles.append(key(color=MUTED, linewidth=1.2, label="E_abs (marker: E_net)"))
    if handles:
        legend(figure, *handles)


def _in_words(joints: Sequence[JointResult], lags: _Shown) -> str:
    driven = [j for j in joints if j.gain.value is not None]
    if not driven:
        return f"{len(joints)} joints; none has a gain or a lag."
    gains = [j.gain.value for j in driven if j.gain.value is not None]
    values = [v for j in driven if (v := lags.of(j).value) is not None]
    words = (
        f"{len(driven)} of {len(joints)} joints have a gain, {min(gains):.3f} to {max(gains):.3f}"
    )
    if values:
        unit = " degrees" if lags.circular else lags.unit
        words += f"; their lag runs from {number(min(values), 1)} to {number(max(values), 1)}{unit}"
    return words + ". The table of joints holds every number."


def _segments_caption(joints: Sequence[JointResult], lags: _Shown) -> str:
    gain = "amplitude of the response over that of the command"
    if not lags.circular:
        gain = "of slow motion, response over command, as the lag; the commands are no gait"
    text = f"Gain: {gain}. Lag: positive is late. Bars are 95 % intervals."
    if any(j.flags for j in joints):
        text += " An exclamation mark stands over flagged joints; the table gives the reason."
    if any(j.energy_net_j is not None for j in joints):
        text += (
            " Energy over the analysed windows: the marker is the net mechanical energy E_net, "
            "the cross-bar E_abs. A joint with negative net energy was driven by the rest of the "
            "body."
        )
    return text


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
    tooltips: dict[str, str] = {}
    with drawing(2.7) as figure:
        grid = figure.subplots(1, len(points), sharex=True, sharey=True, squeeze=False)
        for axes, point, color in zip(grid[0], points, colors, strict=True):
            for style, points_of_null in zip(_NULL_STYLES, body.null.values(), strict=False):
                for null in points_of_null:
                    if null.place == point.place:
                        _harmonic(axes, null, cycle, REFERENCE, style)
            gid = f"place-{len(tooltips)}"
            _harmonic(axes, point, cycle, color, "-", gid=gid)
            tooltips[gid] = point.place
            axes.set_title(short(f"{point.place} ({point.link})", 28))
            axes.set_xticks([0.0, 90.0, 180.0, 270.0, 360.0])
        grid[0, 0].set_ylabel("left of the heading [mm]" if body.plane != "vertical" else "up [mm]")
        figure.supxlabel("phase of the gait [°], zero at the head link's peak", fontsize=8.0)
        nulls = [
            key(color=REFERENCE, linestyle=style, label=short(f"perfect tracking, {name}"))
            for style, name in zip(_NULL_STYLES, body.null, strict=False)
        ]
        legend(figure, key(color=colors[len(colors) // 2], label="measured, 95 %"), *nulls)
        title = f"Motion of {', '.join(p.place for p in points)} over one gait cycle"
        dashed = ". Dashed grey: the same body with every joint exactly on its command."
        words = "; ".join(map(_point_in_words, points)) + dashed
        svg = inline_svg(figure, prefix, title, words, tooltips)
    return Drawing(
        svg,
        "Motion of the links at the gait frequency, across the mean heading. Dashed grey is a "
        "perfect-tracking null: the same body with every joint exactly on its command. Head, "
        "middle and tail differ there already, by kinematics alone, so only what departs from the "
        "dashed line speaks of the joints.",
    )


def _harmonic(
    axes: Axes,
    point: BodyPoint,
    cycle: FloatArray,
    color: str,
    style: object,
    *,
    gid: str | None = None,
) -> None:
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
        band(axes, x, family.min(0), family.max(0), color=color, alpha=0.3)
    y = amplitude.value * np.cos(cycle + phase.value)
    axes.plot(x, y, color=color, linestyle=style, linewidth=width, zorder=zorder, gid=gid)


def _point_in_words(point: BodyPoint) -> str:
    amplitude = estimate(scaled(point.amplitude_m, 1000.0), " mm")
    phase = estimate(degrees(point.phase_rad), "°")
    return f"{point.place}: amplitude {amplitude}, phase {phase}"
