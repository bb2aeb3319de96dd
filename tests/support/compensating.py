"""The twin kicked, compensated, and driven again with what was not used: other noise and gaits.

Yaw joints with a pitch joint between each two, on the ground, as in :mod:`.closed_loop`; joint
angles are read with white noise. Each run starts at another phase of the gait.
"""

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from support import twin_chains
from support.closed_loop import Sines
from undulog.analysis.experiment.kick_coupling import kick_coupling
from undulog.analysis.experiment.kick_runs import KickExperiment, sort_kicks
from undulog.analysis.experiment.pooling import pool_runs
from undulog.analysis.parts.heterogeneity.measure import response_indices
from undulog.analysis.plan.compensate import KEEP, compensation
from undulog.analysis.plan.runs import BaseGait
from undulog.analysis.response.response import Response
from undulog.analysis.session.runs import GaitRun
from undulog.sim import load_scenario, run_batch

SETTLE_S, CYCLES = 10.0, 4
KICK, BASE_RUNS, HELD_OUT = 0.05, 6, (0.05, 0.1, 0.15)
NOISE = 0.005
"""Of each sample of an angle [rad]."""

ABS, EL_CLIPPED = 1, 3
"""Rows of the joints' work in a batch."""


@dataclass(frozen=True)
class Wave:
    """A gait of m yaw joints."""

    m: int
    amplitude: float = 0.4
    frequency_hz: float = 0.5
    lag: float = math.pi / 3

    @property
    def omega(self):
        """Angular frequency [rad/s]."""
        return 2 * math.pi * self.frequency_hz

    @property
    def phasors(self):
        """Complex amplitudes of the wanted wave [rad], shape (m,)."""
        return self.amplitude * np.exp(-1j * self.lag * np.arange(self.m))


@dataclass(frozen=True)
class Driven:
    """A run of commands: its response, and what it did.

    Attributes:
        command: Complex amplitudes [rad], shape (m,).
        response: a/c, shape (m,).
        speed: Of the centre of mass over whole cycles [m/s].
        cost_abs: Cost of transport E_abs / (m g d).
        cost_el: That of E_el, clipped.
        effort_j: E_el, clipped, a cycle [J].
    """

    wave: Wave
    command: np.ndarray
    response: Response
    speed: float
    cost_abs: float
    cost_el: float
    effort_j: float

    def against(self, wave):
        """Return the response to the wanted wave instead of to the commands."""
        ratio = self.response.ratio * self.command / wave.phasors
        return replace(self.response, ratio=ratio)

    def run(self):
        """Return what the analysis would keep of its session."""
        return gait_run(names(len(self.command)), self.wave, self.command, self.response)


def names(m):
    """Of the yaw joints, with a pitch joint between each two."""
    return tuple(f"joint{2 * k + 1:02d}" for k in range(m))


def gait_run(joints, wave, command, response):
    """Return a run as the analysis keeps it."""
    facts = ("driven.mcap", "chain", 0, joints, ("horizontal",), wave.frequency_hz)
    return GaitRun(*facts, command, "head-to-tail", response)


def indices(runs, wave):
    """Return CV of gain and spread of lag against the wanted wave, of several runs together."""
    pooled = pool_runs(names(wave.m), [run.against(wave) for run in runs])
    values = response_indices(pooled.response)
    return values["gain_cv"], values["lag_sd"]


def ratio(after, before):
    """Return after over before, and the ends of its interval from those of both (conservative)."""
    low, high = (a / b for a, b in zip(after.ci95, before.ci95[::-1], strict=True))
    return after.value / before.value, low, high


