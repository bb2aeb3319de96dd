"""The fault campaign: ``make campaign``.

Every part runs cases from seeds and judges them from outside: by the kernel's account of processor
time, memory and signals, by the bytes on the terminal, by mcap's own reader, by senders with their
own sequence numbers and by a listener on the bus. Prints a line for each case, with its seed; a run
that was interrupted goes on where it was.
"""

import argparse
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from . import (
    contention,
    conversions,
    disks,
    gate,
    hostile,
    injection,
    interruptions,
    interruptions_drive,
    kills,
    line_recorder,
    marks,
    results,
    servers,
    texts,
)
from .case import Result
from .fuzz import kind_of, minimise, run_seed
from .stage import Stage

STEP = 1_000_000
"""Seeds of one campaign: from its seed times this."""


@dataclass(frozen=True)
class Part:
    """One kind of attack.

    Attributes:
        run: Makes and runs the case of a seed.
        long: Cases of the long form.
        short: Cases of the form for continuous integration.
        alone: Whether nothing else may run meanwhile.
    """

    run: Callable[[int, Stage], Result]
    long: int
    short: int
    alone: bool = False


def mutated(seed, stage, part="mutated"):
    """Run a command on a mutated file; minimise and store one failure of each kind."""
    with stage.fresh() as folder:
        result, case = run_seed(seed, stage.bases, folder, part)
    for kind in dict.fromkeys(map(kind_of, result.failures)):
        name = "".join(c if c.isalnum() else "-" for c in f"{case.words[0]} {kind}")[:120]
        if stage.failing is not None and not (stage.failing / f"{name}.json").exists():
            stage.keep(name, case)  # at once, so that no other worker minimises the same
            stage.keep(name, minimise(case, kind, stage.bases, stage.fresh))
    return result


PARTS = {
    "contention": Part(contention.run, 6, 1, alone=True),
    "gate": Part(gate.run, 40, 1, alone=True),
    "interruptions": Part(interruptions.run, 60, 1),
    "interruptions_drive": Part(interruptions_drive.run, 40, 1, alone=True),
    "servers": Part(servers.run, 60, 3),
    "hostile": Part(hostile.run, 11 * hostile.COUNT, hostile.COUNT),
    "injection": Part(injection.run, 400, 6),
    "disks": Part(disks.run, 400, 5),
    "conversions": Part(conversions.run, 100, 2),
    "kills": Part(kills.run, 1_000, 4),
    "recorder": Part(kills.run_recorder, 50, 2),
    "results": Part(results.run, 250, 4),
    "marks": Part(marks.run, 100, 2),
    "line_recorder": Part(line_recorder.run, 20, 1),
    "texts": Part(texts.run, 250, 4),
    "tables": Part(partial(mutated, part="tables"), 1_500, 5),
    "arrays": Part(partial(mutated, part="arrays"), 600, 5),
    "datasets": Part(partial(mutated, part="datasets"), 500, 5),
    "bags": Part(partial(mutated, part="bags"), 500, 5),
    "binary": Part(partial(mutated, part="binary"), 4_500, 5),
    "serial": Part(partial(mutated, part="serial"), 1_000, 5),
    "mutated": Part(mutated, 38_294, 12),
}
LONG = sum(part.long for part in PARTS.values())

_stage = None


def _work(part, seed):
    assert _stage is not None
    began = time.monotonic()
    try:
        result = PARTS[part].run(seed, _stage)
    except Exception as error:  # noqa: BLE001 - a case that can't be judged is a failure, too
        result = Result("", [f"campaign: {type(error).__name__}: {error}"])
    return part, seed, result, time.monotonic() - began


def plan(names, seed, cases, *, short):
    """Return every case as (part, seed), those that need the machine alone first.

    Args:
        cases: In all, shared among the parts as in the long form; None for that form.
        short: The form for continuous integration.
    """
    jobs = []
    whole = sum(PARTS[name].long for name in names)
    for name in sorted(names, key=lambda part: not PARTS[part].alone):
        part = PARTS[name]
        count = part.short if short else part.long
        if cases is not None:
            count = max(1, round(cases * part.long / whole))
        jobs += [(name, seed * STEP + number) for number in range(count)]
    return jobs


def run_all(jobs, workers):
    """Run cases: parts that need the machine alone one by one, then the others side by side."""
    for job in jobs:
        if PARTS[job[0]].alone:
            yield _work(*job)
    beside = [job for job in jobs if not PARTS[job[0]].alone]
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        for start in range(0, len(beside), 2000):
            waiting = [pool.submit(_work, *job) for job in beside[start : start + 2000]]
            for finished in waiting:
                yield finished.result()


