"""A gait under a controller: its heading policy, and the wave changed by the sensor readings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane, Robot, SensorKind

from ..gait.contract import WALK, Gait, GaitTick, Generator, Modulation, Readings
from ..scenario.motion import Controller, RandomTurns, TargetHeading, generator
from ..scenario.sensors import layout
from .filters import DeadReckoning, LowPass, PassedWave, turned
from .reactions import (
    AmplitudeReduction,
    ControlInput,
    Distances,
    ObstacleMonitor,
    Steering,
    TailSpeedUp,
)

if TYPE_CHECKING:
    from ..scenario.scenario import Scenario

RANDOM_STREAM = 300
"""Of the scenario's seed; random turns draw from it and nothing else does."""

AVOID, HASTEN, SHRINK, TURN = "avoid", "hasten", "shrink", "turn"
_MODE_HOLD_S = 0.5
_TURNING = 0.05  # offsets of the head above this are turns [rad]


class StraightOn:
    """No course: on as the body lies."""

    names: tuple[str, ...] = ()
    values: FloatArray = np.zeros(0)

    def step(self, now: ControlInput) -> float:  # noqa: ARG002 - straight whatever is known
        """Go straight on."""
        return 0.0


class RandomHeadingPolicy:
    """A random walk: bends drawn at random, each kept for a random time."""

    names = ("course.offset",)

    def __init__(self, parameters: RandomTurns, seed: int) -> None:
        """Start; the first bend is drawn at the first step."""
        self._parameters = parameters
        self._random = np.random.default_rng([seed, RANDOM_STREAM])
        self._until_s = -math.inf
        self.values: FloatArray = np.zeros(1)

    def step(self, now: ControlInput) -> float:
        """Go on, or draw anew."""
        if now.time_s >= self._until_s:
            law = self._parameters
            self.values = self._random.uniform(-law.largest, law.largest, 1)
            self._until_s = now.time_s + float(self._random.uniform(law.shortest_s, law.longest_s))
        return float(self.values[0])


class TargetHeadingPolicy:
    """Towards a target at a known position, by compass and dead reckoning.

    The target's position is given from the start; the robot's own comes from compass and encoders,
    and no sensor measures the target. The compass swings with the head and is late; so it only
    corrects, slowly, the heading from the encoders, and the heading of the path is that one.
    """

    # Heading and bearing of the target from magnetic north [rad], and the robot's position [m].
    names = ("course.heading", "course.bearing", "course.x", "course.y")

    def __init__(
        self,
        parameters: TargetHeading,
        target: tuple[float, float],
        target_radius_m: float,
        turn_radius_m: float,
        robot: Robot,
    ) -> None:
        """Start where the head is.

        Args:
            target: From the head's start, along magnetic north and to the left of it [m].
            target_radius_m: How near it must come [m].
            turn_radius_m: Of the turn with the largest offset [m].
            robot: The robot; its first compass is read, which sits on the head.
        """
        self._law = parameters
        self._target = np.array(target)
        self._target_radius_m, self._turn_radius_m = target_radius_m, turn_radius_m
        self._compass = next(s for s in robot.sensors if s.kind is SensorKind.COMPASS)
        self._north: LowPass[FloatArray] | None = None
        self._before = np.zeros(2)
        self._place = np.zeros(2)
        self.values: FloatArray = np.full(len(self.names), math.nan)

    def step(self, now: ControlInput) -> float:
        """Steer to where the target must be."""
        start = self._start_from_north(now)
        moved, self._before = now.pose.place - self._before, now.pose.place
        if math.isnan(start):
            return 0.0
        self._place = self._place + turned(moved, start)
        way = self._target - self._place
        heading, bearing = start + now.pose.way, math.atan2(way[1], way[0])
        self.values = np.array([heading, bearing, *self._place])
        error = math.remainder(bearing - heading, math.tau)
        if self._inside_turn(math.hypot(*way), abs(error)):
            return 0.0  # no turn leads there: first away from it
        return -min(max(self._law.gain * error, -self._law.largest), self._law.largest)

    def _inside_turn(self, distance: float, error: float) -> bool:
        """Whether the target lies so far inside the tightest turn that the turn misses it."""
        radius = self._turn_radius_m
        ahead, aside = distance * math.cos(error), distance * math.sin(error)
        return math.hypot(ahead, aside - radius) < radius - self._target_radius_m

    def _start_from_north(self, now: ControlInput) -> float:
        """The head's heading at the start from magnetic north, to the left [rad]; NaN at first."""
        field = now.readings.magnetic_field.get(self._compass.name)
        if field is None:
            return math.nan
        heading = math.atan2(-field[1], field[0]) - self._compass.rpy[2]
        start = heading - now.pose.heading
        measured = np.array([math.cos(start), math.sin(start)])
        if self._north is None:
            self._north = LowPass(self._law.filter_s, measured)
        x, y = self._north.step(now.elapsed_s, measured)
        return math.atan2(y, x)


HeadingPolicy: TypeAlias = StraightOn | RandomHeadingPolicy | TargetHeadingPolicy
"""Sets the offset of the head when nothing is in the way, and logs values by name."""


