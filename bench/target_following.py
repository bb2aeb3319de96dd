"""Target following against the random walk, on seeds that no parameter was tuned on.

Both controllers cross the same yard: ten cylinders at places drawn with the seed, a target 3.6 m
away. A run ends when the middle of the head is within the target's radius, without notice to the
controller, or at the limit; then time and energy of the walk are lower bounds, and so are the
ratios. Ratios are paired by seed: random walk over target following. Their medians' intervals are
those of the sign test, which needs no assumption on how they are spread.

Seeds 1 to 16 served for tuning. Results are kept in the output file as they come, and runs that it
holds already are not repeated.

Run: python bench/target_following.py [--seeds 101-130] [--jobs 2] [--walk-limit 60] [-o FILE.json]
"""

from __future__ import annotations

import json
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from measuring import arguments
from records import verdict
from scipy.stats import binom

from undulog.sim import load_scenario
from undulog.sim.gait.contract import CONTROL_RATE_HZ
from undulog.sim.physics.ledger import TERMS
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.twin.twin import Twin

FOLLOW, WALK = "target-following", "random-walk"
UNTUNED = range(101, 131)


def run(name: str, seed: int, limit_s: float, kernels: str = "numpy") -> dict[str, Any]:
    """Run one scenario until the target is met, or to the limit."""
    whole = load_scenario(name).changed(seed=seed)
    scenario = whole.changed(duration_s=limit_s)
    target = scenario.world.target
    assert target is not None
    path_m, touched, link_s, before = 0.0, 0, 0.0, np.zeros(2)
    met = False
    with Twin(scenario, kernels=Kernels(kernels)) as twin:
        for sample in twin.samples():
            place = sample.step.body.position[:2, 0]
            path_m += math.dist(place, before)
            before = place.copy()
            touched += sample.contact_s.sum() > link_s
            link_s = float(sample.contact_s.sum())
            met = math.dist(place, target.position) <= target.radius
            if met:
                break
    energy = dict(zip(TERMS, sample.energy.tolist(), strict=True))
    return {
        "controller": name,
        "seed": seed,
        "limit_s": limit_s,
        "kernels": kernels,
        "session_id": whole.session_id,
        "met": met,
        "time_s": sample.time_s,
        "path_m": path_m,
        "electrical_j": energy["electrical_plus"],
        "electrical_net_j": energy["electrical_net"],
        "contact_s": touched / CONTROL_RATE_HZ,
        "contact_link_s": link_s,
    }


def median_interval(values: list[float], level: float = 0.95) -> tuple[float, float, float]:
    """Return the median and the ends of its interval by the sign test, from order statistics.

    The interval is the whole range where there are too few values for the level.
    """
    ordered = sorted(values)
    k = max(int(binom.ppf((1 - level) / 2, len(ordered), 0.5)), 1)  # P(X < k) <= (1 - level) / 2
    return float(np.median(ordered)), ordered[k - 1], ordered[-k]


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """What the runs say, seed by seed."""
    names = (FOLLOW, WALK)
    by = {name: {r["seed"]: r for r in results if r["controller"] == name} for name in names}
    seeds = sorted(by[FOLLOW].keys() & by[WALK].keys())
    runs = {name: pd.DataFrame([by[name][seed] for seed in seeds]) for name in names}
    result: dict[str, Any] = {"seeds": seeds}
    for name, table in runs.items():
        keys = ("time_s", "electrical_j", "contact_s", "path_m")
        result[name] = {"met": int(table["met"].sum())}
        result[name] |= {key: median_interval(table[key].tolist()) for key in keys}
    for key in ("time_s", "electrical_j"):
        result[f"{key}_ratio"] = median_interval((runs[WALK][key] / runs[FOLLOW][key]).tolist())
    result["contact_share"] = {
        name: float(sum(run_table["contact_s"]) / sum(run_table["time_s"]))
        for name, run_table in runs.items()
    }
    return result


