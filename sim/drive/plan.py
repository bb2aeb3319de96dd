"""Plans: a serpentine gait whose values change from segment to segment, and never jump in phase.

Within a segment each value goes from what it was to what it is to be,

    v(t) = v_0 + (v_1 - v_0) S((t - t_0) / T),   S(x) = 3 x^2 - 2 x^3,

over the segment's transition T, and stays there. The phase is integrated, Phi' = omega, with the
omega in force from each tick on, so it is continuous whatever the plan does. A lag may pass through
zero: that is how a wave turns round.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import WALK, GaitTick
from ..gait.limits import started
from ..gait.readings import Readings
from ..gait.rhythm import Change, IntegratedPhase, Swing
from ..gait.wave import PlaneGait
from ..gait.waves import WaveGenerator
from ..scenario.scenario import Scenario


@dataclass(frozen=True)
class Segment:
    """One part of a plan.

    Attributes:
        duration_s: How long it lasts.
        planes: What each driven plane does once the transition is over.
        transition_s: How long the way there takes, from the segment's start; 0: a jump.
        mode: One word for what it is about.
    """

    duration_s: float
    planes: Mapping[Plane, PlaneGait]
    transition_s: float = 1.0
    mode: str = WALK


@dataclass(frozen=True)
class Plan:
    """A sequence of segments.

    Attributes:
        name: Short name.
        description: One sentence.
        scenario: Robot and world that it was written for.
        start: What each driven plane does at time zero; its ``phase`` is the phase there.
        ramp_s: Amplitude and offset grow from nothing over this time, smoothly.
        segments: At least one; all have the planes of ``start``.
    """

    name: str
    description: str
    scenario: Scenario
    start: Mapping[Plane, PlaneGait]
    ramp_s: float
    segments: tuple[Segment, ...]

    @property
    def duration_s(self) -> float:
        """How long it lasts."""
        return math.fsum(segment.duration_s for segment in self.segments)


class PlanGait(WaveGenerator):
    """The generator of a plan; after the last segment its values stay."""

    def __init__(self, plan: Plan, robot: Robot, *, per_joint: bool = False) -> None:
        """Start at time zero with straight joints.

        Args:
            plan: What to do.
            robot: Who is to do it.
            per_joint: Tell every joint's own values too, for a controller that sets them apart.
        """
        self._starts = _starts(plan)
        self._modes = [segment.mode for segment in plan.segments]
        rhythms = {
            plane: _PlannedRhythm(plan, plane, len(robot.joint_indices(plane)))
            for plane in plan.start
        }
        super().__init__(rhythms, robot, per_joint=per_joint)

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            readings: Not looked at.

        Returns:
            Commands, values, and the segment's mode.
        """
        segment = bisect_right(self._starts, time_s) - 1
        return super().step(time_s, readings)._replace(mode=self._modes[segment])


class _PlannedRhythm:
    """Eq. 2, or Eq. 6, with values that change by plan."""

    def __init__(self, plan: Plan, plane: Plane, joint_count: int) -> None:
        gaits = [plan.start[plane], *(segment.planes[plane] for segment in plan.segments)]
        self._values = np.array(
            [[g.amplitude, g.offset, g.signed_lag, math.tau * g.frequency_hz] for g in gaits]
        )
        self._starts = _starts(plan)
        self._transitions = [segment.transition_s for segment in plan.segments]
        self._ramp_s = plan.ramp_s
        self._places = np.arange(joint_count)
        omega = float(self._values[0, 3])
        self._phase = IntegratedPhase(gaits[0].phase, omega)

    def step(self, time_s: float, change: Change, readings: Readings) -> Swing:  # noqa: ARG002
        segment = bisect_right(self._starts, time_s) - 1
        share = started(time_s - self._starts[segment], self._transitions[segment])
        before, after = self._values[segment], self._values[segment + 1]
        amplitude, offset, lag, omega = (before + (after - before) * share).tolist()
        ramp = started(time_s, self._ramp_s)
        omega *= change.frequency_factor
        return Swing(
            amplitude=ramp * amplitude * change.amplitude_factor,
            offset=ramp * offset + change.offset,
            phase=self._phase.advance(time_s, omega) + self._places * lag,
            omega=omega,
            lag=lag,
        )


def _starts(plan: Plan) -> list[float]:
    """When each segment begins [s]."""
    return [0.0, *accumulate(segment.duration_s for segment in plan.segments[:-1])]
