"""The force laws of ground and servos, applied to one row of a table of steps after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..gait.contract import CONTROL_RATE_HZ
from ..scenario.scenario import Kernels, Scenario
from ..scenario.world import Ground, pushes_during
from .contact import GroundContact
from .engine import BodyStart, engine_type
from .obstacle_contact import obstacle_law
from .servo import Servos
from .steps import Step, Steps


class Laws(Protocol):
    """What fills in a step once its body is there."""

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there."""

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it.

        Args:
            k: Its row, not the first.
        """

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            k: Row of the step at which it comes.
            reference: Joint angles q_ref [rad], shape (m,).
        """


class NumpyLaws:
    """The laws by :mod:`.sim.physics.contact` and :mod:`.sim.physics.servo`."""

    def __init__(
        self, steps: Steps, robot: Robot, ground: Ground | None, servos: Servos, dt: float
    ) -> None:
        """Get ready for one body.

        Args:
            steps: The table that is filled in.
            ground: What carries it, if anything does.
            dt: Step [s].
        """
        radius = np.array([link.radius for link in robot.links])
        self._rows = tuple(steps)
        self._ground = tuple(
            GroundContact(ground, radius, row.body, row.contact) for row in self._rows
        )
        self._servos, self._dt = servos, dt
        self._reference = np.zeros(steps.joint_count)

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there."""
        self._ground[k].act()
        self.command(k, self._reference)

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it."""
        before = self._rows[k - 1]
        self._servos.advance(before.rotors, before.drive, self._dt, self._rows[k].rotors)
        self.start(k)

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next."""
        self._reference = reference
        row = self._rows[k]
        self._servos.drive(reference, row.body.angle, row.body.rate, row.rotors, row.drive)


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
            from .compiled_kernels import CompiledLaws

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

    def advance(self) -> Steps:
        """Go through one control period.

        Returns:
            Its steps from its start to its end, both included, in a table of their own; all of
            them, even where the state became impossible on the way.
        """
        first = self._periods * (len(self._rows) - 1)
        times_s = self.dt * np.arange(first, first + len(self._rows), dtype=np.float64)
        self._period.pushes = pushes_during(self._disturbances, self._link_names, times_s)
        self._periods += 1
        with np.errstate(all="ignore"):  # whoever looks at the steps finds what overflows
            for k in range(1, len(self._rows)):
                self._push(k - 1)
                self._engine.step(self._rows[k - 1].drive.torque)
                self._look(k)
                self._laws.follow(k)
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
        if self._obstacle_law is not None:
            self._period.obstacles[k] = self._obstacle_law(*body[:4])


def resting_height(scenario: Scenario) -> float:
    """Height at which the ground carries a straight robot's weight: m g / k deep [m]."""
    robot, world = scenario.robot, scenario.world
    radius = float(np.mean([link.radius for link in robot.links]))
    if world.ground is None:
        return radius
    mass = robot.total_mass / len(robot.links)
    return radius + mass * min(world.gravity[2], 0.0) / world.ground.stiffness