class Records:
    """The results of a campaign, a line of JSON each, in a file that a later run continues."""

    def __init__(self, path):
        """Read what is there."""
        self.path, self.rows = path, []
        if path.exists():
            text = path.read_text()
            whole = text[: text.rfind("\n") + 1]
            self.rows = [json.loads(line) for line in whole.splitlines()]
            if whole != text:
                path.write_text(whole)

    def add(self, row):
        """Append a line."""
        self.rows.append(row)
        with self.path.open("a") as stream:
            stream.write(json.dumps(row) + "\n")

    @property
    def cases(self):
        """All but the first line, which has the seed."""
        return self.rows[1:]


def summary(records):
    """Return a table by part, then the failures by kind with a seed each."""
    lines = [
        "| part | cases | failed | skipped | most processor time [s] | most memory [MiB] | other |",
        "|---|---|---|---|---|---|---|",
    ]
    for part in dict.fromkeys(row["part"] for row in records.cases):
        part_rows = [row for row in records.cases if row["part"] == part]
        figures = defaultdict(list)
        for row in part_rows:
            for name, value in row["figures"].items():
                figures[name].append(value)
        most = {name: max(values) for name, values in figures.items()}
        other = ", ".join(
            f"{name} {sum(values) if name.startswith('n_') else most[name]:g}"
            for name, values in figures.items()
            if name not in {"cpu_s", "peak_mib"}
        )
        failed = sum(bool(row["failures"]) for row in part_rows)
        skipped = sum(bool(row["skipped"]) for row in part_rows)
        lines.append(
            f"| {part} | {len(part_rows)} | {failed} | {skipped} | {most.get('cpu_s', 0):.1f} "
            f"| {most.get('peak_mib', 0):.0f} | {other} |"
        )
    kinds = defaultdict(list)
    for row in records.cases:
        for failure in row["failures"]:
            kind = f"{' '.join(row['case'].split()[:2])}: {kind_of(failure)}"
            kinds[row["part"], kind].append((row["seed"], row["case"], failure))
    lines.append("")
    for (part, kind), cases in sorted(kinds.items(), key=lambda item: -len(item[1])):
        seed, case, failure = cases[0]
        lines.append(f"{len(cases):5} x {part}: {kind}\n        {part}:{seed} `{case}`: {failure}")
    reasons = Counter(row["skipped"] for row in records.cases if row["skipped"])
    lines += [f"skipped {count} x: {why}" for why, count in reasons.items()]
    return lines


def main():
    """Run the command line; return 1 where a case failed."""
    parser = argparse.ArgumentParser(prog="campaign", description=__doc__)
    parser.add_argument("--seed", type=int, help="of the campaign; a new one by default")
    parser.add_argument("--cases", type=int, help=f"in all; {LONG} by default")
    parser.add_argument("--short", action="store_true", help="the form for continuous integration")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--case", metavar="PART:SEED", help="one case again, with its output")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("-o", "--output", type=Path, default=Path("out/campaign"))
    options = parser.parse_args()
    # Ignored by the caller (nohup, a job in the background), it would be ignored by every case.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="cmp", ignore_cleanup_errors=True) as name:
        return _run(options, Path(name))


def _run(options, folder):
    global _stage  # noqa: PLW0603 - the workers are forked with it
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    os.environ.setdefault("NO_COLOR", "1")  # as the front door does before anything is imported
    _stage = Stage(folder, options.output / "failing")
    for failure in _stage.warm_failures:
        print(f"warm-up: {failure}", flush=True)
    if options.case:
        part, seed = options.case.split(":")
        *_, result, took_s = _work(part, int(seed))
        print(json.dumps(asdict(result), indent=1), f"{took_s:.1f} s")
        return int(bool(result.failures))
    records = Records(options.output / "results.jsonl")
    if not records.rows:
        seed = int(time.time()) % 10**9 if options.seed is None else options.seed
        records.add({"seed": seed, "short": options.short})
    seed = records.rows[0]["seed"]
    jobs = plan(options.parts, seed, options.cases, short=options.short)
    done = {(row["part"], row["seed"]) for row in records.cases}
    left = [job for job in jobs if job not in done]
    print(f"campaign {seed}: {len(jobs)} cases, {len(jobs) - len(left)} done before", flush=True)
    began = time.monotonic()
    for part, number, result, took_s in run_all(left, options.jobs):
        records.add({"part": part, "seed": number, **asdict(result), "took_s": round(took_s, 3)})
        skipped = result.skipped and f"skipped: {result.skipped}"
        verdict = "; ".join(result.failures) or skipped or "ok"
        print(f"{part}:{number} {took_s:.2f} s `{result.case}` {verdict}", flush=True)
    lines = summary(records)
    (options.output / "summary.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    failed = sum(bool(row["failures"]) for row in records.cases) + len(_stage.warm_failures)
    print(
        f"campaign {seed}: {len(records.cases)} cases, {failed} failed, "
        f"{time.monotonic() - began:.0f} s"
    )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
