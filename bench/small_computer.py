"""The recorder on a small computer, by proxies: half a core and a slow disk.

Two buses, each with the frames of the shipped 25-joint robot in its polling cycle, one of them
decoded, go into ``undulog record`` from senders with real-time priority that wait for nobody. The
recorder has

* half of one core: a cgroup's quota of 5 ms in each 10 ms, or, where none can be made, a core it
  shares with a real-time process that is busy for 5 of each 10 ms (``--processor hog``);
* a disk of 10 MB/s that takes 50 ms a flush, one request at a time (``slow_disk.c``, preloaded).

The lowest load is 100 Hz, which must be held without a refused or lost frame; the higher ones
follow until one isn't. A quota does not bind real-time threads, so there the recorder gets nice -10
at most. Needs Linux, root and a C compiler.

Run: python bench/small_computer.py [--seconds 60] [--loads 5600 ...] [--processor quota|hog]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bus_sender import cycle_frames
from contention import BUSES, REFUSED_PRIORITY, ended, sources_at, start_sender, start_undulog
from measuring import HERE, arguments, cpu_s, memory, start, wait_for
from records import not_run, verdict

from undulog.capture import Session

RATE_HZ = 100
LOADS = (5600.0, 9000.0, 13_500.0, 20_000.0, 30_000.0, 45_000.0)
"""Frames/s on each bus. 5600 is the robot at 100 Hz, 9000 about a full bus of 1 Mbit/s."""

PERIOD_US, SHARE_US = 10_000, 5_000
FIRST, LAST = min(os.sched_getaffinity(0)), max(os.sched_getaffinity(0))
CORES = {"senders": FIRST, "recorder": LAST}

HOG = f"""
import os, time
while os.getppid() == {{parent}}:
    end = time.monotonic() + {SHARE_US * 1e-6}
    while time.monotonic() < end:
        pass
    time.sleep({(PERIOD_US - SHARE_US) * 1e-6})
"""


DISK_CHECK = """
import ctypes, json, mmap, os, sys, time
file, times = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT), [time.monotonic()]
os.write(file, bytes(1_000_000))
os.fdatasync(file)
times.append(time.monotonic())
view = mmap.mmap(file, 1_000_000)
start = ctypes.addressof(ctypes.c_char.from_buffer(view))
ctypes.CDLL(None).msync(ctypes.c_void_p(start), ctypes.c_size_t(len(view)), 4)
times.append(time.monotonic())
print(json.dumps([later - sooner for sooner, later in zip(times, times[1:])]))
"""
"""Prints how long it takes to write and flush 1 MB, by calls and by mapped memory [s]."""


@dataclass
class Outcome:
    """The figures of one load.

    Attributes:
        load: Frames/s on each bus.
        offered: Frames that the senders had.
        refused: Of them, those that the recorder's buffers did not take.
        lost: Frames taken and not in the file.
        late: Frames that a sender offered more than 20 ms late; many make the run worthless.
        undecoded: Cycles of the decoded bus without joint states in the file.
        cpu_us: Processor time a frame.
        share: Processor share of the whole core.
        peak_mb: Largest resident memory.
        written: Bytes handed to the disk a frame, write-ahead log included.
        stored: Bytes of the session a frame.
        tick_p99_ms: Of the recorder's loop.
    """

    load: float
    offered: int = 0
    refused: int = 0
    lost: int = 0
    late: int = 0
    undecoded: int = 0
    cpu_us: float = 0.0
    share: float = 0.0
    peak_mb: float = 0.0
    written: float = 0.0
    stored: float = 0.0
    tick_p99_ms: float = 0.0

    @property
    def held(self) -> bool:
        """Whether no frame was refused or lost."""
        return not self.refused + self.lost

    def line(self) -> str:
        """Return one line of the table."""
        return LINE.format(
            f"{2 * self.load:.0f}", self.offered, self.refused, self.lost, self.late,
            self.undecoded, f"{self.cpu_us:.1f}", f"{self.share:.1%}", f"{self.peak_mb:.0f}",
            f"{self.written:.1f}", f"{self.stored:.1f}", f"{self.tick_p99_ms:.1f}",
        )  # fmt: skip


LINE = "{:>8} {:>9} {:>8} {:>6} {:>6} {:>9} {:>9} {:>7} {:>6} {:>9} {:>8} {:>7}"
HEAD = LINE.format(
    "frames/s", "offered", "refused", "lost", "late", "undecoded", "us/frame", "core", "MB",
    "written/B", "file/B", "p99/ms",
)  # fmt: skip


@contextmanager
def quota() -> Iterator[list[str]]:
    """Make a cgroup of half a core; yield the words before a command that put it there."""
    root = Path("/sys/fs/cgroup")
    old = (root / "cpu").is_dir()
    group = (root / "cpu" if old else root) / f"undulog-bench-{os.getpid()}"
    group.mkdir()
    try:
        if old:
            (group / "cpu.cfs_period_us").write_text(f"{PERIOD_US}")
            (group / "cpu.cfs_quota_us").write_text(f"{SHARE_US}")
        else:
            (group / "cpu.max").write_text(f"{SHARE_US} {PERIOD_US}")
        join = f'echo $$ > {group}/cgroup.procs && exec "$@"'
        yield ["sh", "-c", join, "sh", "nice", "-n", "-10", *REFUSED_PRIORITY]
    finally:
        with suppress(TimeoutError):
            wait_for(lambda: not (group / "cgroup.procs").read_text().strip())
        group.rmdir()


@contextmanager
def hog() -> Iterator[list[str]]:
    """Keep half of the recorder's core busy with real-time priority."""
    with ExitStack() as stack:
        code = HOG.format(parent=os.getpid())
        start(
            stack, "taskset", "-c", CORES["recorder"], "chrt", "-f", 20, sys.executable, "-c", code
        )
        yield []


