"""Many runs of the twin at once, on one core or a GPU.

For sweeps: open-loop gaits or given commands on open ground, or without contact. Laws, integrator,
start and checks are those of :class:`.sim.twin.twin.Twin`, and results agree with its runs on
MuJoCo within rounding. A run's results don't depend on the runs beside it, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError, UsageError
from undulog.capture.robot.kinematics import link_positions, rotation_from_quaternion
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import CONTROL_RATE_HZ, Readings
from ..gait.oscillators import OscillatorChains
from ..gait.wave import SerpentineGait
from ..physics.compiled_kernels import LAWS, ground_table
from ..physics.sensing import quantised
from ..physics.servo import Servos
from ..scenario.motion import generator
from ..scenario.scenario import Scenario
from ..twin.twin import MAX_ROTOR_SPEED, MAX_SPEED, failure, resting_height
from .body import (
    ARM,
    CARRIED_ROWS,
    CENTRE,
    HEAD_ROWS,
    INERTIA,
    LANES,
    LINK_ROWS,
    MASS,
    PLACE,
    RADIUS,
    SERVO,
    SPIN,
    TURN,
    VELOCITY,
)
from .kernels import GROUND_ROWS, SAMPLE_ROWS, run_block

_TICKS_A_CALL = CONTROL_RATE_HZ  # Ctrl-C waits for a call
_BLOCK_BYTES = 4 << 30
"""Of the samples of a block on a GPU, which are in memory at once."""

_Shape: TypeAlias = tuple[object, ...]
_Commands: TypeAlias = dict[tuple[object, ...], FloatArray]


@dataclass(frozen=True)
class BatchRun:
    """One run of a batch, at its k control ticks: all of them, or those before it failed.

    Values are the true ones; the scenario's sensors, noise and sampling times have no part in them.

    Attributes:
        error: Why it failed, with the time and the link or servo; None: it did not.
        angle: Joint angles [rad], shape (k, m).
        rate: Joint rates [rad/s], shape (k, m).
        command: Commanded joint angles from the tick on [rad], shape (k, m).
        effort: Gear torques, means over the control period around the tick [N m], shape (k, m).
        current: Winding currents, such means [A], shape (k, m).
        voltage: Motor voltages, such means [V], shape (k, m).
        work: Since the start, by joint [J]: mechanical work on it, its absolute value, electrical
            work at its motor, the positive part of that; shape (4, k, m).
        head: Centre of the head link [m], shape (k, 3).
        head_quaternion: Its orientation x, y, z, w, shape (k, 4).
        head_velocity: Velocity of its centre in the world [m/s], shape (k, 3).
        head_spin: Its angular velocity along its own axes [rad/s], shape (k, 3).
    """

    scenario: Scenario
    error: SimulationError | None
    angle: FloatArray
    rate: FloatArray
    command: FloatArray
    effort: FloatArray
    current: FloatArray
    voltage: FloatArray
    work: FloatArray
    head: FloatArray
    head_quaternion: FloatArray
    head_velocity: FloatArray
    head_spin: FloatArray

    @property
    def time_s(self) -> FloatArray:
        """Times of the ticks since the start [s], shape (k,)."""
        return np.arange(len(self.angle), dtype=np.float64) / CONTROL_RATE_HZ

    @property
    def centre_of_mass(self) -> FloatArray:
        """The robot's centre of mass [m], shape (k, 3)."""
        robot = self.scenario.robot
        turn = rotation_from_quaternion(self.head_quaternion)
        centres = link_positions(robot, self.head, turn, self.angle)
        mass = np.array([link.mass for link in robot.links])
        return np.einsum("i,kij->kj", mass / mass.sum(), centres)


class Device(StrEnum):
    """What steps a batch."""

    CPU = "cpu"
    CUDA = "cuda"


