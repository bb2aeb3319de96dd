"""How often the first sentence is right: thousands of sessions in memory, as a table.

``PYTHONPATH=tests python -m zoo.rates -o FOLDER`` draws healthy robots of every kind, plants every
fault, and gives the recordings of real robots with and without faults to undulog. Each session is a
row of ``FOLDER/rows.jsonl``; a run that was interrupted goes on behind the last row. At the end it
prints a table with a bar for each line: a count within the 99 % limits of the binomial distribution
of the stated share. Seeds are those from ``--first`` on; none is replaced.
"""

import argparse
import json
import sys
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from . import real_faults
from .adapter import Accused, Said, Signals, stated
from .independent_fit import independent_fit, period_of
from .planted import Least
from .planted_faults import FAULTS, KINDS, draw, plant, record
from .rates_table import table
from .recordings import recordings
from .verdicts import Verdict, judged

HEALTHY, RECORDED = "healthy", "recorded"
"""Names of rows without a fault: of a drawn robot, of a recording."""

ROWS = "rows.jsonl"
LONGEST_PERIOD_S = 4.0
"""Period of a recorded motion at most, where an onset is judged [s]: what repeats within a minute
or not at all gives no longer time to find an onset. The recorded gaits have periods up to 4 s."""

SLACK_S = 0.5
"""Difference of the onsets of an accusation with and without a fault, that is the same one [s]."""

PENDING = 4
"""Sessions a process that are handed out ahead: an interrupt loses no more than these."""


@dataclass(frozen=True)
class Task:
    """One session.

    Attributes:
        fault: What is planted, or ``healthy`` or ``recorded``.
        kind: The healthy kind, the recording, or empty where the seed chooses it.
        seed: The seed; of a fault in a recording the joint.
        halves: Least size of the fault in half-widths of the oracle.
        margins: Least size of the fault in margins.
    """

    fault: str
    kind: str
    seed: int
    halves: float = 3.0
    margins: float = 1.0

    @property
    def key(self) -> tuple[str, str, int, float, float]:
        """What tells it from all others."""
        return self.fault, self.kind, self.seed, self.halves, self.margins


KEYS = tuple(field.name for field in fields(Task))
"""Keys of a row that tell its session."""


def run_task(task: Task) -> dict:
    """Return the row of one session; of one that fails the error, which counts as wrong."""
    row = asdict(task)
    try:
        if task.kind in recordings():
            return row | _recorded(task)
        return row | (_healthy(task) if task.fault == HEALTHY else _planted(task))
    except Exception:  # noqa: BLE001  a session that undulog fails on is a result
        return row | {"seen": True, "error": traceback.format_exc(limit=-3), "right": False}


def _times(robot) -> dict[str, float]:
    return {"period_s": robot.motion.period_s, "length_s": float(robot.t_s[-1])}


def _healthy(task: Task) -> dict:
    robot = draw(task.kind, task.seed)
    statement = stated(record(robot, seed=task.seed))
    verdict = judged(statement, robot.names, (), **_times(robot))
    return {
        **_row(statement, verdict),
        "joints": robot.m,
        "differs": robot.differs,
        "unlike": robot.unlike,
        "right": not (verdict.accusations or (verdict.alike and robot.unlike))
        and (robot.differs or not (verdict.differences or verdict.shaped)),
    }


def _planted(task: Task) -> dict:
    only = (task.kind,) if task.kind else ()
    robot, fault = plant(task.fault, task.seed, kinds=only, least=Least(task.halves, task.margins))
    if robot is None or fault is None:
        return {"seen": False}
    statement = stated(record(robot, fault.changes, seed=task.seed))
    verdict = judged(
        statement,
        robot.names,
        fault.joints,
        **_times(robot),
        undecidable=fault.undecidable,
    )
    return {
        **_row(statement, verdict),
        "base": robot.kind,
        "joints": robot.m,
        "planted": [robot.names[joint.joint] for joint in fault.joints],
        "since_s": fault.joints[0].since_s,
        "size": fault.size,
        "half": fault.half,
        "floor": fault.floor,
        "right": verdict.right,
    }


@lru_cache(maxsize=2)
def _recording(name: str) -> tuple[Signals, Said]:
    """Return a recording, and what is stated of it as it is."""
    signals = recordings()[name]()
    return signals, stated(signals)


def _recorded(task: Task) -> dict:
    """Return the row of a recording, as it is or with a fault planted in one of its joints."""
    signals, as_it_is = _recording(task.kind)
    if task.fault == RECORDED:
        statement = as_it_is
        verdict = judged(statement, signals.names, (), period_s=1.0, length_s=1.0)
        refuted = [a.joint for a in statement.accused if _refuted(signals, a)]
        return {**_row(statement, verdict), "refuted": refuted, "right": not verdict.accusations}
    if task.seed not in real_faults.exposed_joints(signals):
        return {"seen": False}
    fault = real_faults.FAULTS[task.fault](signals, task.seed)
    if fault is None:
        return {"seen": False}
    period_s = min(period_of(signals.t_s, signals.commands[:, task.seed]), LONGEST_PERIOD_S)
    statement = stated(real_faults.faulty(signals, fault))
    # What is stated of the recording as it is, is counted there, and is no answer to the fault.
    before = {a.joint for a in as_it_is.accused}
    fresh = tuple(a for a in statement.accused if not any(_same(a, b) for b in as_it_is.accused))
    fresh_statement = replace(statement, accused=fresh)
    length_s = float(signals.t_s[-1] - signals.t_s[0])
    verdict = judged(
        fresh_statement, signals.names, (fault.truth,), period_s=period_s, length_s=length_s
    )
    more = tuple(name for name in verdict.accusations if name not in before)
    return {
        **_row(statement, verdict),
        "planted": [signals.names[task.seed]],
        "since_s": fault.truth.since_s,
        "accusations": more,
        "right": verdict.joint and verdict.kind and not more,
    }


