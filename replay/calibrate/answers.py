"""What was measured, and what the twin answers to the same commands at the same instants."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from undulog.analysis.signals.reading import RESPONSE_TOPIC
from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError
from undulog.sim.drive.command_session import COMMANDS
from undulog.sim.gait.contract import Gait
from undulog.sim.scenario.engines import Kernels
from undulog.sim.scenario.scenario import Scenario
from undulog.sim.scenario.sensors import Noise, SensorModels
from undulog.sim.twin.twin import Twin

from .parameters import DELAY, Unknown, with_values

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
        session: Open, with commands.
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
    return Measured(
        tuple(found), tuple(t for t, _ in found.values()), tuple(a for _, a in found.values())
    )


@dataclass
class Answers:
    """The twin under the recorded commands, as a function of x; counts its runs.

    Attributes:
        scenario: With theta_0.
        make_gait: Builds the gait of recorded commands.
        measured: Which joints are asked for, and when.
        kernels: What computes the force laws.
        on_tick: Called at every tick; may raise to end the run.
        runs: So far.
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
        late_s = next(
            (one.value(e) for one, e in zip(wanted, x.tolist(), strict=True) if one.name == DELAY),
            0.0,
        )
        return self.sampled(self.run(with_values(self.scenario, wanted, x)), late_s)

    def run(self, scenario: Scenario) -> CubicHermiteSpline:
        """Run the twin without noise.

        Args:
            scenario: What to run.

        Returns:
            Joint angles over time [rad], through angles and rates at the control ticks.

        Raises:
            SimulationError: If it fails.
        """
        begun = time.perf_counter()
        quiet = dataclasses.replace(scenario, noise=Noise(), sensing=SensorModels())
        times: list[float] = []
        angles: list[FloatArray] = []
        rates: list[FloatArray] = []
        with Twin(quiet, self.make_gait(), kernels=self.kernels) as twin:
            for sample in twin.samples():
                self.on_tick()
                times.append(sample.time_s)
                angles.append(sample.step.body.angle)
                rates.append(sample.step.body.rate)
        self.runs += 1
        self.work_s += time.perf_counter() - begun
        return CubicHermiteSpline(np.array(times), np.array(angles), np.array(rates))

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
            j = names.index(joint)
            one = CubicHermiteSpline.construct_fast(track.c[:, :, j], track.x)
            angle = np.asarray(one(np.clip(times_s - late_s, track.x[0], track.x[-1])))
            found.append(angle - angle.mean())
        return tuple(found)