def text(result: dict[str, Any], limits_s: dict[str, float]) -> str:
    """Return the answer, then the table."""
    n = len(result["seeds"])
    faster, less = result["time_s_ratio"], result["electrical_j_ratio"]
    censored = n - result[WALK]["met"]
    answer = (
        f"target following met the target in {result[FOLLOW]['met']} of {n} runs, "
        f"{faster[0]:.1f} times as fast as the random walk (95 % interval {faster[1]:.1f} to "
        f"{faster[2]:.1f}), for 1/{less[0]:.1f} of its electrical energy (1/{less[1]:.1f} to "
        f"1/{less[2]:.1f}): medians of paired ratios"
    )
    heads = [f"{head:>22}" for head in ("time s", "electrical J", "contact s")]
    lines = [answer, f"{'':18} {'met':>7} {' '.join(heads)} {'share in contact':>17}"]
    for name in (FOLLOW, WALK):
        row = result[name]
        cells = [
            f"{row[key][0]:8.1f} ({row[key][1]:.1f} to {row[key][2]:.1f})".rjust(22)
            for key in ("time_s", "electrical_j", "contact_s")
        ]
        share = f"{100 * result['contact_share'][name]:.1f} %"
        lines.append(f"{name:18} {row['met']:3}/{n:3} {' '.join(cells)} {share:>17}")
    lines.append(
        f"medians with 95 % intervals of the sign test, over {n} seeds; {censored} random walks "
        f"ended at their limit of {limits_s[WALK]:g} s and count with what they had used by then, "
        f"so the ratios are lower bounds there; target following may take {limits_s[FOLLOW]:g} s"
    )
    return "\n".join(lines)


def study(
    seeds: list[int], limits_s: dict[str, float], jobs: int, kernels: str, output: Path | None
) -> list[dict[str, Any]]:
    """Run what the output file does not hold yet, keeping it up to date."""
    stored = output is not None and output.exists()
    results = json.loads(output.read_text())["runs"] if stored else []
    cases = [(name, seed) for name in limits_s for seed in seeds]
    ids = {(name, seed): load_scenario(name).changed(seed=seed).session_id for name, seed in cases}
    results = [
        r
        for r in results
        if ids.get((r["controller"], r["seed"])) == r["session_id"]
        and (r["met"] or r["limit_s"] >= limits_s[r["controller"]])
    ]
    held = {(r["controller"], r["seed"]) for r in results}
    left = [case for case in cases if case not in held]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        runs = [pool.submit(run, name, seed, limits_s[name], kernels) for name, seed in left]
        for done in as_completed(runs):
            results.append(done.result())
            if output is not None:
                output.parent.mkdir(parents=True, exist_ok=True)
                output.write_text(json.dumps({"runs": results}, indent=1) + "\n")
    return results


def main() -> None:
    """Run, print, keep."""
    parser = arguments(__doc__, jobs=2, follow_limit=90.0, walk_limit=60.0)
    parser.add_argument("--seeds", default=f"{UNTUNED.start}-{UNTUNED.stop - 1}", help="FIRST-LAST")
    parser.add_argument("--kernels", choices=list(Kernels), default=Kernels.NUMPY)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/target_following.json"))
    options = parser.parse_args()
    first, _, last = options.seeds.partition("-")
    seeds = list(range(int(first), int(last or first) + 1))
    limits_s = {FOLLOW: options.follow_limit, WALK: options.walk_limit}
    results = study(seeds, limits_s, options.jobs, options.kernels, options.output)
    result = summary(results)
    kept = {"summary": result, "runs": sorted(results, key=lambda r: (r["controller"], r["seed"]))}
    options.output.write_text(json.dumps(kept, indent=1) + "\n")
    print(text(result, limits_s))
    met, (ratio, low, high) = result[FOLLOW]["met"] / len(seeds), result["time_s_ratio"]
    verdict("target following: targets met", 100 * met, 90, "%", most=False)
    what = f"target following: random walk's time over its own ({low:.3g} to {high:.3g})"
    verdict(what, ratio, None, "times", peer="random walk")
    print(f"{options.output} has every run")


if __name__ == "__main__":
    main()
