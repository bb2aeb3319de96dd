"""Dead bands in words."""

from __future__ import annotations

import math

from undulog.capture.common.console import plain

from ...common import formats
from ...common.estimate import Estimate
from .result import DeadBand


def dead_band_line(name: str, band: DeadBand) -> str:
    """Return the line of a joint with stick or play: its dead band at both reversals."""
    ends = [
        (
            Estimate(reversal.travel_rad, reversal.travel_ci95),
            Estimate(reversal.step_rad, reversal.step_ci95),
        )
        for reversal in (band.top, band.bottom)
    ]
    ends = ends[:1] if ends[0] == ends[1] else ends
    widths = ", ".join(formats.estimate(formats.degrees(travel), "°", most=2) for travel, _ in ends)
    steps = ", ".join(formats.estimate(formats.degrees(step), "°", most=2) for _, step in ends)
    where = "both reversals" if len(ends) == 1 else "its upper and lower reversal"
    lag = math.degrees(band.lag_change_rad)
    return (
        f"Dead band: {plain(name)}, {band.kind} ({band.evidence}): at {where} "
        f"the command travels {widths} before the joint moves and catches up by {steps}; "
        f"of gain and lag the dead band alone makes {band.gain_change:.3f} and {lag:.1f}°"
    )
