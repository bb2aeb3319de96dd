"""Scenarios: complete runs of the twin.

The TOML form is described in :mod:`.sim.scenario.scenario_file`.

Modules that differ: a scenario's own servo and link parameters, in place of the robot's.

A robot description is what the robot is meant to be. What a scenario changes stays out of the
robot description that its sessions carry, as a worn servo or a load on one link would: it is in
the attached scenario and the record of what ran.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.util import find_spec
from typing import Annotated, Any, TypeAlias

import tomlkit

from undulog.capture.common.config import Name, NonNegative, read_field, write
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import StrictTable, above, at_least, at_most
from undulog.capture.robot.model import Robot, Servo

from ..gait.contract import CONTROL_RATE_HZ
from .bus_faults import BusFault
from .motion import Controller, GaitParameters, gait_table
from .obstacles import Seed
from .sensors import Noise, SensorModels
from .world import Push, World, body_length, world_table

MASS_FACTOR = "mass_factor"
"""Multiplies a link's mass and its moments of inertia, as a denser material of that shape would."""

LONGEST_S = 86400.0
"""Longest run."""

_PLAIN = ("duration_s", "settle_s", "seed", "epoch_s", "physics_rate_hz", "engine")


Length: TypeAlias = Annotated[float, at_least(1 / CONTROL_RATE_HZ), at_most(LONGEST_S)]
"""Length of a run [s]."""

PhysicsRate: TypeAlias = Annotated[int, at_least(2 * CONTROL_RATE_HZ)]

Epoch: TypeAlias = Annotated[int, at_least(1_000_000_000)]
"""Unix time from 2001 on [s]: viewers misread stamps near zero."""


class EngineKind(StrEnum):
    """The engines there are, each named after its package."""

    BULLET = "bullet"
    MUJOCO = "mujoco"

    @property
    def package(self) -> str:
        """Name of its package in the package index, and of the module it installs."""
        return {EngineKind.BULLET: "pybullet", EngineKind.MUJOCO: "mujoco"}[self]

    @property
    def installed(self) -> bool:
        """Whether its package can be imported."""
        return find_spec(self.package) is not None


DEFAULT_ENGINE = (
    EngineKind.MUJOCO
    if EngineKind.MUJOCO.installed and not EngineKind.BULLET.installed
    else EngineKind.BULLET
)
"""Engine of a scenario that names none: Bullet, or MuJoCo where PyBullet is not installed.

The engines agree within rounding, not bit by bit. A scenario that is written out and a session name
the engine that ran, and the session id depends on it.
"""


class Kernels(StrEnum):
    """What computes the force laws, and the body's kinematics where that pays.

    Results of the two agree within rounding, not bit by bit, so the default does not depend on
    whether Numba is installed.
    """

    NUMPY = "numpy"
    NUMBA = "numba"


Fields: TypeAlias = Mapping[str, float]
"""Parameter name to value."""


@dataclasses.dataclass(frozen=True)
class Modules:
    """What a scenario changes of the robot's modules.

    Attributes:
        servo: Servo parameters of all joints.
        servo_of: The same of single joints, by joint name.
        link_of: :data:`MASS_FACTOR` of single links, by link name.
    """

    servo: Fields = dataclasses.field(default_factory=dict[str, float])
    servo_of: Mapping[str, Fields] = dataclasses.field(default_factory=dict[str, Fields])
    link_of: Mapping[str, Fields] = dataclasses.field(default_factory=dict[str, Fields])

    def fitted(self, robot: Robot) -> Robot:
        """The robot with these modules.

        Returns:
            As the scenario has it.
        """
        servo_of = {
            name: {**self.servo, **self.servo_of.get(name, {})} for name in robot.joint_names
        }
        return robot.with_modules(servo_of, self.mass_factor)

    @property
    def mass_factor(self) -> Fields:
        """Factors of mass and moments of inertia by link name, where they are given."""
        return {
            name: fields[MASS_FACTOR]
            for name, fields in self.link_of.items()
            if MASS_FACTOR in fields
        }

    def tables(self) -> dict[str, Any]:
        """The tables of a scenario file for these modules; empty ones are left out."""
        return {name: table for name, table in write(self).items() if table}


def read_modules(top: StrictTable, robot: Robot | None) -> Modules:
    """Read ``[servo]``, ``[servo_of.JOINT]`` and ``[link_of.LINK]`` of a scenario.

    Args:
        robot: The robot; None after a fault: then names can't be checked.
    """
    servo = _servo_fields(top.table("servo"))
    servos, links = top.table("servo_of"), top.table("link_of")
    if robot is None:
        return Modules(servo)
    servo_of = {name: _servo_fields(servos.table(name)) for name in robot.joint_names}
    link_of = {link.name: _link_fields(links.table(link.name)) for link in robot.links}
    servos.close()
    links.close()
    modules = Modules(
        servo,
        {name: given for name, given in servo_of.items() if given},
        {name: given for name, given in link_of.items() if given},
    )
    _check_rest(top, modules.fitted(robot))
    return modules


