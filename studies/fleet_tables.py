"""The table of docs/how-to/catalog.md on fleets without changes, and on changes that are found.

``.venv/bin/python studies/fleet_tables.py`` prints it as Markdown: 400 fleets a row, an hour of one
core; ``--fleets 50`` for fewer, ``--quick`` for 5.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np

from undulog.analysis.catalog.change_points import DepartureKind, find_change_points
from undulog.analysis.catalog.session_noise import relative_to_others

JOINTS, DAY_S = 8, 86_400.0


@dataclass(frozen=True)
class Case:
    """A kind of fleet: gain, lag and energy of the joints of one robot over its sessions.

    Attributes:
        rho: Lag-one correlation from session to session.
        sessions: Fewest and most.
        scatter: Of a joint from session to session, of the gain [1] and of the lag [rad]; three
            times that of the energy.
        steps: Changes of the gain of one joint, evenly spread over the sessions.
        within: Share of the sessions by which they are earlier or later, at most.
        freedom: Of Student's t, of what is new in each session; None for normal.
        wild: Scatter of the first joint over that of the others.
        missing: Share of values that are.
        joints: Of the robot.
    """

    name: str
    rho: float = 0.3
    sessions: tuple[int, int] = (20, 60)
    scatter: float = 0.01
    steps: tuple[float, ...] = ()
    within: float = 0.05
    freedom: float | None = None
    wild: float = 1.0
    missing: float = 0.0
    joints: int = JOINTS


NULLS = (
    *(Case(f"rho {rho}", rho) for rho in (0.0, 0.3, 0.6, 0.9)),
    Case("one joint with 4 times the scatter", wild=4.0),
    Case("15 % of the values missing", missing=0.15),
    Case("Student's t with 3 degrees of freedom", freedom=3.0),
    Case("3 joints", joints=3),
)
STEPS = (
    Case("5 %, scatter 1 %, 20 sessions", sessions=(20, 20), steps=(-0.05,)),
    Case("5 %, scatter 2 %, 60 sessions", sessions=(60, 60), scatter=0.02, steps=(-0.05,)),
    Case("5 %, in the middle half, 20 sessions", sessions=(20, 20), steps=(-0.05,), within=0.25),
    Case("-6 and +4 %, scatter 1 %, 40 sessions", sessions=(40, 40), steps=(-0.06, 0.04)),
)


def noise(rng: np.random.Generator, shape: tuple[int, int], case: Case) -> np.ndarray:
    """Return AR(1) noise of variance 1 along the first axis, in units of the scatter if normal."""
    new = rng.normal(size=shape) if case.freedom is None else rng.standard_t(case.freedom, shape)
    values = new.copy()
    for k in range(1, shape[0]):
        values[k] = case.rho * values[k - 1] + np.sqrt(1 - case.rho**2) * new[k]
    return values


def fleet(case: Case, seed: int) -> tuple[list[np.ndarray], list[int], int]:
    """Draw a fleet.

    Returns:
        Ln gain, lag [rad] and ln energy, each of shape (n_sessions, n_joints); the sessions from
        which the gain of a joint changes, and the joint.
    """
    rng = np.random.default_rng([seed, *case.name.encode()])
    shape = int(rng.integers(case.sessions[0], case.sessions[1] + 1)), case.joints
    series: list[np.ndarray] = []
    for size in (1.0, 1.0, 3.0):
        scatter = np.full(case.joints, size * case.scatter)
        scatter[0] *= case.wild
        common = 3 * size * case.scatter * noise(rng, (shape[0], 1), case)
        values = 0.05 * rng.normal(size=case.joints) + common + scatter * noise(rng, shape, case)
        values[rng.random(shape) < case.missing] = np.nan
        series.append(values)
    n, joint, count = shape[0], int(rng.integers(case.joints)), len(case.steps)
    off = rng.uniform(-case.within, case.within, count)
    starts = [round(n * (k / (count + 1) + off[k - 1])) for k in range(1, count + 1)]
    for start, step in zip(starts, case.steps, strict=True):
        series[0][start:, joint] += np.log1p(step)
    return series, starts, joint


def judge(case: Case, seed: int) -> dict[str, bool]:
    """Return what is claimed of a fleet, and whether each change is found, with its interval."""
    series, starts, joint = fleet(case, seed)
    n = len(series[0])
    nothing = np.zeros(n, np.int64)
    relative = [relative_to_others(values, nothing) for values in series]
    judged = find_change_points(relative, DAY_S * np.arange(n, dtype=np.float64), nothing)
    points = [(k, point) for k, quantity in enumerate(judged) for point in quantity.points]
    changes = [(k, point) for k, point in points if point.kind is not DepartureKind.OUTLIER]
    mine = [point for k, point in changes if (k, point.joint) == (0, joint)]
    near = [min(mine, key=lambda p: abs(p.session - start), default=None) for start in starts]
    truths = [*zip(near, starts, np.log1p(case.steps), strict=True)]
    detected = bool(starts) and len(mine) >= len(starts)
    return {
        "any": bool(points),
        "change": bool(changes),
        "outlier": len(changes) < len(points),
        "false": any(k != 0 or point.joint != joint for k, point in points),
        "found": detected,
        "dated": detected and all(p is not None and p.first <= s <= p.last for p, s, _ in truths),
        "sized": detected
        and all(p is not None and p.change_ci95[0] <= d <= p.change_ci95[1] for p, _, d in truths),
    }


def count(case: Case, fleets: int, workers: int = 1) -> dict[str, int]:
    """Return in how many fleets :func:`judge` says so."""
    if workers == 1:
        results = [judge(case, seed) for seed in range(fleets)]
    else:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            results = list(pool.map(partial(judge, case), range(fleets), chunksize=4))
    return {key: sum(result[key] for result in results) for key in results[0]}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=400)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    fleets = 5 if given.quick else given.fleets
    print(f"| {fleets} fleets without changes | change or outlier | change | outlier |")
    print("|---|--:|--:|--:|")
    for case in NULLS:
        of = count(case, fleets, given.workers)
        print(f"| {case.name} | {of['any']} | {of['change']} | {of['outlier']} |", flush=True)
    print(f"\n| {fleets} fleets with a change | found | dated | sized | another |")
    print("|---|--:|--:|--:|--:|")
    for case in STEPS:
        of = count(case, fleets, given.workers)
        numbers = " | ".join(str(of[key]) for key in ("found", "dated", "sized", "false"))
        print(f"| {case.name} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
