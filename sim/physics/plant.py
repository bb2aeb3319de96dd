"""Body, ground, obstacles and servos, stepped together while the commands are held."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..scenario.engines import Kernels
from ..scenario.scenario import CONTROL_RATE_HZ, Scenario
from ..scenario.world import pushes_during
from .engine import engine_type
from .laws import laws_for
from .obstacle_contact import obstacle_law
from .servo import Servos
from .steps import Step, Steps


class Plant:
    """A robot on its ground; :meth:`close` it after use.

    Attributes:
        servos: Its servos.
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
        self._engine = engine_type(scenario.engine, kernels)(
            robot,
            gravity=world.gravity,
            height=_resting_height(scenario),
            heading=world.heading,
            velocity=world.velocity,
            dt=self.dt,
        )
        count = scenario.physics_rate_hz // CONTROL_RATE_HZ
        self._period = Steps.empty(count + 1, len(robot.links), len(robot.joints))
        self._rows = tuple(self._period)
        self._disturbances = scenario.disturbances
        self._link_names = [link.name for link in robot.links]
        self._periods = 0  # gone through
        self._laws = laws_for(
            self._period, robot, world.ground, self.servos, dt=self.dt, kernels=kernels
        )
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


def _resting_height(scenario: Scenario) -> float:
    """Height at which the ground carries a straight robot's weight: m g / k deep [m]."""
    robot, world = scenario.robot, scenario.world
    radius = float(np.mean([link.radius for link in robot.links]))
    if world.ground is None:
        return radius
    mass = robot.total_mass / len(robot.links)
    return radius + mass * min(world.gravity[2], 0.0) / world.ground.stiffness
