"""The twin under the recorded commands of one or several sessions, as a function of x.

Commands take effect at their own times, within a physics step by their mean over it, and angles are
taken at each joint's own sampling times: nothing is rounded to the control ticks.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from undulog.capture.common.arrays import FloatArray
from undulog.sim.gait.contract import CONTROL_RATE_HZ
from undulog.sim.scenario.scenario import Kernels, Scenario
from undulog.sim.scenario.sensors import Noise, SensorModels
from undulog.sim.twin.twin import Plant, check_state

from .parameters import Unknown, late_s, with_values
from .recorded import MeasuredAngles, Recorded, joined

_BATCH_BYTES = 500e6
"""Memory of a block of a batch, at most."""

_TICK_BYTES = 4000.0
"""Of a joint at a tick of a block: what is kept of its 16 runs, and the copy that is returned."""

_COMMAND_BYTES = 128.0
"""Of a joint's command during a physics step of a block."""

_KNOTS = 5
"""Of a control period, at most: between ticks alone, an acceleration that jumps with a command in
the middle leaves 0.5 mrad; the error falls with the square of their distance."""


class RunTrack(NamedTuple):
    """Joint angles and rates of a run over time.

    Attributes:
        times_s: [s], shape (k,).
        angle: [rad], shape (k, m).
        rate: [rad/s], shape (k, m).
    """

    times_s: FloatArray
    angle: FloatArray
    rate: FloatArray


@dataclass
class Work:
    """What the runs took.

    Attributes:
        runs: Their number.
        simulated_s: Their length, all together [s].
        taken_s: Time that they took [s].
    """

    runs: int = 0
    simulated_s: float = 0.0
    taken_s: float = 0.0

    @property
    def speed(self) -> float:
        """Simulated seconds a second."""
        return self.simulated_s / max(self.taken_s, 1e-9)

    def book(self, runs: int, scenario: Scenario, begun: float) -> None:
        """Add runs of a scenario that began at a time of ``time.perf_counter``."""
        self.runs += runs
        self.simulated_s += runs * scenario.duration_s
        self.taken_s += time.perf_counter() - begun


