"""The second power table of docs/explanation/heterogeneity.md: is the right module named?

Every module but the middle one in turn, its servo weakened: by 20, 10 or 5 % in the 25-joint twin
(``weak-servo-pi3`` and its reverse), by 20 % in chains of 13 joints (7 yaw) with gaits, servos and
ground drawn at random. The twin's noise is on the encoders only, so the two runs of a case are made
once, and the noise of 6 + 6 runs is drawn 100 times.

``.venv/bin/python studies/heterogeneity_naming.py`` prints it; it takes a quarter of an
hour of one core. ``--quick``: one module of one chain of 13 joints, only to see that it runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np
from heterogeneity_tables import LEVEL, WAYS, responses, with_weak_servo

from undulog.analysis.experiment.mirror import mirror_test
from undulog.analysis.experiment.reversal import ordered_pairs
from undulog.sim import Wave, load_scenario, parse_scenario
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.twin.recording import record

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support import twin_chains

WEAKENED = (0.2, 0.1, 0.05)
SCATTER = (0.05, 0.1, 0.3)
"""Of a run's lag [degrees], and of its log gain in the same measure."""

SETS = 100


def drawn(seed, folder):
    """Return two scenarios, a wave and its reverse, with a gait, servos and ground of their own."""
    random = np.random.default_rng(seed)
    frequency = random.uniform(0.4, 1.0)
    amplitude, lag = random.uniform(0.25, 0.45), random.uniform(np.pi / 6, np.pi / 2)
    numbers = {"frequency_hz": frequency, "amplitude": amplitude, "lag": lag}
    along, across = random.uniform(0.03, 0.1), random.uniform(0.3, 0.8)
    ground = {"mu_tangential": along, "mu_normal": across}
    text = twin_chains.wave(
        duration_s=10 / frequency,
        settle_s=5 / frequency,
        gait={"ramp_s": 1.0},
        horizontal=numbers,
        world={"ground": ground},
        servo={"stall_torque": random.uniform(0.2, 0.5)},
    )
    (folder / "chain.toml").write_text(twin_chains.chain(13))
    forward = parse_scenario(text, folder / "random.toml")
    plane, wave = next(iter(forward.gait.planes.items()))
    turned = dataclasses.replace(wave, wave=Wave.TAIL_TO_HEAD)
    gait = dataclasses.replace(forward.gait, planes={plane: turned})
    return forward, dataclasses.replace(forward, gait=gait)


def profile(scenario, weak, folder):
    """Return names and responses of the driven joints with one servo weakened by a share."""
    chosen, path = with_weak_servo(scenario, *weak), folder / "run.mcap"
    record(chosen, path, kernels=Kernels.NUMBA, force=True)
    return responses(path)


def cases(ways, weakened, folder, most=None):
    """Every driven module but the middle one: share and rate of being found and named.

    With ``most`` only so many of them.
    """
    names, _ = profile(ways[0], (ways[0].robot.joints[0].name, 0.0), folder)
    middle = names[len(names) // 2] if len(names) % 2 else None
    for share in weakened:
        for name in [name for name in names if name != middle][:most]:
            runs = [profile(way, (name, share), folder)[1] for way in ways]
            for scatter in SCATTER:
                yield name, share, scatter, *rates(names, name, runs, np.radians(scatter))


def rates(names, weak, ways, scatter, *, runs=6, seed=1):
    """Shares of experiments in which a difference is found, and the weak module is named first."""
    random = np.random.default_rng(seed)
    detected = named = 0
    for _ in range(SETS):
        noise = random.normal(0.0, scatter, (2, 2, runs, len(names)))
        test = mirror_test(
            *(y + offset[0] + 1j * offset[1] for y, offset in zip(ways, noise, strict=True))
        )
        first = ordered_pairs(names, test)[:1]
        detected += test.p < LEVEL
        named += bool(first) and first[0].name == weak
    return detected / SETS, named / SETS


def table(title, ways_of, weakened, folder, most=None):
    """Print one row for each weakening and scatter: mean rates, and the worst case."""
    rows = defaultdict(list)
    for label, ways in ways_of:
        for name, share, scatter, detected, named in cases(ways, weakened, folder, most):
            rows[share, scatter].append((named, detected, f"{label} {name}".strip()))
    print(title)
    for (share, scatter), seen in sorted(rows.items(), reverse=True):
        named, detected = (np.mean([case[k] for case in seen]) for k in (0, 1))
        low = min(seen)
        print(
            f"  {100 * share:3.0f} %  {scatter:4.2f}°  {len(seen):3d} cases  "
            f"found {detected:6.1%}  named {named:6.1%}  worst {low[0]:4.0%} ({low[2]})",
            flush=True,
        )


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=16, help="random chains of 13 joints")
    parser.add_argument("--quick", action="store_true", help="one module of one random chain")
    options = parser.parse_args()
    draws, most = (1, 1) if options.quick else (options.draws, None)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if not options.quick:
            long = [("", tuple(load_scenario(way) for way in WAYS))]
            table("25 joints, 12 modules", long, WEAKENED, folder)
        short = ((f"draw {seed}", drawn(seed, folder)) for seed in range(1, draws + 1))
        title = "13 joints, 6 modules, random gaits, servos and ground"
        table(title, short, WEAKENED[:1], folder, most)


if __name__ == "__main__":
    main()
