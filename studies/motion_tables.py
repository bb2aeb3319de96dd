"""The table of docs/explanation/method.md on motion without commands, of the twin.

``nice .venv/bin/python studies/motion_tables.py`` prints it as Markdown; it takes some minutes of
CPU.

The twin runs each gait once. Its true joint angles, without the commands, are read at the times of
another log (each joint's own, jittered, at another rate) and get noise: as often as there are
draws. The truth is what the same analysis gives for the twin's own samples without noise. A second
table has windows of longer runs against what all of these runs together have.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support import twin_chains
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.oscillation import fit_motion
from undulog.analysis.parts.free_motion.measure import free_motion
from undulog.analysis.response.fitting import fit_gait
from undulog.sim import load_scenario, run_batch

JOINTS = 9
FREQUENCY_HZ = 1.0
SETTLE_S = 8.0
CYCLES = (6, 20, 60)
NOISE = 0.01
"""White noise of the angles [rad]."""

RATE_HZ, JITTER, LATE_S = 63.0, 0.4, 0.9 / 63.0
"""Of the other log: samples a second, spread of their times in periods, first to last joint."""

HARMONICS = 3

UNDULATION = {"amplitude": 0.35, "frequency_hz": FREQUENCY_HZ, "lag": math.pi / 3}
LIFTING = {"amplitude": 0.15, "frequency_hz": FREQUENCY_HZ, "lag": math.pi / 3, "phase": 1.2}
GAITS = {
    "wave on the ground": ({}, {"horizontal": UNDULATION}),
    "wave that lifts the body": ({}, {"horizontal": UNDULATION, "gait": {"vertical": LIFTING}}),
    "weak servos": ({"stall_torque": 0.25}, {"horizontal": UNDULATION}),
}
"""Servo and gait."""

QUANTITIES = ("frequency", "lags", "wave numbers")


@dataclass(frozen=True)
class Motion:
    """One run of the twin.

    Attributes:
        t_s: Times of its samples [s], shape (n,).
        angles: Of the joints that are driven [rad], shape (n, m).
    """

    robot: object
    names: tuple[str, ...]
    t_s: np.ndarray
    angles: np.ndarray


@dataclass(frozen=True)
class Coverage:
    """Of one motion and length.

    Attributes:
        inside: Share of the draws whose interval holds the truth, by quantity.
        width: Median width over that of the bound, by quantity.
    """

    inside: dict[str, float]
    width: dict[str, float]


def twin_motions(servo, tables, cycles, runs=1):
    """Run the twin, each run from another phase of the gait."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wave.toml"
        (path.parent / "chain.toml").write_text(twin_chains.chain(JOINTS, **servo))
        duration_s = SETTLE_S + (cycles + 1) / FREQUENCY_HZ
        path.write_text(twin_chains.wave(duration_s=duration_s, settle_s=SETTLE_S, **tables))
        scenario = load_scenario(path)
    scenarios = []
    for k in range(runs):
        planes = {
            plane: replace(wave, phase=wave.phase + 2 * math.pi * k / runs)
            for plane, wave in scenario.gait.planes.items()
        }
        scenarios.append(replace(scenario, gait=replace(scenario.gait, planes=planes)))
    robot = scenario.robot
    driven = [k for k, joint in enumerate(robot.joints) if joint.plane in scenario.gait.planes]
    names = tuple(robot.joint_names[k] for k in driven)
    motions = []
    for run in run_batch(scenarios):
        if run.error is not None:
            raise run.error
        motions.append(Motion(robot, names, run.time_s, run.angle[:, driven]))
    return motions


def foreign(motion, cycles, random, noise):
    """Return the angles as another log has them, by joint."""
    path = CubicSpline(motion.t_s, motion.angles)
    start, stop = SETTLE_S, SETTLE_S + cycles / FREQUENCY_HZ
    late = np.linspace(0.0, LATE_S, len(motion.names))
    series = {}
    for k, name in enumerate(motion.names):
        count = round((stop - start) * RATE_HZ)
        t = (
            start
            + late[k]
            + (np.arange(count) + JITTER * random.uniform(-0.5, 0.5, count)) / RATE_HZ
        )
        values = path(t)[:, k] + noise * random.standard_normal(count)
        series[name] = Series(name, t - start, values)
    return series


