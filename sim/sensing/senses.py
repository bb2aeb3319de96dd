"""All sensors of the robot in its world, as :class:`sim.sensing.contract.Sensing` has them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ..physics.steps import Step
from ..readings import Readings
from ..scenario import CONTROL_RATE_HZ, Scenario
from .contract import JointSample, SensorSample
from .polling import JointPolling


class Senses:
    """The sensors that a scenario asks for."""

    def __init__(self, scenario: Scenario) -> None:
        """Start before the first control period.

        Args:
            scenario: The robot, its world, and how its sensors measure.
        """
        self._polling = JointPolling(
            scenario.sensing.servo,
            scenario.noise,
            len(scenario.robot.joints),
            period_steps=scenario.physics_rate_hz // CONTROL_RATE_HZ,
            dt=1.0 / scenario.physics_rate_hz,
            seed=scenario.seed,
        )
        self._readings = Readings.nothing(scenario.robot)

    @property
    def readings(self) -> Readings:
        """What the robot's computer knows by now."""
        return self._readings

    def observe(self, steps: Sequence[Step]) -> list[SensorSample]:
        """Take in one control period.

        Args:
            steps: Its physics steps from its start to its end, both included.

        Returns:
            The samples that arrive by the end of the period.
        """
        return self._known([*self._polling.observe(steps)])

    def flush(self) -> list[SensorSample]:
        """End the run.

        Returns:
            Samples that were taken and have not arrived yet.
        """
        return self._known([*self._polling.flush()])

    def _known(self, samples: list[SensorSample]) -> list[SensorSample]:
        """Take samples into the readings; returns them."""
        for sample in samples:
            if isinstance(sample, JointSample):
                self._readings = dataclasses.replace(
                    self._readings, angle=sample.position, velocity=sample.velocity
                )
        return samples
