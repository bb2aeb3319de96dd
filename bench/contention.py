"""Recording while others hold every core and the disk: what is refused, what is lost, what is late.

``python bench/contention.py [SECONDS] [--runs N]``: 2 x 9,000 frames/s beside two busy loops a core
and ``dd`` with fsync on the same disk. Senders have real-time priority, wait for nobody and note
when ``send()`` returned for each frame; the recorder has its priority granted (nice -10), or not
(without CAP_SYS_NICE). The first second is start-up and counted apart.
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
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from undulog.capture import Session

HERE = Path(__file__).parent
BUSES = ("front", "rear")
RATE = 9000.0
START_UP_NS = 1_000_000_000
LATE_NS = 5_000_000
PYTHON_CAN = "python-can Logger, BLF"
REFUSED_PRIORITY = ("setpriv", "--bounding-set=-sys_nice")
TICKS_S = os.sysconf("SC_CLK_TCK")


@dataclass
class Shares:
    """What became of the frames of one run, start-up apart.

    Attributes:
        name: The recorder and how it was started.
        offered: Frames that the senders had.
        refused: Of them, those that the recorder's buffers did not take.
        start_refused: The same during start-up, not among ``refused``.
        lost: Frames taken and not in the file, start-up included.
        late: Frames stamped more than 5 ms from the return of ``send()``; None where the peer
            keeps no time of arrival.
        worst_ms: The largest such distance [ms].
        cpu: The recorder's processor share, of a core.
    """

    name: str
    offered: int
    refused: int
    start_refused: int
    lost: int
    late: int | None
    worst_ms: float
    cpu: float

    def line(self) -> str:
        """One line of the table."""
        late = "-" if self.late is None else f"{self.late / max(self.offered, 1):.3%}"
        return (
            f"{self.name:<46} {self.offered:>8} {self.refused / max(self.offered, 1):>8.3%} "
            f"{self.start_refused:>6} {self.lost:>5} {late:>8} {self.worst_ms:>8.1f} "
            f"{self.cpu:>6.1%}"
        )


HEAD = (
    f"{'recorder':<46} {'offered':>8} {'refused':>8} {'start':>6} {'lost':>5} {'> 5 ms':>8} "
    f"{'worst/ms':>8} {'core':>6}"
)


@contextmanager
def contention(folder: Path) -> Iterator[None]:
    """Two busy loops a core, and a file written and synced again and again."""
    alive = "while kill -0 $PPID"  # they end with the bench, however that ends
    count = "i=0; while [ $i -lt 100000 ]; do i=$((i+1)); done"
    loops = ["sh", "-c", f"{alive}; do {count}; done"]
    disk = f"{alive}; do dd if=/dev/zero of={folder / 'dd'} bs=1M count=64 conv=fsync; done"
    commands = [loops] * (2 * (os.cpu_count() or 1)) + [["sh", "-c", disk]]
    running = [
        subprocess.Popen(each, stderr=subprocess.DEVNULL, start_new_session=True)
        for each in commands
    ]
    try:
        yield
    finally:
        for process in running:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def end(process: subprocess.Popen[str]) -> None:
    """End a process that we started."""
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def start_sender(
    kind: str, where: str, folder: Path, stack: ExitStack, *, seconds: float, per_packet: int
) -> subprocess.Popen[str]:
    """One bus, in a process of real-time priority."""
    sent = folder / f"sent-{len(list(folder.glob('*.begun')))}.npz"
    sent.with_suffix(".begun").touch()
    command = [sys.executable, str(HERE / "bus_sender.py"), kind, where, "--fifo"]
    command += ["--rate", str(RATE), "--seconds", str(seconds), "--buffer", "0"]
    command += ["--per-packet", str(per_packet), "--sent", str(sent)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    stack.callback(end, process)
    return process


def cpu_s(pid: int) -> float:
    """Processor time of a process, all its threads [s]."""
    parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(parts[11]) + int(parts[12])) / TICKS_S


def waited(senders: Sequence[subprocess.Popen[str]], pid: int) -> tuple[float, int]:
    """Wait for the senders; the recorder's processor share meanwhile, and frames sent late."""
    begun, used = time.monotonic(), cpu_s(pid)
    late = 0
    for sender in senders:
        text, _ = sender.communicate(timeout=120)
        late += json.loads(text.splitlines()[-1])["late"]
    return (cpu_s(pid) - used) / (time.monotonic() - begun), late


