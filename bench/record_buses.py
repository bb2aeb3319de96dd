"""Recording two saturated 1 Mbit/s buses: what is lost, what it costs, what others take for it.

``python bench/record_buses.py [SECONDS]``: 2 x 9,000 frames/s from two other processes, into
``undulog record`` over AF_UNIX and over loopback socketcand, one bus decoded; the latter also with
frames alone, as the others write them; the same socketcand buses into python-can's Logger (BLF and
candump) and into mcap-ros2-support; a burst of 500,000 frames/s; and a live view that is frozen all
the time. Senders are paced by the clock and wait for nobody: what the socket refuses is lost. What
a sender itself sends more than 20 ms late, since the machine stopped it, is in a row of its own. In
the end the same beside busy loops and a busy disk (``bench/contention.py``).
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import contention
from contention import (
    BUSES,
    RATE,
    ended,
    served,
    sources_at,
    start_peer,
    start_sender,
    start_undulog,
)
from measuring import arguments, cpu_s, memory, start, wait_for
from records import compared, verdict, versions

from undulog.capture import Session

SETTLE_S = 3.0
CANDUMP = "python-can Logger, candump"


@dataclass
class Outcome:
    """The figures of one run."""

    name: str
    offered: int = 0
    late: int = 0
    in_file: int = 0
    cpu: float = 0.0
    rss_mb: list[float] = field(default_factory=list)
    size: int = 0
    tick_p99_ms: float | None = None
    worst_behind_ms: float = 0.0
    packages: tuple[str, ...] = ()

    @property
    def lost(self) -> int:
        """Frames offered that are not in the file."""
        return self.offered - self.in_file

    @property
    def frame_us(self) -> float:
        """Processor time of a frame while the senders send [us]."""
        return 1e6 * self.cpu / (2 * RATE)

    def line(self) -> str:
        """Return one line of the table."""
        rss = f"{self.rss_mb[0]:.0f} -> {self.rss_mb[-1]:.0f}" if self.rss_mb else "-"
        tick = f"{self.tick_p99_ms:.2f}" if self.tick_p99_ms is not None else "-"
        return LINE.format(
            self.name, self.offered, self.lost, self.late, f"{self.cpu:.1%}", rss,
            f"{self.size / 1e6:.1f}", tick, f"{self.worst_behind_ms:.1f}",
        )  # fmt: skip


LINE = "{:<34} {:>9} {:>8} {:>8} {:>7} {:>12} {:>8} {:>8} {:>9}"
HEAD = LINE.format(
    "recorder", "offered", "lost", "late", "core", "RSS/MB", "file/MB", "p99/ms", "behind/ms"
)


def watch(outcome: Outcome, pid: int, seconds: float, senders: list[subprocess.Popen[str]]) -> None:
    """Measure the recorder while the senders send; then take what these say."""
    time.sleep(SETTLE_S)
    begun, used = time.monotonic(), cpu_s(pid)
    while time.monotonic() < begun + seconds - SETTLE_S - 2:
        time.sleep(1.0)
        outcome.rss_mb.append(memory("VmRSS", pid) / 1e6)
    outcome.cpu = (cpu_s(pid) - used) / (time.monotonic() - begun)
    for sender in senders:
        text, _ = sender.communicate(timeout=60)
        report = json.loads(text.splitlines()[-1])
        outcome.offered += report["offered"]
        outcome.late += report["late"]
        outcome.worst_behind_ms = max(outcome.worst_behind_ms, report["worst_behind_ms"])
    time.sleep(1.0)  # what is buffered is taken


def start_senders(
    stack: ExitStack, kind: str, places: Sequence[object], seconds: float, rate: float = RATE
) -> list[subprocess.Popen[str]]:
    """Start a sender for each bus."""
    options = ("--rate", rate, "--seconds", seconds)
    return [start_sender(stack, kind, place, *options) for place in places]


def finish(outcome: Outcome, recorder: subprocess.Popen[str], folder: Path) -> Outcome:
    """End our recorder and count the frames in the file."""
    report = json.loads(ended(recorder))
    outcome.tick_p99_ms = float(report["recorder"]["tick_p99_s"]) * 1e3
    output = folder / "run.mcap"
    outcome.size = output.stat().st_size
    with Session.open(output) as session:
        outcome.in_file = sum(len(session.frames(f"/can/{n}")) for n in BUSES)
    return outcome


def over_unix(
    folder: Path, seconds: float, rate: float = RATE, name: str = "undulog, AF_UNIX"
) -> Outcome:
    """Measure our recorder, frames by packets."""
    outcome = Outcome(name)
    paths = [folder / f"{name}.sock" for name in BUSES]
    with ExitStack() as stack:
        recorder = start_undulog(stack, folder, sources_at("unix", paths))
        senders = start_senders(stack, "unix", paths, seconds, rate)
        wait_for(paths[1].exists)
        watch(outcome, recorder.pid, seconds, senders)
        return finish(outcome, recorder, folder)


def over_socketcand(folder: Path, seconds: float, *, decode: bool = True) -> Outcome:
    """Measure our recorder, frames as text over TCP."""
    outcome = Outcome("undulog, socketcand" if decode else "undulog, socketcand, not decoded")
    with ExitStack() as stack:
        senders = start_senders(stack, "socketcand", (0, 0), seconds)
        sources = sources_at("socketcand", served(senders))
        recorder = start_undulog(stack, folder, sources, decode=decode)
        time.sleep(1.0)
        watch(outcome, recorder.pid, seconds, senders)
        return finish(outcome, recorder, folder)


def peer(folder: Path, seconds: float, kind: str, name: str) -> Outcome:
    """Measure a recorder of another make on the same buses."""
    packages = ("mcap-ros2-support",) if kind == "mcap-ros2" else ("python-can",)
    outcome = Outcome(name, packages=packages)
    with ExitStack() as stack:
        senders = start_senders(stack, "socketcand", (0, 0), seconds)
        recorder = start_peer(stack, kind, folder, served(senders))
        assert recorder.stdout is not None
        recorder.stdout.readline()  # it is ready
        watch(outcome, recorder.pid, seconds, senders)
        outcome.in_file = json.loads(ended(recorder).splitlines()[-1])["frames"]
        outcome.size = sum(file.stat().st_size for file in folder.glob("peer.*"))
    return outcome


def frozen_viewer(folder: Path, seconds: float) -> Outcome:
    """Our recorder with a live view that is stopped after a second and never looked at again."""
    outcome = Outcome("undulog, AF_UNIX, frozen viewer")
    paths = [folder / f"{name}.sock" for name in BUSES]
    with ExitStack() as stack:
        recorder = start_undulog(stack, folder, sources_at("unix", paths))
        wait_for((folder / "control.sock").exists)
        view = [sys.executable, "-m", "undulog", "view", "--live", folder / "control.live"]
        relay = start(stack, *view, "--save", folder / "live.rrd", stderr=subprocess.DEVNULL)
        wait_for((folder / "control.live").exists)
        senders = start_senders(stack, "unix", paths, seconds)
        time.sleep(2.0)
        relay.send_signal(signal.SIGSTOP)
        watch(outcome, recorder.pid, seconds, senders)
        finish(outcome, recorder, folder)
        relay.send_signal(signal.SIGCONT)
    return outcome


def main() -> None:
    """Run everything and judge it."""
    parser = arguments(__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=60.0, help="of each run")
    parser.add_argument("--contended", type=float, default=6.0, help="of each run, 0: none [s]")
    options = parser.parse_args()
    seconds: float = options.seconds
    print(f"two buses of {RATE:.0f} frames/s, {seconds:.0f} s\n{HEAD}", flush=True)
    runs = [
        (over_unix, seconds),
        (over_socketcand, seconds),
        (partial(over_socketcand, decode=False), seconds),
        (frozen_viewer, seconds),
        (over_unix, 2.0 + SETTLE_S, 250_000.0, "undulog, burst 500k frames/s"),
        (peer, seconds, "blf", "python-can Logger, BLF"),
        (peer, seconds, "candump", CANDUMP),
        (peer, seconds, "mcap-ros2", "mcap-ros2-support, a message a frame"),
    ]
    outcomes = []
    for run, *how in runs:
        with tempfile.TemporaryDirectory(prefix="undulog-bench-") as folder:
            outcomes.append(run(Path(folder), *how))
        print(outcomes[-1].line(), flush=True)
    ours, text, alone, frozen, _, *peers = outcomes
    growth = ours.rss_mb[-1] - ours.rss_mb[len(ours.rss_mb) // 3]
    more_ms = (frozen.tick_p99_ms or 0) - (ours.tick_p99_ms or 0)
    good = [
        *(verdict(f"{case.name}: frames lost", case.lost, 0, "frames") for case in outcomes[:5]),
        verdict(f"{ours.name}: memory growth in the last two thirds", growth, 5, "MB"),
        verdict("frozen viewer: more at the 99th percentile of the tick", more_ms, 0.5, "ms"),
        *(
            compared(
                f"record two buses, {mine.name.removeprefix('undulog, ')}: time a frame",
                [mine.frame_us], [other.frame_us],
                f"{other.name} ({versions(*other.packages)})",
                bar=0.7 if mine is not ours and other.name == CANDUMP else 1.0, unit="us",
            )
            for mine in (text, alone, ours)
            for other in peers
        ),
    ]  # fmt: skip
    for other in peers:
        verdict(f"{other.name}: frames lost", other.lost, None, "frames")
    for outcome in outcomes:
        verdict(f"{outcome.name}: frames that the sender sent late", outcome.late, None, "frames")
    if options.contended:
        print(f"\nbeside two busy loops a core and dd with fsync\n{contention.HEAD}", flush=True)
        good.append(contention.judge(contention.measure(options.contended, runs=3)))
    sys.exit(not all(good))


if __name__ == "__main__":
    main()