class Stage:
    """A chain on its ground, to be driven."""

    def __init__(self, m, stall=0.25, noise=NOISE, **servo):
        """Build it.

        Args:
            m: Yaw joints.
            stall: Torque of the servos [N m].
            noise: Of each sample of an angle [rad].
            servo: More of their parameters.
        """
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            robot = twin_chains.chain(2 * m - 1, stall_torque=stall, **servo)
            (folder / "chain.toml").write_text(robot)
            text = twin_chains.wave(duration_s=60.0, settle_s=SETTLE_S)
            (folder / "scenario.toml").write_text(text)
            self.scenario = load_scenario(folder / "scenario.toml")
        self.m, self.robot, self.noise = m, self.scenario.robot, noise

    def drive(self, wave, commands, seeds):
        """Run commands; a seed is that of the noise and of the phase at the start.

        Args:
            wave: The wanted wave.
            commands: Complex amplitudes of each run [rad], shape (k, m).
            seeds: Of each run.
        """
        length_s = SETTLE_S + CYCLES / wave.frequency_hz
        scenario = self.scenario.changed(duration_s=round(length_s, 2))
        randoms = [np.random.default_rng(seed) for seed in seeds]
        turned = [
            command * np.exp(1j * random.uniform(-np.pi, np.pi))
            for command, random in zip(commands, randoms, strict=True)
        ]
        times_s = np.arange(scenario.tick_count) / 100
        given = [
            np.array([gait.step(t, None).command for t in times_s])
            for gait in (Sines(phasors, wave.omega) for phasors in turned)
        ]
        runs = run_batch([scenario] * len(given), commands=given)
        return [
            self._driven(wave, command, phasors, random, run)
            for command, phasors, random, run in zip(commands, turned, randoms, runs, strict=True)
        ]

    def _driven(self, wave, command, turned, random, run):
        assert run.error is None, run.error
        angles = run.angle[:, ::2] + self.noise * random.standard_normal((len(run.angle), self.m))
        first = round(100 * SETTLE_S)
        middle, energy = run.centre_of_mass[:, :2], run.work[[ABS, EL_CLIPPED]].sum(axis=2)
        way = float(np.linalg.norm(middle[-1] - middle[first]))
        spent = energy[:, -1] - energy[:, first]
        weight = 9.81 * sum(link.mass for link in self.robot.links)
        return Driven(
            wave,
            command,
            _response(angles[first:], turned, wave.omega),
            way / (run.time_s[-1] - SETTLE_S),
            *(spent / (weight * way)),
            spent[1] / CYCLES,
        )

    def base(self, wave):
        """Return the gait as a plan has it."""
        n = 2 * self.m - 1
        driven = tuple(range(0, n, 2))
        joints = self.robot.joint_names
        return BaseGait(joints, driven, wave.phasors, np.zeros(n), wave.omega)

    def kicks(self, wave, seed):
        """Kick each phase and amplitude, and return the local matrices."""
        m, unit = self.m, np.eye(self.m)
        random = np.random.default_rng(seed)
        off = [np.zeros(m, dtype=complex)] * BASE_RUNS
        off += [
            s * step * unit_vector
            for step in (KICK * 1j, KICK)
            for unit_vector in unit
            for s in (1, -1)
        ]
        off += [1j * random.uniform(-size, size, m) for size in HELD_OUT]
        commands = [wave.phasors * np.exp(change) for change in off]
        runs = self.drive(wave, commands, [[seed, k] for k in range(len(commands))])
        commands = np.array(commands)
        experiment = KickExperiment(
            index=tuple(range(len(runs))),
            runs=sort_kicks(commands),
            names=names(m),
            command=wave.phasors,
            ratio=np.stack([run.response.ratio for run in runs]),
            log_gain_variance=np.stack([run.response.log_gain_variance for run in runs]),
            lag_variance=np.stack([run.response.lag_variance for run in runs]),
            dof=np.stack([run.response.dof for run in runs]),
            labels=tuple(f"run{k}" for k in range(len(runs))),
            frequency_hz=wave.frequency_hz,
        )
        return kick_coupling(experiment, lambda _: None)

    def compensate(self, coupling, wave, seed, rounds=2, keep=KEEP):
        """Return the commands of each round and what was planned for it."""
        rounds_done, after = [], ()
        for k in range(rounds):
            base = self.base(wave)
            plan, commands = compensation(coupling, base, self.robot, after, keep=keep)
            rounds_done.append((plan, commands))
            after = (self.drive(wave, [commands], [[seed, k]])[0].run(),)
        return rounds_done


def _response(angles, command, omega):
    """Fit three harmonics and a line, by least squares over whole cycles."""
    t_s = SETTLE_S + np.arange(len(angles)) / 100
    turn = np.exp(1j * omega * np.outer(t_s, (1, 2, 3)))
    parts = np.column_stack([np.ones(len(t_s)), t_s, turn.imag, turn.real])
    coefficients, *_ = np.linalg.lstsq(parts, angles, rcond=None)
    left = angles - parts @ coefficients
    dof = np.full(angles.shape[1], len(t_s) - parts.shape[1], dtype=float)
    amplitude = coefficients[2] + 1j * coefficients[5]
    variance = 2 * np.sum(left**2, axis=0) / dof / len(t_s) / np.abs(amplitude) ** 2
    return Response(amplitude / command, variance, variance, dof)
