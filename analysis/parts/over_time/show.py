"""Responses cycle by cycle in words."""

from __future__ import annotations

from collections.abc import Iterator

from ...common import formats
from ...common.estimate import Estimate
from .result import ResponseOverTime


def over_time_lines(over_time: ResponseOverTime) -> Iterator[str]:
    """Yield the range of gain and lag over cycles, for a session without a single gait."""
    cycles = [
        (gain, lag, rate)
        for joint in over_time.joints
        for gain, lag, rate in zip(joint.gain, joint.lag_rad, joint.frequency_hz, strict=True)
        if gain is not None and lag is not None
    ]
    gains, lags, rates = (sorted(cycle[k] for cycle in cycles) for k in range(3))
    low, high = (formats.degrees(Estimate(lag)).value for lag in (lags[0], lags[-1]))
    yield (
        f"Cycle by cycle, by the logged phase: {len(over_time.joints)} joints, gain "
        f"{formats.number(gains[0], 2)} to {formats.number(gains[-1], 2)}, lag "
        f"{formats.number(low, 1)} to {formats.number(high, 1)}°, {rates[0]:.2f} to "
        f"{rates[-1]:.2f} Hz (--json has each)"
    )
