"""Draw gain and lag of joints: against frequency (Bode's diagram), and cycle by cycle as maps.

Colours run in a straight line through OKLab, in equal steps of lightness for equal steps of value,
and from one hue over the ground to another where the sign matters.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.ticker
import numpy as np
from markupsafe import Markup

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.common.palette import joint_hex, scale_ends

from ..common.estimate import Estimate
from ..common.formats import decimals_for_values, degrees, estimate, number, short
from ..parts.frequency_response.result import JointFrequencyResponse
from ..results.best_linear import BestLinearJoint
from ..session.cycle_maps import CycleMaps
from .page_tables import LEVELS, color_bar, element, hue, svg_element
from .svg import Drawing, band, drawing, inline_svg, key, legend

MARKERS = ("o", "s", "^", "D", "v", "P")
"""Of the joints in one figure, since colours alone don't distinguish them for all readers."""

JOINTS = len(MARKERS)
"""Joints in one figure."""

_TICKS = (1.0, 2.0, 5.0)
ticker: Any = matplotlib.ticker  # its stubs lack the classes

_BEST = (
    " Dashed: standard deviation that nonlinear distortion gives to the gain of one realisation, "
    "where there is any; dotted: standard deviation by noise of the mean of all realisations."
)

MOST_COLUMNS = 150
"""Columns of a map; more cycles are averaged, with a note."""

WIDTH = 960.0
"""One unit is a pixel of a wide page."""

_RIGHT = 8.0


def bode(responses: Sequence[JointFrequencyResponse], prefix: str) -> list[Drawing]:
    """Draw the responses, :data:`JOINTS` joints a figure.

    Args:
        responses: In chain order.
        prefix: For identifiers, unique in the page.
    """
    groups = [responses[k : k + JOINTS] for k in range(0, len(responses), JOINTS)]
    return [_figure(group, f"{prefix}-{k}") for k, group in enumerate(groups)]


def best_linear_bode(joints: Sequence[BestLinearJoint], prefix: str) -> list[Drawing]:
    """Draw best linear approximations likewise, with the noise and the distortion of each gain."""
    groups = [joints[k : k + JOINTS] for k in range(0, len(joints), JOINTS)]
    return [
        _figure([joint.response for joint in group], f"{prefix}-{k}", group)
        for k, group in enumerate(groups)
    ]


def _figure(
    group: Sequence[JointFrequencyResponse], prefix: str, best: Sequence[BestLinearJoint] = ()
) -> Drawing:
    colors = joint_hex(len(group))
    tooltips: dict[str, str | Sequence[str]] = {}
    with drawing(4.6) as figure:
        gain_axes, lag_axes = figure.subplots(2, 1, sharex=True)
        for number, (response, color) in enumerate(zip(group, colors, strict=True)):
            frequency = np.array(response.frequency_hz)
            gain, ends = np.array(response.gain), np.array(response.gain_ci95)
            style = {"color": color, "linewidth": 1.4, "marker": MARKERS[number], "markersize": 3.6}
            gain_axes.plot(frequency, gain, gid=f"gain-{number}", **style)
            tooltips[f"gain-{number}"] = _tips(response, range(gain.size), lag=False)
            low = np.maximum(ends[:, 0], gain.min() / 10)  # a logarithm has no zero
            band(gain_axes, frequency, low, ends[:, 1], color=color, alpha=0.18)
            sure = np.array([interval is not None for interval in response.lag_ci95])
            if sure.any():
                lag = _unwrapped(np.array(response.lag_rad)[sure])
                reach = np.array([_reach(response, k) for k in np.flatnonzero(sure).tolist()])
                lag_axes.plot(frequency[sure], np.degrees(lag), gid=f"lag-{number}", **style)
                tooltips[f"lag-{number}"] = _tips(response, np.flatnonzero(sure).tolist(), lag=True)
                edges = np.degrees(lag - reach), np.degrees(lag + reach)
                band(lag_axes, frequency[sure], *edges, color=color, alpha=0.18)
        for joint, color in zip(best, colors, strict=False):
            frequency = np.array(joint.response.frequency_hz)
            for values, line in ((joint.distortion_sd, "--"), (joint.noise_sd, ":")):
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
            key(color=color, linewidth=1.4, marker=marker, label=short(response.joint, 14))
            for response, color, marker in zip(group, colors, MARKERS, strict=False)
        ]
        legend(figure, *handles)
        figure.align_ylabels()
        names = ", ".join(response.joint for response in group)
        svg = inline_svg(
            figure, prefix, f"Frequency response of {names}", _bode_in_words(group), tooltips
        )
    return Drawing(
        svg,
        "Gain and lag of each joint's response to its command; bands hold the 95 % interval. Lag "
        "is drawn where the gain is distinct from zero." + (_BEST if best else ""),
    )


