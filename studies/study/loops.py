"""A chain's kicks: P and R of its open loop, and what they foretell of its closed loop.

Of n yaw joints in contact (2 n - 1 joints in all) each command's phase is kicked, up and down: that
gives P and R. Generators with feedback from their servos, phi' = omega + eps (2 q/A cos phi - b),
are then kicked on the same body, all phases by a random pattern, and are predicted with nothing
fitted. The average over a cycle (:mod:`undulog.analysis.oscillators.predictions`) leaves out a
ripple of eps/omega of each phase at twice the gait's frequency. With q_i = g_i A sin(phi_i +
Delta_i) turned by P and R at once, and theta_i = 2 phi_i + Delta_i of the generators without a
kick, it is

    d phi_i' = eps g_i ((cos Delta_i + cos theta_i) (P d phi)_i + (sin Delta_i + sin theta_i)
                        (R d phi)_i - (cos Delta_i - cos theta_i) d phi_i) - eps K (L d phi)_i.

All deviations are without their mean: all phases together are a shift of time.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from undulog.analysis.estimators.intervals import NoisyMatrix, noise_draws
from undulog.analysis.experiment.kick_coupling import kick_coupling
from undulog.analysis.experiment.kick_runs import KickExperiment, sort_kicks
from undulog.analysis.oscillators.laplacian import intervals_of, spectrum
from undulog.analysis.oscillators.predictions import (
    explicit_coupling,
    felt_response,
    homogeneous,
    path_laplacian,
    relaxation,
)
from undulog.sim import load_scenario
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.twin.recording import quick_collections
from undulog.sim.twin.twin import Twin

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from support import twin_chains
from support.closed_loop import AGE_S, FREQUENCY_HZ, KICK, LAG, OMEGA, Sines

SETTLE_S, MEASURE_S = 10.0, 6.0
UNTIL_S = 12.0
TICKS = 10
STEP_S = TICKS / 100
KICK_AT_S = 12.1
"""After all times that are predicted, so that no second kick comes."""

DRAWS = 100
RATE = 0.1
"""At which explicit coupling is to bring back every pattern [eps]."""


@dataclass(frozen=True)
class Case:
    """A chain and its gait."""

    n: int
    engine: str = "bullet"
    law: str = "ellipse"
    stall: float = 0.25
    amplitude: float = 0.4


@dataclass(frozen=True)
class Loop:
    """The generators: feedback [1/s], largest kick [rad], explicit coupling K [eps]."""

    eps: float = 0.3
    kick: float = 0.2
    K: float = 0.0
    until_s: float = UNTIL_S


STANDARD = Loop()


def open_loop(case: Case) -> dict:
    """Kick the open loop; return P, R and the response with their errors, and the modes."""
    start = time.monotonic()
    coupling = kick_coupling(_kicked(case), lambda _: None)
    P, R = np.array(coupling.P.value), np.array(coupling.R.value)
    J = np.eye(case.n) + relaxation(*_drawn(_measured(coupling)))
    here, ends = spectrum(J[0]), intervals_of(J[0], J[1:])
    K = [explicit_coupling(matrix, RATE) for matrix in J[:21]]
    return {
        "kind": "P",
        **asdict(case),
        **_measured(coupling),
        "rows_P": float(np.abs(P.sum(axis=1) - 1).max()),
        "rows_R": float(np.abs(R.sum(axis=1)).max()),
        "checks_pass": coupling.checks_pass,
        "curvature": coupling.kick_size.curvature,
        "rates": here.rates.real.tolist(),
        "slowest": here.gap,
        "slowest_low": ends.gap.ci95[0],
        "slowest_high": ends.gap.ci95[1],
        "strong": here.strong,
        "toeplitz_slowest": spectrum(homogeneous(P)).gap,
        "toeplitz_strong": spectrum(homogeneous(P)).strong,
        "explicit": K[0],
        "explicit_low": min(K),
        "explicit_high": max(K),
        "seconds": time.monotonic() - start,
    }


def _kicked(case: Case) -> KickExperiment:
    """Run the gait and each kick of one phase; a run's response is that of its last cycles."""
    n = case.n
    wave = case.amplitude * np.exp(-1j * LAG * np.arange(n))
    off = np.vstack([np.zeros(n), KICK * np.eye(n), -KICK * np.eye(n)])
    commands = wave * np.exp(1j * off)
    scenario = _scenario(case, SETTLE_S + MEASURE_S, "serpentine", {})
    fits = [_fit(_run(scenario, Sines(command))[0]) for command in commands]
    response, variance = (np.array(part) for part in zip(*fits, strict=True))
    return KickExperiment(
        index=tuple(range(len(off))),
        runs=sort_kicks(commands),
        names=tuple(f"joint{2 * k + 1:02d}" for k in range(n)),
        command=wave,
        ratio=response / commands,
        log_gain_variance=variance,
        lag_variance=variance,
        dof=np.full(off.shape, round(MEASURE_S * 100) - 8.0),
        labels=tuple(f"run{k:03d}" for k in range(len(off))),
        frequency_hz=FREQUENCY_HZ,
    )


