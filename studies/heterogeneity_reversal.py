"""Level and power of the reversal test on a tilted floor, for docs/explanation/heterogeneity.md.

Profiles without noise come from the 25-joint twin (``weak-servo-pi3``): identical modules on a
floor tilted by 0, 0.3, 1 and 2 degrees along the body and across it, and each yaw module in turn
20 % weaker and stronger. Experiments are drawn on these profiles.

The robot is its own mirror image, so the reversed wave is the wave read from tail to head on a
floor that falls the other way along the body. That relation gives the reversed wave of single
modules; it is checked on runs, and the runs of identical modules and of joint05 need it not.

``.venv/bin/python studies/heterogeneity_reversal.py`` prints the tables; ``--profiles FOLDER``
keeps the profiles.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from undulog.analysis.estimators.series import Series
from undulog.analysis.experiment.mirror import mirror_test
from undulog.analysis.experiment.reversal import SIGNIFICANT, ordered_pairs, tilt_check
from undulog.analysis.response.fitting import fit_gait
from undulog.sim import load_scenario, run_batch

TILTS_DEG = (0.3, 1.0, 2.0)
DIRECTIONS = {"fore-aft": 0.0, "sideways": math.pi / 2}
SHARE = 0.2
YAW = tuple(f"joint{k:02d}" for k in range(1, 26, 2))
MIDDLE = YAW[len(YAW) // 2]


@dataclass(frozen=True)
class Case:
    """One run of the twin.

    Attributes:
        tilt_deg: Of the floor [degrees].
        direction: Where it falls to, a key of ``DIRECTIONS``.
        heading_deg: Of the robot at the start, 0 or 180 [degrees].
        joint: The module that differs; empty: none.
        share: By how much its stall torque does.
        reverse: Whether the wave runs from tail to head.
    """

    tilt_deg: float = 0.0
    direction: str = "fore-aft"
    heading_deg: int = 0
    joint: str = ""
    share: float = 0.0
    reverse: bool = False

    @property
    def file(self) -> str:
        """Return name of the file that keeps its profile."""
        way = "reverse" if self.reverse else "forward"
        module = f"{self.joint}{self.share:+g}" if self.joint else "identical"
        return f"{way}-{self.tilt_deg:g}-{self.direction}-{self.heading_deg}-{module}.npy"


def profile(case, folder):
    """ln(response/command) of the yaw joints without noise, kept or from a run, shape (13,)."""
    kept = folder / case.file
    if kept.exists():
        return np.load(kept)
    changes = {"world.heading": math.radians(case.heading_deg)}
    if case.tilt_deg:
        changes["world.slope"] = math.radians(case.tilt_deg)
        changes["world.slope_heading"] = DIRECTIONS[case.direction]
    if case.joint:
        changes[f"servo_of.{case.joint}.stall_torque"] = 0.25 * (1 + case.share)
    scenario = load_scenario("weak-servo-pi3" + ("-reverse" if case.reverse else ""), changes)
    (run,) = run_batch([scenario])
    if run.error is not None:
        raise run.error
    settled = run.time_s >= scenario.settle_s
    t_s = run.time_s[settled]
    commands, angles = (
        {
            name: Series(name, t_s, np.ascontiguousarray(column[settled]))
            for name, column in zip(scenario.robot.joint_names, table.T, strict=True)
            if name in YAW
        }
        for table in (run.command, run.angle)
    )
    gait = fit_gait(commands, angles, float(np.ptp(t_s)), lambda _: None)
    if gait is None or gait.answered != YAW:
        raise RuntimeError(f"{case}: not all joints have gain and lag")
    y = np.log(gait.response.ratio)
    np.save(kept, y)
    return y


def is_run(case):
    """Whether the reversed wave of a case is simulated rather than taken from the relation."""
    return not case.joint or (case.joint == "joint05" and case.share < 0)


def other_way(case, folder):
    """Return the profile of the reversed wave, joints from head to tail."""
    return profile(replace(case, reverse=True), folder) if is_run(case) else mirrored(case, folder)


def mirrored(case, folder):
    """Return the profile of the reversed wave by the relation, joints from head to tail."""
    falls_along = case.tilt_deg and case.direction == "fore-aft"
    heading = 180 - case.heading_deg if falls_along else case.heading_deg
    mirror = YAW[-1 - YAW.index(case.joint)] if case.joint else ""
    return profile(replace(case, heading_deg=heading, joint=mirror), folder)[::-1]


def text(rates, count):
    """Return counts of experiments as percentages."""
    return "  ".join(f"{100 * part / count:5.1f}" for part in rates)


def experiments(case, folder, *, balanced, count, scatter, seed):
    """Draw experiments of 6 + 6 runs on a case.

    Args:
        case: The floor and the module; its heading is that of the runs with one heading.
        folder: Folder of the kept profiles.
        balanced: Whether half of the runs of each direction are turned.
        count: Experiments.
        scatter: Standard deviation of a run's log gain, and of its lag [rad].
        seed: Seed of the scatter.

    Returns:
        Counts, shape (4,): identical modules are rejected; a pair is stated; it is named (stated
        without 'or the floor is tilted'); the right one is first and in the right order.
    """
    random = np.random.default_rng(seed)
    headings = (0, 180) if balanced and case.tilt_deg else (0, 0)
    ways = [
        np.stack([simulate(replace(case, heading_deg=heading), folder) for heading in headings])
        for simulate in (profile, other_way)
    ]
    # The wave at one heading is the mirror image of its reverse at the other.
    strata = (np.repeat([0, 1], 3), np.repeat([1, 0], 3)) if balanced else None
    first = None
    if case.joint:
        pair = (case.joint, YAW[-1 - YAW.index(case.joint)])
        first = pair if case.share < 0 else pair[::-1]
    rates = np.zeros(4)
    for _ in range(count):
        noise = random.normal(0.0, scatter, (2, 2, 6, len(YAW)))
        runs = [
            np.repeat(y, 3, axis=0) + z[0] + 1j * z[1] for y, z in zip(ways, noise, strict=True)
        ]
        test = mirror_test(*runs, strata)
        rates[0] += test.p < SIGNIFICANT
        if pairs := ordered_pairs(YAW, test):
            named = balanced or tilt_check(*runs, test).excluded
            rates[1:] += 1, named, (pairs[0].name, pairs[0].mirror) == first
    return rates


def check_relation(folder, tilts, directions):
    """Print how far runs of the reversed wave are from the relation."""
    checked = [Case(), Case(joint="joint05", share=-SHARE)]
    for direction in directions:
        for heading in (0, 180):
            checked += [Case(tilt, direction, heading) for tilt in tilts]
            checked.append(Case(2.0, direction, heading, "joint05", -SHARE))
    worst = max(np.abs(other_way(case, folder) - mirrored(case, folder)).max() for case in checked)
    print(
        f"{len(checked)} runs of the reversed wave against the relation: at most "
        f"{math.degrees(worst):.4f} degrees"
    )


def check_cancelling(folder, tilts, directions):
    """Print what a floor leaves of d with one heading and with both, identical modules."""
    print(f"{'floor':22}|d| in degrees: one heading, balanced; common/contrast, one heading")
    for tilt in tilts:
        for direction in directions:
            plus = [profile(Case(tilt, direction, heading), folder) for heading in (0, 180)]
            minus = [
                other_way(Case(tilt, direction, heading), folder)[::-1] for heading in (0, 180)
            ]
            single, both = plus[0] - minus[0], (plus[0] + plus[1] - minus[0] - minus[1]) / 2
            ratio = np.linalg.norm(single + single[::-1]) / np.linalg.norm(single - single[::-1])
            size = [math.degrees(np.abs(d).max()) for d in (single, both)]
            print(f"  {tilt:3.1f} {direction:9s} {size[0]:16.3f} {size[1]:10.4f} {ratio:10.2f}")


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profiles", type=Path, help="folder that keeps the twin's profiles")
    parser.add_argument("--count", type=int, default=500, help="experiments a row")
    parser.add_argument("--scatter", type=float, default=0.1, help="of a run [degrees]")
    parser.add_argument("--quick", action="store_true", help="one floor, one module, five draws")
    chosen = parser.parse_args()
    count, scatter = 5 if chosen.quick else chosen.count, math.radians(chosen.scatter)
    tilts = TILTS_DEG[-1:] if chosen.quick else TILTS_DEG
    directions = tuple(DIRECTIONS)[:1] if chosen.quick else tuple(DIRECTIONS)
    modules = ("joint05",) if chosen.quick else tuple(name for name in YAW if name != MIDDLE)
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.profiles or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        check_relation(folder, tilts, directions)
        check_cancelling(folder, tilts, directions)
        print(f"{count} experiments of 6 + 6 runs a row, scatter {chosen.scatter:g} degrees")
        print("                                        rejected stated named right, in %")
        floors = [(0.0, "fore-aft"), *((t, d) for t in tilts for d in directions)]
        plans = {"one heading": False, "balanced": True}
        drawn = partial(experiments, folder=folder, count=count, scatter=scatter)
        for plan, balanced in plans.items():
            for seed, (tilt, direction) in enumerate(floors):
                rates = drawn(Case(tilt, direction), balanced=balanced, seed=seed)
                print(f"  identical {plan:11s} {tilt:3.1f} {direction:9s}  {text(rates, count)}")
        for plan, balanced in plans.items():
            for tilt, direction, share in (
                (0.0, "fore-aft", -SHARE),
                (0.0, "fore-aft", SHARE),
                *((2.0, direction, -SHARE) for direction in directions),
            ):
                rows = {}
                for joint in modules:
                    case = Case(tilt, direction, joint=joint, share=share)
                    rows[joint] = drawn(case, balanced=balanced, seed=YAW.index(joint))
                hardest = min(rows, key=lambda joint: rows[joint][-1])
                title = f"{100 * share:+.0f} % {plan:11s} {tilt:3.1f} {direction:9s}"
                mean = np.mean(list(rows.values()), axis=0)
                print(f"  {title} joint05       {text(rows['joint05'], count)}")
                print(f"  {title} mean of {len(rows):2d}    {text(mean, count)}")
                print(f"  {title} worst {hardest} {text(rows[hardest], count)}", flush=True)


if __name__ == "__main__":
    main()