@dataclass(frozen=True)
class Answers:
    """The twin under the recorded commands.

    Attributes:
        sessions: At least one.
        kernels: What computes the force laws.
        on_tick: Called at every tick; may raise to end the run.
    """

    sessions: tuple[Recorded, ...]
    kernels: Kernels = Kernels.NUMPY
    on_tick: Callable[[], None] = lambda: None
    work: Work = field(default_factory=Work)

    @property
    def scenario(self) -> Scenario:
        """The first session's, with theta_0."""
        return self.sessions[0].scenario

    @cached_property
    def measured(self) -> MeasuredAngles:
        """Joint angles of all sessions."""
        return joined(self.sessions)

    def changed(self, change: Callable[[Scenario], Scenario]) -> Answers:
        """The same sessions in other worlds; runs are counted together."""
        sessions = tuple(
            dataclasses.replace(session, scenario=change(session.scenario))
            for session in self.sessions
        )
        return dataclasses.replace(self, sessions=sessions)

    def at(self, unknowns: Sequence[Unknown], x: FloatArray) -> tuple[FloatArray, ...]:
        """Joint angles at the measured instants, less their means.

        Args:
            unknowns: K of them.
            x: Shape (K,).

        Returns:
            [rad], shapes (n_j,).

        Raises:
            SimulationError: If the twin fails with these parameters.
        """
        late = late_s(unknowns, x)
        return tuple(
            angles
            for session in self.sessions
            for angles in sampled(
                self._run(session, with_values(session.scenario, unknowns, x)), session, late
            )
        )

    def near(
        self, unknowns: Sequence[Unknown], points: Sequence[FloatArray]
    ) -> Iterator[tuple[FloatArray, ...]]:
        """Yield joint angles as :meth:`at` gives them, of many x, whose differences are wanted.

        They are runs of a batch where that can make them: all on its engine, then.

        Args:
            unknowns: K of them.
            points: Each of shape (K,).

        Yields:
            For each point angles [rad], shapes (n_j,).

        Raises:
            SimulationError: If the twin fails with these parameters.
        """
        late = [late_s(unknowns, x) for x in points]
        parts: list[list[tuple[FloatArray, ...]]] = []
        for session in self.sessions:
            scenarios = [with_values(session.scenario, unknowns, x) for x in points]
            in_batch = self.kernels is Kernels.NUMBA and _fits_batch(session)
            tracks = (
                self._run_batch(session, scenarios)
                if in_batch
                else (self._run(session, scenario) for scenario in scenarios)
            )
            parts.append([sampled(t, session, s) for t, s in zip(tracks, late, strict=True)])
        for of_point in zip(*parts, strict=True):
            yield tuple(chain.from_iterable(of_point))

    def _run_batch(self, session: Recorded, scenarios: Sequence[Scenario]) -> Iterator[RunTrack]:
        from undulog.sim import run_batch  # needs numba

        self.on_tick()
        begun = time.perf_counter()
        # Commands were read as they were given: they are rounded already.
        plain = [dataclasses.replace(s, noise=Noise(), sensing=SensorModels()) for s in scenarios]
        runs = run_batch(plain, commands=[session.references] * len(plain))
        self.work.book(len(runs), session.scenario, begun)
        for run in runs:
            if run.error is not None:
                raise run.error
            yield RunTrack(run.time_s, run.angle, run.rate)

    def _run(self, session: Recorded, scenario: Scenario) -> RunTrack:
        """Run the twin without noise.

        Raises:
            SimulationError: If it fails.
        """
        begun = time.perf_counter()
        steps, references = session.steps_a_tick, session.references
        stride = next(k for k in range(-(-steps // _KNOTS), steps + 1) if steps % k == 0)
        knots, periods = steps // stride, scenario.tick_count - 1
        motion = np.zeros((periods * knots + 1, 2, references.shape[1]))
        with closing(Plant(scenario, self.kernels)) as plant:
            for tick in range(periods):
                self.on_tick()
                period = references[tick * steps : (tick + 1) * steps]
                plant.command(period[0])
                rows = plant.advance(period)
                check_state(rows, scenario, tick / CONTROL_RATE_HZ)
                motion[tick * knots : (tick + 1) * knots + 1] = rows.motion[::stride]
        self.work.book(1, scenario, begun)
        times_s = np.arange(len(motion)) / (CONTROL_RATE_HZ * knots)
        return RunTrack(times_s, motion[:, 0], motion[:, 1])


def _fits_batch(session: Recorded) -> bool:
    """Whether a batch can run a session, and has memory for it."""
    scenario = session.scenario
    size = scenario.tick_count * len(scenario.robot.joints)
    size *= _TICK_BYTES + _COMMAND_BYTES * session.steps_a_tick
    return not (scenario.world.obstacles or scenario.disturbances) and size <= _BATCH_BYTES


def sampled(track: RunTrack, session: Recorded, late_s: float = 0.0) -> tuple[FloatArray, ...]:
    """A run at the measured instants of its session.

    Args:
        track: Angles in between are those of a cubic through angles and rates.
        late_s: Dead time [s].

    Returns:
        Joint angles less their means [rad], shapes (n_j,).
    """
    names, measured = session.scenario.robot.joint_names, session.measured
    at_samples: list[FloatArray] = []
    for joint, times_s in zip(measured.joints, measured.times_s, strict=True):
        k = names.index(joint)
        curve = CubicHermiteSpline(track.times_s, track.angle[:, k], track.rate[:, k])
        angle = np.asarray(curve(np.clip(times_s - late_s, 0.0, track.times_s[-1])))
        at_samples.append(angle - angle.mean())
    return tuple(at_samples)