class AdaptiveGait:
    """Wraps a generator; steers, shrinks and hastens it once a tick, before it goes on.

    Modes, the first that applies: ``avoid`` an obstacle ahead, ``hasten`` since one is near the
    tail, ``shrink`` beside a wall, ``turn`` to the course, ``walk``. A mode lasts 0.5 s at least,
    so that the log's changes of mode are few.
    """

    def __init__(
        self, generator: Generator, controller: Controller, course: HeadingPolicy, robot: Robot
    ) -> None:
        """Wrap a generator that has not been stepped yet.

        Args:
            generator: Makes the wave; it must drive the horizontal plane.
            controller: Parameters of the reactions.
        """
        roles = layout(robot)
        self._generator, self._robot, self._course = generator, robot, course
        self._distances = Distances(roles.fold_m, controller.near_hold_s)
        self._reckoning = DeadReckoning(controller.calibration, robot)
        self._lookout = ObstacleMonitor(controller.lookout, roles, robot)
        self._steering = Steering(controller.head)
        self._shrinking = (
            AmplitudeReduction(controller.side, roles, robot) if controller.side else None
        )
        self._haste = TailSpeedUp(controller.tail, roles) if controller.tail else None
        parts = (self._steering, self._shrinking, self._haste, course)
        self._parts = [part for part in parts if part is not None]
        names = (name for part in self._parts for name in part.names)
        self.names: tuple[str, ...] = (*generator.names, *names)
        self._horizontal = robot.joint_indices(Plane.HORIZONTAL)
        self._phase_at = generator.names.index(f"{Plane.HORIZONTAL}.phase")
        self._lag_at = generator.names.index(f"{Plane.HORIZONTAL}.lag")
        self._wave: PassedWave | None = None
        self._phase = self._time_s = 0.0
        self._mode = WALK
        self._mode_since_s = 0.0

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Change the generator by the readings, and step it."""
        if self._wave is None:  # the first tick tells phase and lag; from the next on it reacts
            tick = self._generator.step(time_s, readings)
            self._wave = PassedWave(len(self._horizontal), float(tick.values[self._lag_at]))
            return self._reported_tick(tick, time_s)
        elapsed_s, phase = time_s - self._time_s, self._phase
        pose = self._reckoning.step(elapsed_s, phase, self._steering.offset, readings)
        now = ControlInput(time_s, elapsed_s, phase, pose, readings)
        self._distances.step(time_s, readings.ranges)
        head = self._steering.step(now, self._lookout.step(now), self._course.step(now))
        unchanged = Modulation.none(len(self._robot.joints))
        offset = unchanged.offset.copy()
        offset[self._horizontal] = self._wave.step(now.phase, head)
        change = Modulation(
            amplitude_factor=self._shrinking.step(now, self._distances)
            if self._shrinking is not None
            else unchanged.amplitude_factor,
            offset=offset,
            frequency_factor=self._haste.step(now, self._distances)
            if self._haste is not None
            else unchanged.frequency_factor,
        )
        self._generator.modulate(change)
        return self._reported_tick(self._generator.step(time_s, readings), time_s)

    def _reported_tick(self, tick: GaitTick, time_s: float) -> GaitTick:
        """The generator's tick, with what the controller meant."""
        self._phase, self._time_s = float(tick.values[self._phase_at]), time_s
        values = np.concatenate((tick.values, *(part.values for part in self._parts)))
        return GaitTick(tick.command, values, self._choose_mode(time_s), tick.clamped)

    def _choose_mode(self, time_s: float) -> str:
        """One word for the tick, at least for a while."""
        mode = WALK
        if self._steering.avoiding:
            mode = AVOID
        elif self._haste is not None and self._haste.hastening:
            mode = HASTEN
        elif self._shrinking is not None and self._shrinking.shrinking:
            mode = SHRINK
        elif abs(self._steering.offset) > _TURNING:
            mode = TURN
        if mode != self._mode and time_s - self._mode_since_s >= _MODE_HOLD_S:
            self._mode, self._mode_since_s = mode, time_s
        return self._mode


def build_gait(scenario: Scenario) -> Gait:
    """Return the gait of a scenario, for the twin or a bus.

    Args:
        scenario: Gait, controller and robot; of its world only the target's position, and of its
            sensors the direction of north.

    Returns:
        The gait, at time zero.
    """
    robot, controller = scenario.robot, scenario.controller
    if controller is None:
        return generator(scenario.gait, robot)
    # A controller bends and shrinks joint by joint, and the log is to hold what each was given.
    wave = generator(scenario.gait, robot, per_joint=True)
    return AdaptiveGait(wave, controller, _course(scenario), robot)


def _course(scenario: Scenario) -> HeadingPolicy:
    controller, target = scenario.controller, scenario.world.target
    course = controller.course if controller is not None else None
    if isinstance(course, RandomTurns):
        return RandomHeadingPolicy(course, scenario.seed)
    if controller is not None and isinstance(course, TargetHeading) and target is not None:
        x, y = turned(np.array(target.position), -scenario.sensing.compass.north).tolist()
        radius_m = controller.calibration.turn_radius_m
        return TargetHeadingPolicy(course, (x, y), target.radius, radius_m, scenario.robot)
    return StraightOn()
