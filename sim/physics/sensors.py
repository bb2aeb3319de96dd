"""All sensors of the robot in its world: servos polled in turn, accelerometers, compasses.

At rest that is gravity's opposite: +9.81 m/s^2 upwards. A sample is the mean over one sampling
period and carries the time of that period's middle. The velocity is the mount point's, so spin and
lever arm are in it; within a physics step the force is turned into the sensor's frame as the mean
of the frames at its ends has it.

Magnetometers as compasses: the earth's field in their own frame.

Magnetic north is the world's +x, unless the model turns it; the field dips into the ground by the
inclination, 65 degrees in central Europe. A level compass of two axes gives its heading by
atan2(-B_y, B_x), counter-clockwise from north; tilted, it mixes the vertical field in: pointing
north, each degree of roll turns the heading by tan(inclination) degrees, 2.1.

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

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.robot.model import Robot, Sensor, SensorKind

from ..gait.contract import CONTROL_RATE_HZ, Readings
from ..scenario.scenario import Scenario
from ..scenario.sensors import AccelerometerModel, CompassModel, Noise, ServoPolling
from .contact import cross, into_frames, out_of_frames
from .ranging import Infrared, RayCaster, Sonar
from .sensing import (
    JointSample,
    Mounts,
    RangeSample,
    Schedule,
    SensorSample,
    VectorSample,
    quantised,
)
from .steps import Steps

ACCELEROMETER_STREAM = 5
"""Number of the random stream that the sensors' noise is drawn from."""

COMPASS_STREAM = 6
"""Number of the random stream that the sensors' noise is drawn from."""

STREAM = 1
"""Number of the random stream that the servos' noise is drawn from."""


class Accelerometer:
    """A robot's accelerometers, mostly one."""

    def __init__(
        self,
        model: AccelerometerModel,
        sensors: Sequence[Sensor],
        robot: Robot,
        gravity: Sequence[float],
        *,
        dt: float,
        seed: int,
    ) -> None:
        """Start before the first control period.

        Args:
            gravity: Acceleration of gravity in the world [m/s^2], length 3.
            dt: Physics step [s].
        """
        self._names = [sensor.name for sensor in sensors]
        self._mounts = Mounts(sensors, robot)
        self._gravity = np.array(gravity)
        self._model = model
        self._axes = measured(sensors)
        self._dt = dt
        self._count = max(1, round(1.0 / (model.rate_hz * dt)))
        self._summed = np.zeros((len(sensors), 3))
        self._steps = 0  # in the sum
        self._random = np.random.default_rng([seed, ACCELEROMETER_STREAM])

    def observe(self, steps: Steps, start: int) -> list[VectorSample]:
        """Measure during one control period.

        Args:
            steps: Its physics steps, both ends included.
            start: Number of the first one since the start of the run.

        Returns:
            The samples whose sampling periods end with it or in it, in order of time.
        """
        samples: list[VectorSample] = []
        force = self._specific_force(steps)
        done = 0
        while done < len(force):
            taken = force[done : done + self._count - self._steps]
            self._summed += taken.sum(axis=0)
            self._steps += len(taken)
            done += len(taken)
            if self._steps == self._count:
                time_s = (start + done - self._count / 2) * self._dt
                samples += self._measured(self._summed / self._count, time_s)
                self._summed[:] = 0.0
                self._steps = 0
        return samples

    def _specific_force(self, steps: Steps) -> FloatArray:
        """Mean specific force of each step in the carrying links' frames, shape (t, k, 3)."""
        body, count = steps.stacked.body, len(steps) - 1
        means: list[FloatArray] = []
        for link, mount in zip(self._mounts.link, self._mounts.position, strict=True):
            quaternion = body.quaternion[:, :, link].T  # (4, t + 1)
            velocity = body.velocity[:, :, link].T
            if mount.any():
                arm = out_of_frames(quaternion, np.tile(mount[:, None], count + 1))
                velocity = velocity + cross(body.spin[:, :, link].T, arm)
            force = (velocity[:, 1:] - velocity[:, :-1]) / self._dt - self._gravity[:, None]
            at_ends = into_frames(
                np.concatenate([quaternion[:, :-1], quaternion[:, 1:]], axis=1),
                np.concatenate([force, force], axis=1),
            )
            means.append(0.5 * (at_ends[:, :count] + at_ends[:, count:]).T)
        return np.stack(means, axis=1)

    def _measured(self, force: FloatArray, time_s: float) -> list[VectorSample]:
        force = (force[:, None] @ self._mounts.rotation)[:, 0]  # into the sensors' frames
        force += self._model.noise * self._random.standard_normal(force.shape)
        measured = self._axes * quantised(force, self._model.resolution)
        return [
            VectorSample(name, time_s, vector)
            for name, vector in zip(self._names, measured, strict=True)
        ]


