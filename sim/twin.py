"""The twin: body, ground, servos and gait, stepped together.

Physics runs at the scenario's rate (1 kHz by default), control and samples at 100 Hz. Within a
control period the commands are held, as a servo bus holds them, and each new command makes the
motors start: torque, current and voltage ripple at 100 Hz. Sampled at an instant they would always
show the same phase of the ripple (in the shipped scenario ``flat`` electrical work would come out
44 % too large), so a sample carries their means over one control period around its time stamp, as
an integrating sensor gives them; positions and velocities are those of the instant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from capture.arrays import FloatArray
from capture.errors import SimulationError

from .gait import Gait, GaitTick, generator
from .physics.contact import contact_law
from .physics.engine import engine_type
from .physics.ledger import Ledger, Step
from .physics.servo import Drive, Rotors, Servos
from .scenario import CONTROL_RATE_HZ, Scenario
from .sensing.contract import SensorSample
from .sensing.senses import Senses
from .stability import likely_cause

MAX_SPEED = 10.0
"""No link of an undulating robot is faster than this [m/s]: beyond it the simulation has failed."""


class Sample(NamedTuple):
    """The twin at one control tick.

    Attributes:
        tick: Number of the control period, from 0.
        gait: What the gait commands from here on.
        step: Body, ground, rotors and servos at this instant.
        sensed: The sensors' samples that have arrived since the tick before; the newest ones
            arrive after the run, by :meth:`Twin.flush`.
        drive: Means over the control period around this instant (half a one at start and end).
        energy: The ledger up to here [J], as :data:`sim.physics.ledger.TERMS`, shape (19,).
    """

    tick: int
    gait: GaitTick
    step: Step
    sensed: list[SensorSample]
    drive: Drive
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
        sensed: Sensor samples that arrive by the present tick, there before the gait is asked: a
            gait that speaks over a bus hands them out first.
    """

    def __init__(self, scenario: Scenario, gait: Gait | None = None) -> None:
        """Set the robot on the ground, straight, its servos at rest, in vertical balance.

        Args:
            scenario: What to run.
            gait: Who commands the joints; the scenario's own gait if None.

        Raises:
            UsageError: If the engine cannot hold the robot.
        """
        robot, world = scenario.robot, scenario.world
        self.scenario = scenario
        self.gait: Gait = gait or generator(scenario.gait, robot)
        self.servos = Servos([joint.servo for joint in robot.joints])
        radius = np.array([link.radius for link in robot.links])
        self._below = np.zeros((3, len(radius)))
        self._below[2] = -radius
        self._ground_law = contact_law(world.ground, radius)
        self.sensed: list[SensorSample] = []
        self._sensing = Senses(scenario)
        self._dt = 1.0 / scenario.physics_rate_hz
        self._body = engine_type(scenario.engine)(
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
        self.close()

    def close(self) -> None:
        """Free the physics world; the twin can't be run any more."""
        self._body.close()

    def samples(self) -> Iterator[Sample]:
        """Run the scenario, once.

        Yields:
            A sample at the start of every control period, and one at the end of the last.

        Raises:
            SimulationError: If the state becomes impossible.
        """
        half = self.scenario.physics_rate_hz // CONTROL_RATE_HZ // 2
        behind: list[Step] = []  # the control period that ends at the tick
        for tick in range(self.scenario.tick_count):
            time_s = tick / CONTROL_RATE_HZ
            if tick:
                behind = self._advance(behind, half, time_s - self._dt * half)
                self._ledger.book(behind)
                self._step = behind[-1]
                self.sensed = self._sensing.observe(behind)
            gait = self.gait.step(time_s, self._sensing.readings)
            self._reference = gait.command
            step = self._step = self._step._replace(drive=self._drive(self._step))
            energy = self._ledger.read(step)
            last = tick == self.scenario.tick_count - 1
            ahead = [step] if last else self._advance([step], half, time_s)
            around = [part.drive for part in (*behind[-1 - half : -1], *ahead[:half])]
            yield Sample(tick, gait, step, self.sensed, _mean(around), energy)
            behind = ahead

    def flush(self) -> list[SensorSample]:
        """End the run, wherever it stands: sensor samples that have not arrived yet.

        Returns:
            These samples, in the order of their arrival.
        """
        return self._sensing.flush()

    def _look(self, rotors: Rotors) -> Step:
        """All that acts at this instant."""
        body = self._body.read()
        contact = self._ground_law(body.position, body.quaternion, body.velocity, body.spin)
        drive = self.servos.drive(self._reference, body.angle, body.rate, rotors)
        return Step(body, contact, rotors, drive)

    def _drive(self, step: Step) -> Drive:
        """What the servos do at an instant, given the present commands."""
        return self.servos.drive(self._reference, step.body.angle, step.body.rate, step.rotors)

    def _advance(self, steps: list[Step], count: int, time_s: float) -> list[Step]:
        """Continue a list of steps from its last one, and check where that leads.

        Args:
            steps: At least one step.
            count: How many to add.
            time_s: Time of the last one [s].

        Returns:
            The longer list.

        Raises:
            SimulationError: If the state becomes impossible.
        """
        steps = list(steps)
        with np.errstate(all="ignore"):  # a state that overflows is found and named below
            for _ in range(count):
                step = steps[-1]
                self._body.push(step.contact.force, step.body.position + self._below)
                self._body.step(step.drive.torque)
                steps.append(self._look(self.servos.advance(step.rotors, step.drive, self._dt)))
            speed = np.abs([step.body.velocity for step in steps[-1 - count :]]).max(axis=1)
        sound = speed <= MAX_SPEED  # false for NaN
        if not sound.all():
            k, link = map(int, np.argwhere(~sound)[0])
            raise SimulationError(
                f"the twin failed at {time_s + k * self._dt:.3f} s: "
                f"{self.scenario.robot.links[link].name} moves at {speed[k, link]:g} m/s, more "
                f"than {MAX_SPEED:g} m/s; {likely_cause(self.scenario)}"
            )
        return steps


def _mean(drives: Sequence[Drive]) -> Drive:
    """Means of what the servos do."""
    voltage, current, torque = np.array(drives).mean(axis=0)
    return Drive(voltage, current, torque)


def _resting_height(scenario: Scenario) -> float:
    """Height at which the ground carries a straight robot's weight: m g / k deep [m]."""
    robot, world = scenario.robot, scenario.world
    radius = float(np.mean([link.radius for link in robot.links]))
    if world.ground is None:
        return radius
    mass = robot.total_mass / len(robot.links)
    return radius + mass * min(world.gravity[2], 0.0) / world.ground.stiffness
