"""The gait in words."""

from __future__ import annotations

from ...common.formats import estimate
from .result import GaitFacts


def gait_frequency(gait: GaitFacts) -> str:
    """Format the gait's frequency, or the frequency of each group of joints.

    Returns:
        For example ``0.97 Hz [0.969, 0.971]`` or ``1.432 Hz (8 joints) and 0.954 Hz (8 joints)``,
        each with its interval.
    """
    if len(gait.groups) < 2:
        return estimate(gait.frequency_hz, " Hz", most=4)
    parts = [
        f"{estimate(group.frequency_hz, ' Hz', most=4)} ({len(group.joints)} "
        f"joint{'' if len(group.joints) == 1 else 's'})"
        for group in gait.groups
    ]
    return f"{', '.join(parts[:-1])} and {parts[-1]}"