def _run(scenario, gait=None) -> tuple[np.ndarray, np.ndarray]:
    """Return the yaw joints' angles at each tick, and the oscillators' phases, shape (k, n)."""
    angles, values = [], []
    with quick_collections(), Twin(scenario, gait, kernels=Kernels.NUMBA) as twin:
        names = twin.gait.names
        for sample in twin.samples():
            angles.append(sample.step.body.angle[::2].copy())
            values.append(sample.gait.values)
    phases = [k for k, name in enumerate(names) if re.fullmatch(r"joint\d+\.phase", name)]
    return np.array(angles), np.unwrap(np.array(values)[:, phases], axis=0)


def _fit(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the complex amplitudes of whole cycles, and the variance of their logarithms."""
    t_s = np.arange(len(angles)) / 100
    used = t_s >= SETTLE_S
    turn = np.exp(1j * OMEGA * np.outer(t_s[used], (1, 2, 3)))
    parts = np.column_stack([np.ones(used.sum()), t_s[used], turn.imag, turn.real])
    coefficients, *_ = np.linalg.lstsq(parts, angles[used], rcond=None)
    noise = np.var(angles[used] - parts @ coefficients, axis=0)
    response = coefficients[2] + 1j * coefficients[5]
    return response, 2 * noise / used.sum() / np.abs(response) ** 2


def _measured(coupling) -> dict:
    """Return what the prediction needs, as lists."""
    base, scatter = coupling.base, coupling.scatter
    return {
        "P": coupling.P.value,
        "P_error": coupling.P.standard_error,
        "R": coupling.R.value,
        "R_error": coupling.R.standard_error,
        "gain": base.gain,
        "gain_error": base.gain_error,
        "lag": base.lag_rad,
        "lag_error": base.lag_error,
        "correlation": scatter.correlation,
        "dof": scatter.dof,
    }


def _drawn(identified: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return P, R and g exp(j Delta), then draws of them within their errors."""
    P, R, P_error, R_error, correlation = (
        np.array([list(row) for row in identified[key]])
        for key in ("P", "R", "P_error", "R_error", "correlation")
    )
    felt, n = _felt(identified), len(P)
    log_error = np.array(identified["gain_error"]) / np.array(identified["gain"])
    # The response to the gait is one more column: errors of one run, shared as those of the kicks.
    own_error = np.concatenate([identified["lag_error"], log_error])
    error = np.column_stack([np.vstack([P_error, R_error]), own_error])
    dof = np.full_like(error, float(identified["dof"]))
    drawn = noise_draws(NoisyMatrix(np.zeros_like(error), error, dof, correlation), 61)
    drawn = np.concatenate([np.zeros((1, *error.shape)), drawn[:DRAWS]])
    turned = felt * np.exp(drawn[:, n:, n] + 1j * drawn[:, :n, n])
    return P + drawn[:, :n, :n], R + drawn[:, n:, :n], turned


def _felt(identified: dict) -> np.ndarray:
    ratio = np.array(identified["gain"]) * np.exp(-1j * np.array(identified["lag"]))
    return felt_response(ratio, OMEGA, AGE_S)


def closed_loop(case: Case, loop: Loop, identified: dict, patterns: int) -> list[dict]:
    """Kick generators with feedback, and compare with what P and R foretell."""
    P, R, felt = _drawn(identified)
    links = loop.K * path_laplacian(case.n)
    J = loop.eps * (relaxation(P[0], R[0], felt[0]) - links)
    free = _phases(case, loop, identified, 0)
    rows = []
    for seed in range(1, patterns + 1):
        kicked = _phases(case, loop, identified, seed)
        off = (kicked - free)[::TICKS]
        size = np.linalg.norm(_spread(off[0]))

        def share(deviation: np.ndarray, size=size) -> np.ndarray:
            return np.linalg.norm(_spread(deviation), axis=-1) / size

        foretold = _foretold((P, R, felt), loop, free, off[0])
        error = share(foretold - off[:, None])
        low, high = np.quantile(error[-1, 1:], (0.025, 0.975))
        like = (homogeneous(P[0])[None], R[:1], felt[:1])
        like = _foretold(like, loop, free, off[0])[:, 0]
        over_time = {
            "error": error[:, 0],
            "averaged": share(_averaged(J, off) - off),
            "still": share(off - off[0]),
            "toeplitz": share(like - off),
            "left": share(off),
            "foretold": share(foretold[:, 0]),
        }
        rows.append(
            {"kind": "kick", **asdict(case), **asdict(loop), "pattern": seed}
            | {"kick_rms_rad": size / case.n**0.5, "error_low": low, "error_high": high}
            | {name: course[-1] for name, course in over_time.items()}
            | {f"{name}_most": course.max() for name, course in over_time.items()}
            | {f"{name}_t": course.tolist() for name, course in over_time.items()}
            | {"t_s": (np.arange(len(off)) * STEP_S).tolist()}
        )
    return rows


def _foretold(drawn: tuple, loop: Loop, free: np.ndarray, kick: np.ndarray) -> np.ndarray:
    """Integrate the equation above for each draw of P, R and g exp(j Delta); steps of STEP_S.

    Args:
        drawn: P and R, shape (draws, n, n), and g exp(j Delta), shape (draws, n).
        free: Phases without a kick, at each tick [rad], shape (k, n).
        kick: [rad], shape (n,).

    Returns:
        Shape (times, draws, n).
    """
    P, R, felt = drawn
    gain, lag = np.abs(felt), np.angle(felt)
    links = loop.K * path_laplacian(len(kick))

    def rate(off: np.ndarray, tick: int) -> np.ndarray:
        theta = 2 * free[tick] + lag
        turned, grown = ((matrix @ off[..., None])[..., 0] for matrix in (P, R))
        driven = (np.cos(lag) + np.cos(theta)) * turned + (np.sin(lag) + np.sin(theta)) * grown
        return loop.eps * (gain * (driven - (np.cos(lag) - np.cos(theta)) * off) - off @ links)

    off = np.repeat(kick[None], len(P), axis=0)
    trajectory, h = [off], STEP_S
    for tick in range(0, len(free) - TICKS, TICKS):
        k1 = rate(off, tick)
        k2 = rate(off + h / 2 * k1, tick + TICKS // 2)
        k3 = rate(off + h / 2 * k2, tick + TICKS // 2)
        k4 = rate(off + h * k3, tick + TICKS)
        off = off + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        trajectory.append(off)
    return np.array(trajectory)


def _averaged(J: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return exp(J t) off(0) at the times of the observed phases."""
    step = expm(J * STEP_S)
    trajectory = [off[0]]
    for _ in off[1:]:
        trajectory.append(step @ trajectory[-1])
    return np.array(trajectory)


def _spread(off: np.ndarray) -> np.ndarray:
    return off - off.mean(axis=-1, keepdims=True)


def _phases(case: Case, loop: Loop, identified: dict, seed: int) -> np.ndarray:
    """Return phases at each tick from the kick on; no kick if the seed is 0."""
    at_s = max(KICK_AT_S, loop.until_s + 2 * STEP_S)
    chain = {
        "forward": loop.eps * loop.K,
        "backward": loop.eps * loop.K,
        "feedback": loop.eps,
        "feedback_bias": _felt(identified).imag.tolist(),
    }
    if seed:
        chain |= {"kick_every_s": at_s, "kick_size": loop.kick, "kick_seed": seed}
    scenario = _scenario(case, at_s + loop.until_s + STEP_S, "oscillators", chain)
    _, phases = _run(scenario)
    first = round(at_s * 100)
    return phases[first : first + round(loop.until_s * 100) + 1]


def _scenario(case: Case, duration_s: float, kind: str, chain: dict):
    wave = {"amplitude": case.amplitude, "frequency_hz": FREQUENCY_HZ, "lag": LAG, **chain}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = twin_chains.chain(2 * case.n - 1, stall_torque=case.stall)
        (folder / "chain.toml").write_text(robot)
        text = twin_chains.wave(
            duration_s=duration_s,
            settle_s=SETTLE_S,
            engine=case.engine,
            gait={"kind": kind},
            horizontal=wave,
            world={"ground": {"law": case.law}},
        )
        (folder / "scenario.toml").write_text(text)
        return load_scenario(folder / "scenario.toml")
