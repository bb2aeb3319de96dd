"""Draw the profile of a wave over the mirrored profile of its reverse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.palette import joint_hex

from ...results.estimate import Estimate, leaves_out_zero
from ...results.experiment import Experiment, Reversal
from ...results.formats import degrees, estimate, relative, short
from .svg import (
    DASHED,
    INK,
    MUTED,
    REFERENCE,
    WIDTH_IN,
    Axes,
    Drawing,
    drawing,
    inline_svg,
    joint_ticks,
    key,
    legend,
    new_figure,
    plot_estimate,
)

_ASIDE = 0.16
"""Distance of the dots of single runs from their joint's position."""

_SOLID: dict[str, Any] = {"markersize": 4.6, "markeredgecolor": INK, "markeredgewidth": 0.5}
_HOLLOW = _SOLID | {"markersize": 6.6, "markerfacecolor": "none", "markeredgewidth": 1.0}
_MIRRORED: dict[str, Any] = {"color": INK, "linestyle": (0, (2, 2))}


class Profiles(NamedTuple):
    """Gain and lag of the runs of a reversal, all read at the joints of the forward wave.

    Attributes:
        gain: Of the r1 runs from head to tail, shape (r1, m).
        lag_deg: Their lag [deg], within 180 of the joint's mean, shape (r1, m).
        mirrored_gain: Of the r2 runs from tail to head, read from tail to head, shape (r2, m).
        mirrored_lag_deg: Their lag [deg], shape (r2, m).
    """

    gain: FloatArray
    lag_deg: FloatArray
    mirrored_gain: FloatArray
    mirrored_lag_deg: FloatArray


def profiles(experiment: Experiment, reversal: Reversal) -> Profiles:
    """Return gain and lag of the joints that take part in a reversal test, run by run."""
    names = [one.name for one in reversal.joints]

    def of(role: str) -> tuple[FloatArray, FloatArray]:
        chosen = [
            {joint.name: joint for joint in session.joints}
            for run, session in zip(experiment.runs, experiment.sessions, strict=True)
            if run.role == role
        ]
        gain = [[joints[name].gain.value for name in names] for joints in chosen]
        lag = [[joints[name].lag_rad.value for name in names] for joints in chosen]
        return np.array(gain, dtype=np.float64), np.array(lag, dtype=np.float64)

    (gain, lag), (back_gain, back_lag) = of("forward"), of("reverse")
    middle = np.angle(np.nanmean(np.exp(1j * lag)))
    lag, back_lag = (middle + np.angle(np.exp(1j * (one - middle))) for one in (lag, back_lag))
    parts = (gain, np.degrees(lag), back_gain[:, ::-1], np.degrees(back_lag)[:, ::-1])
    return Profiles(*map(frozen, parts))


def mirror_profile(seen: Profiles, reversal: Reversal, prefix: str) -> Drawing:
    """Draw gain and lag of both directions, each with its differences below.

    Args:
        prefix: For identifiers, unique in the page.
    """
    joints = reversal.joints
    colors = joint_hex(len(joints))
    tooltips: dict[str, str] = {}
    gains = [relative(one.log_gain_difference) for one in joints]
    lags = [degrees(one.lag_difference_rad) for one in joints]
    labels = ("gain [1]", "difference [%]", "lag [°]", "difference [°]")
    with drawing():
        figure = new_figure(WIDTH_IN, 6.6)
        rows = figure.subplots(4, 1, sharex=True, height_ratios=[1.35, 1, 1.35, 1])
        _profile(rows[0], seen.gain, seen.mirrored_gain, colors)
        _differences(rows[1], reversal, gains, colors, tooltips, what="gain")
        _profile(rows[2], seen.lag_deg, seen.mirrored_lag_deg, colors)
        _differences(rows[3], reversal, lags, colors, tooltips, what="lag")
        for axes, label in zip(rows, labels, strict=True):
            axes.set_ylabel(label)
        joint_ticks(rows[3], [one.name for one in joints])
        rows[3].set_xlabel("joint with the wave from head to tail, head on the left")
        figure.align_ylabels()
        middle = colors[len(colors) // 2]
        legend(
            figure,
            key(color=middle, marker="o", label="wave from head to tail", **_SOLID),
            key(marker="D", label="from tail to head, mirrored", **_MIRRORED, **_HOLLOW),
            key(color=MUTED, marker=".", linestyle="none", label="one run"),
            key(color=middle, linewidth=2.2, label="difference, 95 % together"),
        )
        title = "Gain and lag of both directions, and their differences"
        svg = inline_svg(figure, prefix, title, _description(reversal), tooltips)
    caption = (
        "Identical modules mirror: the profile with the wave from tail to head, read from tail to "
        "head, lies on the other one, whatever the free ends do to both. The intervals of the "
        "differences hold all together at 95 %: a pair differs where its interval leaves out zero. "
        "The name of a weak module stands at its difference."
    )
    return Drawing(svg, caption)


def _profile(axes: Axes, one: FloatArray, other: FloatArray, colors: Sequence[str]) -> None:
    place: FloatArray = np.arange(1.0, one.shape[1] + 1.0)
    for runs, aside in ((one, -_ASIDE), (other, _ASIDE)):
        for run in runs:
            axes.plot(place + aside, run, ".", color=MUTED, markersize=2.2, zorder=2)
    axes.plot(place, other.mean(0), linewidth=1.0, **_MIRRORED)
    axes.plot(place, one.mean(0), color=MUTED, linewidth=1.0, zorder=1)
    for x, y, color in zip(place, one.mean(0), colors, strict=True):
        axes.plot([x], [y], "o", markerfacecolor=color, **_SOLID, zorder=3)
    # Hollow and larger, so that a diamond on a dot shows both.
    axes.plot(place, other.mean(0), "D", **_HOLLOW, zorder=4)


def _differences(
    axes: Axes,
    reversal: Reversal,
    values: Sequence[Estimate],
    colors: Sequence[str],
    tooltips: dict[str, str],
    *,
    what: str,
) -> None:
    named = {pair.name for pair in reversal.pairs}
    axes.axhline(0.0, color=REFERENCE, linestyle=DASHED, zorder=1)
    unit = " %" if what == "gain" else "°"
    for k, (joint, value, color) in enumerate(zip(reversal.joints, values, colors, strict=True)):
        if value.value is None or value.ci95 is None:
            continue
        size, edge = (5.2, 0.9) if leaves_out_zero(value.ci95) else (3.6, 0.4)
        gid = f"{what}-{k}"
        style: dict[str, Any] = {"markersize": size, "markeredgewidth": edge, "gid": gid}
        plot_estimate(axes, k + 1, value, color, bar=2.2, **style)
        tooltips[gid] = f"{joint.name} against {joint.mirror}: {what} {estimate(value, unit)}"
        if joint.name in named:
            above = value.value > 0
            axes.annotate(
                short(joint.name, 14),
                (k + 1, value.ci95[1] if above else value.ci95[0]),
                xytext=(0, 5 if above else -5),
                textcoords="offset points",
                ha="center",
                va="bottom" if above else "top",
                fontweight="bold",
            )
    axes.margins(y=0.3)


def _description(reversal: Reversal) -> str:
    less = ", ".join(f"{pair.name} less than {pair.mirror}" for pair in reversal.pairs) or "none"
    return (
        f"{len(reversal.joints)} joints, {reversal.forward_runs} and {reversal.reverse_runs} runs. "
        f"Pairs that differ beyond doubt: {less}. The table of mirror pairs holds every number."
    )
