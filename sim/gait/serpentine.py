"""The serpentine generator, Eqs. 2 and 6 of Meister, Stepanenko & Kernbach 2011."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from undulog.capture.common.config import NonNegative
from undulog.capture.robot.model import Plane, Robot

from .contract import Readings
from .rhythm import Change, IntegratedPhase, Swing, started
from .wave import PlaneGait, WaveGenerator


@dataclass(frozen=True)
class Serpentine:
    """Parameters of the serpentine gait.

    Attributes:
        planes: The planes that are driven; the joints of the others are held straight.
        ramp_s: Amplitude and offset grow from nothing over this time, smoothly.
    """

    planes: dict[Plane, PlaneGait] = field(default_factory=dict[Plane, PlaneGait])
    ramp_s: NonNegative = 2.0


class SerpentineGait(WaveGenerator):
    """The serpentine generator: every joint computes its own sine."""

    def __init__(self, parameters: Serpentine, robot: Robot, *, per_joint: bool = False) -> None:
        """Start at time zero with straight joints.

        Args:
            parameters: What to do.
            robot: Who is to do it.
            per_joint: Tell every joint's own values too, for a controller that sets them apart.
        """
        rhythms = {
            plane: _SerpentineRhythm(wave, parameters.ramp_s, len(robot.joint_indices(plane)))
            for plane, wave in parameters.planes.items()
        }
        super().__init__(rhythms, robot, per_joint=per_joint)


class _SerpentineRhythm:
    """Eq. 2, or Eq. 6: A sin(Phi(t) + (i - 1) phi) + Y, Phi(0) = phi_0."""

    def __init__(self, wave: PlaneGait, ramp_s: float, joint_count: int) -> None:
        self._wave, self._ramp_s = wave, ramp_s
        self._omega = 2.0 * math.pi * wave.frequency_hz
        self._phase = IntegratedPhase(wave.phase, self._omega)
        self._lags = np.arange(joint_count, dtype=np.float64) * wave.signed_lag

    def step(self, time_s: float, change: Change, readings: Readings) -> Swing:  # noqa: ARG002
        wave, ramp = self._wave, started(time_s, self._ramp_s)
        omega = self._omega * change.frequency_factor
        return Swing(
            amplitude=ramp * wave.amplitude * change.amplitude_factor,
            offset=ramp * wave.offset + change.offset,
            phase=self._phase.advance(time_s, omega) + self._lags,
            omega=omega,
            lag=wave.signed_lag,
        )