def judged(name: str, folder: Path, stamps: Sequence[dict[int, int] | int], cpu: float) -> Shares:
    """Hold what is in the file against what the senders noted.

    Args:
        name: Of the run.
        folder: Where the senders noted it.
        stamps: For each bus the recorded time of arrival of each frame by its number, or only how
            many frames were recorded.
        cpu: The recorder's processor share.

    Returns:
        The shares.
    """
    total = Shares(name, 0, 0, 0, 0, None, 0.0, cpu)
    for k, found in enumerate(stamps):
        with np.load(folder / f"sent-{k}.npz") as noted:
            sent_ns = noted["sent_ns"]
        number = np.arange(len(sent_ns))
        begun = number < START_UP_NS * RATE / 1e9
        total.offered += int((~begun).sum())
        refused = sent_ns == 0
        total.refused += int((refused & ~begun).sum())
        total.start_refused += int((refused & begun).sum())
        if isinstance(found, int):
            total.lost += int((~refused).sum()) - found
            continue
        kept = np.zeros(len(sent_ns), dtype=np.int64)
        kept[np.fromiter(found, np.int64)] = np.fromiter(found.values(), np.int64)
        total.lost += int(((kept == 0) & ~refused).sum())
        both = (kept > 0) & ~refused & ~begun
        apart = np.abs(kept[both] - sent_ns[both])
        total.late = (total.late or 0) + int((apart > LATE_NS).sum())
        total.worst_ms = max(total.worst_ms, float(apart.max(initial=0)) / 1e6)
    return total


def undulog(kind: str, folder: Path, seconds: float, per_packet: int, *, granted: bool) -> Shares:
    """Our recorder."""
    output = folder / "run.mcap"
    paths = [str(folder / f"{name}.sock") for name in BUSES]
    with ExitStack() as stack:
        senders: list[subprocess.Popen[str]] = []
        if kind == "unix":
            sources = [f"{n}=unix:{p}" for n, p in zip(BUSES, paths, strict=True)]
        else:
            ports: list[int] = []
            for _ in BUSES:
                senders.append(
                    start_sender(kind, "0", folder, stack, seconds=seconds, per_packet=per_packet)
                )
                ports.append(served(senders[-1]))
            sources = [
                f"{name}=can:socketcand:can0?host=127.0.0.1&port={port}"
                for name, port in zip(BUSES, ports, strict=True)
            ]
        command: list[str] = [] if granted else list(REFUSED_PRIORITY)
        command += [sys.executable, "-m", "undulog", "record", *sources, "--robot", "snake25"]
        command += ["--bus", "front", "-o", str(output), "--floor", "0", "--json", "--quiet"]
        command += ["--socket", str(folder / "control.sock")]
        recorder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        stack.callback(end, recorder)
        if kind == "unix":
            wait_for(Path(paths[1]))
            senders = [
                start_sender(kind, p, folder, stack, seconds=seconds, per_packet=per_packet)
                for p in paths
            ]
        stack.enter_context(contention(folder))
        cpu, _ = waited(senders, recorder.pid)
        recorder.send_signal(signal.SIGTERM)
        recorder.communicate(timeout=120)
    with Session.open(output) as session:
        stamps = [numbered(session, name, folder / f"sent-{k}.npz") for k, name in enumerate(BUSES)]
    how = "granted" if granted else "refused"
    packets = f", {per_packet} a packet" if kind == "unix" else ""
    name = f"undulog, {'AF_UNIX' if kind == 'unix' else kind}{packets}, priority {how}"
    return judged(name, folder, stamps, cpu)


def numbered(session: Session, name: str, sent: Path) -> dict[int, int]:
    """Time of arrival of each recorded frame by the sender's number [Unix ns]."""
    frames = session.frames(f"/can/{name}")
    with np.load(sent) as noted:
        apart_ns = frames["t_device_ns"].astype(np.int64) - int(noted["t0_ns"])
    numbers = np.rint(apart_ns * (RATE / 1e9)).astype(np.int64)
    return dict(zip(numbers.tolist(), frames["t_host_ns"].astype(np.int64).tolist(), strict=True))