def measure(robot, series, seconds):
    """Return values and intervals of all quantities."""

    def refuse(text):
        raise AssertionError(text)

    gait = fit_gait({}, series, seconds, refuse)
    motion, _ = free_motion(robot, fit_motion(series, gait))
    half = t_factor(gait.omega_dof) * gait.omega_error
    omega = gait.fit.omega
    lags = [joint.lag_rad for joint in motion.joints if joint.lag_rad.value is not None]
    waves = [wave.wave_number for wave in motion.waves]
    return {
        "frequency": [(omega, (omega - half, omega + half))],
        "lags": [(lag.value, lag.ci95) for lag in lags],
        "wave numbers": [(wave.value, wave.ci95) for wave in waves],
    }


def truth(motion, cycles):
    """Return the values of the twin's own samples without noise."""
    at = (motion.t_s >= SETTLE_S) & (motion.t_s < SETTLE_S + cycles / FREQUENCY_HZ)
    t = motion.t_s[at] - SETTLE_S
    series = {
        name: Series(name, t, np.ascontiguousarray(motion.angles[at, k]))
        for k, name in enumerate(motion.names)
    }
    measured = measure(motion.robot, series, cycles / FREQUENCY_HZ)
    return {name: np.array([value for value, _ in parts]) for name, parts in measured.items()}


def bound(motion, cycles, noise):
    """Return the Cramer-Rao bound of each standard error, all harmonics and offsets unknown."""
    series = foreign(motion, cycles, np.random.default_rng(0), 0.0)
    omega = truth(motion, cycles)["frequency"][0]
    order = np.arange(1, HARMONICS + 1)
    sizes, inverses, turns, information = [], [], [], 0.0
    for signal in series.values():
        turning = np.exp(1j * omega * np.outer(signal.t_s, order))
        columns = np.hstack([np.ones((signal.count, 1)), turning.real, -turning.imag])
        fitted = np.linalg.lstsq(columns, signal.values, rcond=None)[0]
        amplitudes = fitted[1 : 1 + HARMONICS] + 1j * fitted[1 + HARMONICS :]
        by_omega = signal.t_s * np.real(turning @ (1j * order * amplitudes))
        inverse = np.linalg.inv(columns.T @ columns)
        drift = -inverse @ (columns.T @ by_omega)
        information += by_omega @ (by_omega + columns @ drift)
        real, imaginary = 1, 1 + HARMONICS
        sizes.append(amplitudes[0])
        inverses.append(inverse[np.ix_([real, imaginary], [real, imaginary])])
        turns.append(drift[[real, imaginary]])
    turn = np.concatenate(turns)
    covariance = np.outer(turn, turn) / information
    for k, inverse in enumerate(inverses):
        covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += inverse
    lags, waves = (
        np.sqrt(np.einsum("pi,ij,pj->p", slope, covariance, slope))
        for slope in _slopes(motion, np.array(sizes))
    )
    return {
        "frequency": noise * np.array([information**-0.5]),
        "lags": noise * lags,
        "wave numbers": noise * waves,
    }


def _slopes(motion, amplitudes):
    """Return the derivatives of lags and of wave numbers by Re a and Im a, joint after joint."""
    step = 1e-6
    slopes = []
    for k in range(amplitudes.size):
        for way in (1.0, 1j):
            off = np.zeros_like(amplitudes)
            off[k] = step * way
            ends = [_lags_and_waves(motion, amplitudes + sign * off) for sign in (1, -1)]
            slopes.append([(up - down) / (2 * step) for up, down in zip(*ends, strict=True)])
    return [np.stack([row[part] for row in slopes], axis=1) for part in (0, 1)]


