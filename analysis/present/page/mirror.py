"""A wave and its reverse: the profile of one direction over the mirrored other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.palette import joint_hex

from ...results.estimate import Estimate, leaves_out_zero
from ...results.experiment import Experiment, Reversal
from ...results.formats import degrees, estimate, relative, short
from .svg import (
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
)

_ASIDE = 0.16
"""Dots of single runs stand this far beside a joint's place."""


_SOLID: dict[str, Any] = {"markersize": 4.6, "markeredgecolor": INK, "markeredgewidth": 0.5}
_HOLLOW: dict[str, Any] = {
    "markersize": 6.6,
    "markerfacecolor": "none",
    "markeredgecolor": INK,
    "markeredgewidth": 1.0,
}


@dataclass(frozen=True)
class Profiles:
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
    """Collect what the runs of a reversal measured.

    Args:
        reversal: Its reversal test, which says what joints took part.
    """
    names = [one.name for one in reversal.joints]

    def of(role: str) -> tuple[FloatArray, FloatArray]:
        gain: list[list[float]] = []
        lag: list[list[float]] = []
        for run, session in zip(experiment.runs, experiment.sessions, strict=True):
            if run.role != role:
                continue
            joints = {joint.name: joint for joint in session.joints}
            gain.append([_known(joints[name].gain) for name in names])
            lag.append([_known(joints[name].lag_rad) for name in names])
        return np.array(gain), np.array(lag)

    (gain, lag), (back_gain, back_lag) = of("forward"), of("reverse")
    middle = np.angle(np.nanmean(np.exp(1j * lag)))
    lag, back_lag = (middle + np.angle(np.exp(1j * (one - middle))) for one in (lag, back_lag))
    return Profiles(
        frozen(gain),
        frozen(np.degrees(lag)),
        frozen(back_gain[:, ::-1]),
        frozen(np.degrees(back_lag)[:, ::-1]),
    )


def mirror_profile(seen: Profiles, reversal: Reversal, prefix: str) -> Drawing:
    """Profiles of both directions, and their differences with simultaneous intervals.

    Args:
        prefix: For identifiers, unique in the page.

    Returns:
        The figure: gain and lag, each with its difference below.
    """
    joints = reversal.joints
    colors = joint_hex(len(joints))
    tooltips: dict[str, str] = {}
    gains = [relative(one.log_gain_difference) for one in joints]
    lags = [degrees(one.lag_difference_rad) for one in joints]
    with drawing():
        figure = new_figure(WIDTH_IN, 6.6)
        rows = figure.subplots(4, 1, sharex=True, height_ratios=[1.35, 1, 1.35, 1])
        _profile(rows[0], seen.gain, seen.mirrored_gain, colors)
        _differences(rows[1], reversal, gains, colors, tooltips, what="gain")
        _profile(rows[2], seen.lag_deg, seen.mirrored_lag_deg, colors)
        _differences(rows[3], reversal, lags, colors, tooltips, what="lag")
        for axes, label in zip(
            rows, ("gain [1]", "difference [%]", "lag [°]", "difference [°]"), strict=True
        ):
            axes.set_ylabel(label)
        joint_ticks(rows[3], [one.name for one in joints])
        rows[3].set_xlabel("joint with the wave from head to tail, head on the left")
        figure.align_ylabels()
        middle = colors[len(colors) // 2]
        legend(
            figure,
            [
                key([], [], color=middle, marker="o", label="wave from head to tail", **_SOLID),
                key(
                    [],
                    [],
                    color=INK,
                    marker="D",
                    linestyle=(0, (2, 2)),
                    label="from tail to head, mirrored",
                    **_HOLLOW,
                ),
                key([], [], color=MUTED, marker=".", linestyle="none", label="one run"),
                key([], [], color=middle, linewidth=2.2, label="difference, 95 % together"),
            ],
        )
        svg = inline_svg(
            figure,
            prefix=prefix,
            title="Gain and lag of both directions, and their differences",
            description=_in_words(reversal),
            tooltips=tooltips,
        )
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
    axes.plot(place, other.mean(0), color=INK, linestyle=(0, (2, 2)), linewidth=1.0)
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
    axes.axhline(0.0, color=REFERENCE, linestyle=(0, (5, 3)), zorder=1)
    unit = " %" if what == "gain" else "°"
    for k, (joint, value, color) in enumerate(zip(reversal.joints, values, colors, strict=True)):
        if value.value is None or value.ci95 is None:
            continue
        away = leaves_out_zero(value.ci95)
        axes.plot([k + 1] * 2, value.ci95, color=color, linewidth=2.2, zorder=2)
        gid = f"{what}-{k}"
        axes.plot(
            [k + 1],
            [value.value],
            "o",
            markersize=5.2 if away else 3.6,
            markerfacecolor=color,
            markeredgecolor=INK,
            markeredgewidth=0.9 if away else 0.4,
            gid=gid,
            zorder=3,
        )
        tooltips[gid] = f"{joint.name} against {joint.mirror}: {what} {estimate(value, unit)}"
        if joint.name in named:
            axes.annotate(
                short(joint.name, 14),
                (k + 1, value.ci95[1] if value.value > 0 else value.ci95[0]),
                xytext=(0, 5 if value.value > 0 else -5),
                textcoords="offset points",
                ha="center",
                va="bottom" if value.value > 0 else "top",
                fontweight="bold",
            )
    axes.margins(y=0.3)


def _in_words(reversal: Reversal) -> str:
    less = ", ".join(f"{pair.name} less than {pair.mirror}" for pair in reversal.pairs) or "none"
    return (
        f"{len(reversal.joints)} joints, {reversal.forward_runs} and {reversal.reverse_runs} runs. "
        f"Pairs that differ beyond doubt: {less}. The table of mirror pairs holds every number."
    )


def _known(quantity: Estimate) -> float:
    return float("nan") if quantity.value is None else quantity.value
