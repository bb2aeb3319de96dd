"""All sensors of the robot in its world, as :class:`.sim.sensing.contract.Sensing` has them."""

from __future__ import annotations

from typing import Protocol

from undulog.capture.robot.model import Sensor, SensorKind

from ..gait.contract import Readings
from ..physics.steps import Steps
from ..scenario.scenario import CONTROL_RATE_HZ, Scenario
from .accelerometer import Accelerometer
from .compass import Compass
from .contract import JointSample, RangeSample, SensorSample, VectorSample
from .polling import JointPolling
from .ranging import Infrared, Sonar
from .rays import RayCaster


class _Kind(Protocol):
    """All sensors of one kind."""

    def observe(self, steps: Steps, start: int) -> list[RangeSample] | list[VectorSample]:
        """Measure during one control period, whose first step has a number."""
        ...


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
        self._kinds = _kinds(scenario) if scenario.sensing.enabled else []
        self._accelerometers = frozenset(
            one.name for one in scenario.robot.sensors if one.kind is SensorKind.ACCELEROMETER
        )
        self._readings = Readings.nothing(scenario.robot)
        self._start = 0  # number of the next period's first step

    @property
    def readings(self) -> Readings:
        """What the robot's computer knows by now."""
        return self._readings

    def observe(self, steps: Steps) -> list[SensorSample]:
        """Take in one control period.

        Args:
            steps: Its physics steps from its start to its end, both included.

        Returns:
            The samples that arrive by the end of the period, in the order of their times; the
            servos' cycle, which is older, comes last.
        """
        start = self._start
        self._start += len(steps) - 1
        measured = [one for kind in self._kinds for one in kind.observe(steps, start)]
        measured.sort(key=lambda one: one.time_s)  # stable: in the order of kinds at one time
        return self._known([*measured, *self._polling.observe(steps)])

    def flush(self) -> list[SensorSample]:
        """End the run.

        Returns:
            Samples that were taken and have not arrived yet.
        """
        return self._known([*self._polling.flush()])

    def _known(self, samples: list[SensorSample]) -> list[SensorSample]:
        """Take samples into the readings; returns them."""
        if not samples:
            return samples
        old = self._readings
        angle, velocity = old.angle, old.velocity
        ranges, acceleration, field = {**old.ranges}, {**old.acceleration}, {**old.magnetic_field}
        for sample in samples:
            if isinstance(sample, JointSample):
                angle, velocity = sample.position, sample.velocity
            elif isinstance(sample, RangeSample):
                ranges[sample.name] = sample.distance
            elif sample.name in self._accelerometers:
                acceleration[sample.name] = sample.vector
            else:
                field[sample.name] = sample.vector
        self._readings = Readings(angle, velocity, ranges, acceleration, field)
        return samples


def _kinds(scenario: Scenario) -> list[_Kind]:
    """The sensors that the robot has, by kind."""
    robot, world, models = scenario.robot, scenario.world, scenario.sensing
    dt, seed = 1.0 / scenario.physics_rate_hz, scenario.seed
    caster = RayCaster(world.obstacles, ground=world.ground is not None)

    def having(kind: SensorKind) -> tuple[Sensor, ...]:
        return tuple(one for one in robot.sensors if one.kind is kind)

    kinds: list[_Kind] = []
    if sensors := having(SensorKind.IR):
        kinds.append(Infrared(models.ir, sensors, robot, caster, dt=dt, seed=seed))
    if sensors := having(SensorKind.SONAR):
        kinds.append(Sonar(models.sonar, sensors, robot, caster, dt=dt, seed=seed))
    if sensors := having(SensorKind.ACCELEROMETER):
        kinds.append(
            Accelerometer(models.accelerometer, sensors, robot, world.gravity, dt=dt, seed=seed)
        )
    if sensors := having(SensorKind.COMPASS):
        kinds.append(Compass(models.compass, sensors, robot, dt=dt, seed=seed))
    return kinds
