"""Mutants: ``make mutants``. Small faults planted in the product; do its fast tests find them?

Mutants are those of cosmic-ray, drawn with a seed from the modules of :data:`PARTS`, one a place
at most. Each is tried in a copy of the tree by the fast tests of the folder of the same name, those
that import the module first, for a minute. A mutant that is not killed by then has survived,
whether it changes anything or not. A run that was interrupted goes on where it was.
"""

import argparse
import ast
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

from support.paths import ROOT

PARTS = {
    "recorder": ["capture/recorder", "capture/log/write", "capture/common/part_files.py"],
    "write-ahead log": ["capture/log/wal"],
    "gate": ["sim/drive"],
    "estimators": ["analysis/estimators"],
    "response": ["analysis/response", "analysis/parts/frequency_response"],
    "energy": ["analysis/parts/energy/measure.py"],
    "samples of the replay": ["replay/samples"],
}
"""What is mutated; as many of each part."""

LIMIT_S = 60.0
"""For the tests of one mutant."""
HANGS_S = 20.0
"""A test that takes longer hangs, and has failed: a fast one takes a few seconds."""
LEFT_OUT = {"core/RemoveDecorator", "core/VariableReplacer", "core/VariableInserter"}
"""Operators that change what isn't code that runs, or that need names."""


@dataclass(frozen=True, order=True)
class Mutant:
    """A fault.

    Attributes:
        path: The module, below the root.
        line: From 1.
        column: From 0.
        operator: Of cosmic-ray.
        occurrence: Which of the operator's places in the module.
    """

    path: str
    line: int
    column: int
    operator: str
    occurrence: int


# -- what there is -----------------------------------------------------------------------------


def modules(roots):
    """Return the modules below some folders, or modules themselves."""
    paths = [ROOT / root for root in roots]
    files = [path for path in paths if path.is_file()]
    return files + [file for path in paths if path.is_dir() for file in sorted(path.rglob("*.py"))]


def mutants_of(path):
    """Return all mutants of a module, but those of annotations."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    text = path.read_text()
    quiet, nodes = annotations_of(text), list(ast_nodes(get_ast(text)))
    name, mutants = path.relative_to(ROOT).as_posix(), []
    for operator_name in operator_names():
        kind = get_operator(operator_name)
        if operator_name in LEFT_OUT or kind.arguments():
            continue
        places = [start for node in nodes for start, _ in kind().mutation_positions(node)]
        mutants += [
            Mutant(name, line, column, operator_name, occurrence)
            for occurrence, (line, column) in enumerate(places)
            if not any(first <= (line, column) < last for first, last in quiet)
        ]
    return mutants


def annotations_of(text):
    """Return where annotations are: from, to, as (line, column)."""
    spans = []
    for node in ast.walk(ast.parse(text)):
        for field in ("annotation", "returns"):
            part = getattr(node, field, None)
            if part is not None:
                spans.append(
                    ((part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset))
                )
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            spans.append(((node.lineno, 0), (node.end_lineno + 1, 0)))
    return spans


def drawn(seed, count, parts=None):
    """Draw mutants, as many of each part, one a place at most."""
    rng, chosen, parts = random.Random(seed), [], parts or list(PARTS)
    for number, part in enumerate(parts):
        places = {}
        for path in modules(PARTS[part]):
            for mutant in mutants_of(path):
                places.setdefault((mutant.path, mutant.line, mutant.column), []).append(mutant)
        share = count // len(parts) + (number < count % len(parts))
        some = rng.sample(sorted(places), min(share, len(places)))
        chosen += [planted for place in some if (planted := _planted(sorted(places[place]), rng))]
    return chosen


def _planted(mutants, rng):
    """Choose a mutant that cosmic-ray can plant: it replaces no exception of a dotted name."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    while mutants:
        mutant = rng.choice(mutants)
        with contextlib.suppress(AttributeError):
            mutate_code(
                (ROOT / mutant.path).read_text(), get_operator(mutant.operator)(), mutant.occurrence
            )
            return mutant
        mutants = [other for other in mutants if other != mutant]
    return None


def tests_of(path):
    """Return the test modules for a module: of the folder of the same name, importers first."""
    module = Path(path)
    folder = ROOT / "tests" / module.parent
    dotted = ".".join(("undulog", *module.with_suffix("").parts))
    files = sorted(folder.glob("test_*.py"))
    if not files:
        return [ROOT / "tests" / module.parent]
    names = module.stem
    return sorted(files, key=lambda file: (dotted not in file.read_text(), names not in file.stem))


# -- one try -----------------------------------------------------------------------------------


