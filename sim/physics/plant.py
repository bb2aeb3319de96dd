"""Body, ground and servos, stepped together while the commands are held."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from capture.arrays import FloatArray

from ..scenario import CONTROL_RATE_HZ, Scenario
from .contact import contact_law
from .engine import engine_type
from .servo import Servos
from .steps import Step, Steps


class Plant:
    """A robot on its ground; :meth:`close` it after use.

    Attributes:
        servos: Its servos.
        dt: Physics step [s].
    """

    def __init__(self, scenario: Scenario) -> None:
        """Set the robot on the ground, straight, its servos at rest, in vertical balance.

        Args:
            scenario: The robot, its world, the engine and the physics rate.

        Raises:
            UsageError: If the engine cannot hold the robot.
        """
        robot, world = scenario.robot, scenario.world
        self.servos = Servos([joint.servo for joint in robot.joints])
        self.dt = 1.0 / scenario.physics_rate_hz
        radius = np.array([link.radius for link in robot.links])
        self._below = np.zeros((3, len(radius)))
        self._below[2] = -radius
        self._ground_law = contact_law(world.ground, radius)
        self._engine = engine_type(scenario.engine)(
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
        self._reference = np.zeros(len(robot.joints))
        self._look(self._rows[0])

    def close(self) -> None:
        """Free the physics world."""
        self._engine.close()

    @property
    def now(self) -> Step:
        """The present instant, in arrays of its own."""
        return self._period[:1].copy()[0]

    def command(self, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            reference: Joint angles q_ref [rad], shape (m,).
        """
        self._reference = reference
        self._drive(self._rows[0])

    def advance(self) -> Steps:
        """Go through one control period.

        Returns:
            Its steps from its start to its end, both included, in a table of their own; all of
            them, even where the state became impossible on the way.
        """
        with np.errstate(all="ignore"):  # whoever looks at the steps finds what overflows
            for before, here in zip(self._rows[:-1], self._rows[1:], strict=True):
                self._engine.push(before.contact.force, before.body.position + self._below)
                self._engine.step(before.drive.torque)
                _put(here.rotors, self.servos.advance(before.rotors, before.drive, self.dt))
                self._look(here)
        steps = self._period.copy()
        self._period.table[0] = self._period.table[-1]
        return steps

    def _look(self, here: Step) -> None:
        """Fill in all that acts at this instant but for the rotors, which are there."""
        body = self._engine.read()
        _put(here.body, body)
        contact = self._ground_law(body.position, body.quaternion, body.velocity, body.spin)
        _put(here.contact, contact)
        self._drive(here)

    def _drive(self, here: Step) -> None:
        """Fill in what the servos do."""
        angle, rate = here.body.angle, here.body.rate
        _put(here.drive, self.servos.drive(self._reference, angle, rate, here.rotors))


def _put(into: Iterable[FloatArray], values: Iterable[FloatArray]) -> None:
    for place, value in zip(into, values, strict=True):
        place[...] = value


def _resting_height(scenario: Scenario) -> float:
    """Height at which the ground carries a straight robot's weight: m g / k deep [m]."""
    robot, world = scenario.robot, scenario.world
    radius = float(np.mean([link.radius for link in robot.links]))
    if world.ground is None:
        return radius
    mass = robot.total_mass / len(robot.links)
    return radius + mass * min(world.gravity[2], 0.0) / world.ground.stiffness
