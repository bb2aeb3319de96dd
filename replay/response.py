"""Response of each joint as bars, head to tail: how much, how late, at what cost.

The baseline of gain and lag is perfect tracking: a gain of one and no lag. A whisker in
each bar reaches to the far end of its 95 % interval. One bar chart a joint, so that each bar has
its joint's colour and name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import rerun as rr

from analysis.result import Analysis, Estimate

from .joints import GREY, Color

SEGMENTS = "/segments"

_WIDTH = 0.8
_WHISKER = 0.2  # thin: Rerun adds the light of bars that lie on each other


@dataclass(frozen=True)
class Bar:
    """One joint's bar.

    Attributes:
        joint: The joint's name.
        place: Its number along the body, the head's joint is 1.
        value: Height.
        far: The end of its 95 % interval that is farther from the baseline, or None.
    """

    joint: str
    place: int
    value: float
    far: float | None


@dataclass(frozen=True)
class Chart:
    """One bar chart.

    Attributes:
        key: Last part of its entity's path.
        title: What it shows, with unit.
        bars: A bar for each joint whose value could be computed.
    """

    key: str
    title: str
    bars: tuple[Bar, ...]


def charts(analysis: Analysis) -> tuple[Chart, ...]:
    """What an analysis says about each joint, in the units that are shown.

    Args:
        analysis: The session's analysis.

    Returns:
        Gain less one [%], lag [degrees] and net mechanical energy [J]; without those of which
        no joint has a value.
    """
    gain = [(j.name, _scaled(j.gain, 100.0, 1.0)) for j in analysis.joints]
    lag = [(j.name, _scaled(j.lag_rad, math.degrees(1.0), 0.0)) for j in analysis.joints]
    energy = [(j.name, Estimate(j.energy_net_j)) for j in analysis.joints]
    found = (
        Chart("gain_minus_one_percent", "Gain − 1 [%]", _bars(gain)),
        Chart("lag_degrees", "Lag [°]", _bars(lag)),
        Chart("energy_net_joule", "Net energy [J]", _bars(energy)),
    )
    return tuple(chart for chart in found if chart.bars)


def log_charts(
    rec: rr.RecordingStream, found: tuple[Chart, ...], palette: Mapping[str, Color]
) -> None:
    """Write the bars, valid for the whole session.

    Args:
        rec: The recording.
        found: The charts.
        palette: Colour by joint name.
    """
    for chart in found:
        for bar in chart.bars:
            name = rr.escape_entity_path_part(bar.joint)
            parts = [("estimate", bar.value, _WIDTH, palette.get(bar.joint, GREY))]
            if bar.far is not None:
                parts.append(("ci95", bar.far, _WHISKER, GREY))
            for kind, height, width, color in parts:
                left = bar.place - width / 2
                drawn = rr.BarChart([height], abscissa=[left], widths=[width], color=color)
                rec.log(f"{SEGMENTS}/{chart.key}/{kind}/{name}", drawn, static=True)


def _scaled(estimate: Estimate, scale: float, baseline: float) -> Estimate:
    if estimate.value is None:
        return estimate
    low_high = estimate.ci95
    if low_high is not None:
        low_high = (scale * (low_high[0] - baseline), scale * (low_high[1] - baseline))
    return Estimate(scale * (estimate.value - baseline), low_high)


def _bars(values: list[tuple[str, Estimate]]) -> tuple[Bar, ...]:
    return tuple(
        Bar(name, i + 1, value.value, _far(value))
        for i, (name, value) in enumerate(values)
        if value.value is not None
    )


def _far(estimate: Estimate) -> float | None:
    return None if estimate.ci95 is None else max(estimate.ci95, key=abs)
