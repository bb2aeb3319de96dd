"""Generators that feel their servos on a chain in contact, and what open-loop kicks foretell.

Yaw joints with a pitch joint between each two, on the ground. Once each joint is commanded its
sine, and the phases are turned one by one: that gives P and R. Then phase oscillators with feedback
from their servos and no other coupling drive the same chain, and are kicked.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from support import twin_chains
from support.analysed import experiment as together
from undulog.analysis.oscillators.predictions import felt_response, relaxation
from undulog.analysis.parts.oscillators.weak_form import read_phases
from undulog.capture import Session
from undulog.sim import GaitTick, load_scenario
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.twin.recording import Driver, record

AMPLITUDE, FREQUENCY_HZ, LAG = 0.4, 0.5, math.pi / 3
OMEGA = 2.0 * math.pi * FREQUENCY_HZ
SETTLE_S, MEASURE_S = 10.0, 10.0
KICK = 0.05
"""Of one command's phase, open loop [rad]."""

EPS = 0.3
"""Of the feedback [1/s]."""

KICK_AT_S, LARGEST = 12.0, 0.2
"""When all oscillators are turned, and by how much at most [rad]."""

AGE_S = 0.025
"""Of an angle on average when it is used: at a tick that of two control periods before is known,
and it is used for one."""


class Sines:
    """An open-loop gait of the yaw joints, given by its phasors."""

    names = ()

    def __init__(self, phasors, omega=OMEGA):
        """Take the phasors of the yaw joints' commands [rad], and their rate [rad/s]."""
        self._phasors, self._omega = phasors, omega

    def step(self, time_s, readings):
        """Return the command by the phasors, growing from zero over 2 s."""
        x = min(time_s / 2.0, 1.0)
        wave = x * x * (3.0 - 2.0 * x) * np.imag(np.exp(1j * self._omega * time_s) * self._phasors)
        command = np.zeros(2 * wave.size - 1)
        command[::2] = wave
        return GaitTick(command, np.empty(0), "walk", ())


@dataclass(frozen=True)
class Relaxation:
    """Phases of m oscillators after a kick, and those predicted by P and R, at k times.

    Attributes:
        t_s: After the kick [s], shape (k,).
        off: Phases against the run without a kick [rad], shape (k, m).
        predicted: Shape (k, m).
    """

    t_s: np.ndarray
    off: np.ndarray
    predicted: np.ndarray

    @property
    def moved(self):
        """Return the distance from the kicked phases, in shares of the kick, shape (k,)."""
        return _share(self.off - self.off[0], self.off[0])

    @property
    def error(self):
        """Return the error of the prediction, in shares of the kick, shape (k,)."""
        return _share(self.off - self.predicted, self.off[0])


def write_chain(folder, m, stall):
    """Write the robot with m yaw joints, for the runs in a folder."""
    (folder / "chain.toml").write_text(twin_chains.chain(2 * m - 1, stall_torque=stall))


def open_loop(folder, m, held_out=()):
    """Run and analyse the experiment of kicks around the gait.

    Args:
        folder: Has the robot.
        m: Yaw joints.
        held_out: Largest phase of each random pattern that is to be predicted [rad].
    """
    scenario = _scenario(folder / "open.toml", SETTLE_S + MEASURE_S)
    base = AMPLITUDE * np.exp(-1j * LAG * np.arange(m))
    paths = []
    for label, off in _deviations(m, held_out):
        paths.append(folder / f"{label}.mcap")
        driver = Driver(Sines(base * np.exp(1j * off)), {"driven.by": label}, {})
        record(scenario, paths[-1], driver=driver, kernels=Kernels.NUMBA)

    return together(paths)


def base_response(experiment):
    """Return the yaw joints' response to the gait: gain exp(-j lag), shape (m,)."""
    yaw = [joint for joint in experiment.sessions[0].joints if joint.gain.value is not None]
    return np.array([joint.gain.value * np.exp(-1j * joint.lag_rad.value) for joint in yaw])


def closed_loop(folder, coupling, ratio):
    """Run kicked generators, and predict them from the open loop without a fitted parameter.

    Args:
        folder: Has the robot.
        coupling: Of the kicks: P and R.
        ratio: The response to the gait: gain exp(-j lag), shape (m,).
    """
    P, R = (np.array(estimate.value) for estimate in (coupling.P, coupling.R))
    felt = felt_response(ratio, OMEGA, AGE_S)
    kicked = _phases(folder, "kicked", felt.imag, kick_every_s=KICK_AT_S, kick_size=LARGEST)
    off = kicked - _phases(folder, "free", felt.imag)
    t_s = np.arange(len(off)) * 0.1
    J = EPS * relaxation(P, R, felt)
    return Relaxation(t_s, off, np.array([expm(J * t) @ off[0] for t in t_s]))


def _deviations(m, held_out):
    """Of the commands' phases: none, each up and down, and random ones of all."""
    random = np.random.default_rng(1)
    yield "base", np.zeros(m)
    for joint in range(m):
        for sign in (1.0, -1.0):
            off = np.zeros(m)
            off[joint] = sign * KICK
            yield f"kick{joint:02d}{'+' if sign > 0 else '-'}", off
    for size in held_out:
        yield f"held-out-{size:g}", random.uniform(-size, size, m)


def _phases(folder, label, bias, **kicks):
    """Return phases of generators with feedback, ten a second from the kick on."""
    alone = {"forward": 0.0, "backward": 0.0}
    feedback = {"feedback": EPS, "feedback_bias": bias.tolist()}
    scenario = _scenario(
        folder / f"{label}.toml", 2 * KICK_AT_S, "oscillators", **alone, **feedback, **kicks
    )
    record(scenario, folder / f"{label}.mcap", kernels=Kernels.NUMBA)
    with Session.open(folder / f"{label}.mcap") as session:
        (log,) = read_phases(session)
    return log.phases[round(KICK_AT_S / log.period_s) : -1 : round(0.1 / log.period_s)]


def _scenario(path, duration_s, kind="serpentine", **chain):
    wave = {"amplitude": AMPLITUDE, "frequency_hz": FREQUENCY_HZ, "lag": LAG, **chain}
    text = twin_chains.wave(
        duration_s=duration_s, settle_s=SETTLE_S, gait={"kind": kind}, horizontal=wave
    )
    path.write_text(text)
    return load_scenario(path)


def _share(off, kick):
    return np.linalg.norm(off, axis=1) / np.linalg.norm(kick)