def _tips(response: JointFrequencyResponse, lines: Iterable[int], *, lag: bool) -> list[str]:
    """Return the text of each line of a response, with its interval."""
    texts: list[str] = []
    for k in lines:
        value = Estimate(response.gain[k], response.gain_ci95[k])
        if lag:
            value = degrees(Estimate(response.lag_rad[k], response.lag_ci95[k]))
        shown = f"lag {estimate(value, '°')}" if lag else f"gain {estimate(value)}"
        texts.append(f"{response.joint}: {shown} at {response.frequency_hz[k]:.4g} Hz")
    return texts


def _reach(response: JointFrequencyResponse, k: int) -> float:
    """Return the half width of a lag's interval [rad]; 0 where there is none."""
    interval = response.lag_ci95[k]
    return 0.0 if interval is None else (interval[1] - interval[0]) / 2


def _unwrapped(lag_rad: FloatArray) -> FloatArray:
    """Remove jumps by a whole turn, beginning in (-pi, pi]."""
    return np.asarray(np.unwrap(lag_rad), dtype=np.float64)


def _bode_in_words(group: Sequence[JointFrequencyResponse]) -> str:
    return "; ".join(
        f"{response.joint}: gain {response.gain[0]:.3g} at {response.frequency_hz[0]:.3g} Hz and "
        f"{response.gain[-1]:.3g} at {response.frequency_hz[-1]:.3g} Hz, lag "
        f"{math.degrees(response.lag_rad[0]):.3g}° and {math.degrees(response.lag_rad[-1]):.3g}°"
        for response in group
    )


@dataclass(frozen=True)
class Map:
    """A map.

    Attributes:
        names: Of the rows, head at the top, m.
        value: Means of the columns, NaN where all their cycles are missing, shape (m, k).
        holed: Whether any cycle of a column is missing, shape (m, k).
        edges_s: Limits of the columns from the session's start [s], shape (k + 1,).
        signed: Whether colours part at zero.
        least: Smallest span of the colours, so that noise isn't magnified.
    """

    title: str
    names: tuple[str, ...]
    value: FloatArray
    holed: BoolArray
    edges_s: FloatArray
    signed: bool
    least: float

    @property
    def limits(self) -> tuple[float, float]:
        """The values at the ends of the colours."""
        return scale_ends(self.value, self.least, signed=self.signed)


def cycle_drawings(cycles: CycleMaps, prefix: str) -> tuple[Drawing, ...]:
    """Draw gain, lag and power, as far as any cycle has them.

    Args:
        prefix: For identifiers, unique in the page.
    """
    shown = (
        ("Gain", cycles.driven, cycles.gain, False, 0.02),
        ("Lag [°]", cycles.driven, np.degrees(cycles.lag_rad), False, 1.0),
        ("Mean mechanical power [mW]", cycles.powered, 1000 * cycles.power_w, True, 1.0),
    )
    drawings: list[Drawing] = []
    for title, names, value, signed, least in shown:
        if np.isfinite(value).any():
            chart = Map(title, names, *_thinned(cycles, value), signed, least)
            drawings.append(_draw(chart, f"{prefix}-{len(drawings)}", _caption(cycles, chart)))
    return tuple(drawings)


