"""Gain, lag and energy of every joint, head to tail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import fmean

import numpy as np

from undulog.capture.common.palette import joint_hex

from ...results.analysis import JointResult
from ...results.estimate import Estimate
from ...results.formats import degrees, estimate, number
from .svg import (
    INK,
    MUTED,
    PAPER,
    REFERENCE,
    WIDTH_IN,
    Axes,
    Drawing,
    Figure,
    Handle,
    drawing,
    inline_svg,
    key,
    legend,
    marker,
    new_figure,
)
from .tables import is_driven

_MARKER_SIZE = 5.2
_PLANE_WORDS = {"horizontal": "horizontal", "vertical": "vertical", None: "plane unknown"}


def segments(joints: Sequence[JointResult], prefix: str) -> Drawing:
    """Gain, lag and energy of every joint, head to tail, in three panels on one axis.

    Args:
        joints: In chain order, at least one.
        prefix: For identifiers, unique in the page.

    Returns:
        The figure. Joints without a command show in the energy panel only, hollow.
    """
    colors = joint_hex(len(joints))
    tooltips: dict[str, str] = {}
    with drawing():
        figure = new_figure(WIDTH_IN, 5.8)
        gain_axes, lag_axes, energy_axes = figure.subplots(3, 1, sharex=True)
        _estimates(gain_axes, joints, colors, tooltips, what="gain", of=lambda j: j.gain)
        _estimates(lag_axes, joints, colors, tooltips, what="lag", of=lambda j: degrees(j.lag_rad))
        _energies(energy_axes, joints, colors, tooltips)
        gain_axes.set_ylabel("gain [1]")
        lag_axes.set_ylabel("lag [°]")
        energy_axes.set_ylabel("energy [J]")
        _flag_marks(gain_axes, joints)
        _segment_axis(energy_axes, len(joints))
        _legend(figure, joints)
        figure.align_ylabels()
        svg = inline_svg(
            figure,
            prefix=prefix,
            title="Gain, lag and energy of every joint, head to tail",
            description=_in_words(joints),
            tooltips=tooltips,
        )
    return Drawing(svg, _segments_caption(joints))


def _estimates(
    axes: Axes,
    joints: Sequence[JointResult],
    colors: Sequence[str],
    tooltips: dict[str, str],
    *,
    what: str,
    of: Callable[[JointResult], Estimate],
) -> None:
    """One panel of values with their intervals, and the mean of each plane, dashed."""
    unit = "°" if what == "lag" else ""
    drawn = False
    for i, joint in enumerate(joints):
        quantity = of(joint)
        if quantity.value is None:
            continue
        drawn = True
        color, place = colors[i], i + 1
        if quantity.ci95 is not None:
            axes.plot([place, place], quantity.ci95, color=color, linewidth=1.6, zorder=2)
        gid = f"{what}-{i}"
        axes.plot(
            [place],
            [quantity.value],
            marker=marker(joint.plane),
            markersize=_MARKER_SIZE,
            markerfacecolor=color,
            markeredgecolor=INK,
            markeredgewidth=0.5,
            linestyle="none",
            gid=gid,
            zorder=3,
        )
        tooltips[gid] = _tooltip(joint, f"{what} {estimate(quantity, unit)}")
    _mean_lines(axes, joints, of, _circular_mean_deg if what == "lag" else fmean)
    if not drawn:
        _empty(axes, f"no {what}: see the warnings")
    elif what == "gain":
        _room(axes, least=0.02)
    else:
        _room(axes, least=1.0)


def _circular_mean_deg(values: Sequence[float]) -> float:
    """Mean direction [°] (Fisher 1993, Statistical Analysis of Circular Data, Eq. 2.9)."""
    return float(np.degrees(np.angle(np.mean(np.exp(1j * np.radians(values))))))


def _mean_lines(
    axes: Axes,
    joints: Sequence[JointResult],
    of: Callable[[JointResult], Estimate],
    average: Callable[[Sequence[float]], float],
) -> None:
    """The mean over the joints of a plane: where all would lie if they moved alike."""
    for plane in ("horizontal", "vertical", None):
        members = [(i + 1, of(j).value) for i, j in enumerate(joints) if j.plane == plane]
        known = [(place, value) for place, value in members if value is not None]
        if len(known) < 2:
            continue
        mean = average([value for _, value in known])
        ends = [known[0][0] - 0.4, known[-1][0] + 0.4]
        axes.plot(ends, [mean, mean], color=REFERENCE, linestyle=(0, (5, 3)), zorder=1)


def _energies(
    axes: Axes, joints: Sequence[JointResult], colors: Sequence[str], tooltips: dict[str, str]
) -> None:
    """Net energy as a marker on a stem, absolute energy as a bar across it."""
    drawn = False
    for i, joint in enumerate(joints):
        color, place = colors[i], i + 1
        if joint.energy_abs_j is not None:
            axes.plot(
                [place - 0.3, place + 0.3],
                [joint.energy_abs_j] * 2,
                color=MUTED,
                linewidth=1.2,
                solid_capstyle="butt",
            )
            drawn = True
        net = joint.energy_net_j
        if net is None:
            continue
        drawn = True
        axes.plot([place, place], [0.0, net], color=color, linewidth=1.6, zorder=2)
        gid = f"energy-{i}"
        driven = is_driven(joint)
        axes.plot(
            [place],
            [net],
            marker=marker(joint.plane),
            markersize=_MARKER_SIZE,
            markerfacecolor=color if driven else PAPER,
            markeredgecolor=INK if driven else color,
            markeredgewidth=0.5 if driven else 1.2,
            linestyle="none",
            gid=gid,
            zorder=3,
        )
        values = f"E_net {number(net, 4)} J, E_abs {number(joint.energy_abs_j, 4)} J"
        tooltips[gid] = _tooltip(joint, values)
    if drawn:
        axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=1)
    else:
        _empty(axes, "no energy: see the notes")


def _tooltip(joint: JointResult, values: str) -> str:
    flags = f"; flags: {', '.join(joint.flags)}" if joint.flags else ""
    return f"{joint.name}: {values}{flags}"


def _empty(axes: Axes, text: str) -> None:
    axes.set_yticks([])
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED)


def _room(axes: Axes, least: float) -> None:
    """Never magnify noise: the panel spans at least ``least`` of its unit."""
    low, high = axes.get_ylim()
    if high - low < least:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * least, middle + 0.5 * least)


def _flag_marks(axes: Axes, joints: Sequence[JointResult]) -> None:
    for i, joint in enumerate(joints):
        if joint.flags:
            axes.text(
                i + 1,
                1.0,
                "!",
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="bottom",
                fontweight="bold",
            )


def _segment_axis(axes: Axes, count: int) -> None:
    axes.set_xlim(0.25, count + 0.75)
    step = next(step for step in (1, 2, 5, 10, 20, 50, count) if count / step <= 30)
    axes.set_xticks([1, *range(max(step, 2), count + 1, step)] if count > 1 else [1])
    axes.set_xlabel("segment, joint number along the body: head on the left, tail on the right")


def _legend(figure: Figure, joints: Sequence[JointResult]) -> None:
    handles: list[Handle] = []
    middle = joint_hex(3)[1]
    solid = {"markersize": _MARKER_SIZE, "markeredgecolor": INK, "markeredgewidth": 0.5}
    for plane, word in _PLANE_WORDS.items():
        if any(j.plane == plane and is_driven(j) for j in joints):
            handles.append(
                key([], [], color=middle, marker=marker(plane), label=f"{word}, 95 %", **solid)
            )
    passive = {j.plane for j in joints if not is_driven(j) and j.energy_net_j is not None}
    hollow = {"markersize": _MARKER_SIZE, "markeredgewidth": 1.2, "markerfacecolor": PAPER}
    for plane, word in _PLANE_WORDS.items():
        if plane in passive:
            handles.append(
                key(
                    [],
                    [],
                    linestyle="none",
                    color=middle,
                    marker=marker(plane),
                    label=f"{word}, no command",
                    **hollow,
                )
            )
    if sum(j.gain.value is not None for j in joints) > 1:
        handles.append(
            key([], [], color=REFERENCE, linestyle=(0, (5, 3)), label="mean of the plane")
        )
    if any(j.energy_abs_j is not None for j in joints):
        handles.append(key([], [], color=MUTED, linewidth=1.2, label="E_abs (marker: E_net)"))
    if handles:
        legend(figure, handles)


def _in_words(joints: Sequence[JointResult]) -> str:
    driven = [j for j in joints if j.gain.value is not None]
    if not driven:
        return f"{len(joints)} joints; none has a gain or a lag."
    gains = [j.gain.value for j in driven if j.gain.value is not None]
    lags = [v for j in driven if (v := degrees(j.lag_rad).value) is not None]
    words = (
        f"{len(driven)} of {len(joints)} joints have a gain, {min(gains):.3f} to {max(gains):.3f}"
    )
    if lags:
        words += f"; their lag runs from {number(min(lags), 1)} to {number(max(lags), 1)} degrees"
    return words + ". The table of joints holds every number."


def _segments_caption(joints: Sequence[JointResult]) -> str:
    text = (
        "Gain: amplitude of the response over that of the command. Lag: positive is late. "
        "Bars are 95 % intervals."
    )
    if any(j.flags for j in joints):
        text += " An exclamation mark stands over flagged joints; the table gives the reason."
    if any(j.energy_net_j is not None for j in joints):
        text += (
            " Energy over the analysed windows: the marker is the net mechanical energy E_net, "
            "the cross-bar E_abs. A joint with negative net energy was driven by the rest of the "
            "body."
        )
    return text
