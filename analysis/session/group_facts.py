"""What the result states of each group of joints that share a rhythm."""

from __future__ import annotations

import numpy as np

from undulog.capture.robot.model import Robot

from ..estimators.intervals import around, t_factor
from ..response.fitting import GaitFit
from ..response.gait import phase_step, wave_name
from ..results.analysis import GroupFacts, Window
from ..results.estimate import Estimate
from ..signals.reading import by_plane
from ..signals.windows import Span, Stretch, whole_cycles

_NS = 1e9


def group_facts(
    robot: Robot | None, gait: GaitFit, span: Span, stretch: Stretch, start_ns: int
) -> tuple[GroupFacts, ...]:
    """State frequency, whole cycles and wave of each group.

    Args:
        robot: The robot, or None.
        gait: The fitted gait.
        span: The largest group's whole cycles.
        stretch: The fitted stretch.
        start_ns: Unix time of the session's start [ns].

    Returns:
        One a group, the largest first.
    """
    ends = [(t - start_ns) / _NS for t in (stretch.start_ns, stretch.stop_ns)]
    shift_s = (span.origin_ns - start_ns) / _NS
    result: list[GroupFacts] = []
    for index, group in enumerate(gait.groups):
        frequency = group.fit.frequency_hz
        half = t_factor(group.omega_dof) * group.omega_error / (2 * np.pi)
        if index == 0:
            window = Window(span.start_s + shift_s, span.stop_s + shift_s, float(span.cycles))
        else:
            first_s, last_s, cycles = whole_cycles(ends[0], ends[1], frequency)
            window = Window(first_s, last_s, float(cycles))
        wave, steps = _wave(robot, group)
        estimate = Estimate(frequency, around(frequency, half))
        result.append(GroupFacts(estimate, group.driven, (window,), wave, steps))
    return tuple(result)


def _wave(robot: Robot | None, gait: GaitFit) -> tuple[str | None, dict[str, float]]:
    """Direction of the wave of the plane with the largest command, and each plane's phase step."""
    steps: dict[str, float] = {}
    main, largest = None, 0.0
    for plane, names in by_plane(robot, gait.driven).items():
        if len(names) > 1:
            waves = gait.fit.fundamental[[gait.command_of(name) for name in names]]
            steps[plane] = phase_step(waves)
            if np.abs(waves).max() > largest:
                main, largest = plane, float(np.abs(waves).max())
    return None if main is None else wave_name(steps[main]), steps
