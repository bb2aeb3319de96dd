"""Conversions to Rerun's format onto disks that fill, and into files that may grow no further."""

import random
import resource
import shlex
import subprocess
import sys
import time
import warnings
from contextlib import ExitStack, contextmanager

from .case import Result, front_door, run_forked
from .disks import disk, fill
from .kills import lay_out

LINES = [
    "view run.mcap --save disk/new.rrd",
    "view run.mcap --save disk/new.rrd --force",
    "view run.mcap other.mcap --save disk/new.rrd",
]
BUSY = "while True: pass"
LARGEST = 4_000_000
"""More than any of the recordings has [byte]; most have a quarter of that."""
LONGEST_S = 100.0
"""Wall time of a case [s], beside the others: less than the limit of any wait of the product."""


@contextmanager
def load(count):
    """Run busy processes beside a case."""
    with ExitStack() as stack:
        for _ in range(count):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-S", "-c", BUSY]))
            stack.callback(process.kill)
        yield


def limited(words, size):
    """Return the command as one whose files end at a size, where a write fails."""
    work = front_door(words)

    def run_limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        work()

    return run_limited


def whole(path):
    """Return why a recording isn't whole by Rerun's own reader; empty if it is."""
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            RrdReader(path).store()
    except (RuntimeError, ValueError, Warning) as error:
        return str(error)
    return ""


def run(seed, stage):
    """Convert once, while the disk fills or the file may not grow, beside a load."""
    rng = random.Random(seed)
    kind = rng.choice(["fills", "fills", "small", "limited", "limited"])
    size = int(4096 * (LARGEST / 4096) ** rng.random())
    at_s, busy, line = rng.random() * 2.5, rng.choice([0, 1, 2, 4]), rng.choice(LINES)
    words = shlex.split(line)
    result = Result(f"{line!r}: {kind}, {size} bytes, {at_s:.2f} s, {busy} busy")
    with stage.fresh() as folder, load(busy):
        lay_out(folder, stage)
        place = folder / "disk"
        with disk(place, f"{size}" if kind == "small" else "16m") as can:
            if not can:
                result.skipped = "mounting is not permitted here"
                return result
            if "--force" in words and size > 8192:
                (place / "new.rrd").write_bytes(b"the former one")
            before = contents(place)

            def fill_later(_child):
                time.sleep(at_s)
                fill(place, size)

            work = limited(words, size) if kind == "limited" else front_door(words)
            began_s = time.monotonic()
            meanwhile = fill_later if kind == "fills" else None
            outcome = run_forked(work, folder, meanwhile=meanwhile)
            result.figures["wall_s"] = round(time.monotonic() - began_s, 1)
            result.add(outcome)
            result.failures += faults(outcome, place, before, result.figures["wall_s"])
            result.figures["n_refused"] = int(outcome.code == 1)
    return result


def contents(place):
    """Return the files of a folder, but for the one that fills the disk."""
    return {path.name: path.read_bytes() for path in place.iterdir() if path.name != "other"}


def faults(outcome, place, before, wall_s):
    """Return what is wrong with the end of a conversion."""
    failures = []
    if wall_s > LONGEST_S and not outcome.hung:
        failures.append(f"hang: {wall_s:.0f} s")
    if outcome.code == 0:
        if reason := whole(place / "new.rrd"):
            failures.append(f"output: new.rrd is not whole: {reason}")
        if set(contents(place)) != {"new.rrd"}:
            failures.append(f"output: left {sorted(contents(place))}")
        return failures
    text = outcome.err.decode(errors="replace")
    if outcome.code != 1:
        failures.append(f"exit code: {outcome.code} on a full disk")
    if not text.startswith("error: ") or text.count("\n") != 1:
        failures.append(f"message: {text[:200]!r}")
    if contents(place) != before:
        failures.append(f"output: left {sorted(contents(place))} of {sorted(before)}")
    return failures
