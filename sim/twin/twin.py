"""The twin: a robot in its world, its sensors and its gait.

Physics runs at the scenario's rate (1 kHz by default), control and samples at 100 Hz. Within a
control period the commands are held, as a servo bus holds them. A period is simulated to its end,
then the sensors look at all of it, then the gait is asked with what they have told by then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Self

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError
from undulog.capture.robot.model import Joint, Link, Robot

from ..gait.contract import CONTROL_RATE_HZ, Gait, GaitTick
from ..physics.engine import BodyStart, engine_type
from ..physics.ledger import Ledger
from ..physics.obstacle_contact import obstacle_law
from ..physics.sensing import SensorSample, quantised
from ..physics.sensors import Senses
from ..physics.servo import Servos
from ..physics.steps import Laws, NumpyLaws, Step, Steps
from ..scenario.scenario import Kernels, Scenario
from ..scenario.world import Ground, pushes_during
from .adaptive import build_gait
from .stability import likely_cause

MAX_SPEED = 10.0
"""No link of an undulating robot is faster than this [m/s]: beyond it the simulation has failed."""

_MARGIN = 1.5
"""Speeds are limited by component: in plan view, a link may be sqrt(2) times as fast."""

MAX_ROTOR_SPEED = 1000.0
"""No servo turns faster than this, referred to its joint [rad/s]."""


class Plant:
    """A robot on its ground; :meth:`close` it after use.

    Attributes:
        dt: Physics step [s].
    """

    def __init__(self, scenario: Scenario, kernels: Kernels = Kernels.NUMPY) -> None:
        """Set the robot on the ground, straight, its servos at rest, in vertical balance.

        Args:
            scenario: The robot, its world, the engine and the physics rate.
            kernels: What computes the force laws.

        Raises:
            UsageError: If the engine cannot hold the robot.
            ImportError: If the engine or the kernels are not installed.
        """
        robot, world = scenario.robot, scenario.world
        self.servos = Servos([joint.servo for joint in robot.joints])
        self.dt = 1.0 / scenario.physics_rate_hz
        radius = np.array([link.radius for link in robot.links])
        length = np.array([link.length for link in robot.links])
        self._below = np.zeros((3, len(radius)))
        self._below[2] = -radius
        self._obstacle_law = (
            obstacle_law(
                *(world.obstacles, world.obstacle_contact, radius, length),
                mass=np.array([link.mass for link in robot.links]),
                inertia=np.array([min(link.inertia) for link in robot.links]),
                dt=self.dt,
            )
            if world.obstacles
            else None
        )
        self._near = self._obstacle_law  # those in reach of the present period
        height = resting_height(scenario)
        start = BodyStart(world.gravity, height, world.heading, world.velocity, self.dt)
        self._engine = engine_type(scenario.engine, kernels)(robot, start)
        count = scenario.physics_rate_hz // CONTROL_RATE_HZ
        self._period = Steps.empty(count + 1, len(robot.links), len(robot.joints))
        self._rows = tuple(self._period)
        self._disturbances = scenario.disturbances
        self._link_names = [link.name for link in robot.links]
        self._periods = 0  # gone through
        laws: Callable[[Steps, Robot, Ground | None, Servos, float], Laws] = NumpyLaws
        if kernels is Kernels.NUMBA:
            from ..physics.compiled_kernels import CompiledLaws

            laws = CompiledLaws
        self._laws = laws(self._period, robot, world.ground, self.servos, self.dt)
        self._look(0)
        self._laws.start(0)

    def close(self) -> None:
        """Free the physics world."""
        self._engine.close()

    @property
    def now(self) -> Step:
        """The present instant, in arrays of its own."""
        return self._period.taken(0)

    def command(self, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            reference: Joint angles q_ref [rad], shape (m,).
        """
        self._laws.command(0, reference)

    def advance(self, references: FloatArray | None = None) -> Steps:
        """Go through one control period.

        Args:
            references: Joint angles q_ref during each of its steps [rad], shape (k, m), the first
                row as :meth:`command` gave it; None: that command is held.

        Returns:
            Its steps from its start to its end, both included, in a table of their own; all of
            them, even where the state became impossible on the way.
        """
        first = self._periods * (len(self._rows) - 1)
        times_s = self.dt * np.arange(first, first + len(self._rows), dtype=np.float64)
        self._period.pushes = pushes_during(self._disturbances, self._link_names, times_s)
        if self._obstacle_law is not None:  # a faster link ends the run
            way = MAX_SPEED * (times_s[-1] - times_s[0]) * _MARGIN
            self._near = self._obstacle_law.reachable(self._rows[0].body.position, way)
        self._periods += 1
        changes = () if references is None else _changes(references)
        with np.errstate(all="ignore"):  # whoever looks at the steps finds what overflows
            for k in range(1, len(self._rows)):
                self._push(k - 1)
                self._engine.step(self._rows[k - 1].drive.torque)
                self._look(k)
                self._laws.follow(k)
                if references is not None and k in changes:
                    self._laws.command(k, references[k])
        steps = self._period.copy()
        self._period.table[0] = self._period.table[-1]
        self._period.obstacles[0] = self._period.obstacles[-1]
        return steps

    def _push(self, k: int) -> None:
        """Let ground, obstacles and disturbances act on the links."""
        step = self._rows[k]
        self._engine.push(step.contact.force, step.body.position + self._below)
        if self._obstacle_law is not None:
            for force, point in self._period.obstacles[k].layers(self._period.link_count):
                self._engine.push(force, point)
        if self._period.pushes is not None:
            self._engine.push(self._period.pushes[k], step.body.position)

    def _look(self, k: int) -> None:
        """Fill in the body, and what obstacles do to it."""
        body = self._engine.read(self._rows[k].body)
        if self._near is not None:
            self._period.obstacles[k] = self._near(*body[:4])