def run_batch(
    scenarios: Sequence[Scenario],
    *,
    commands: Sequence[FloatArray] | None = None,
    dtype: DTypeLike = np.float64,
    device: str = Device.CPU,
) -> tuple[BatchRun, ...]:
    """Run scenarios, many at a time, each from its start to its end.

    Runs of equal joints, friction law, length and physics rate share the steps; everything else may
    differ from run to run. The engine that a scenario names is not used.

    Args:
        scenarios: The runs; what they give stays in memory, 80 bytes a joint and tick.
        commands: Of each run at its k ticks [rad], shape (k, m), in place of its gait's; they are
            held from tick to tick. Or of p equal parts of each control period, shape (k p, m), p a
            divisor of the physics steps of a period: what a servo has on average during each part.
        dtype: ``float64``, or ``float32`` for gains and lags within 1e-3 at a higher speed.
        device: ``cpu``: one core; ``cuda``: an NVIDIA GPU (package numba-cuda), for
            thousands of runs: results agree with the CPU's within rounding, not bit for bit.

    Returns:
        Results in the order of the scenarios.

    Raises:
        UsageError: If a scenario needs what a batch hasn't: obstacles, pushes, a controller or
            oscillators with feedback; lists all such fields. If there is no such device.
        ValueError: If commands have another shape than their run.
    """
    precision = np.dtype(dtype)
    if precision.name not in ("float64", "float32"):
        raise UsageError(f"dtype {precision}: use float64 or float32")
    width, advance = _stepper(device)
    for scenario in scenarios:
        _refuse(scenario, driven=commands is not None)
    if commands is None:
        cache: _Commands = {}
        commands = [_commands(scenario, cache) for scenario in scenarios]
    else:
        commands = [
            quantised(command, scenario.sensing.servo.command_resolution)
            for scenario, command in zip(scenarios, commands, strict=True)
        ]
    for scenario, command in zip(scenarios, commands, strict=True):
        _check_shape(command, scenario)
    groups: dict[_Shape, list[int]] = {}
    for i, (scenario, rows) in enumerate(zip(scenarios, commands, strict=True)):
        groups.setdefault((*_shape(scenario), len(rows)), []).append(i)
    runs: dict[int, BatchRun] = {}
    for group in groups.values():
        command = scenarios[group[0]]
        bytes_a_run = (
            command.tick_count * len(command.robot.joints) * SAMPLE_ROWS * precision.itemsize
        )
        lanes = width or max(1, min(len(group), _BLOCK_BYTES // bytes_a_run))
        for first in range(0, len(group), lanes):
            members = group[first : first + lanes]
            of_members = [commands[i] for i in members]
            block = _Block([scenarios[i] for i in members], of_members, precision, lanes)
            block.run(advance)
            runs |= zip(members, block.results(), strict=True)
    return tuple(runs[i] for i in range(len(scenarios)))


def _stepper(device: str) -> tuple[int | None, Callable[..., None]]:
    """How many runs a block of a device has (None: any number), and what steps them.

    Raises:
        UsageError: If no device has that name.
    """
    if device not in list(Device):
        raise UsageError(f"device {device}: use {' or '.join(Device)}")
    if device == Device.CPU:
        return LANES, run_block
    from .cuda import run_block_on_gpu

    return None, run_block_on_gpu


def _refuse(scenario: Scenario, *, driven: bool) -> None:
    """Raise for what a batch can't run; of a driven run the gait doesn't matter."""
    needs = {
        "world.obstacles": bool(scenario.world.obstacles),
        "disturbances": bool(scenario.disturbances),
        "controller": scenario.controller is not None and not driven,
    }
    if isinstance(scenario.gait, OscillatorChains) and not driven:
        for plane, chain in scenario.gait.planes.items():
            needs[f"gait.{plane}.feedback"] = chain.feedback > 0.0
    if fields := [name for name, needed in needs.items() if needed]:
        raise UsageError(
            f"a batch can't run scenario {scenario.name}: it has {', '.join(fields)}; leave out "
            "what it has, or use Twin or record"
        )


def _shape(scenario: Scenario) -> _Shape:
    """What runs must share to share their steps."""
    ground = scenario.world.ground
    law = None if ground is None else ground.law
    planes = tuple(joint.plane for joint in scenario.robot.joints)
    return planes, law, scenario.physics_rate_hz, scenario.tick_count


def _check_shape(commands: FloatArray, scenario: Scenario) -> None:
    """Raise for commands that fit neither ticks nor equal parts of the control periods."""
    steps, ticks = scenario.physics_rate_hz // CONTROL_RATE_HZ, scenario.tick_count
    parts, rest = divmod(len(commands), ticks)
    whole = parts > 0 and rest == 0 and steps % parts == 0
    if not whole or commands.shape[1:] != (len(scenario.robot.joints),):
        raise ValueError(
            f"commands of shape {commands.shape}; expected {ticks} ticks of "
            f"{len(scenario.robot.joints)} joints, or equal parts of them that divide {steps} steps"
        )


def _commands(scenario: Scenario, cache: _Commands) -> FloatArray:
    """Commands of all ticks, shape (k, m), computed once for runs that share them."""
    resolution = scenario.sensing.servo.command_resolution
    limits = tuple((joint.plane, joint.lower, joint.upper) for joint in scenario.robot.joints)
    key = (id(scenario.gait), limits, scenario.tick_count, resolution)
    if key not in cache:
        times_s = np.arange(scenario.tick_count) / CONTROL_RATE_HZ
        gait = generator(scenario.gait, scenario.robot)
        if isinstance(gait, SerpentineGait):
            commands = gait.commands(times_s)
        else:
            unknown = Readings.nothing(scenario.robot)
            commands = np.array([gait.step(t, unknown).command for t in times_s.tolist()])
        cache[key] = quantised(commands, resolution)
    return cache[key]


def _chain(robot: Robot) -> FloatArray:
    """Parameters of the links, shape (n, SERVO)."""
    half = np.array([link.length / 2 for link in robot.links])
    table = np.zeros((len(half), SERVO))
    table[:, ARM], table[1:, CENTRE] = -2.0 * half, -half[1:]
    table[0, ARM] = -half[0]
    table[:, RADIUS] = [link.radius for link in robot.links]
    table[:, MASS] = [link.mass for link in robot.links]
    table[:, INERTIA : INERTIA + 3] = [link.inertia for link in robot.links]
    return table


def _last(of_runs: Sequence[ArrayLike]) -> FloatArray:
    """Arrays of runs as one whose last axis is the run."""
    return np.moveaxis(np.asarray(of_runs, dtype=np.float64), 0, -1)


class _Block:
    """Runs that share their steps; lanes that are left over repeat the last of them."""

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        commands: Sequence[FloatArray],
        dtype: np.dtype,
        width: int,
    ) -> None:
        """Set the robots on the ground, straight, their servos at rest."""
        self._scenarios = scenarios
        lanes = [scenarios[min(r, len(scenarios) - 1)] for r in range(width)]
        first = scenarios[0]
        n, m, ticks = len(first.robot.links), len(first.robot.joints), first.tick_count
        self._vertical = np.array([joint.plane is Plane.VERTICAL for joint in first.robot.joints])
        self._law = 0 if first.world.ground is None else LAWS.index(first.world.ground.law)
        self._steps = first.physics_rate_hz // CONTROL_RATE_HZ
        self._links = np.zeros((n, LINK_ROWS, width), dtype)
        self._head = np.zeros((HEAD_ROWS, width), dtype)
        self._carried = np.zeros((CARRIED_ROWS, width), dtype)
        self._ground = np.zeros((GROUND_ROWS, width), dtype)
        self._gravity = np.zeros((3, width), dtype)
        self._commands = np.zeros((len(commands[0]), m, width), dtype)
        self._parts = len(commands[0]) // ticks
        self._samples = np.zeros((ticks, SAMPLE_ROWS, m, width), dtype)
        self._poses = np.zeros((ticks, HEAD_ROWS, width), dtype)
        self._failure = np.full((4, width), -1.0)
        chains = {id(lane.robot.links): _chain(lane.robot) for lane in lanes}
        self._links[:, :SERVO] = _last([chains[id(lane.robot.links)] for lane in lanes])
        servos = Servos([joint.servo for lane in lanes for joint in lane.robot.joints]).table
        parameters = servos.reshape(len(servos), width, m).transpose(2, 0, 1)
        self._links[1:, SERVO : SERVO + len(servos)] = parameters
        heading = np.array([lane.world.heading for lane in lanes]) / 2
        self._head[PLACE + 2] = [resting_height(lane) for lane in lanes]
        self._head[TURN + 2], self._head[TURN + 3] = np.sin(heading), np.cos(heading)
        self._head[VELOCITY : VELOCITY + 3] = _last([lane.world.velocity for lane in lanes])
        self._ground[:] = _last([ground_table(lane.world.ground) for lane in lanes])
        self._gravity[:] = _last([lane.world.gravity for lane in lanes])
        self._commands[:] = _last([*commands, *[commands[-1]] * (width - len(commands))])
        self._poses[0] = self._head

    def run(self, advance: Callable[..., None]) -> None:
        """Run to the end, or until all have failed."""
        ticks, n = len(self._samples), len(self._scenarios)
        limits = np.array([MAX_ROTOR_SPEED, MAX_SPEED**2])
        step_s = 1.0 / self._scenarios[0].physics_rate_hz
        for first in range(0, ticks - 1, _TICKS_A_CALL):
            if (self._failure[0, :n] >= 0).all():
                return
            last = min(first + _TICKS_A_CALL, ticks - 1)
            part = slice(first, last + 1)
            given = slice(first * self._parts, last * self._parts + 1)
            advance(
                *(self._links, self._head, self._carried, self._ground, self._gravity),
                *(self._vertical, self._law, self._commands[given], self._samples[part]),
                *(self._poses[part], self._failure, limits, step_s, self._steps, first, last),
                self._head.shape[1],
            )

    def results(self) -> Iterator[BatchRun]:
        """Take the runs apart."""
        steps = self._steps
        # All runs at once: a run's numbers are far apart in a block.
        samples = np.ascontiguousarray(self._samples.transpose(3, 1, 0, 2), np.float64)
        poses = np.ascontiguousarray(self._poses.transpose(2, 0, 1), np.float64)
        commands = self._commands[:: self._parts]  # at the ticks
        commands = np.ascontiguousarray(commands.transpose(2, 0, 1), np.float64)
        samples[:, 2:5, 1:-1] /= steps
        samples[:, 2:5, [0, -1]] /= steps / 2
        for r, scenario in enumerate(self._scenarios):
            error, end = self._failed(r)
            sample, pose = samples[r, :, :end], poses[r, :end]
            yield BatchRun(
                scenario,
                error,
                *(sample[0], sample[1], commands[r, :end], sample[2], sample[3], sample[4]),
                sample[5:],
                head=pose[:, PLACE : PLACE + 3],
                head_quaternion=pose[:, TURN : TURN + 4],
                head_velocity=pose[:, VELOCITY : VELOCITY + 3],
                head_spin=pose[:, SPIN : SPIN + 3],
            )

    def _failed(self, r: int) -> tuple[SimulationError | None, int]:
        """Why a run failed, and how many ticks it has: those before the period in which it did."""
        step, of_link, place, value = self._failure[:, r].tolist()
        if step < 0:
            return None, len(self._samples)
        scenario = self._scenarios[r]
        parts = scenario.robot.links if of_link else scenario.robot.joints
        speed = value**0.5 if of_link else value
        time_s = step / scenario.physics_rate_hz
        return failure(scenario, time_s, parts[int(place)], speed), -(-int(step) // self._steps)
