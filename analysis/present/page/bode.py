"""Draw frequency responses: gain and lag of joints against frequency (Bode's diagram)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import matplotlib.ticker
import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_hex

from ...results.estimate import Estimate
from ...results.formats import degrees, estimate, short
from ...results.frequency_response import BestLinearJoint, JointFrequencyResponse
from .svg import Drawing, band, drawing, inline_svg, key, legend

MARKERS = ("o", "s", "^", "D", "v", "P")
"""Of the joints in one figure, since colours alone don't distinguish them for all readers."""

JOINTS = len(MARKERS)
"""Joints in one figure."""

_TICKS = (1.0, 2.0, 5.0)
ticker: Any = matplotlib.ticker  # its stubs lack the classes


def bode(found: Sequence[JointFrequencyResponse], prefix: str) -> list[Drawing]:
    """Draw the responses, :data:`JOINTS` joints a figure.

    Args:
        found: In chain order.
        prefix: For identifiers, unique in the page.
    """
    groups = [found[k : k + JOINTS] for k in range(0, len(found), JOINTS)]
    return [_figure(group, f"{prefix}-{k}") for k, group in enumerate(groups)]


def best_linear_bode(found: Sequence[BestLinearJoint], prefix: str) -> list[Drawing]:
    """Draw best linear approximations likewise, with the noise and the distortion of each gain."""
    groups = [found[k : k + JOINTS] for k in range(0, len(found), JOINTS)]
    return [
        _figure([one.response for one in group], f"{prefix}-{k}", group)
        for k, group in enumerate(groups)
    ]


def _figure(
    group: Sequence[JointFrequencyResponse], prefix: str, best: Sequence[BestLinearJoint] = ()
) -> Drawing:
    colors = joint_hex(len(group))
    tooltips: dict[str, str | Sequence[str]] = {}
    with drawing(4.6) as figure:
        gain_axes, lag_axes = figure.subplots(2, 1, sharex=True)
        for number, (one, color) in enumerate(zip(group, colors, strict=True)):
            frequency = np.array(one.frequency_hz)
            gain, ends = np.array(one.gain), np.array(one.gain_ci95)
            style = {"color": color, "linewidth": 1.4, "marker": MARKERS[number], "markersize": 3.6}
            gain_axes.plot(frequency, gain, gid=f"gain-{number}", **style)
            tooltips[f"gain-{number}"] = _tips(one, range(gain.size), lag=False)
            low = np.maximum(ends[:, 0], gain.min() / 10)  # a logarithm has no zero
            band(gain_axes, frequency, low, ends[:, 1], color=color, alpha=0.18)
            sure = np.array([interval is not None for interval in one.lag_ci95])
            if sure.any():
                lag = _unwrapped(np.array(one.lag_rad)[sure])
                reach = np.array([_reach(one, k) for k in np.flatnonzero(sure).tolist()])
                lag_axes.plot(frequency[sure], np.degrees(lag), gid=f"lag-{number}", **style)
                tooltips[f"lag-{number}"] = _tips(one, np.flatnonzero(sure).tolist(), lag=True)
                edges = np.degrees(lag - reach), np.degrees(lag + reach)
                band(lag_axes, frequency[sure], *edges, color=color, alpha=0.18)
        for one, color in zip(best, colors, strict=False):
            frequency = np.array(one.response.frequency_hz)
            for values, line in ((one.distortion_sd, "--"), (one.noise_sd, ":")):
                shown = np.array(values or ()) > 0  # a logarithm has no zero
                if shown.any():
                    sd = np.array(values)[shown]
                    gain_axes.plot(frequency[shown], sd, line, color=color, linewidth=1.0)
        gain_axes.set_xscale("log")
        gain_axes.set_yscale("log")
        for axis in (gain_axes.yaxis, lag_axes.xaxis):
            axis.set_major_locator(ticker.LogLocator(subs=_TICKS))
            axis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            axis.set_minor_locator(ticker.NullLocator())
        gain_axes.set_ylabel("gain [1]")
        lag_axes.set_ylabel("lag [°]")
        lag_axes.set_xlabel("frequency [Hz]")
        handles = [
            key(color=color, linewidth=1.4, marker=each, label=short(one.joint, 14))
            for one, color, each in zip(group, colors, MARKERS, strict=False)
        ]
        legend(figure, *handles)
        figure.align_ylabels()
        names = ", ".join(one.joint for one in group)
        svg = inline_svg(
            figure, prefix, f"Frequency response of {names}", _in_words(group), tooltips
        )
    return Drawing(
        svg,
        "Gain and lag of each joint's response to its command; bands hold the 95 % interval. Lag "
        "is drawn where the gain is distinct from zero." + (_BEST if best else ""),
    )


_BEST = (
    " Dashed: standard deviation that nonlinear distortion gives to the gain of one realisation, "
    "where there is any; dotted: standard deviation by noise of the mean of all realisations."
)


def _tips(one: JointFrequencyResponse, lines: Iterable[int], *, lag: bool) -> list[str]:
    """Return the text of each line of a response, with its interval."""
    texts: list[str] = []
    for k in lines:
        value = Estimate(one.gain[k], one.gain_ci95[k])
        if lag:
            value = degrees(Estimate(one.lag_rad[k], one.lag_ci95[k]))
        shown = f"lag {estimate(value, '°')}" if lag else f"gain {estimate(value)}"
        texts.append(f"{one.joint}: {shown} at {one.frequency_hz[k]:.4g} Hz")
    return texts


def _reach(one: JointFrequencyResponse, k: int) -> float:
    """Return the half width of a lag's interval [rad]; 0 where there is none."""
    interval = one.lag_ci95[k]
    return 0.0 if interval is None else (interval[1] - interval[0]) / 2


def _unwrapped(lag_rad: FloatArray) -> FloatArray:
    """Remove jumps by a whole turn, beginning in (-pi, pi]."""
    return np.asarray(np.unwrap(lag_rad), dtype=np.float64)


def _in_words(group: Sequence[JointFrequencyResponse]) -> str:
    return "; ".join(
        f"{one.joint}: gain {one.gain[0]:.3g} at {one.frequency_hz[0]:.3g} Hz and "
        f"{one.gain[-1]:.3g} at {one.frequency_hz[-1]:.3g} Hz, lag "
        f"{math.degrees(one.lag_rad[0]):.3g}° and {math.degrees(one.lag_rad[-1]):.3g}°"
        for one in group
    )