def _changes(references: FloatArray) -> frozenset[int]:
    """Rows that differ from the row before them."""
    changed = (references[1:] != references[:-1]).any(axis=1)
    return frozenset((np.flatnonzero(changed) + 1).tolist())


def resting_height(scenario: Scenario) -> float:
    """Height at which the ground carries a straight robot's weight: m g / k deep [m]."""
    robot, world = scenario.robot, scenario.world
    radius = float(np.mean([link.radius for link in robot.links]))
    if world.ground is None:
        return radius
    mass = robot.total_mass / len(robot.links)
    return radius + mass * min(world.gravity[2], 0.0) / world.ground.stiffness


class Sample(NamedTuple):
    """The twin at one control tick.

    Attributes:
        tick: Number of the control period, from 0.
        gait: What the gait commands from here on.
        step: Body, ground, rotors and servos at this instant.
        sensed: The sensors' samples that have arrived since the tick before; the newest ones
            arrive after the run, by :meth:`Twin.flush`.
        energy: The ledger up to here [J], as :data:`.sim.physics.ledger.TERMS`, shape (23,).
        contact_s: For how long each link has touched an obstacle so far [s], shape (n,).
        joint_energy: The part of each joint in it [J], rows as
            :data:`.sim.physics.ledger.JOINT_TERMS`, shape (9, m).
    """

    tick: int
    gait: GaitTick
    step: Step
    sensed: list[SensorSample]
    energy: FloatArray
    contact_s: FloatArray
    joint_energy: FloatArray

    @property
    def time_s(self) -> float:
        """Time since the start [s]."""
        return self.tick / CONTROL_RATE_HZ


