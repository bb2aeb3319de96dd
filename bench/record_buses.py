"""Recording two saturated 1 Mbit/s buses: what is lost, what it costs, what others take for it.

``python bench/record_buses.py [SECONDS]``: 2 x 9,000 frames/s from two other processes, into
``undulog record`` over AF_UNIX and over loopback socketcand; the same socketcand buses into
python-can's Logger (BLF and candump) and into mcap-ros2-support; a burst of 500,000 frames/s; and
a live view that is frozen all the time. Senders are paced by the clock and wait for nobody: what
the socket refuses and what is sent more than 20 ms late counts as lost. In the end the same beside
busy loops and a busy disk (``bench/contention.py``).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import contention

from undulog.capture import Session

HERE = Path(__file__).parent
RATE = 9000.0
SETTLE_S = 3.0
TICKS_S = os.sysconf("SC_CLK_TCK")


@dataclass
class Outcome:
    """What one run gave."""

    name: str
    offered: int = 0
    lost_by_sender: int = 0
    in_file: int = 0
    cpu: float = 0.0
    rss_mb: list[float] = field(default_factory=list)
    size: int = 0
    tick_p99_ms: float | None = None
    worst_behind_ms: float = 0.0

    @property
    def lost(self) -> int:
        """Frames offered that are not in the file, and those the sender could not send in time."""
        return self.offered - self.in_file + self.lost_by_sender

    def line(self) -> str:
        """One line of the table."""
        rss = f"{self.rss_mb[0]:.0f} -> {self.rss_mb[-1]:.0f}" if self.rss_mb else "-"
        tick = f"{self.tick_p99_ms:.2f}" if self.tick_p99_ms is not None else "-"
        return (
            f"{self.name:<34} {self.offered:>9} {self.lost:>8} {self.cpu:>7.1%} {rss:>12} "
            f"{self.size / 1e6:>8.1f} {tick:>8} {self.worst_behind_ms:>9.1f}"
        )


HEAD = (
    f"{'recorder':<34} {'offered':>9} {'lost':>8} {'core':>7} {'RSS/MB':>12} {'file/MB':>8} "
    f"{'p99/ms':>8} {'behind/ms':>9}"
)


def cpu_s(pid: int) -> float:
    """Processor time of a process, all its threads [s]."""
    parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(parts[11]) + int(parts[12])) / TICKS_S


def rss_mb(pid: int) -> float:
    """Resident memory [MB]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def start_senders(
    kind: str, where: Sequence[str], seconds: float, rate: float, stack: ExitStack
) -> list[subprocess.Popen[str]]:
    """One process a bus."""
    senders: list[subprocess.Popen[str]] = []
    for place in where:
        command = [sys.executable, str(HERE / "bus_sender.py"), kind, place]
        command += ["--rate", str(rate), "--seconds", str(seconds)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        stack.callback(end, process)
        senders.append(process)
    return senders


def end(process: subprocess.Popen[str]) -> None:
    """End a process that we started."""
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def watch(outcome: Outcome, pid: int, seconds: float, senders: list[subprocess.Popen[str]]) -> None:
    """Measure the recorder while the senders send; then take what these say."""
    time.sleep(SETTLE_S)
    begun, used = time.monotonic(), cpu_s(pid)
    while time.monotonic() < begun + seconds - SETTLE_S - 2:
        time.sleep(1.0)
        outcome.rss_mb.append(rss_mb(pid))
    outcome.cpu = (cpu_s(pid) - used) / (time.monotonic() - begun)
    for sender in senders:
        text, _ = sender.communicate(timeout=60)
        said = json.loads(text.splitlines()[-1])
        outcome.offered += said["offered"]
        outcome.lost_by_sender += said["late"]
        outcome.worst_behind_ms = max(outcome.worst_behind_ms, said["worst_behind_ms"])


def start_undulog(
    folder: Path, sources: Sequence[str], stack: ExitStack
) -> tuple[subprocess.Popen[str], Path]:
    """The recorder as a user starts it."""
    output = folder / "run.mcap"
    command = [sys.executable, "-m", "undulog", "record", *sources, "--robot", "snake25"]
    command += ["--bus", "front", "-o", str(output), "--floor", "0", "--json"]
    command += ["--socket", str(folder / "control.sock"), "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    stack.callback(end, process)
    return process, output


def finish_undulog(outcome: Outcome, process: subprocess.Popen[str], output: Path) -> None:
    """Stop it as a service manager does, and count what is in the file."""
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    text, _ = process.communicate(timeout=120)
    report = json.loads(text)
    outcome.tick_p99_ms = float(report["recorder"]["tick_p99_s"]) * 1e3
    outcome.size = output.stat().st_size
    with Session.open(output) as session:
        outcome.in_file = sum(len(session.frames(f"/can/{n}")) for n in ("front", "rear"))


def over_unix(folder: Path, seconds: float, rate: float = RATE, name: str = "") -> Outcome:
    """Our recorder, frames by packets."""
    outcome = Outcome(name or "undulog, AF_UNIX")
    paths = [str(folder / f"{name}.sock") for name in ("front", "rear")]
    with ExitStack() as stack:
        sources = [f"{n}=unix:{p}" for n, p in zip(("front", "rear"), paths, strict=True)]
        recorder, output = start_undulog(folder, sources, stack)
        senders = start_senders("unix", paths, seconds, rate, stack)
        wait_for_socket(Path(paths[1]))
        watch(outcome, recorder.pid, seconds, senders)
        finish_undulog(outcome, recorder, output)
    return outcome


def wait_for_socket(path: Path) -> None:
    """Until the recorder listens."""
    deadline = time.monotonic() + 60
    while not path.exists():
        if time.monotonic() > deadline:
            sys.exit(f"{path}: the recorder doesn't listen")
        time.sleep(0.02)


def served(senders: list[subprocess.Popen[str]]) -> list[int]:
    """Ports of socketcand senders."""
    ports: list[int] = []
    for sender in senders:
        assert sender.stdout is not None
        ports.append(json.loads(sender.stdout.readline())["port"])
    return ports


def over_socketcand(folder: Path, seconds: float) -> Outcome:
    """Our recorder, frames as text over TCP."""
    outcome = Outcome("undulog, socketcand")
    with ExitStack() as stack:
        senders = start_senders("socketcand", ["0", "0"], seconds, RATE, stack)
        sources = [
            f"{name}=can:socketcand:can0?host=127.0.0.1&port={port}"
            for name, port in zip(("front", "rear"), served(senders), strict=True)
        ]
        recorder, output = start_undulog(folder, sources, stack)
        time.sleep(1.0)
        watch(outcome, recorder.pid, seconds, senders)
        finish_undulog(outcome, recorder, output)
    return outcome


def peer(kind: str, folder: Path, seconds: float) -> Outcome:
    """A recorder of another make on the same buses."""
    title = {"blf": "python-can Logger, BLF", "candump": "python-can Logger, candump"}
    outcome = Outcome(title.get(kind, "mcap-ros2-support, a message a frame"))
    with ExitStack() as stack:
        senders = start_senders("socketcand", ["0", "0"], seconds, RATE, stack)
        ports = [str(port) for port in served(senders)]
        command = [sys.executable, str(HERE / "peer_recorder.py"), kind, str(folder / "peer")]
        process = subprocess.Popen(
            [*command, *ports], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        stack.callback(end, process)
        watch(outcome, process.pid, seconds, senders)
        time.sleep(1.0)
        process.send_signal(signal.SIGTERM)
        text, _ = process.communicate(timeout=120)
        outcome.in_file = json.loads(text.splitlines()[-1])["frames"]
        outcome.size = sum(file.stat().st_size for file in folder.glob("peer.*"))
    return outcome


def frozen_viewer(folder: Path, seconds: float) -> Outcome:
    """Our recorder with a live view that is stopped after a second and never looked at again."""
    outcome = Outcome("undulog, AF_UNIX, frozen viewer")
    paths = [str(folder / f"{name}.sock") for name in ("front", "rear")]
    with ExitStack() as stack:
        sources = [f"{n}=unix:{p}" for n, p in zip(("front", "rear"), paths, strict=True)]
        recorder, output = start_undulog(folder, sources, stack)
        wait_for_socket(folder / "control.sock")
        view = [sys.executable, "-m", "undulog", "view", "--live", str(folder / "control.live")]
        relay = subprocess.Popen(
            [*view, "--save", str(folder / "live.rrd")],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        stack.callback(end, relay)
        wait_for_socket(folder / "control.live")
        senders = start_senders("unix", paths, seconds, RATE, stack)
        time.sleep(2.0)
        relay.send_signal(signal.SIGSTOP)
        watch(outcome, recorder.pid, seconds, senders)
        finish_undulog(outcome, recorder, output)
        relay.send_signal(signal.SIGCONT)
    return outcome


def main() -> None:
    """Run everything and judge it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seconds", type=float, nargs="?", default=60.0, help="of each run")
    seconds = parser.parse_args().seconds
    print(f"two buses of {RATE:.0f} frames/s, {seconds:.0f} s\n{HEAD}", flush=True)
    runs = [
        lambda folder: over_unix(folder, seconds),
        lambda folder: over_socketcand(folder, seconds),
        lambda folder: frozen_viewer(folder, seconds),
        lambda folder: over_unix(folder, 2.0 + SETTLE_S, 250_000.0, "undulog, burst 500k frames/s"),
        lambda folder: peer("blf", folder, seconds),
        lambda folder: peer("candump", folder, seconds),
        lambda folder: peer("mcap-ros2", folder, seconds),
    ]
    outcomes: list[Outcome] = []
    for run in runs:
        with tempfile.TemporaryDirectory(prefix="undulog-bench-") as folder:
            outcomes.append(run(Path(folder)))
        print(outcomes[-1].line(), flush=True)
    print(f"\nbeside two busy loops a core and dd with fsync\n{contention.HEAD}", flush=True)
    contended = contention.measure(6.0, runs=3)
    ours, text, frozen, burst, *peers = outcomes
    growth = ours.rss_mb[-1] - ours.rss_mb[len(ours.rss_mb) // 3]
    more_ms = (frozen.tick_p99_ms or 0) - (ours.tick_p99_ms or 0)
    least = min(peers, key=lambda outcome: outcome.cpu)
    for passed, words in (
        (ours.lost == 0, f"AF_UNIX: {ours.lost} lost (bar 0)"),
        (ours.cpu <= 0.15, f"AF_UNIX: {ours.cpu:.1%} of a core (bar 15 %)"),
        (growth < 5, f"AF_UNIX: resident memory grows by {growth:+.1f} MB in the last two thirds"),
        (text.lost == 0, f"socketcand: {text.lost} lost (bar 0)"),
        (text.cpu <= 0.25, f"socketcand: {text.cpu:.1%} of a core (bar 25 %)"),
        (burst.lost == 0, f"burst: {burst.lost} of {burst.offered} lost (bar 0)"),
        (frozen.lost == 0, f"frozen viewer: {frozen.lost} lost (bar 0)"),
        (more_ms <= 0.5, f"frozen viewer: p99 of the tick {more_ms:+.2f} ms (bar +0.5 ms)"),
        (
            text.cpu < least.cpu,
            f"socketcand: {least.cpu / text.cpu:.1f} times as cheap as {least.name}",
        ),
        *contention.verdicts(contended),
    ):
        print("PASS" if passed else "FAIL", words)


if __name__ == "__main__":
    main()
