"""Reads mutated files: a script for the tests in ``test_mutations.py``, its memory bounded.

It is no test module. Each seed stands for one mutated file; it is announced before it is read, so
that whoever waits can name the one that hangs. What is not an error of ours is told with its trace.
"""

import contextlib
import json
import random
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

from undulog.capture import load_robot
from undulog.capture.common.errors import UndulogError
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.wal.reader import recover
from undulog.capture.robot.description import parse_robot

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))
from campaign.base import of_recorder, write_files, write_logs, write_texts
from campaign.fuzz import read_session
from campaign.mutate import mutate_bytes, mutate_text

MIB = 1 << 20
ROOM = 1 << 30
"""Address space beyond what the process has when it begins [byte]."""
GROWTH = 192 * MIB
"""Memory in use beyond that [byte]: far less than any size that a mutated header claims."""


def make_corpus(folder):
    """Write whole files as the campaign does, but shorter; return name to path and content."""
    folder.mkdir()
    write_texts(folder)
    unfinished, _ = of_recorder(folder)
    corpus = {name: {name: data} for name, data in write_logs(folder, ticks=8).items()}
    return corpus | {"unfinished": {path: unfinished.files[path] for path in unfinished.mutable}}


def lay_out(files, place):
    """Write files in a folder that holds nothing else."""
    shutil.rmtree(place, ignore_errors=True)
    write_files(place, files)


def check_and_read(path):
    """Check a session and read all its parts; errors of the error tree are answers, too."""
    with contextlib.suppress(UndulogError):
        check_session(path)
    read_session(path)
    return "read"


def read_log(folder):
    """Read the messages of a write-ahead log."""
    recovery = recover(folder)
    for _ in recovery:
        pass
    return f"recovered with {recovery.missing} missing"


def parse_mutated(rng):
    """Parse a robot description, or its bus database, with faults."""
    robot = load_robot(rng.choice(["snake25", "arcsnake-joint"]))
    databases = dict(robot.databases)
    text = robot.toml

    def mutated(whole):
        return mutate_text(whole.encode(), rng).decode("utf-8", "replace")

    if rng.random() < 0.5:
        text = mutated(text)
    else:
        name = rng.choice(sorted(databases))
        databases[name] = mutated(databases[name])
    parse_robot(text, source="mutated.toml", databases=databases)
    return "parsed"


def try_seed(seed, corpus, folder):
    """Read the mutated file of a seed; return the result in words."""
    rng = random.Random(seed)
    kind = seed % 10
    try:
        if kind == 9:
            return parse_mutated(rng)
        name = "unfinished" if kind >= 7 else rng.choice([n for n in corpus if n != "unfinished"])
        files, place = dict(corpus[name]), folder / "mutated"
        chosen = rng.choice(list(files))
        files[chosen] = mutate_bytes(files[chosen], rng)
        lay_out(files, place)
        if kind == 8:
            return read_log(place / "run.mcap.wal")
        return check_and_read(place / ("run.mcap" if name == "unfinished" else name))
    except UndulogError as error:
        str(error)
        return f"refused: {type(error).__name__}"


def in_use():
    """Return the peak of memory in use [byte]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main():
    """Read the seeds from the first argument to before the second; one line of JSON for each."""
    first, stop = map(int, sys.argv[1:3])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        corpus = make_corpus(folder / "bases")
        warnings.simplefilter("error")
        for files in corpus.values():  # everything that is loaded lazily is loaded now
            lay_out(files, folder / "whole")
            stored = next(path for path in files if path.endswith((".mcap", ".mcap.part")))
            check_and_read(folder / "whole" / stored.removesuffix(".part"))
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
        before = in_use()
        for seed in range(first, stop):
            print(json.dumps({"begin": seed}), flush=True)
            result = {"seed": seed}
            try:
                result["came"] = try_seed(seed, corpus, folder)
            except BaseException as error:  # noqa: BLE001 (every stray one is what is looked for)
                result["stray"] = type(error).__name__
                result["trace"] = traceback.format_exc(limit=-12)
            result["grown"] = in_use() - before
            print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
