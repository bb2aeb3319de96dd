"""An hour of the 25-joint snake, analysed and reported: time and memory of the commands.

Each command runs as a process of its own, as a user starts it: wall-clock time from start to exit,
and the peak of its resident memory, mapped file included. Processor time is printed beside, which
other processes disturb less. The file is in the page cache; the best of several runs counts.

With --adaptive amplitude and frequency of the gait vary all the time, so that each sample of the
logged gait begins a new run. The bars are the same.

Writing the hour takes longer than measuring it: with --keep the session stays where it is, and the
next run with the same file measures it again.

Run: python bench/analyse_hour.py [--minutes 60] [--runs 2] [--adaptive]
                                  [--folder DIR | --keep FILE]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from measuring import HERE, HOUR_S, PEAK_MIB, add_place, arguments, write_hour
from records import compared, verdict, versions

MIB = 1 << 20
ANALYSE, REPORT = 0.25, 0.5
"""The bars, shares of the peer's processor time."""
ANALYSE_MIB, PAGE_MIB = 1.5e9 / MIB, 3e6 / MIB
OF_READING = 6.0
"""The bar of ``analyse`` to reading the columns of joints, times, power and sensors."""
PEER_S = 120.0
"""What the peer decodes at most; its time is scaled to the whole session [s]."""

DECODE = """
import sys
from pathlib import Path
from hour_session import EPOCH_NS, JOINT_TOPICS
from one_hour import OWN_TIMES, decode
window = EPOCH_NS, EPOCH_NS + round(float(sys.argv[2]) * 1e9)
decode(Path(sys.argv[1]), [*JOINT_TOPICS, *OWN_TIMES], window)
"""


READ = """
import sys
from pathlib import Path
from one_hour import load
load(Path(sys.argv[1]), 1)
"""


COMMAND = f"""
import atexit, sys
from pathlib import Path
peak = Path(sys.argv.pop(1))
atexit.register(lambda: peak.write_text(str({PEAK_MIB})))
import undulog
undulog.main()
"""


class Cost(NamedTuple):
    """Cost of a command.

    Attributes:
        wall_s: From start to exit.
        processor_s: User and system time, all threads.
        peak_mib: Largest resident memory.
    """

    wall_s: float
    processor_s: float
    peak_mib: float


def cost(*words: str) -> Cost:
    """Run ``undulog WORDS...`` and return its cost."""
    start = time.perf_counter()
    with tempfile.NamedTemporaryFile() as peak:
        command = [sys.executable, "-c", COMMAND, peak.name, *words]
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        took = time.perf_counter() - start
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            raise SystemExit(f"undulog {' '.join(words)} failed with exit code {child.returncode}")
        peak_mib = float(Path(peak.name).read_text())
    return Cost(took, usage.ru_utime + usage.ru_stime, peak_mib)


def spent_s(program: str, *words: str) -> float:
    """Return the processor time of a Python program [s]."""
    child = subprocess.Popen([sys.executable, "-c", program, *words], cwd=HERE)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"the peer failed with exit code {child.returncode}")
    return usage.ru_utime + usage.ru_stime


def measure(path: Path, part: float, runs: int, *, adaptive: bool = False) -> bool:
    """Run both commands and the peer in turn, print; return whether all bars are met.

    Args:
        path: The session.
        part: Its length over an hour.
        runs: Runs of each command.
        adaptive: Whether its gait varies all the time.
    """
    page = path.with_suffix(".html")
    length = f"{part * 60:g} min{', adaptive' if adaptive else ''}"
    seconds = part * HOUR_S
    peer_s = min(PEER_S, seconds)
    turns = [
        (
            cost("analyse", str(path)),
            cost("report", str(path), "-o", str(page), "--force"),
            spent_s(DECODE, str(path), str(peer_s)),
            spent_s(READ, str(path)),
        )
        for _ in range(runs)
    ]
    analysed, reported, theirs, read = zip(*turns, strict=True)
    peer = f"{versions('mcap', 'mcap-ros2-support')} decoding the JointStates"
    if peer_s < seconds:
        peer += f" (scaled from {peer_s:g} s)"
    good: list[bool] = []
    for verb, costs, bar in (("analyse", analysed, ANALYSE), ("report", reported, REPORT)):
        what = f"undulog {verb}, {length}"
        ours = [one.processor_s for one in costs]
        good.append(compared(what, ours, theirs, peer, bar=bar, scale=seconds / peer_s))
        verdict(f"{what}, wall-clock time", min(one.wall_s for one in costs), None, "s")
        peak = max(one.peak_mib for one in costs)
        bar_mib = round(ANALYSE_MIB) if verb == "analyse" else None
        good.append(verdict(f"{what}, peak memory", peak, bar_mib, "MiB"))
    what, ours = f"undulog analyse, {length}", [one.processor_s for one in analysed]
    good.append(compared(what, ours, read, "undulog reading its columns", bar=OF_READING))
    size = page.stat().st_size / MIB
    good.append(verdict(f"undulog report, {length}, page", size, round(PAGE_MIB, 2), "MiB"))
    return all(good)


def main() -> None:
    """Write, measure, print."""
    parser = arguments(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--adaptive", action="store_true", help="a gait that varies all the time")
    add_place(parser, "1 GB")
    options = parser.parse_args()
    seconds = max(round(options.minutes * 60), 60)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path: Path = (options.keep or Path(folder) / "hour.mcap").resolve()
        if not path.exists():
            write_hour(path, seconds, can=False, adaptive=options.adaptive)
        good = measure(path, seconds / HOUR_S, options.runs, adaptive=options.adaptive)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