def _same(accused: Accused, before: Accused) -> bool:
    """Whether an accusation is as it was without the fault, within the slack of an onset."""
    apart_s = abs((accused.since_s or 0.0) - (before.since_s or 0.0))
    same = (accused.joint, accused.kinds) == (before.joint, before.kinds)
    return same and apart_s <= SLACK_S


def _refuted(signals: Signals, accused: Accused) -> bool:
    joint = signals.names.index(accused.joint)
    span_s = accused.since_s, accused.until_s
    return independent_fit(*real_faults.columns(signals, joint), span_s).refutes


def _row(statement: Said, verdict: Verdict) -> dict:
    return {
        "seen": True,
        "accusations": verdict.accusations,
        "differences": verdict.differences,
        "shaped": verdict.shaped,
        "alike": verdict.alike,
        "joint": verdict.joint,
        "kind_right": verdict.kind,
        "onset": verdict.onset,
        "silent": verdict.silent,
        "kinds": {a.joint: sorted(a.kinds) for a in statement.accused},
        "sentence": statement.sentence or statement.refused,
    }


def tasks(chosen: argparse.Namespace) -> Iterator[Task]:
    """Yield the sessions of a run, seed by seed, so that an interrupted run has some of all."""
    for name, read in recordings().items() if chosen.recorded is not None else ():
        if chosen.recorded and name not in chosen.recorded:
            continue
        yield Task(RECORDED, name, 0)
        joints = range(len(read().names))
        names = [fault for fault in real_faults.FAULTS if fault in chosen.faults]
        yield from (Task(fault, name, j) for j in joints for fault in names)
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        yield from (Task(HEALTHY, name, seed) for name in chosen.kinds)
        for name in chosen.faults:
            for base in chosen.base or [""]:
                yield Task(name, base, seed, chosen.halves, chosen.margins)


def stored_rows(path: Path) -> list[dict]:
    """Return the rows that are there; one that was cut short is made again."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def run(chosen: argparse.Namespace) -> list[dict]:
    """Run all sessions that have no row yet; return the rows of this run and of those before."""
    path = chosen.output / ROWS
    path.parent.mkdir(parents=True, exist_ok=True)
    planned = list(tasks(chosen))
    rows = {Task(**{key: row[key] for key in KEYS}).key: row for row in stored_rows(path)}
    left = iter([task for task in planned if task.key not in rows])
    if path.exists() and not path.read_bytes().endswith(b"\n"):
        with path.open("a") as file:
            file.write("\n")
    with path.open("a") as file, ProcessPoolExecutor(chosen.jobs) as pool:
        waiting = {
            pool.submit(run_task, task): task for task in islice(left, PENDING * chosen.jobs)
        }
        while waiting:
            done = next(as_completed(waiting))
            task = waiting.pop(done)
            line = json.dumps(done.result(), default=_plain)
            rows[task.key] = json.loads(line)
            file.write(line + "\n")
            file.flush()
            for more in islice(left, 1):
                waiting[pool.submit(run_task, more)] = more
    return [rows[task.key] for task in planned]


def _plain(value):
    """Return a number of NumPy as one that JSON has."""
    return np.asarray(value).tolist()


def parsed(arguments=None) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = {"kinds": list(KINDS), "faults": list(FAULTS)}
    for option, choices in names.items():
        about = f"{option} to draw; all by default, none without a name"
        parser.add_argument(
            f"--{option}", nargs="*", default=choices, choices=choices, help=about, metavar="NAME"
        )
    about = "healthy kinds in which faults are planted, all faults in each; chosen by the seed"
    parser.add_argument("--base", nargs="*", default=[], help=about, choices=list(KINDS))
    parser.add_argument("--seeds", type=int, default=100, help="seeds of each kind and fault")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--halves", type=float, default=3.0, help="least sizes in half-widths")
    about = "recordings of real robots, too; all without a name"
    parser.add_argument("--margins", type=float, default=1.0, help="least sizes in margins")
    parser.add_argument("--recorded", nargs="*", help=about, choices=list(recordings()))
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the rows")
    return parser.parse_args(arguments)


def main(arguments=None) -> int:
    """Run, print the table; return 0 if every bar is met, else 1."""
    chosen = parsed(arguments)
    lines, is_met = table(run(chosen))
    print("\n".join(lines))
    return int(not is_met)


if __name__ == "__main__":
    sys.exit(main())