def _thinned(cycles: CycleMaps, value: FloatArray) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return means over as few cycles as fit into the map's columns."""
    count = cycles.start_s.size
    first = np.arange(0, count, -(-count // MOST_COLUMNS))
    finite = np.isfinite(value)
    total = np.add.reduceat(np.where(finite, value, 0.0), first, axis=1)
    seen = np.add.reduceat(finite.astype(np.float64), first, axis=1)
    mean = np.divide(total, seen, out=np.full_like(total, np.nan), where=seen > 0)
    width = np.diff(np.append(first, count))
    end_s = cycles.start_s[-1] + cycles.period_s
    return mean, seen < width, np.append(cycles.start_s[first], end_s)


def _draw(shown: Map, prefix: str, caption: str) -> Drawing:
    m = len(shown.names)
    side = 18.0 if m <= 13 else 12.0
    left, top = 14.0 + 7.0 * max(len(short(name, 12)) for name in shown.names), 6.0
    width, height = WIDTH - left - _RIGHT, side * m
    at_s = (shown.edges_s - shown.edges_s[0]) / (shown.edges_s[-1] - shown.edges_s[0])
    edges = left + width * at_s
    low, high = shown.limits
    share = (shown.value - low) / (high - low)
    level = np.where(np.isfinite(share), np.rint(share * LEVELS), -1).astype(np.int64)
    paths = [
        element("path", d=_cells(level == n, edges, top, side), **hue(n, signed=shown.signed))
        for n in range(LEVELS + 1)
        if (level == n).any()
    ]
    parts = [element("g", *paths, class_="cells")]
    if shown.holed.any():
        line = element("path", d="M0 0V6", class_="hatch")
        pattern = {
            "id": f"{prefix}-missing",
            "width": 6,
            "height": 6,
            "patternUnits": "userSpaceOnUse",
            "patternTransform": "rotate(45)",
        }
        holes = _cells(shown.holed, edges, top, side)
        parts.append(element("pattern", line, **pattern))
        parts.append(element("path", d=holes, fill=f"url(#{prefix}-missing)", class_="holed"))
    foot = top + height
    svg = svg_element(
        prefix,
        f"{shown.title} of every joint in every cycle",
        _map_in_words(shown),
        *parts,
        element("rect", x=left, y=top, width=width, height=height, class_="frame"),
        *_names(shown.names, left, top, side),
        *_times(shown.edges_s, left, width, foot),
        *_bar(shown, left, foot + 40),
        viewBox=f"0 0 {WIDTH:.0f} {foot + 74:.0f}",
        role="img",
        class_="map",
        data_map=_cell_values(shown, edges, top, side),
    )
    return Drawing(str(svg), caption)


def _cell_values(shown: Map, edges: FloatArray, top: float, side: float) -> str:
    """Return places and values of all cells for the page's script, with three digits."""
    low, high = shown.limits
    decimals = decimals_for_values([low, high], 3)
    values = [
        [round(value, decimals) if math.isfinite(value) else None for value in row]
        for row in shown.value.tolist()
    ]
    facts = {
        "top": top,
        "side": side,
        "edges": edges.round(1).tolist(),
        "times": shown.edges_s.round(2).tolist(),
        "names": shown.names,
        "values": values,
        "label": shown.title[0].lower() + shown.title[1:],
    }
    return json.dumps(facts, ensure_ascii=False, separators=(",", ":"))


def _cells(chosen: BoolArray, edges: FloatArray, top: float, side: float) -> str:
    """Path around the chosen cells, those beside one another in a row as one."""
    turns = np.diff(np.pad(chosen.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(turns == 1)
    _, stops = np.nonzero(turns == -1)
    return "".join(
        f"M{edges[i]:.1f} {top + side * row:g}H{edges[j]:.1f}v{side:g}H{edges[i]:.1f}z"
        for row, i, j in zip(rows, starts, stops, strict=True)
    )


def _names(names: Sequence[str], left: float, top: float, side: float) -> list[Markup]:
    step = 1 if side > 14 else 2
    return [
        element("text", short(name, 12), x=left - 6, y=top + side * (i + 0.5), text_anchor="end")
        for i, name in enumerate(names)
        if i % step == 0
    ]


def _times(edges_s: FloatArray, left: float, width: float, foot: float) -> list[Markup]:
    start, stop = float(edges_s[0]), float(edges_s[-1])
    rough = (stop - start) / 8
    power = 10.0 ** math.floor(math.log10(rough))
    step = float(power * next(n for n in (1, 2, 5, 10) if n * power >= rough))
    digits = decimals_for_values([step], 1)
    ticks = [n * step for n in range(math.ceil(start / step), math.floor(stop / step) + 1)]
    parts: list[Markup] = []
    for tick in ticks:
        x = left + width * (tick - start) / (stop - start)
        parts.append(element("path", d=f"M{x:.1f} {foot:g}v4", class_="tick"))
        parts.append(element("text", number(tick, digits), x=x, y=foot + 13, text_anchor="middle"))
    label = "time from the session's start [s]"
    parts.append(element("text", label, x=left + width, y=foot + 30, text_anchor="end"))
    return parts


def _bar(shown: Map, left: float, top: float) -> list[Markup]:
    low, high = shown.limits
    digits = decimals_for_values([low, high], 3)
    width = 240.0
    ends = ((low, 0.0, "start"), ((low + high) / 2, 0.5, "middle"), (high, 1.0, "end"))
    texts = [
        element("text", number(v, digits), x=left + width * f, y=top + 20, text_anchor=anchor)
        for v, f, anchor in ends
    ]
    title = element("text", shown.title, x=left + width + 14, y=top + 5)
    return [*color_bar(left, top, width, 9, signed=shown.signed), *texts, title]


def _map_in_words(shown: Map) -> str:
    m, k = shown.value.shape
    low, high = float(np.nanmin(shown.value)), float(np.nanmax(shown.value))
    digits = decimals_for_values([low, high], 3)
    missing = int(np.count_nonzero(shown.holed))
    return (
        f"{m} joints in rows, head at the top, {k} columns of time; values from "
        f"{number(low, digits)} to {number(high, digits)}; {missing or 'no'} cells miss cycles."
    )


def _caption(cycles: CycleMaps, shown: Map) -> str:
    count = cycles.start_s.size
    step = -(-count // MOST_COLUMNS)
    name = shown.title.partition(" [")[0].capitalize()
    text = f"{name}: each column is one of {count} cycles."
    if step > 1:
        many = f"{count} cycles are too many to show one by one"
        text = f"{name}: {many}; each column is the mean of {step}."
    if shown.signed:
        text += " Negative: driven by the rest of the body."
    if shown.holed.any():
        text += " Hatched: cycles are missing there, or falsified by a sensor."
    return text
