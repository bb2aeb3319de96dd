"""All sensors of the robot in its world.

The servos, polled in turn: each joint's sample has its own time.

Cycle k starts with control period k; joint i (from 0) is read at t_k + i slot_s. Angle and rate are
those of that instant. Torque, current and voltage ripple with the control period, since each new
command makes the motors start; sampled at an instant they would always show the same phase of the
ripple (in the shipped scenario ``flat`` electrical work would come out 44 % too large). So the
servos report their means over one control period around the instant, as an integrating sensor gives
them, and a cycle can be told when the second control period after its start has ended.

Between physics steps angles and rates are interpolated linearly and the integrals of what the
servos do likewise: exactly the integrator's own motion, since rate and torque are constant in a
step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.robot.model import Sensor, SensorKind

from ..gait.contract import CONTROL_RATE_HZ, Readings
from ..physics.steps import Steps
from ..scenario.scenario import Scenario
from ..scenario.sensors import Noise, ServoPolling
from .contract import JointSample, RangeSample, SensorSample, quantised
from .inertial import Accelerometer, Compass
from .ranging import Infrared, RayCaster, Sonar

STREAM = 1
"""Number of the random stream that the servos' noise is drawn from."""


_Sensors: TypeAlias = Infrared | Sonar | Accelerometer | Compass
"""All sensors of one kind."""


class _Period(NamedTuple):
    """What one control period of n steps holds.

    Attributes:
        motion: Angles and rates at the n + 1 instants, shape (n + 1, 2, m).
        drive: Voltage, current and torque during the n steps, shape (n, 3, m).
    """

    motion: FloatArray
    drive: FloatArray


