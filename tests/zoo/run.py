"""The fault zoo as a table: ``make zoo``.

Every fault is planted with many seeds into foreign bags; undulog's outputs are judged against the
truth. Prints a table, one line a fault when it is done, below it the seeds that fail with the
outputs.
"""

import argparse
import sys
import tempfile
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby, product
from pathlib import Path

import numpy as np

from .bags import write_bag
from .faults import FAULTS, plant
from .judging import Judgement, judge
from .outputs import OUTPUTS, Statement, detected, statements
from .robot import Robot, draw, record
from .truth import Truth

DETECTION = "detection"
"""The detection of joints that do not follow, by itself, on arrays: fast."""

RIGHT = 0.95
SOUND = 0.05


@dataclass(frozen=True)
class Case:
    """One fault planted with one seed, and the outputs of undulog."""

    fault: str
    seed: int
    robot: Robot
    truth: Truth
    statements: dict[str, Statement]
    judged: dict[str, Judgement]


def robot_for(fault, seed, *, small=False):
    """Return the healthy robot into which a fault is planted; small: few joints and samples."""
    own_seed = seed_of(fault.name, seed)
    rng = np.random.default_rng([own_seed, 4])
    channels = None if fault.channels is None else fault.channels[rng.integers(len(fault.channels))]
    return draw(own_seed, small=small, channels=channels, joints=fault.joints)


def seed_of(name, seed):
    """Return a seed that differs from fault to fault."""
    return seed + zlib.crc32(name.encode())


def run_case(name, seed, *, small=False, outputs=OUTPUTS):
    """Plant a fault, write the bag, run undulog, judge the outputs."""
    fault = FAULTS[name]
    robot = robot_for(fault, seed, small=small)
    own_seed = seed_of(name, seed)
    changes, truth = plant(fault, robot, own_seed)
    log = record(robot, changes, own_seed)
    if outputs == (DETECTION,):  # on arrays, so without a file
        by_output = {DETECTION: detected(log)}
    else:
        with tempfile.TemporaryDirectory() as folder:
            bag = write_bag(log, Path(folder) / "faulty.mcap")
            healthy = None
            if "compare" in outputs:
                healthy = write_bag(
                    record(robot, (), own_seed + 10**6), Path(folder) / "healthy.mcap"
                )
            by_output = statements(bag, healthy, second=robot.channels.second, outputs=outputs)
    judged = {
        output: judge(output, statement, truth, robot) for output, statement in by_output.items()
    }
    return Case(name, seed, robot, truth, by_output, judged)


def _work(name, seed, *, small, outputs):
    try:
        return run_case(name, seed, small=small, outputs=outputs)
    except Exception as error:
        raise RuntimeError(f"{name}, seed {seed}") from error


def run_all(names, seeds, *, small=False, outputs=OUTPUTS, jobs=1):
    """Run every fault with every seed, in order."""
    work = partial(_work, small=small, outputs=outputs)
    pairs = zip(*product(names, seeds), strict=True)
    if jobs == 1:
        yield from map(work, *pairs)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(work, *pairs, chunksize=4)


def header(width, outputs=OUTPUTS):
    """Return the head of the table."""
    return f"{'fault':<{width}}  " + "  ".join(f"{o:>9}" for o in outputs) + "    sound  narrow"


def line(cases, width, outputs=OUTPUTS):
    """Return the table's line of one fault: shares right, and naming a sound joint."""
    shares = [np.mean([case.judged[o].right for case in cases]) for o in outputs]
    sound = np.mean([any(verdict.sound for verdict in case.judged.values()) for case in cases])
    narrow = np.mean([any(verdict.narrow for verdict in case.judged.values()) for case in cases])
    fine = min(shares) >= RIGHT and sound <= SOUND
    row = "  ".join(f"{share:>9.0%}" for share in shares)
    verdict = "" if fine else "FAILS"
    return f"{cases[0].fault:<{width}}  {row}  {sound:>7.0%} {narrow:>7.0%}  {verdict}"


def failures(cases):
    """Yield the failures, case by case."""
    for case in cases:
        for output, verdict in case.judged.items():
            if verdict.missing or verdict.sound:
                why = [
                    *verdict.missing,
                    *(f"names {name}, which is sound" for name in verdict.sound),
                ]
                robot, text = case.robot, case.statements[output].text[:300]
                drawn = f"seed {case.seed} ({robot.m} joints, {robot.channels})"
                yield f"{case.fault!r} {drawn}, {output}: {'; '.join(why)}\n    text: {text!r}"


def main(arguments=None):
    """Run the zoo; return 0 if every fault meets the bar, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100, help="seeds a fault")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--fault", action="append", help="only faults whose name contains this")
    choices = {"default": list(OUTPUTS), "choices": [*OUTPUTS, DETECTION]}
    parser.add_argument("--outputs", nargs="*", **choices)
    parser.add_argument("--small", action="store_true", help="few joints and samples")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--quiet", action="store_true", help="the table only")
    chosen = parser.parse_args(arguments)
    names = [n for n in FAULTS if not chosen.fault or any(part in n for part in chosen.fault)]
    outputs = tuple(chosen.outputs)
    seeds = range(chosen.first, chosen.first + chosen.seeds)
    print(f"fault zoo, seeds {seeds[0]} to {seeds[-1]}", flush=True)
    width = max(map(len, names))
    print(header(width, outputs), flush=True)
    all_fine = True
    runs = run_all(names, seeds, small=chosen.small, outputs=outputs, jobs=chosen.jobs)
    for k, (_, of_one) in enumerate(groupby(runs, lambda case: case.fault)):
        cases = []
        for case in of_one:
            cases.append(case)
            if sys.stderr.isatty():
                done = k * len(seeds) + len(cases)
                print(f"\r{done} of {len(names) * len(seeds)}\r", end="", file=sys.stderr)
        row = line(cases, width, outputs)
        all_fine &= not row.endswith("FAILS")
        print(row, flush=True)
        if not chosen.quiet:
            for failure in failures(cases):
                print(failure, flush=True)
    return int(not all_fine)


if __name__ == "__main__":
    sys.exit(main())