class Twin:
    """One robot in its world; use it in a ``with`` block, and run it with :meth:`samples`.

    Example::

        with undulog.Twin(undulog.load_scenario("flat").changed(duration_s=0.1)) as twin:
            times_s = [sample.time_s for sample in twin.samples()]

    Attributes:
        kernels: What computes the force laws.
        sensed: Sensor samples that arrive by the present tick, there before the gait is asked: a
            gait that speaks over a bus hands them out first.
    """

    def __init__(
        self, scenario: Scenario, gait: Gait | None = None, *, kernels: Kernels = Kernels.NUMPY
    ) -> None:
        """Set the robot on the ground, straight, its servos at rest, in vertical balance.

        Args:
            gait: Who commands the joints; the scenario's own gait if None.
            kernels: What computes the force laws.

        Raises:
            UsageError: If the engine cannot hold the robot.
            ImportError: If the engine or the kernels are not installed.
        """
        self.scenario = scenario
        self.kernels = kernels
        self.gait: Gait = gait or build_gait(scenario)
        self.sensed: list[SensorSample] = []
        self._sensing = Senses(scenario)
        self._plant = Plant(scenario, kernels)
        self._ledger = Ledger(scenario, self._plant.servos, self._plant.now, kernels)

    def __enter__(self) -> Self:
        """Enter the block that owns the physics world."""
        return self

    def __exit__(self, *_: object) -> None:
        """Free the physics world."""
        self.close()

    def close(self) -> None:
        """Free the physics world; the twin can't be run any more."""
        self._plant.close()

    def samples(self) -> Iterator[Sample]:
        """Run the scenario, once.

        Yields:
            A sample at the start of every control period, and one at the end of the last.

        Raises:
            SimulationError: If the state becomes impossible.
        """
        resolution = self.scenario.sensing.servo.command_resolution
        for tick in range(self.scenario.tick_count):
            time_s = tick / CONTROL_RATE_HZ
            if tick:
                steps = self._plant.advance()
                check_state(steps, self.scenario, time_s - 1 / CONTROL_RATE_HZ)
                self._ledger.book(steps)
                self.sensed = self._sensing.observe(steps)
            gait = self.gait.step(time_s, self._sensing.readings)
            gait = gait._replace(command=quantised(gait.command, resolution))
            self._plant.command(gait.command)
            step = self._plant.now
            ledger = self._ledger
            booked = ledger.read(step), ledger.contact_s, ledger.joints
            yield Sample(tick, gait, step, self.sensed, *booked)

    def flush(self) -> list[SensorSample]:
        """End the run, wherever it stands: sensor samples that have not arrived yet.

        Returns:
            These samples, in the order of their arrival.
        """
        return self._sensing.flush()


def check_state(steps: Steps, scenario: Scenario, start_s: float) -> None:
    """Refuse an impossible state.

    Args:
        steps: Of a control period.
        start_s: Its start [s].

    Raises:
        SimulationError: If a link or a servo is too fast; names the first.
    """
    motion, rotors = np.abs(steps.links[:, 7:10]), np.abs(steps.motors[:, 1])
    if motion.max() <= MAX_SPEED and rotors.max() <= MAX_ROTOR_SPEED:  # false for NaN
        return
    speed = motion.max(axis=1)
    sound = rotors <= MAX_ROTOR_SPEED  # false for NaN
    k = int(np.argmin(sound.all(axis=1) & (speed <= MAX_SPEED).all(axis=1)))
    time_s, robot = start_s + k / scenario.physics_rate_hz, scenario.robot
    if not sound[k].all():  # a servo that runs away throws links, hardly the other way round
        joint = int(np.argmax(rotors[k]))  # NaN before all numbers
        raise failure(scenario, time_s, robot.joints[joint], rotors[k, joint])
    link = int(np.argmax(speed[k]))
    raise failure(scenario, time_s, robot.links[link], speed[k, link])


def failure(scenario: Scenario, time_s: float, part: Joint | Link, speed: float) -> SimulationError:
    """Describe an impossible state.

    Args:
        time_s: When it was reached [s].
        part: The joint whose servo, or the link that is too fast.
        speed: Of the servo [rad/s] or the link [m/s].
    """
    if isinstance(part, Joint):
        what = f"the servo of {part.name} turns at {speed:g} rad/s"
        bound = f"{MAX_ROTOR_SPEED:g} rad/s"
    else:
        what, bound = f"{part.name} moves at {speed:g} m/s", f"{MAX_SPEED:g} m/s"
    return SimulationError(
        f"the twin failed at {time_s:.3f} s: {what}, more than {bound}; {likely_cause(scenario)}"
    )
