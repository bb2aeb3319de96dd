"""The figures of docs/explanation/heterogeneity.md: level and power of the reversal test.

``.venv/bin/python studies/heterogeneity_tables.py`` prints them; it takes about two minutes, most
of it for eight runs of the 25-joint twin. With ``--quick`` few draws and one weakened servo, only
to see that it runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from undulog.analysis import analyse_session
from undulog.analysis.experiment.mirror import Strata, family_wise_p, mirror_test, parts
from undulog.analysis.experiment.reversal import ordered_pairs
from undulog.capture import Session
from undulog.sim import load_scenario
from undulog.sim.scenario.scenario import Kernels, Modules
from undulog.sim.twin.recording import record

LEVEL = 0.05
WAYS = ("weak-servo-pi3", "weak-servo-pi3-reverse")
WEAK = "joint05"


def boundary_pattern(joints):
    """Response of identical modules that lag more in the middle, and not mirror-symmetric."""
    place = np.linspace(0.0, 1.0, joints)
    lag = np.radians(7.5 + 6.2 * np.sin(np.pi * place) + 3.0 * place)
    return (1.07 - 0.14 * np.sin(np.pi * place)) * np.exp(-1j * lag)


def sensed(random, ratio, *, sets, runs, ar=0.0, sigma=0.01, noisy=None):
    """Return ln(response/command) of runs with noise on the encoders, shape (sets, runs, m).

    The fit is over four cycles of 10 samples.

    Args:
        random: Generator.
        ratio: Response over command without noise, shape (m,).
        sets: Experiments.
        runs: Runs of each experiment.
        ar: Coefficient of the noise's autoregression; 0 is white.
        sigma: Standard deviation of the noise [rad]; the commands' amplitude is 0.4 rad.
        noisy: Index of a joint whose noise is three times as large.
    """
    wave = np.exp(-2j * np.pi * 4 * np.arange(40) / 40)
    noise = random.normal(size=(sets, runs, ratio.size, 40 + 40))
    if ar:
        noise = lfilter([(1 - ar**2) ** 0.5], [1.0, -ar], noise)
    noise = sigma * noise[..., 40:]  # the filter has settled
    if noisy is not None:
        noise[:, :, noisy] *= 3
    return np.log(ratio + 2 / 40 * (noise @ wave) / 0.4)


def false_positives(joints, *, runs=6, sets=5000, seed=1, **noise):
    """Return share of experiments with identical modules in which a difference is claimed."""
    random = np.random.default_rng(seed)
    forward = boundary_pattern(joints)
    first = np.zeros(runs, dtype=np.int64)
    design = Strata.of(first, first)
    labels = design.labellings()
    claimed = 0
    for _ in range(sets // 100):
        first = sensed(random, forward, sets=100, runs=runs, **noise)
        other = sensed(random, forward[::-1], sets=100, runs=runs, **noise)
        claimed += np.count_nonzero(_p(first, other, design, labels) < LEVEL)
    return claimed / sets


def _p(forward, reverse, design, labels):
    """Return the family-wise p of each of many experiments, shape (sets,)."""
    both = np.concatenate([forward, reverse[..., ::-1]], axis=1)
    half = both.shape[-1] // 2
    odd, even = (both - both[..., ::-1]) / 2, (both + both[..., ::-1]) / 2
    columns = odd[..., :half], even[..., : both.shape[-1] - half]
    runs = np.concatenate([parts(column) for column in columns], axis=-1)
    return family_wise_p(np.abs(design.scores(runs, labels))).min(axis=-1)


def twin_profile(scenario, weakened, folder, kernels):
    """Return the responses of the 25-joint twin's yaw joints, one servo weakened by a share."""
    path = Path(folder) / f"{scenario}-{weakened:g}.mcap"
    record(with_weak_servo(load_scenario(scenario), WEAK, weakened), path, kernels=kernels)
    return responses(path)


def with_weak_servo(scenario, joint, share):
    """Return a scenario in which the servo of a joint is weakened by a share."""
    servo = scenario.modules.servo
    modules = Modules(servo, {joint: {"stall_torque": servo["stall_torque"] * (1 - share)}})
    return dataclasses.replace(scenario, modules=modules, robot=modules.fitted(scenario.robot))


def responses(path):
    """Return the names of a session's driven joints, and ln(response/command), shape (m,)."""
    with Session.open(path) as session:
        joints = [
            joint for joint in analyse_session(session).joints if joint.gain.value is not None
        ]
    y = [np.log(joint.gain.value) - 1j * joint.lag_rad.value for joint in joints]
    return [joint.name for joint in joints], np.array(y)


def power(names, forward, reverse, scatter, *, runs=6, sets=500, seed=1):
    """Share of experiments in which a difference is found, and in which the right joint is named.

    Args:
        names: Joints.
        forward: y without noise, shape (m,).
        reverse: The same the other way.
        scatter: Standard deviation of a run's log gain, and of its lag [rad].
        runs: Runs each way.
        sets: Experiments.
        seed: Of the noise.

    Returns:
        The two shares.
    """
    random = np.random.default_rng(seed)
    detected = named = 0
    for _ in range(sets):
        draw = random.normal(0.0, scatter, (2, 2, runs, len(names)))
        noise = draw[0] + 1j * draw[1]
        test = mirror_test(forward + noise[0], reverse + noise[1])
        pairs = ordered_pairs(names, test)
        detected += test.p < LEVEL
        named += bool(pairs) and pairs[0].name == WEAK
    return detected / sets, named / sets


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few draws, one weakened servo")
    quick = parser.parse_args().quick
    sets = 100 if quick else 5000
    print(f"false positives at 5 %, 13 identical joints, {sets} experiments each")
    for label, noise in (
        ("white noise", {}),
        ("AR(0.9) noise", {"ar": 0.9}),
        ("white, one joint three times as noisy", {"noisy": 2}),
    ):
        print(f"  {label}: {100 * false_positives(13, sets=sets, **noise):.1f} %")
    print(f"{WEAK} weakened; scatter of a run; difference found; {WEAK} named")
    with tempfile.TemporaryDirectory() as folder:
        for weakened in (0.2,) if quick else (0.0, 0.05, 0.1, 0.2):
            kernels = Kernels.NUMBA if quick else Kernels.NUMPY
            (names, forward), (_, reverse) = (
                twin_profile(way, weakened, folder, kernels) for way in WAYS
            )
            for scatter in (0.05, 0.1, 0.3, 1.0):
                detected, named = power(
                    names, forward, reverse, np.radians(scatter), sets=20 if quick else 500
                )
                print(f"  {100 * weakened:3.0f} %  {scatter:4.2f}°  {detected:6.1%}  {named:6.1%}")


if __name__ == "__main__":
    main()
