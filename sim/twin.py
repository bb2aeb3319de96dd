"""The twin: body, ground, servos and gait, stepped together.

Physics runs at the scenario's rate (1 kHz by default), control and samples at 100 Hz. Within a
control period the commands are held, as a servo bus holds them. A sample stands for the instant
of its time stamp: the state there, the command issued there, and what the servos do about it.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from capture.arrays import FloatArray
from capture.errors import SimulationError

from .body import Body
from .contact import contact_law
from .gait import GaitTick, SerpentineGait
from .ledger import Ledger, Step
from .scenario import CONTROL_RATE_HZ, Scenario
from .servo import Drive, Rotors, Servos
from .stability import likely_cause

MAX_SPEED = 10.0
"""No link of an undulating robot is faster than this [m/s]: beyond it the simulation has failed."""


class Sample(NamedTuple):
    """The twin at one control tick.

    Attributes:
        tick: Number of the control period, from 0.
        gait: What the gait commands from here on.
        step: Body, ground, rotors and servos at this instant.
        energy: The ledger up to here [J], as :data:`sim.ledger.TERMS`, shape (19,).
    """

    tick: int
    gait: GaitTick
    step: Step
    energy: FloatArray

    @property
    def time_s(self) -> float:
        """Time since the start [s]."""
        return self.tick / CONTROL_RATE_HZ


class Twin:
    """One robot in its world; use it in a ``with`` block, and run it with :meth:`samples`.

    Attributes:
        scenario: What it runs.
        gait: Its gait.
        servos: Its servos.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Set the robot on the ground, straight, its servos at rest, in vertical balance.

        Args:
            scenario: What to run.

        Raises:
            UsageError: If the engine cannot hold the robot.
        """
        robot, world = scenario.robot, scenario.world
        self.scenario = scenario
        self.gait = SerpentineGait(scenario.gait, robot)
        self.servos = Servos([joint.servo for joint in robot.joints])
        radius = np.array([link.radius for link in robot.links])
        self._below = np.zeros((3, len(radius)))
        self._below[2] = -radius
        self._ground_law = contact_law(world.ground, radius)
        self._dt = 1.0 / scenario.physics_rate_hz
        self._body = Body(
            robot,
            gravity=world.gravity,
            height=_resting_height(scenario),
            heading=world.heading,
            velocity=world.velocity,
            dt=self._dt,
        )
        still = np.zeros(len(robot.joints))
        self._reference = still
        self._step = self._look(Rotors(still, still))
        self._ledger = Ledger(
            robot,
            self.servos,
            gravity=np.array(world.gravity),
            stiffness=world.ground.stiffness if world.ground is not None else 0.0,
            dt=self._dt,
            start=self._step,
        )

    def __enter__(self) -> Self:
        """Enter the block that owns the physics world."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Free the physics world."""
        self._body.close()

    def samples(self) -> Iterator[Sample]:
        """Run the scenario, once.

        Yields:
            A sample at the start of every control period, and one at the end of the last.

        Raises:
            SimulationError: If the state becomes impossible.
        """
        for tick in range(self.scenario.tick_count):
            if tick:
                self._advance(tick - 1)
            gait = self.gait.step(tick / CONTROL_RATE_HZ)
            self._reference = gait.command
            self._step = self._step._replace(drive=self._drive(self._step))
            yield Sample(tick, gait, self._step, self._ledger.read(self._step))

    def _look(self, rotors: Rotors) -> Step:
        """All that acts at this instant."""
        body = self._body.read()
        contact = self._ground_law(body.position, body.quaternion, body.velocity, body.spin)
        drive = self.servos.drive(self._reference, body.angle, body.rate, rotors)
        return Step(body, contact, rotors, drive)

    def _drive(self, step: Step) -> Drive:
        """What the servos do at an instant, given the present commands."""
        return self.servos.drive(self._reference, step.body.angle, step.body.rate, step.rotors)

    def _advance(self, tick: int) -> None:
        """Go through one control period, check it, and book it."""
        steps = [self._step]
        with np.errstate(all="ignore"):  # a state that overflows is found and named below
            for _ in range(self.scenario.physics_rate_hz // CONTROL_RATE_HZ):
                step = steps[-1]
                self._body.push(step.contact.force, step.body.position + self._below)
                self._body.step(step.drive.torque)
                steps.append(self._look(self.servos.advance(step.rotors, step.drive, self._dt)))
            speed = np.array([np.abs(step.body.velocity).max(axis=0) for step in steps])
        sound = speed <= MAX_SPEED  # false for NaN
        if not sound.all():
            k, link = map(int, np.argwhere(~sound)[0])
            raise SimulationError(
                f"the twin failed at {tick / CONTROL_RATE_HZ + k * self._dt:.3f} s: "
                f"{self.scenario.robot.links[link].name} moves at {speed[k, link]:g} m/s, more "
                f"than {MAX_SPEED:g} m/s; {likely_cause(self.scenario)}"
            )
        self._ledger.book(steps)
        self._step = steps[-1]


def _resting_height(scenario: Scenario) -> float:
    """Height at which the ground carries a straight robot's weight: m g / k deep [m]."""
    robot, world = scenario.robot, scenario.world
    radius = float(np.mean([link.radius for link in robot.links]))
    if world.ground is None:
        return radius
    mass = robot.total_mass / len(robot.links)
    return radius + mass * min(world.gravity[2], 0.0) / world.ground.stiffness
