"""The serpentine generator, Eqs. 2 and 6 of Meister, Stepanenko & Kernbach 2011."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from capture.robot import Plane, Robot

from ..readings import Readings
from .contract import WALK, GaitTick
from .limits import smoothstep, within_limits
from .wave import VALUE_NAMES, PlaneGait


@dataclass(frozen=True)
class Serpentine:
    """Parameters of the open-loop serpentine gait.

    Attributes:
        planes: The planes that are driven; the joints of the others are held straight.
        ramp_s: Amplitude and offset grow from nothing over this time, smoothly.
    """

    planes: dict[Plane, PlaneGait] = field(default_factory=dict[Plane, PlaneGait])
    ramp_s: float = 2.0


class SerpentineGait:
    """The serpentine generator, Eqs. 2 and 6 of Meister, Stepanenko & Kernbach 2011."""

    def __init__(self, parameters: Serpentine, robot: Robot) -> None:
        """Start at time zero with straight joints.

        Args:
            parameters: What to do.
            robot: Who is to do it.
        """
        lower, upper = robot.limits()
        self._parameters = parameters
        self._command = np.clip(np.zeros(len(robot.joints)), lower, upper)
        self._time_s = 0.0
        self._joints = {plane: robot.joint_indices(plane) for plane in parameters.planes}
        self._limits = {
            plane: (float(lower[chosen].max()), float(upper[chosen].min()))
            for plane, chosen in self._joints.items()
        }
        self._phase = {plane: gait.phase for plane, gait in parameters.planes.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values: five for each driven plane."""
        return tuple(f"{plane}.{name}" for plane in self._joints for name in VALUE_NAMES)

    def step(self, time_s: float, readings: Readings) -> GaitTick:  # noqa: ARG002 - open loop
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            readings: Not looked at.

        Returns:
            Commands and values.
        """
        elapsed, self._time_s = time_s - self._time_s, time_s
        ramp_s = self._parameters.ramp_s
        ramp = smoothstep(time_s / ramp_s) if ramp_s > 0.0 else 1.0
        command = self._command.copy()
        values: list[float] = []
        clamped: list[str] = []
        for plane, gait in self._parameters.planes.items():
            omega = 2.0 * math.pi * gait.frequency_hz
            self._phase[plane] += omega * elapsed
            phase, lag, joints = self._phase[plane], gait.signed_lag, self._joints[plane]
            wanted = ramp * gait.amplitude, ramp * gait.offset
            amplitude, offset = within_limits(*wanted, *self._limits[plane])
            if amplitude != wanted[0]:
                clamped.append(f"{plane}.A")
            if offset != wanted[1]:
                clamped.append(f"{plane}.offset")
            # Eq. 2: A sin(omega t + (i - 1) phi) + Y
            command[joints] = amplitude * np.sin(phase + np.arange(len(joints)) * lag) + offset
            values += [amplitude, omega, lag, offset, phase]
        return GaitTick(command, np.array(values), WALK, tuple(clamped))
