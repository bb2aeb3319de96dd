"""Sentences of a result beside its tables: times of artefacts, cost, change over time."""

from __future__ import annotations

import math
from collections.abc import Iterator

from undulog.capture.common.console import plain

from ...results import formats
from ...results.analysis import Analysis
from ...results.energy import EnergyResult
from ...results.estimate import Estimate

_ABOUT = {
    "sensor": "Artefact of the sensor",
    "sensor or joint": "Sensor or joint",
    "record": "Artefact of the record",
    "limit": "At a limit",
}

_SPANS = 3
"""Stretches of an artefact that a line names at most."""


def more_lines(analysis: Analysis) -> Iterator[str]:
    """Lines to print after the tables.

    Args:
        analysis: The result.

    Yields:
        Plain text without a line break.
    """
    if analysis.energy is not None:
        yield from _energy(analysis.energy)
    yield from _over_time(analysis)
    yield from _dead_bands(analysis)
    for one in analysis.artefacts:
        spans = [f"{start:.2f} to {stop:.2f} s" for start, stop in one.spans_s[:_SPANS]]
        more = len(one.spans_s) - _SPANS
        times = ", ".join(spans) + (f" and {more} more" if more > 0 else "")
        note = f" ({one.note})" if one.note else ""
        where = f"{one.quantity} on {one.topic}" if one.topic else one.quantity
        about = f"{plain(one.joint)}, {where}: {one.flag}{note}"
        yield f"{_ABOUT[one.about]}: {about}{': ' if times else ''}{times}"


def _dead_bands(analysis: Analysis) -> Iterator[str]:
    """A line for each joint with stick or play: how far its command travels in vain."""
    for joint in analysis.joints:
        band = joint.dead_band
        if band is None:
            continue
        ends = [
            (Estimate(one.travel_rad, one.travel_ci95), Estimate(one.step_rad, one.step_ci95))
            for one in (band.top, band.bottom)
        ]
        ends = ends[:1] if ends[0] == ends[1] else ends
        widths = ", ".join(formats.estimate(formats.degrees(one), "°", most=2) for one, _ in ends)
        steps = ", ".join(formats.estimate(formats.degrees(one), "°", most=2) for _, one in ends)
        where = "both reversals" if len(ends) == 1 else "its upper and lower reversal"
        lag = math.degrees(band.lag_change_rad)
        yield (
            f"Dead band: {plain(joint.name)}, {band.kind} ({band.evidence}): at {where} "
            f"the command travels {widths} before the joint moves and catches up by {steps}; "
            f"of gain and lag the dead band alone makes {band.gain_change:.3f} and {lag:.1f}°"
        )


def _energy(energy: EnergyResult) -> Iterator[str]:
    cost = energy.transport
    named = (("E_net", cost.net), ("E_abs", cost.abs), ("E_el", cost.el))
    known = [f"{name} {formats.estimate(one, most=4)}" for name, one in named if one.value]
    if known:
        way = formats.estimate(cost.distance_m, " m", most=3)
        yield f"Cost of transport E/(m g d): {', '.join(known)}, over {way}"
    if energy.unknown is not None:
        yield formats.sentence(energy.unknown)
    closure = energy.closure
    if closure is not None and closure.mechanical_balance is not None:
        parts = [f"balance {100 * closure.mechanical_balance:.3f} %"]
        parts += [] if closure.net is None else [f"E_net {100 * closure.net:.2f} %"]
        parts += [] if closure.el is None else [f"E_el {100 * closure.el:.2f} %"]
        yield f"Against the twin's ledger, in % of E_abs: {', '.join(parts)}"


def _over_time(analysis: Analysis) -> Iterator[str]:
    """The range of gain and lag over cycles, where there is no one gait to tell them for."""
    if analysis.over_time is None or analysis.gait.frequency_hz.value is not None:
        return
    known = [
        (gain, lag, rate)
        for joint in analysis.over_time.joints
        for gain, lag, rate in zip(joint.gain, joint.lag_rad, joint.frequency_hz, strict=True)
        if gain is not None and lag is not None
    ]
    gains, lags, rates = (sorted(one[k] for one in known) for k in range(3))
    low, high = (formats.degrees(Estimate(one)).value for one in (lags[0], lags[-1]))
    yield (
        f"Cycle by cycle, by the logged phase: {len(analysis.over_time.joints)} joints, gain "
        f"{formats.number(gains[0], 2)} to {formats.number(gains[-1], 2)}, lag "
        f"{formats.number(low, 1)} to {formats.number(high, 1)}°, {rates[0]:.2f} to "
        f"{rates[-1]:.2f} Hz (--json has each)"
    )