def _check_rest(top: StrictTable, robot: Robot) -> None:
    """A rotor at rest withstands no less than a moving one: add a fault where it would."""
    for joint in robot.joints:
        servo = joint.servo
        if 0 < servo.static_friction < servo.coulomb_friction:
            top.fault(
                "servo.static_friction",
                f"0, or at least coulomb_friction = {servo.coulomb_friction:g} of {joint.name}",
                f"{servo.static_friction:g}",
            )
            return


def _servo_fields(table: StrictTable) -> dict[str, float]:
    """The servo parameters that a table gives."""
    names = [item.name for item in dataclasses.fields(Servo) if item.name in table]
    given = {name: read_field(table, Servo, name) for name in names}
    table.close()
    return given


def _link_fields(table: StrictTable) -> dict[str, float]:
    given = {MASS_FACTOR: table.number(MASS_FACTOR, above(0.0))} if MASS_FACTOR in table else {}
    table.close()
    return given


@dataclass(frozen=True)
class Scenario:
    """One run of the twin, complete.

    Example::

        scenario = undulog.load_scenario("flat").changed(duration_s=2.0)

    Attributes:
        robot_name: The robot as the scenario names it.
        robot: The robot, with the scenario's modules.
        gait: Its gait.
        settle_s: The first part of it that is not fit for steady-state analysis.
        noise: What the servos' readings carry.
        modules: Its servos and links that differ from the robot's own.
        seed: Of all that is drawn at random.
        epoch_s: Unix time at which the session starts [s].
        physics_rate_hz: Steps a second, a multiple of twice :data:`CONTROL_RATE_HZ`.
        engine: The engine that solves the body's dynamics.
        faults: Faults of its bus, where it is served on one.
        controller: Changes the gait by the sensor readings; None: no controller.
    """

    name: Name
    description: str
    robot_name: str
    robot: Robot
    gait: GaitParameters
    duration_s: Length
    settle_s: NonNegative = 0.0
    world: World = field(default_factory=World)
    noise: Noise = field(default_factory=Noise)
    sensing: SensorModels = field(default_factory=SensorModels)
    modules: Modules = field(default_factory=Modules)
    disturbances: tuple[Push, ...] = ()
    seed: Seed = 1
    epoch_s: Epoch = 1_735_689_600  # 2025-01-01T00:00:00Z
    physics_rate_hz: PhysicsRate = 1000
    engine: EngineKind = DEFAULT_ENGINE
    faults: tuple[BusFault, ...] = ()
    controller: Controller | None = None

    @property
    def epoch_ns(self) -> int:
        """Start of the session [Unix ns]."""
        return self.epoch_s * 1_000_000_000

    @property
    def tick_count(self) -> int:
        """Samples of the run: one at the start and one at the end of every control period."""
        return round(self.duration_s * CONTROL_RATE_HZ) + 1

    @property
    def session_id(self) -> str:
        """Hash of everything that decides what the run gives."""
        parts = (self.toml(), self.robot.toml or repr(self.robot))
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]

    def changed(self, *, duration_s: float | None = None, seed: int | None = None) -> Scenario:
        """The same scenario with another length or seed.

        Args:
            duration_s: Length of the run; ``settle_s`` is cut to it.
            seed: Of the noise, and of a random field of obstacles without a seed of its own.

        Raises:
            UsageError: If the length is not at least one control period, the seed negative, or the
                field too small for its obstacles with this seed.
        """
        length = self.duration_s if duration_s is None else duration_s
        if not 1 / CONTROL_RATE_HZ <= length <= LONGEST_S:
            raise UsageError(
                f"a duration of {length:g} s; it can be {1 / CONTROL_RATE_HZ:g} to {LONGEST_S:g} s"
            )
        if seed is not None and seed < 0:
            raise UsageError(f"a seed of {seed}; it can be 0 or a positive whole number")
        world = self.world
        if seed is not None:
            world = world.redrawn(seed, body_length(self.robot))
        return dataclasses.replace(
            self,
            duration_s=length,
            settle_s=min(self.settle_s, length),
            seed=self.seed if seed is None else seed,
            world=world,
        )

    def toml(self) -> str:
        """The scenario as TOML, every value written out; reading it gives the same scenario."""
        values: dict[str, Any] = {
            "name": self.name,
            "description": self.description,
            "robot": self.robot_name,
            **{key: getattr(self, key) for key in _PLAIN},
            "gait": gait_table(self.gait),
            "world": world_table(self.world),
            "noise": write(self.noise),
            "sensing": write(self.sensing),
            **self.modules.tables(),
        }
        if self.controller is not None:
            values["controller"] = write(self.controller)
        if self.disturbances:
            values["disturbances"] = [write(push) for push in self.disturbances]
        if self.faults:
            values["faults"] = [fault.as_table() for fault in self.faults]
        return tomlkit.dumps(values)