PROCESSORS = {"quota": quota, "hog": hog}


def quota_works() -> bool:
    """Whether a cgroup with a quota can be made here."""
    with suppress(OSError), quota():
        return True
    return False


def compiled(folder: Path) -> Path:
    """Return the library of the slow disk."""
    library = folder / "slow_disk.so"
    compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
    command = [compiler, "-shared", "-fPIC", "-O2", "-o", library, HERE / "slow_disk.c"]
    subprocess.run(command, check=True)
    done = subprocess.run(
        [sys.executable, "-c", DISK_CHECK, folder / "check"],
        env=os.environ | {"LD_PRELOAD": str(library)},
        check=True,
        capture_output=True,
        text=True,
    )
    took_s = json.loads(done.stdout)
    assert all(duration >= 0.14 for duration in took_s), f"the slow disk is not in effect: {took_s}"
    return library


def run(folder: Path, load: float, seconds: float, before: Sequence[str]) -> Outcome:
    """Record one load.

    Args:
        folder: An empty folder.
        load: Frames/s on each bus.
        seconds: How long.
        before: The words before the recorder's command.
    """
    outcome = Outcome(load)
    cycle = folder / "cycle.npy"
    np.save(cycle, cycle_frames())
    places = [folder / f"{name}.sock" for name in BUSES]
    with ExitStack() as stack:
        recorder = start_undulog(stack, folder, sources_at("unix", places), *before)
        wait_for(places[1].exists)
        pid = recorder.pid
        begun, used, written = time.monotonic(), cpu_s(pid), _written(pid)
        options = ["--fifo", "--rate", load, "--seconds", seconds, "--cycle", cycle]
        options += ["--per-packet", 9, "--buffer", 0]
        senders = [start_sender(stack, "unix", place, *options) for place in places]
        for sender in senders:
            os.sched_setaffinity(sender.pid, {CORES["senders"]})
        accepted = 0
        for sender in senders:
            sent = json.loads(sender.communicate(timeout=seconds + 60)[0].splitlines()[-1])
            outcome.offered += sent["offered"]
            outcome.refused += sent["offered"] - sent["accepted"]
            outcome.late += sent["late"]
            accepted += sent["accepted"]
        used = cpu_s(pid) - used
        outcome.share = used / (time.monotonic() - begun)
        outcome.cpu_us = used / accepted * 1e6
        outcome.written = (_written(pid) - written) / accepted
        outcome.peak_mb = memory("VmHWM", pid) / 1e6
        report = json.loads(ended(recorder, 2.0))
    outcome.tick_p99_ms = float(report["recorder"]["tick_p99_s"]) * 1e3
    outcome.stored = (folder / "run.mcap").stat().st_size / accepted
    with Session.open(folder / "run.mcap") as session:
        outcome.lost = accepted - sum(len(session.frames(f"/can/{name}")) for name in BUSES)
        states = session.channels["/joint_states"].count
    outcome.undecoded = max(0, round(load * seconds) // len(np.load(cycle)) - states)
    return outcome


def _written(pid: int) -> int:
    lines = Path(f"/proc/{pid}/io").read_text().splitlines()
    figures = {key: int(value) for key, _, value in (line.partition(": ") for line in lines)}
    return figures["write_bytes"] - figures["cancelled_write_bytes"]


def judge(outcomes: Sequence[Outcome], seconds: float, where: str) -> bool:
    """Print and keep the figures; return whether the bars are met."""
    base = outcomes[0]
    held = [outcome for outcome in outcomes if outcome.held]
    failed = base.refused + base.lost
    load = f"{where}, two buses of 25 joints at {RATE_HZ} Hz"
    good = [
        verdict(f"{load}: frames refused or lost in {seconds:g} s", failed, 0, "frames"),
        verdict(f"{load}: cycles not decoded", base.undecoded, 1, "cycles"),
    ]
    for what, value, unit in (
        ("processor time a frame", base.cpu_us, "us"),
        ("share of the whole core", 100 * base.share, "%"),
        ("peak memory", base.peak_mb, "MB"),
        ("written to the disk, write-ahead log included", base.written, "B a frame"),
        ("stored", base.stored, "B a frame"),
        ("99 % of the loop's ticks", base.tick_p99_ms, "ms"),
    ):
        verdict(f"{load}: {what}", value, None, unit)
    highest = 2 * max((outcome.load for outcome in held), default=0.0)
    what = f"{where}: highest load held for {seconds:g} s without a refused or lost frame"
    good.append(verdict(what, highest, 2 * LOADS[0], "frames/s", most=False))
    return all(good)


def main() -> int:
    """Raise the load until a frame is refused; print; return 1 if a bar is missed."""
    parser = arguments(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each load")
    parser.add_argument("--loads", type=float, nargs="+", default=LOADS, help="frames/s on a bus")
    parser.add_argument("--processor", choices=PROCESSORS, help="how half a core is made")
    parser.add_argument("--fast-disk", action="store_true", help="the disk as it is")
    parser.add_argument("--folder", type=Path, help="on the disk to record to")
    options: argparse.Namespace = parser.parse_args()
    processor = options.processor or ("quota" if quota_works() else "hog")
    if os.geteuid() or not (shutil.which("cc") or shutil.which("gcc")):
        not_run("the recorder on a small computer", "needs root and a C compiler")
        return 0
    disk = "the disk as it is" if options.fast_disk else "slow disk"
    where = f"half a core by {processor}, {disk}"
    print(f"{where}, {options.seconds:g} s each\n{HEAD}", flush=True)
    outcomes: list[Outcome] = []
    for load in options.loads:
        with (
            tempfile.TemporaryDirectory(prefix="undulog-bench-", dir=options.folder) as name,
            PROCESSORS[processor]() as words,
        ):
            folder = Path(name)
            before = [*words, "taskset", "-c", CORES["recorder"]]
            if not options.fast_disk:
                before += ["env", f"LD_PRELOAD={compiled(folder)}"]
            outcomes.append(run(folder, load, options.seconds, [str(word) for word in before]))
        print(outcomes[-1].line(), flush=True)
        if not outcomes[-1].held:
            break
    return int(not judge(outcomes, options.seconds, where))


if __name__ == "__main__":
    sys.exit(main())