def _lags_and_waves(motion, amplitudes):
    """Return lags, in the order of the joints, and the wave number of each plane."""
    planes = np.array([joint.plane for joint in motion.robot.joints])
    of = planes[[motion.robot.joint_names.index(name) for name in motion.names]]
    lags, waves = np.full(amplitudes.size, np.nan), []
    for plane in dict.fromkeys(of.tolist()):
        rows = np.flatnonzero(of == plane)
        phase = np.unwrap(np.angle(amplitudes[rows]))
        lags[rows[1:]] = -np.diff(phase)
        slope = np.polyfit(np.arange(rows.size), phase, 1, w=np.abs(amplitudes[rows]))[0]
        waves.append(-slope)
    return lags[np.isfinite(lags)], np.array(waves)


def coverage(motion, cycles, draws, *, noise=NOISE, seed=1):
    """Judge the intervals of many draws of the noise."""
    random = np.random.default_rng([cycles, seed])
    expected, least = truth(motion, cycles), bound(motion, cycles, noise)
    inside = {name: [] for name in QUANTITIES}
    width = {name: [] for name in QUANTITIES}
    for _ in range(draws):
        series = foreign(motion, cycles, random, noise)
        measured = measure(motion.robot, series, cycles / FREQUENCY_HZ)
        for name in QUANTITIES:
            ends = np.array([ends for _, ends in measured[name]])
            inside[name].append((ends[:, 0] <= expected[name]) & (expected[name] <= ends[:, 1]))
            width[name].append((ends[:, 1] - ends[:, 0]) / (2 * 1.96 * least[name]))
    return Coverage(
        {name: float(np.mean(parts)) for name, parts in inside.items()},
        {name: float(np.median(parts, axis=0).max()) for name, parts in width.items()},
    )


def lasting(motions, whole, cycles):
    """Return the shares of windows whose intervals hold the values of all runs together."""
    random = np.random.default_rng(cycles)
    expected = [truth(motion, whole) for motion in motions]
    inside = {name: [] for name in QUANTITIES}
    for motion in motions:
        for first in range(0, whole - cycles + 1, cycles):
            part = replace(motion, t_s=motion.t_s - first / FREQUENCY_HZ)
            measured = measure(
                part.robot, foreign(part, cycles, random, NOISE), cycles / FREQUENCY_HZ
            )
            for name in QUANTITIES:
                value = np.mean([motion_values[name] for motion_values in expected], axis=0)
                ends = np.array([ends for _, ends in measured[name]])
                inside[name].append((ends[:, 0] <= value) & (value <= ends[:, 1]))
    return {name: float(np.mean(parts)) for name, parts in inside.items()}


def main():
    """Print the table; with ``--quick`` of few draws."""
    quick = "--quick" in sys.argv
    draws, lengths = (10, CYCLES[:1]) if quick else (200, CYCLES)
    print(
        "| gait | cycles | " + " | ".join(f"{quantity} | width" for quantity in QUANTITIES) + " |"
    )
    print("|---" * 8 + "|")
    for name, (servo, tables) in GAITS.items():
        (motion,) = twin_motions(servo, tables, max(lengths))
        for cycles in lengths:
            result = coverage(motion, cycles, draws)
            cells = " | ".join(
                f"{100 * result.inside[quantity]:.1f} % | {result.width[quantity]:.2f}"
                for quantity in QUANTITIES
            )
            print(f"| {name} | {cycles} | {cells} |", flush=True)
    runs, whole = (2, 18) if quick else (8, 390)
    name = "wave that lifts the body"
    print(f"\n{name}, windows of {runs} runs of {whole} cycles\n")
    print(f"| cycles | {' | '.join(QUANTITIES)} |")
    print("|---" * 4 + "|")
    motions = twin_motions(*GAITS[name], whole, runs)
    for cycles in lengths:
        result = lasting(motions, whole, cycles)
        print(
            f"| {cycles} | {' | '.join(f'{result[quantity]:.0%}' for quantity in QUANTITIES)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
