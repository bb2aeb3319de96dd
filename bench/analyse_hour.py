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

import sys
import tempfile
from functools import partial
from pathlib import Path

from measuring import (
    HERE,
    HOUR_S,
    PEAK_MIB,
    Took,
    add_place,
    arguments,
    command_took,
    hour_of,
    in_turn,
)  # fmt: skip
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


def cost(*words: object) -> tuple[Took, float]:
    """Run ``undulog WORDS...``; return its cost and its largest resident memory [MiB]."""
    with tempfile.NamedTemporaryFile() as peak:
        took = command_took(sys.executable, "-c", COMMAND, peak.name, *words)
        return took, float(Path(peak.name).read_text())


def program_s(program: str, *words: object) -> float:
    """Return the processor time of a Python program that imports from this folder [s]."""
    command = [sys.executable, "-c", program, *words]
    return command_took(*command, stdout=None, cwd=HERE).processor_s


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
    analysed, reported, decoding, reading = in_turn(
        runs,
        partial(cost, "analyse", path),
        partial(cost, "report", path, "-o", page, "--force"),
        partial(program_s, DECODE, path, peer_s),
        partial(program_s, READ, path),
    )
    peer = f"{versions('mcap', 'mcap-ros2-support')} decoding the JointStates"
    if peer_s < seconds:
        peer += f" (scaled from {peer_s:g} s)"
    good: list[bool] = []
    for verb, costs, bar, bar_mib in (
        ("analyse", analysed, ANALYSE, round(ANALYSE_MIB)),
        ("report", reported, REPORT, None),
    ):
        what = f"undulog {verb}, {length}"
        took, peaks = zip(*costs, strict=True)
        ours = [usage.processor_s for usage in took]
        good.append(compared(what, ours, decoding, peer, bar=bar, scale=seconds / peer_s))
        verdict(f"{what}, wall-clock time", min(usage.wall_s for usage in took), None, "s")
        good.append(verdict(f"{what}, peak memory", max(peaks), bar_mib, "MiB"))
    what, ours = f"undulog analyse, {length}", [usage.processor_s for usage, _ in analysed]
    good.append(compared(what, ours, reading, "undulog reading its columns", bar=OF_READING))
    size = page.stat().st_size / MIB
    good.append(verdict(f"undulog report, {length}, page", size, round(PAGE_MIB, 2), "MiB"))
    return all(good)


def main() -> None:
    """Write, measure, print."""
    parser = arguments(__doc__, minutes=60.0, runs=2)
    parser.add_argument("--adaptive", action="store_true", help="a gait that varies all the time")
    add_place(parser, "1 GB")
    options = parser.parse_args()
    with hour_of(options, adaptive=options.adaptive) as (path, seconds):
        good = measure(path, seconds / HOUR_S, options.runs, adaptive=options.adaptive)
    sys.exit(not good)


if __name__ == "__main__":
    main()
