"""A process that ends a test run whose test stands still, with the stacks of all its threads.

It is a process of its own, so that it also ends a run whose interpreter is held by compiled code.

Usage: ``watcher.py STDERR RUN``: the handle of the run's standard error and its process. Lines on
standard input: ``SECONDS NAME`` begins a wait, an empty one ends it. Time counts by the watcher's
own looks, so that a computer that slept is no reason; and where the run could have gone on, but
other programs had the processors, only its own processor time counts.
"""

import contextlib
import os
import select
import signal
import sys
import time
from pathlib import Path

LOOK_S = 1.0
DUMP_S = 3.0
"""For the run to print its stacks, on a busy computer [s]."""
STACKS = signal.SIGUSR2
"""The run prints its stacks on this signal."""


def descendants(pid):
    """Return all processes that a process has started, and those that they have."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                facts = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if facts[0] != "Z":
                parents[int(folder.name)] = int(facts[1])
    family = {pid}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    return family - {pid, os.getpid()}


def scheduled(pids):
    """Return by thread the time on a processor and the time that it waited for one [s]."""
    times = {}
    for pid in pids:
        with contextlib.suppress(OSError):  # it has ended meanwhile, or the kernel doesn't count
            for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                ran, waited, _ = path.read_text().split()
                times[path] = int(ran) * 1e-9, int(waited) * 1e-9
    return times


def passed(before, after):
    """Return how much of a look counts [s]: all but what threads waited for a processor in it."""
    both = [(*before[thread], *after[thread]) for thread in before.keys() & after.keys()]
    ran = sum(new - old for old, _, new, _ in both)
    waited = sum(new - old for _, old, _, new in both)
    return min(max(ran, LOOK_S - waited), LOOK_S)


def end(run, stderr, name, limit_s):
    """Print what stood still and the stacks, then kill the run and all that it has started."""
    os.write(stderr, f"\n{name} stood still for {limit_s:g} s; all stacks:\n".encode())
    os.kill(run, STACKS)
    time.sleep(DUMP_S)
    os.kill(run, signal.SIGSTOP)  # orphans become its children, so none is missed
    for _ in range(10):
        for pid in descendants(run):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        time.sleep(0.05)
        if not descendants(run):
            break
    os.write(stderr, b"the run is ended\n")
    os.kill(run, signal.SIGKILL)


def main(stderr, run):
    """Watch a run until its pipe closes."""
    for stop in (signal.SIGINT, signal.SIGHUP):  # are the run's own, which may go on
        signal.signal(stop, signal.SIG_IGN)
    name, left_s, limit_s, text, before = "", 0.0, 0.0, b"", {}
    while True:
        if select.select([0], [], [], LOOK_S)[0]:
            data = os.read(0, 65536)
            if not data:
                return
            *lines, text = (text + data).split(b"\n")
            if lines:
                seconds, _, name = lines[-1].decode().partition(" ")
                left_s = limit_s = float(seconds or 0.0)
                before = {}
        elif limit_s:
            after = scheduled({run, *descendants(run)})
            left_s -= passed(before, after)
            before = after
            if left_s <= 0.0:
                end(run, stderr, name, limit_s)
                return


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