class Tree:
    """A copy of the tree, in which one mutant at a time is planted; ``output`` is of its tests."""

    def __init__(self, folder):
        """Copy what git tracks."""
        self.root, self.output = folder, folder.with_suffix(".output")
        names = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True
        ).stdout.split(b"\0")
        for name in map(os.fsdecode, filter(None, names)):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target, follow_symlinks=False)

    def tried(self, mutant, tests):
        """Plant a mutant, run tests; return the outcome, the time [s], and the changed line."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        path = self.root / mutant.path
        whole = path.read_text()
        changed = mutate_code(whole, get_operator(mutant.operator)(), mutant.occurrence)
        path.write_text(changed)
        try:
            outcome, took_s = self.run(tests)
        finally:
            path.write_text(whole)
        lines = zip(whole.splitlines(), changed.splitlines(), strict=False)
        differing = [(old, new) for old, new in lines if old != new]
        return outcome, took_s, " -> ".join(text.strip() for text in differing[0])

    def run(self, tests):
        """Run fast tests in the copy; return the outcome, and the time [s]."""
        names = [test.relative_to(ROOT) for test in tests]
        began = time.monotonic()
        code = self.code_of("-m", "not slow and not clock", *names, limit_s=LIMIT_S)
        outcome = {None: "limit", 0: "passed", 5: "passed"}.get(code, "failed")
        return outcome, time.monotonic() - began

    def code_of(self, *words, limit_s):
        """Run pytest in the copy; return its exit code, None if it was ended at the limit."""
        words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *words]
        env = os.environ | {"PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1"}
        env |= {"UNDULOG_TEST_LIMIT_S": str(HANGS_S)}
        with self.output.open("w") as output, subprocess.Popen(
            list(map(str, words)), cwd=self.root, env=env, stdin=subprocess.DEVNULL,
            stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
        ) as process:  # fmt: skip
            try:
                return process.wait(limit_s)
            except subprocess.TimeoutExpired:
                return None
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)


class Mutants:
    """The results, a line of JSON each, in a file that a later run continues."""

    def __init__(self, path):
        """Read what is there."""
        self.path = path
        lines = path.read_text().splitlines() if path.exists() else []
        self.rows = [json.loads(line) for line in lines]
        self.done = {Mutant(**row["mutant"]) for row in self.rows}

    def add(self, mutant, outcome, took_s, change):
        """Append a line; returns it."""
        row = {"mutant": asdict(mutant), "killed": outcome == "failed"}
        row |= {"outcome": outcome, "change": change}
        row |= {"took_s": round(took_s, 2)}
        self.rows.append(row)
        with self.path.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
        return row


def summary(rows):
    """Return the share that was killed, by part, and the survivors."""
    lines = ["| part | mutants | killed |", "|---|---|---|"]
    for part, roots in PARTS.items():
        part_rows = [
            row for row in rows if any(row["mutant"]["path"].startswith(root) for root in roots)
        ]
        lines.append(f"| {part} | {len(part_rows)} | {sum(row['killed'] for row in part_rows)} |")
    killed = sum(row["killed"] for row in rows)
    lines.append(f"| all | {len(rows)} | {killed}, {killed / max(1, len(rows)):.0%} |")
    lines.append("")
    for row in rows:
        if not row["killed"]:
            place = f"{row['mutant']['path']}:{row['mutant']['line']}"
            lines.append(f"survived: {place}: {row['change']} ({row['outcome']})")
    return lines


def main():
    """Run the command line; return 1 where fewer than 90 % are killed."""
    parser = argparse.ArgumentParser(prog="mutants", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=210)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("-o", "--output", type=Path, default=Path("out/mutants"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    results = Mutants(options.output / f"seed{options.seed}.jsonl")
    chosen = drawn(options.seed, options.count, options.parts)
    left = [mutant for mutant in chosen if mutant not in results.done]
    with tempfile.TemporaryDirectory(prefix="mutants", ignore_cleanup_errors=True) as name:
        trees = SimpleQueue()
        for number in range(options.jobs):
            trees.put(Tree(Path(name) / str(number)))
        sound = set()

        def work(mutant):
            tree, tests = trees.get(), tests_of(mutant.path)
            try:
                key = tuple(tests)
                if key not in sound:
                    outcome, _ = tree.run(tests)
                    assert outcome != "failed", f"without a fault:\n{tree.output.read_text()}"
                    sound.add(key)
                return mutant, *tree.tried(mutant, tests)
            finally:
                trees.put(tree)

        with ThreadPoolExecutor(options.jobs) as pool:
            for row in (results.add(*outcome) for outcome in pool.map(work, left)):
                place = f"{row['mutant']['path']}:{row['mutant']['line']}"
                verdict = "killed" if row["killed"] else "SURVIVED"
                print(f"{verdict} {row['took_s']:.0f} s {place} {row['change']}", flush=True)
    lines = summary(results.rows)
    print("\n".join(lines))
    return int(sum(row["killed"] for row in results.rows) < 0.9 * len(results.rows))


if __name__ == "__main__":
    sys.exit(main())
