#!/usr/bin/env python3
"""Everything that takes long, in parts: ``make nightly``.

Each part is a command, and may take an hour; one that goes on where it was (the night, the
campaign, the mutants) has as many hours as it needs, one a run. What passed for this commit isn't
run again. At the end, and after an interrupt, a table says what became of each part. The exit code
is 1 unless all of them passed. Words on the command line choose parts by name: ``.ci/nightly.py zoo
pages``.

Only the standard library is used.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "out" / "nightly"
LIMIT_S = 3600.0
ALL = {"UNDULOG_REQUIRE_ALL_TESTS": "1"}


@dataclass(frozen=True)
class Part:
    """A part.

    Attributes:
        command: Run by a shell at the root; COMMIT stands for the commit.
        guards: What it is for.
        resumes: Whether it goes on where it was after an interrupt.
    """

    command: str
    guards: str
    resumes: bool = False


PARTS = {
    "slow": Part("make slow", "the slow tests of what is promised"),
    "clock": Part("make clock", "the tests of real time"),
    "delays": Part("make delays", "delays planted in the product, for the tests of real time"),
    "night": Part(
        "UNDULOG_PASSED=out/nightly/COMMIT/passed.txt make night",
        "levels of intervals, long runs of the twin, pictures, studies",
        resumes=True,
    ),
    "campaign": Part(
        "PYTHONPATH=tests:bench:. .venv/bin/python -m campaign.run -o out/nightly/COMMIT/campaign",
        "50,000 attacks with a new seed",
        resumes=True,
    ),
    "mutants": Part(
        "PYTHONPATH=tests .venv/bin/python -m mutants.run -o out/nightly/COMMIT/mutants",
        "210 planted faults",
        resumes=True,
    ),
    "zoo": Part("make zoo", "planted faults of robots, 100 seeds each"),
    "pages": Part("make pages", "the long parts of the manual"),
    "install": Part("make install-paths", "every way to install"),
    "newest": Part(
        "rm -rf out/nightly/newest && python3.11 -m venv out/nightly/newest"
        " && out/nightly/newest/bin/pip install -q -r requirements.lock"
        " && out/nightly/newest/bin/pip install -q --no-deps --no-build-isolation -e ."
        " && out/nightly/newest/bin/pip install -q --upgrade rerun-sdk pandas"
        " && out/nightly/newest/bin/python -m pytest -p no:cacheprovider"
        ' -m "not slow and not clock" tests/replay tests/analysis',
        "the newest rerun-sdk and pandas",
    ),
}


@dataclass(frozen=True)
class Outcome:
    """What became of a part.

    Attributes:
        state: ``passed``, ``failed``, ``goes on`` (at the limit, and resumable) or ``limit``.
        minutes: Of all its runs.
        last: The last line that it printed.
    """

    state: str
    minutes: float
    last: str


def run(name: str, before: Outcome | None, this: str) -> Outcome:
    """Run a part; its output goes to a file.

    Args:
        before: Its outcome so far.
        this: The commit: cases of another one say nothing of it.
    """
    part, log = PARTS[name], FOLDER / f"{name}.log"
    began = time.monotonic()
    with log.open("ab") as output:
        process = subprocess.Popen(  # noqa: S602  our own commands
            part.command.replace("COMMIT", this),
            shell=True,
            cwd=ROOT,
            env=os.environ | ALL,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            end(process)
    minutes = (time.monotonic() - began) / 60 + (before.minutes if before else 0.0)
    lines = log.read_text(errors="replace").strip().splitlines()
    states = {0: "passed", None: "goes on" if part.resumes else "limit"}
    return Outcome(states.get(code, "failed"), round(minutes, 1), lines[-1] if lines else "")


def end(process: subprocess.Popen[bytes]) -> None:
    """End a command and what it has started, if it still runs."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def commit() -> str:
    """Return the commit, with a mark where files differ from it."""
    words = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    done = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True)  # noqa: S603
    return done.stdout.strip()


def table(outcomes: dict[str, Outcome]) -> list[str]:
    """Return the lines of a table of all parts."""
    lines = ["| part | guards | state | min | last line |", "|---|---|---|---|---|"]
    for name, part in PARTS.items():
        outcome = outcomes.get(name, Outcome("not run", 0.0, ""))
        last = outcome.last.replace("|", "/")[:80]
        lines.append(f"| {name} | {part.guards} | {outcome.state} | {outcome.minutes} | {last} |")
    return lines


def main() -> int:
    """Run the parts that are left."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    chosen = parser.parse_args().parts or list(PARTS)
    if unknown := set(chosen) - PARTS.keys():
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    state, this = FOLDER / "outcomes.json", commit()
    kept = json.loads(state.read_text()) if state.exists() else {}
    outcomes = {name: Outcome(**fields) for name, fields in kept.get(this, {}).items()}
    try:
        for name in chosen:
            if name in outcomes and outcomes[name].state == "passed":
                continue
            print(f"{time.strftime('%H:%M')} {name}: {PARTS[name].command}", flush=True)  # noqa: T201
            outcomes[name] = run(name, outcomes.get(name), this)
            state.write_text(
                json.dumps({this: {k: asdict(outcome) for k, outcome in outcomes.items()}})
            )
    except KeyboardInterrupt:
        print("interrupted")  # noqa: T201
    print(f"{this}:", *table(outcomes), sep="\n")  # noqa: T201
    return int(any(outcomes.get(n, Outcome("", 0, "")).state != "passed" for n in chosen))


if __name__ == "__main__":
    sys.exit(main())
