"""Scenarios: what the twin is to run, complete.

The TOML form is described in :mod:`.sim.scenario.scenario_file`.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

import tomlkit

from undulog.capture.common.config import Name, NonNegative, write
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import at_least, at_most
from undulog.capture.robot.model import Robot

from ..gait.build import GaitParameters
from ..gait.contract import CONTROL_RATE_HZ
from .bus_faults import BusFault
from .controllers import Controller
from .engines import EngineKind
from .field import Seed
from .gaits_toml import gait_table
from .modules import Modules
from .sensors import Noise, SensorModels
from .world import Push, World
from .world_toml import body_length, world_table

LONGEST_S = 86400.0
"""Longest run."""

Length: TypeAlias = Annotated[float, at_least(1 / CONTROL_RATE_HZ), at_most(LONGEST_S)]
"""Length of a run [s]."""
PhysicsRate: TypeAlias = Annotated[int, at_least(2 * CONTROL_RATE_HZ)]
Epoch: TypeAlias = Annotated[int, at_least(1_000_000_000)]
"""Unix time from 2001 on [s]: viewers misread stamps near zero."""


@dataclass(frozen=True)
class Scenario:
    """One run of the twin, complete.

    Attributes:
        name: Short name.
        description: One sentence.
        robot_name: The robot as the scenario names it.
        robot: The robot, with the scenario's modules.
        gait: What it is commanded to do.
        duration_s: Length of the run.
        settle_s: The first part of it that is not fit for steady-state analysis.
        world: Where it is.
        noise: What the servos' readings carry.
        sensing: How its sensors measure.
        modules: Its servos and links that differ from the robot's own.
        disturbances: What pushes it.
        seed: Of all that is drawn at random.
        epoch_s: Unix time at which the session starts [s].
        physics_rate_hz: Steps a second, a multiple of twice :data:`CONTROL_RATE_HZ`.
        engine: Who solves the body's dynamics.
        faults: What goes wrong on its bus, where it is served on one.
        controller: What changes the gait by what the sensors say; None: nothing does.
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
    engine: EngineKind = EngineKind.BULLET
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

        Returns:
            The scenario.

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
            "duration_s": self.duration_s,
            "settle_s": self.settle_s,
            "seed": self.seed,
            "epoch_s": self.epoch_s,
            "physics_rate_hz": self.physics_rate_hz,
            "engine": self.engine,
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