def measured(sensors: Sequence[Sensor]) -> FloatArray:
    """Which axes sensors measure, as factors.

    Returns:
        1 for an axis that a sensor measures and NaN for another, shape (k, 3).
    """
    return np.array(
        [[1.0 if axis in sensor.axes else np.nan for axis in "xyz"] for sensor in sensors]
    )


def earth_field(model: CompassModel) -> FloatArray:
    """The earth's field in the world.

    Args:
        model: Strength, inclination and direction of north.

    Returns:
        [T], shape (3,).
    """
    level = model.horizontal_field
    return level * np.array(
        [math.cos(model.north), math.sin(model.north), -math.tan(model.inclination)]
    )


class Compass:
    """A robot's compasses, mostly one."""

    def __init__(
        self, model: CompassModel, sensors: Sequence[Sensor], robot: Robot, *, dt: float, seed: int
    ) -> None:
        """Start before the first control period.

        Args:
            dt: Physics step [s].
        """
        self._names = [sensor.name for sensor in sensors]
        self._mounts = Mounts(sensors, robot)
        self._schedule = Schedule(1.0 / model.rate_hz, len(sensors), dt)
        self._model = model
        self._field = earth_field(model)
        self._axes = measured(sensors)
        self._dt = dt
        self._random = np.random.default_rng([seed, COMPASS_STREAM])

    def observe(self, steps: Steps, start: int) -> list[VectorSample]:
        """Measure what is due in one control period.

        Args:
            steps: Its physics steps, both ends included; the last instant is the next period's.
            start: Number of the first one since the start of the run.

        Returns:
            The samples, in order of time.
        """
        step, which = self._schedule.due(start + len(steps) - 1)
        if not len(step):
            return []
        _, quaternion = self._mounts.poses(steps.stacked.body, step - start, which)
        level = into_frames(quaternion, np.tile(self._field[:, None], len(which)))  # the link's
        field = (level.T[:, None] @ self._mounts.rotation[which])[:, 0]  # R^T B
        field += self._model.noise * self._random.standard_normal(field.shape)
        measured = self._axes[which] * quantised(field, self._model.resolution)
        return [
            VectorSample(self._names[i], float(k * self._dt), vector)
            for k, i, vector in zip(step.tolist(), which.tolist(), measured, strict=True)
        ]


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
        self._count, self._dt = period_steps, dt
        self._kept: deque[_Period] = deque(maxlen=3)
        self._first = 0  # number of the first control period in there
        self._next = 0  # the cycle to be told next
        self._reported = np.full(joint_count, np.nan)

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
            still = np.abs(angle - self._reported) <= self._servos.dead_band  # false at the start
            angle = np.where(still, self._reported, angle)
        self._reported = quantised(angle, self._servos.resolution)
        return self._reported


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
            sensor.name
            for sensor in scenario.robot.sensors
            if sensor.kind is SensorKind.ACCELEROMETER
        )
        self.readings = Readings.nothing(scenario.robot)
        self._start = 0  # number of the next period's first step

    def observe(self, steps: Steps) -> list[SensorSample]:
        """Take in one control period."""
        start = self._start
        self._start += len(steps) - 1
        measured = [sample for kind in self._kinds for sample in kind.observe(steps, start)]
        measured.sort(key=lambda sample: sample.time_s)  # stable: in the order of kinds at one time
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
        SensorKind.IR: lambda sensors: Infrared(
            models.ir, sensors, robot, caster, dt=dt, seed=seed
        ),
        SensorKind.SONAR: lambda sensors: Sonar(
            models.sonar, sensors, robot, caster, dt=dt, seed=seed
        ),
        SensorKind.ACCELEROMETER: lambda sensors: Accelerometer(
            models.accelerometer, sensors, robot, world.gravity, dt=dt, seed=seed
        ),
        SensorKind.COMPASS: lambda sensors: Compass(
            models.compass, sensors, robot, dt=dt, seed=seed
        ),
    }
    sensors = {kind: [sensor for sensor in robot.sensors if sensor.kind is kind] for kind in build}
    return [build[kind](sensor) for kind, sensor in sensors.items() if sensor]