def python_can(folder: Path, seconds: float) -> Shares:
    """python-can's own Logger on socketcand; it keeps the server's times, none of arrival."""
    with ExitStack() as stack:
        senders = [
            start_sender("socketcand", "0", folder, stack, seconds=seconds, per_packet=1)
            for _ in BUSES
        ]
        ports = [str(served(sender)) for sender in senders]
        command = [sys.executable, str(HERE / "peer_recorder.py"), "blf", str(folder / "peer")]
        peer = subprocess.Popen(
            [*command, *ports], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        stack.callback(end, peer)
        stack.enter_context(contention(folder))
        cpu, _ = waited(senders, peer.pid)
        time.sleep(1.0)
        peer.send_signal(signal.SIGTERM)
        frames = int(json.loads(peer.communicate(timeout=120)[0].splitlines()[-1])["frames"])
    return judged(PYTHON_CAN, folder, [frames, 0], cpu)  # it doesn't say of which bus


def served(sender: subprocess.Popen[str]) -> int:
    """Port of a socketcand sender."""
    assert sender.stdout is not None
    return int(json.loads(sender.stdout.readline())["port"])


def wait_for(path: Path) -> None:
    """Until the recorder listens."""
    deadline = time.monotonic() + 60
    while not path.exists():
        if time.monotonic() > deadline:
            sys.exit(f"{path}: the recorder doesn't listen")
        time.sleep(0.02)


def measure(
    seconds: float, *, runs: int, only: str = "", folder: Path | None = None
) -> list[Shares]:
    """Run every case and print a line for each run.

    Args:
        seconds: Of each run.
        runs: Of each case.
        only: Cases whose name has this text.
        folder: On the disk to be measured; the usual place for temporary files by default.

    Returns:
        What became of the frames in each run.
    """
    cases: dict[str, Callable[[Path], Shares]] = {
        f"{kind} {per_packet} {'granted' if granted else 'refused'}": (
            lambda place, kind=kind, per_packet=per_packet, granted=granted: undulog(
                kind, place, seconds, per_packet, granted=granted
            )
        )
        for granted in (True, False)
        for kind, per_packet in (("unix", 1), ("unix", 9), ("socketcand", 1))
    }
    cases["python-can"] = lambda place: python_can(place, seconds)
    found: list[Shares] = []
    for name, run in cases.items():
        for _ in range(runs if only in name else 0):
            with tempfile.TemporaryDirectory(prefix="undulog-bench-", dir=folder) as place:
                found.append(run(Path(place)))
            print(found[-1].line(), flush=True)
    return found


def verdicts(found: Sequence[Shares]) -> list[tuple[bool, str]]:
    """Hold the runs against the bars.

    Args:
        found: The runs.

    Returns:
        For each bar whether it is reached, and the figures.
    """
    lines: list[tuple[bool, str]] = []
    for name in dict.fromkeys(each.name for each in found if each.name != PYTHON_CAN):
        runs = [each for each in found if each.name == name]
        offered = sum(each.offered for each in runs)
        refused = sum(each.refused for each in runs) / offered
        late = sum(each.late or 0 for each in runs) / offered
        lost = sum(each.lost for each in runs)
        bar = 0.0 if "granted" in name else 0.005
        lines.append((lost == 0, f"{name}: {lost} accepted frames lost (bar 0)"))
        lines.append((refused <= bar, f"{name}: {refused:.3%} refused (bar {bar:.1%})"))
        if "granted" in name:
            lines.append((late <= 0.001, f"{name}: {late:.3%} stamped > 5 ms off (bar 0.1 %)"))
    peers = [each.lost for each in found if each.name == PYTHON_CAN]
    if peers:
        ours = sum(each.lost for each in found if "socketcand" in each.name)
        text = f"socketcand: {ours} lost; {PYTHON_CAN} on the same load: {sum(peers)} lost"
        lines.append((ours <= sum(peers), text))
    return lines


def main() -> None:
    """Run everything and judge it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seconds", type=float, nargs="?", default=6.0, help="of each run")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--only", default="", help="cases whose name has this text")
    parser.add_argument("--folder", type=Path, help="on the disk to be measured")
    args = parser.parse_args()
    print(HEAD, flush=True)
    found = measure(args.seconds, runs=args.runs, only=args.only, folder=args.folder)
    for passed, words in verdicts(found):
        print("PASS" if passed else "FAIL", words)


if __name__ == "__main__":
    main()
