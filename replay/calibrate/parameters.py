"""What is fitted: x = ln(theta / theta_0), so that every parameter stays positive.

The servo's parameters are shared by all modules, the ground's by all links; one module may have a
stall torque of its own. A dead time is no parameter of the twin: it is fitted to the times of the
samples, in units of its own prior deviation.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.log.read.joint_topics import RESPONSE_TOPIC
from undulog.capture.robot.model import Servo
from undulog.sim.drive.motion import COMMANDS
from undulog.sim.gait.contract import CONTROL_RATE_HZ, Gait, Readings
from undulog.sim.scenario.scenario import Kernels, Scenario
from undulog.sim.scenario.sensors import Noise, SensorModels
from undulog.sim.scenario.world import FrictionLaw
from undulog.sim.twin.twin import Twin

SERVO = {
    "stall_torque": "N m",
    "proportional_gain": "1/rad",
    "coulomb_friction": "N m",
    "viscous_friction": "N m s/rad",
    "gear_stiffness": "N m/rad",
    "gear_damping": "N m s/rad",
}
"""Shared servo parameters and their units."""

_DRY = {"mu_tangential": "1", "mu_normal": "1"}
_VISCOUS = {"drag_tangential": "N s/m", "drag_normal": "N s/m"}

DELAY = "delay"
DELAY_S = 0.02
"""Prior standard deviation of the dead time [s]."""


@dataclass(frozen=True)
class Unknown:
    """One entry of x.

    Attributes:
        name: A servo's or the ground's parameter, or :data:`DELAY`.
        unit: SI.
        start: theta_0; 0 for a dead time.
        spread: Prior standard deviation of its entry of x.
        module: The joint whose own parameter it is, as a factor on the shared one; None for all.
    """

    name: str
    unit: str
    start: float
    spread: float
    module: str | None = None

    @property
    def label(self) -> str:
        """How it is called in text."""
        words = self.name.replace("_", " ")
        return words if self.module is None else f"{words} of {self.module}"

    def value(self, x: float) -> float:
        """Theta in its unit: of a module, its factor on the shared value."""
        return DELAY_S * x if self.name == DELAY else self.start * math.exp(x)


def unknowns(
    scenario: Scenario, *, spread: float, only: Sequence[str] = (), delay: bool = False
) -> tuple[Unknown, ...]:
    """What can be fitted of a scenario.

    Args:
        scenario: Where the commands will be given; its servos identical.
        spread: Prior standard deviation of each ln theta.
        only: Names of the parameters wanted; all if empty.
        delay: Fit a dead time, too.

    Returns:
        Those of its servos and of its ground that aren't 0: what is absent stays absent.

    Raises:
        UsageError: If the servos differ, or a name is none of them.
    """
    servos = {joint.servo for joint in scenario.robot.joints}
    if len(servos) > 1:
        raise UsageError(
            f"{scenario.name}: its servos differ and shared parameters are to be fitted; leave out "
            "servo_of and the joints' own servos"
        )
    (servo,) = servos
    ground = scenario.world.ground
    of_law = _VISCOUS if ground is not None and ground.law is FrictionLaw.VISCOUS else _DRY
    found = {
        name: Unknown(name, unit, float(getattr(owner, name)), spread)
        for owner, units in ((servo, SERVO), (ground, of_law))
        for name, unit in (units.items() if owner is not None else ())
    }
    for name in only:
        if name not in found:
            raise UsageError(f"--only {name}: expected one of {', '.join(found)}")
        if found[name].start == 0.0:
            raise UsageError(f"--only {name}: it is 0 in {scenario.name} and can't be scaled")
    wanted = [one for name, one in found.items() if not only or name in only]
    chosen = tuple(one for one in wanted if one.start > 0.0)
    return (*chosen, Unknown(DELAY, "s", 0.0, 1.0)) if delay else chosen


def module_unknown(scenario: Scenario, joint: str, spread: float) -> Unknown:
    """The stall torque of one module, as a factor on that of all.

    Args:
        scenario: Where the commands will be given.
        spread: Prior standard deviation of the factor's logarithm.

    Raises:
        UsageError: If there is no such joint.
    """
    names = scenario.robot.joint_names
    if joint not in names:
        raise UsageError(f"--module {joint}: {scenario.robot.name} has {', '.join(names)}")
    return Unknown("stall_torque", "1", 1.0, spread, joint)


def with_values(scenario: Scenario, wanted: Sequence[Unknown], x: FloatArray) -> Scenario:
    """The scenario with other parameters.

    Args:
        scenario: With theta_0.
        wanted: K unknowns.
        x: Shape (K,).

    Returns:
        The scenario to run; its tables of modules are left as they were.
    """
    shared, of_ground, factor = dict[str, float](), dict[str, float](), dict[str, float]()
    for one, entry in zip(wanted, x.tolist(), strict=True):
        if one.module is not None:
            factor[one.module] = one.value(entry)
        elif one.name in SERVO:
            shared[one.name] = one.value(entry)
        elif one.name != DELAY:
            of_ground[one.name] = one.value(entry)
    joints = tuple(
        dataclasses.replace(joint, servo=_servo(joint.servo, shared, factor.get(joint.name, 1.0)))
        for joint in scenario.robot.joints
    )
    robot, world = dataclasses.replace(scenario.robot, joints=joints), scenario.world
    if world.ground is not None:
        world = dataclasses.replace(world, ground=dataclasses.replace(world.ground, **of_ground))
    return dataclasses.replace(scenario, robot=robot, world=world)


def _servo(servo: Servo, shared: dict[str, float], factor: float) -> Servo:
    given = dataclasses.replace(servo, **shared)
    return dataclasses.replace(given, stall_torque=given.stall_torque * factor)


FEWEST = 20
"""Samples that a joint must have to be looked at."""


@dataclass(frozen=True)
class Measured:
    """Joint angles of the settled part.

    Attributes:
        joints: r names.
        times_s: Each joint's sampling times since the first command [s], shapes (n_j,).
        angles: Less their mean: where a joint's zero is, is its own affair [rad], shapes (n_j,).
    """

    joints: tuple[str, ...]
    times_s: tuple[FloatArray, ...]
    angles: tuple[FloatArray, ...]


def read_measured(session: SessionView, settle_s: float, end_s: float) -> Measured:
    """Read what the joints did.

    Args:
        settle_s: The first part to leave out [s] since the first command.
        end_s: Where the commands end [s].

    Returns:
        Its joint angles; samples without a value are left out.

    Raises:
        MissingChannelError: If it has no joint states.
        DataError: If too few are left.
    """
    commands, states = session.joints(COMMANDS), session.joints(RESPONSE_TOPIC)
    start_ns = min(int(t[0]) for t in commands.t_ns if len(t))
    found: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name, t_ns, values in zip(states.names, states.t_ns, states.values, strict=True):
        times_s = np.asarray((t_ns - start_ns) * 1e-9, dtype=np.float64)
        kept = (times_s >= settle_s) & (times_s <= end_s) & np.isfinite(values)
        if kept.sum() >= FEWEST:
            angles: FloatArray = values[kept]
            angles -= angles.mean()
            found[name] = times_s[kept], angles
    if not found:
        raise DataError(
            f"{session.path}: no joint has {FEWEST} samples on {RESPONSE_TOPIC} between "
            f"{settle_s:g} s and {end_s:g} s; is --settle too long?"
        )
    times, values = zip(*found.values(), strict=True)
    return Measured(tuple(found), times, values)


_BATCH_SAMPLES = 100_000
"""Joints times ticks of a run of a batch, at most: a block takes 4 kB of memory for each."""


def _quiet(scenario: Scenario) -> Scenario:
    """The scenario without noise."""
    return dataclasses.replace(scenario, noise=Noise(), sensing=SensorModels())


def _late_s(wanted: Sequence[Unknown], x: FloatArray) -> float:
    """Dead time among the unknowns [s]."""
    pairs = zip(wanted, x.tolist(), strict=True)
    return sum(one.value(entry) for one, entry in pairs if one.name == DELAY)


@dataclass
class Answers:
    """The twin under the recorded commands, as a function of x; counts its runs.

    Attributes:
        scenario: With theta_0.
        make_gait: Builds the gait of recorded commands.
        measured: The joints and their sampling times.
        kernels: What computes the force laws.
        on_tick: Called at every tick; may raise to end the run.
        work_s: What they took [s].
    """

    scenario: Scenario
    make_gait: Callable[[], Gait]
    measured: Measured
    kernels: Kernels = Kernels.NUMPY
    on_tick: Callable[[], None] = lambda: None
    runs: int = 0
    work_s: float = 0.0

    @property
    def speed(self) -> float:
        """Simulated seconds a second."""
        return self.runs * self.scenario.duration_s / max(self.work_s, 1e-9)

    def at(self, wanted: Sequence[Unknown], x: FloatArray) -> tuple[FloatArray, ...]:
        """Joint angles at the measured instants, less their means.

        Args:
            wanted: K unknowns.
            x: Shape (K,).

        Returns:
            [rad], shapes (n_j,).

        Raises:
            SimulationError: If the twin fails with these parameters.
        """
        track = self.run(with_values(self.scenario, wanted, x))
        return self.sampled(track, _late_s(wanted, x))

    def near(
        self, wanted: Sequence[Unknown], points: Sequence[FloatArray]
    ) -> Iterator[tuple[FloatArray, ...]]:
        """Yield joint angles as :meth:`at` gives them, of many x, whose differences are wanted.

        They are runs of a batch where that can make them: all on its engine, then.

        Args:
            wanted: K unknowns.
            points: Each of shape (K,).

        Yields:
            For each point angles [rad], shapes (n_j,).

        Raises:
            SimulationError: If the twin fails with these parameters.
        """
        scenarios = [with_values(self.scenario, wanted, x) for x in points]
        tracks = self._run_batch(scenarios) if self._fits_batch else map(self.run, scenarios)
        for track, x in zip(tracks, points, strict=True):
            yield self.sampled(track, _late_s(wanted, x))

    @property
    def _fits_batch(self) -> bool:
        """Whether a batch can run the scenario, and has memory for it."""
        scenario = self.scenario
        size = scenario.tick_count * len(scenario.robot.joints)
        plain = not (scenario.world.obstacles or scenario.disturbances)
        return self.kernels is Kernels.NUMBA and plain and size <= _BATCH_SAMPLES

    def _run_batch(self, scenarios: Sequence[Scenario]) -> list[CubicHermiteSpline]:
        from undulog.sim import run_batch  # needs numba

        self.on_tick()
        begun = time.perf_counter()
        quiet = [_quiet(scenario) for scenario in scenarios]
        found: list[CubicHermiteSpline] = []
        for run in run_batch(quiet, commands=[self._commands] * len(quiet)):
            if run.error is not None:
                raise run.error
            found.append(CubicHermiteSpline(run.time_s, run.angle, run.rate))
        self.runs += len(quiet)
        self.work_s += time.perf_counter() - begun
        return found

    @cached_property
    def _commands(self) -> FloatArray:
        """The recorded commands at the ticks [rad], shape (k, m)."""
        gait, nothing = self.make_gait(), Readings.nothing(self.scenario.robot)
        times_s = np.arange(self.scenario.tick_count) / CONTROL_RATE_HZ
        return np.array([gait.step(t, nothing).command for t in times_s.tolist()])

    def run(self, scenario: Scenario) -> CubicHermiteSpline:
        """Run the twin without noise.

        Returns:
            Joint angles over time [rad], through angles and rates at the control ticks.

        Raises:
            SimulationError: If it fails.
        """
        begun = time.perf_counter()
        quiet = _quiet(scenario)
        rows: list[tuple[float, FloatArray, FloatArray]] = []
        with Twin(quiet, self.make_gait(), kernels=self.kernels) as twin:
            for sample in twin.samples():
                self.on_tick()
                rows.append((sample.time_s, sample.step.body.angle, sample.step.body.rate))
        self.runs += 1
        self.work_s += time.perf_counter() - begun
        times, angles, rates = (np.array(column) for column in zip(*rows, strict=True))
        return CubicHermiteSpline(times, angles, rates)

    def sampled(self, track: CubicHermiteSpline, late_s: float = 0.0) -> tuple[FloatArray, ...]:
        """A run at the measured instants.

        Args:
            track: From :meth:`run`.
            late_s: Dead time [s].

        Returns:
            Joint angles less their means [rad], shapes (n_j,).
        """
        names = self.scenario.robot.joint_names
        # The joints share one table of breaks; a spline of one joint is a column of it.
        found: list[FloatArray] = []
        for joint, times_s in zip(self.measured.joints, self.measured.times_s, strict=True):
            one = CubicHermiteSpline.construct_fast(track.c[:, :, names.index(joint)], track.x)
            angle = np.asarray(one(np.clip(times_s - late_s, track.x[0], track.x[-1])))
            found.append(angle - angle.mean())
        return tuple(found)
