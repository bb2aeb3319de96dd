"""The table of docs/explanation/method.md on ground contact, of the twin, which knows it.

``nice .venv/bin/python studies/contact_tables.py [SEED ...]`` prints it as Markdown; a seed takes
half a minute of CPU. The scales of ``analysis/parts/ground_contact/measure.py`` were chosen by
seed 1, so it is none of those that are tried by default.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.ground_contact.measure import PHASES, TOUCHES, cycle_loads
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.sim import load_scenario, run_batch

LIFTING = (
    "sidewinding",
    "twist",
    "vertical",
    "caterpillar",
    "combined",
    "snake13-vertical-pi2",
    "snake13-vertical-pi3",
)
FLAT = ("flat", "rolling")
"""Gaits in which all links are on the ground all the time."""

SETTLE_S, CYCLES = 8.0, 3
RUNS = 3
"""Of each gait and seed."""

NOISE = 0.02
"""White noise of a torque's samples [N m]; of current, it is that over the torque constant."""


def varied(name, random):
    """Return a shipped scenario with another amplitude, lag and frequency, and the frequency."""
    scenario = load_scenario(name)
    amplitude, lag, speed = random.uniform([0.8, 0.9, 0.8], [1.2, 1.1, 1.2]).tolist()
    planes = {
        plane: replace(
            wave,
            amplitude=min(amplitude * wave.amplitude, 0.52),
            lag=lag * wave.lag,
            frequency_hz=speed * wave.frequency_hz,
        )
        for plane, wave in scenario.gait.planes.items()
    }
    frequency = next(iter(planes.values())).frequency_hz
    duration_s = round(SETTLE_S + (CYCLES + 0.2) / frequency, 2)
    return replace(
        scenario, gait=replace(scenario.gait, planes=planes), duration_s=duration_s
    ), frequency


def judged(scenario, frequency, random):
    """Return the true contact of links in parts of cycles, and that from effort and current."""
    (run,) = run_batch([scenario])
    if run.error is not None:
        raise run.error
    robot, t_s = scenario.robot, run.time_s
    turn = rotation_from_quaternion(run.head_quaternion)
    centres, _ = link_poses(robot, run.head, turn, run.angle)
    touching = centres[..., 2] < [link.radius for link in robot.links]
    factor = [joint.servo.torque_constant for joint in robot.joints]
    angles, up = (_series(t_s, values) for values in (run.angle, turn[:, 2]))
    truth, estimated = [], []
    for k in range(CYCLES):
        edges = SETTLE_S + np.linspace(k, k + 1, PHASES + 1) / frequency
        part = np.digitize(t_s, edges) - 1
        truth.append([touching[part == p].mean(axis=0) > 0.5 for p in range(PHASES)])
        loads = []
        for torque in (run.effort, factor * run.current):
            noisy = torque + NOISE * random.standard_normal(torque.shape)
            loads.append(cycle_loads(robot, angles, _series(t_s, noisy), up, edges)[0] >= TOUCHES)
        estimated.append(loads)
    return np.array(truth), np.moveaxis(np.array(estimated), 1, 0)


def _series(t_s, columns):
    return [Series(str(k), t_s, np.ascontiguousarray(values)) for k, values in enumerate(columns.T)]


def balanced(estimated, truth):
    """Return the mean of the shares of contacts and of lifted links that are recognised."""
    return (estimated[truth].mean() + (~estimated[~truth]).mean()) / 2


def accuracy(name, seeds, runs):
    """Return the true share of contact, and how often effort and current are right."""
    parts = []
    for seed in seeds:
        random = np.random.default_rng([seed, *name.encode()])
        for _ in range(runs):
            truth, estimated = judged(*varied(name, random), random)
            right = [
                claim[truth].mean() if truth.all() else balanced(claim, truth)
                for claim in estimated
            ]
            parts.append([truth.mean(), *right])
    return np.mean(parts, axis=0)


def main():
    """Print the table; with ``--quick`` of two gaits, one run each."""
    quick = "--quick" in sys.argv
    seeds = [int(word) for word in sys.argv[1:] if word.isdigit()] or [2, 3]
    print("| gait | on the ground | right by effort | by current |")
    print("|---" * 4 + "|")
    tried = (seeds[:1], 1) if quick else (seeds, RUNS)
    for name in ("caterpillar", "flat") if quick else (*LIFTING, *FLAT):
        share, effort, current = accuracy(name, *tried)
        print(f"| {name} | {share:.0%} | {effort:.0%} | {current:.0%} |", flush=True)


if __name__ == "__main__":
    main()