class JointPolling:
    """Takes physics steps in, gives joint samples out."""

    def __init__(
        self,
        servos: ServoPolling,
        noise: Noise,
        joint_count: int,
        *,
        period_steps: int,
        dt: float,
        seed: int,
    ) -> None:
        """Start before the first control period.

        Args:
            joint_count: m.
            period_steps: Physics steps in a control period, an even number.
            dt: Physics step [s].
        """
        self._offset_s = frozen(servos.slot_s * np.arange(joint_count, dtype=np.float64))
        self._at_once = servos.slot_s == 0.0
        self._servos = servos
        self._noise = np.array([[noise.position], [noise.velocity], [noise.effort]])
        self._random = np.random.default_rng([seed, STREAM])
        self._count = period_steps
        self._dt = dt
        self._kept: deque[_Period] = deque(maxlen=3)
        self._first = 0  # number of the first control period in there
        self._next = 0  # the cycle to be told next
        self._told = np.full(joint_count, np.nan)

    def observe(self, steps: Steps) -> list[JointSample]:
        """Take in one control period.

        Args:
            steps: Its steps, both ends included.

        Returns:
            The cycle that started one control period before it, once there is one.
        """
        self._first += len(self._kept) == self._kept.maxlen
        self._kept.append(_Period(steps.motion, steps.drives[:-1]))
        return [self._sample()] if self._next < self._ended else []

    def flush(self) -> list[JointSample]:
        """End the run: return the remaining cycles, the last one at the end's instant.

        Joints whose turn comes after the end are sampled at the end, and their offsets say so.

        Returns:
            At most two cycles; none where no control period has passed.
        """
        samples: list[JointSample] = []
        while self._kept and self._next <= self._ended + 1:
            samples.append(self._sample())
        return samples

    @property
    def _ended(self) -> int:
        """Number of the newest control period."""
        return self._first + len(self._kept) - 1

    def _sample(self) -> JointSample:
        """The next cycle, from the control periods around it."""
        cycle, n = self._next, self._count
        self._next += 1
        start = n * (cycle - self._first)  # in steps from the first period kept
        end = n * len(self._kept)
        offset: FloatArray = np.minimum(self._offset_s / self._dt, float(end - start))
        at = start + offset
        motion = np.concatenate(
            [self._kept[0].motion[:1], *(period.motion[1:] for period in self._kept)]
        )
        drive = np.concatenate([period.drive for period in self._kept])
        if self._at_once:  # at a step, so nothing is to be interpolated
            position, velocity = motion[start]
            first, last = max(start - n // 2, 0), min(start + n // 2, end)
            voltage, current, effort = drive[first:last].sum(axis=0) / (last - first)
        else:
            position, velocity = _between(motion, at)
            summed = np.concatenate([np.zeros((1, *drive.shape[1:])), np.cumsum(drive, axis=0)])
            lower, upper = np.maximum(at - n / 2, 0.0), np.minimum(at + n / 2, end)
            voltage, current, effort = (_between(summed, upper) - _between(summed, lower)) / (
                upper - lower
            )
        reported = np.array([position, velocity, effort])
        reported += self._noise * self._random.standard_normal(reported.shape)
        return JointSample(
            cycle=cycle,
            offset_s=self._offset_s if end - start >= n else offset * self._dt,
            position=self._encoded(reported[0]),
            velocity=reported[1],
            effort=reported[2],
            current=current,
            voltage=voltage,
        )

    def _encoded(self, angle: FloatArray) -> FloatArray:
        """Return the encoders' angles, given their last ones."""
        if self._servos.dead_band > 0.0:
            still = np.abs(angle - self._told) <= self._servos.dead_band  # false at the start
            angle = np.where(still, self._told, angle)
        self._told = quantised(angle, self._servos.resolution)
        return self._told


def _between(series: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate linearly, each joint at a place of its own."""
    low: IntArray = at.astype(np.int64)
    high = np.minimum(low + 1, len(series) - 1)
    joint = np.arange(len(at))
    before, after = series[low, :, joint].T, series[high, :, joint].T
    return before + (at - low) * (after - before)


class Senses:
    """The sensors of a scenario.

    Attributes:
        readings: Newest readings of the robot's computer.
    """

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
        self.readings = Readings.nothing(scenario.robot)
        self._start = 0  # number of the next period's first step

    def observe(self, steps: Steps) -> list[SensorSample]:
        """Take in one control period."""
        start = self._start
        self._start += len(steps) - 1
        measured = [one for kind in self._kinds for one in kind.observe(steps, start)]
        measured.sort(key=lambda one: one.time_s)  # stable: in the order of kinds at one time
        return self._known([*measured, *self._polling.observe(steps)])

    def flush(self) -> list[SensorSample]:
        """End the run."""
        return self._known([*self._polling.flush()])

    def _known(self, samples: list[SensorSample]) -> list[SensorSample]:
        """Take samples into the readings; returns them."""
        if not samples:
            return samples
        old = self.readings
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
        self.readings = Readings(angle, velocity, ranges, acceleration, field)
        return samples


def _kinds(scenario: Scenario) -> list[_Sensors]:
    """The sensors that the robot has, by kind."""
    robot, world, models = scenario.robot, scenario.world, scenario.sensing
    dt, seed = 1.0 / scenario.physics_rate_hz, scenario.seed
    caster = RayCaster(world.obstacles, ground=world.ground is not None)

    build: dict[SensorKind, Callable[[list[Sensor]], _Sensors]] = {
        SensorKind.IR: lambda own: Infrared(models.ir, own, robot, caster, dt=dt, seed=seed),
        SensorKind.SONAR: lambda own: Sonar(models.sonar, own, robot, caster, dt=dt, seed=seed),
        SensorKind.ACCELEROMETER: lambda own: Accelerometer(
            models.accelerometer, own, robot, world.gravity, dt=dt, seed=seed
        ),
        SensorKind.COMPASS: lambda own: Compass(models.compass, own, robot, dt=dt, seed=seed),
    }
    sensors = {kind: [one for one in robot.sensors if one.kind is kind] for kind in build}
    return [build[kind](own) for kind, own in sensors.items() if own]
