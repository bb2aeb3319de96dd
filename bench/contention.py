"""Recording while others hold every core and the disk: what is refused, what is lost, what is late.

``python bench/contention.py [SECONDS] [--runs N]``: 2 x 9,000 frames/s beside two busy loops a core
and ``dd`` with fsync on the same disk. Senders have real-time priority, wait for nobody and note
when ``send()`` returned for each frame; the recorder has its priority granted (nice -10), or not
(without CAP_SYS_NICE). The first second is start-up and counted apart.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from measuring import HERE, arguments, cpu_s, start, wait_for
from records import verdict, versions

from undulog.capture import Session

BUSES = ("front", "rear")
RATE = 9000.0
START_UP_NS = 1_000_000_000
LATE_NS = 5_000_000
PYTHON_CAN = "python-can Logger, BLF"
REFUSED_PRIORITY = ("setpriv", "--bounding-set=-sys_nice")


@dataclass
class Shares:
    """Counts of the frames of one run, start-up apart.

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
        """Return one line of the table."""
        refused, late = (
            "-" if count is None else f"{count / max(self.offered, 1):.3%}"
            for count in (self.refused, self.late)
        )
        return LINE.format(
            self.name, self.offered, refused, self.start_refused, self.lost, late,
            f"{self.worst_ms:.1f}", f"{self.cpu:.1%}",
        )  # fmt: skip


LINE = "{:<46} {:>8} {:>8} {:>6} {:>5} {:>8} {:>8} {:>6}"
HEAD = LINE.format("recorder", "offered", "refused", "start", "lost", "> 5 ms", "worst/ms", "core")


@contextmanager
def contention(folder: Path) -> Iterator[None]:
    """Two busy loops a core, and a file written and synced again and again."""
    alive = "while kill -0 $PPID"  # they end with the bench, however that ends
    count = "i=0; while [ $i -lt 100000 ]; do i=$((i+1)); done"
    loops = ["sh", "-c", f"{alive}; do {count}; done"]
    disk = f"{alive}; do dd if=/dev/zero of={folder / 'dd'} bs=1M count=64 conv=fsync; done"
    commands = [loops] * (2 * (os.cpu_count() or 1)) + [["sh", "-c", disk]]
    running = [
        subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
        for command in commands
    ]
    try:
        yield
    finally:
        for process in running:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def start_sender(
    stack: ExitStack, kind: str, place: object, *options: object
) -> subprocess.Popen[str]:
    """Start the sender of one bus; ``place`` is its socket, 0 for socketcand."""
    return start(stack, sys.executable, HERE / "bus_sender.py", kind, place, *options)


def served(senders: Sequence[subprocess.Popen[str]]) -> list[int]:
    """Return the ports of socketcand senders."""
    return [json.loads(sender.stdout.readline())["port"] for sender in senders]


def sources_at(kind: str, places: Sequence[object]) -> list[str]:
    """Return the addresses of two buses by their sockets or ports."""
    form = "{}=unix:{}" if kind == "unix" else "{}=can:socketcand:can0?host=127.0.0.1&port={}"
    return [form.format(*pair) for pair in zip(BUSES, places, strict=True)]


def start_undulog(
    stack: ExitStack, folder: Path, sources: Sequence[str], *before: str, decode: bool = True
) -> subprocess.Popen[str]:
    """Start the recorder as a user does, to ``run.mcap``; the first bus is decoded, or none."""
    command = [*before, sys.executable, "-m", "undulog", "record", *sources]
    command += ["--robot", "snake25", "--bus", "front"] if decode else []
    command += ["-o", folder / "run.mcap", "--floor", 0, "--json", "--quiet"]
    return start(stack, *command, "--socket", folder / "control.sock")


def start_peer(
    stack: ExitStack, kind: str, folder: Path, ports: Sequence[int]
) -> subprocess.Popen[str]:
    """Start a recorder of another make."""
    command = [sys.executable, HERE / "peer_recorder.py", kind, folder / "peer", *ports]
    return start(stack, *command, stderr=subprocess.DEVNULL)


def ended(recorder: subprocess.Popen[str], after_s: float = 1.0) -> str:
    """End a recorder as a service manager does; return its output."""
    time.sleep(after_s)
    recorder.send_signal(signal.SIGTERM)
    return recorder.communicate(timeout=120)[0]


def waited(senders: Sequence[subprocess.Popen[str]], pid: int) -> float:
    """Wait for the senders; return the recorder's processor share meanwhile."""
    begun, used = time.monotonic(), cpu_s(pid)
    for sender in senders:
        sender.communicate(timeout=120)
    return (cpu_s(pid) - used) / (time.monotonic() - begun)


def judged(name: str, folder: Path, stamps: Sequence[dict[int, int] | int], cpu: float) -> Shares:
    """Compare the frames in the file with those noted by the senders.

    Args:
        name: Of the run.
        folder: Folder of the senders' notes.
        stamps: For each bus the recorded time of arrival of each frame by its number, or only the
            number of recorded frames.
        cpu: The recorder's processor share.
    """
    total = Shares(name, 0, 0, 0, 0, None, 0.0, cpu)
    for k, stamp in enumerate(stamps):
        with np.load(folder / f"sent-{k}.npz") as noted:
            sent_ns = noted["sent_ns"]
        number = np.arange(len(sent_ns))
        begun = number < START_UP_NS * RATE / 1e9
        total.offered += int((~begun).sum())
        refused = sent_ns == 0
        total.refused += int((refused & ~begun).sum())
        total.start_refused += int((refused & begun).sum())
        if isinstance(stamp, int):
            total.lost += int((~refused).sum()) - stamp
            continue
        kept = np.zeros(len(sent_ns), dtype=np.int64)
        kept[np.fromiter(stamp, np.int64)] = np.fromiter(stamp.values(), np.int64)
        total.lost += int(((kept == 0) & ~refused).sum())
        both = (kept > 0) & ~refused & ~begun
        apart = np.abs(kept[both] - sent_ns[both])
        total.late = (total.late or 0) + int((apart > LATE_NS).sum())
        total.worst_ms = max(total.worst_ms, float(apart.max(initial=0)) / 1e6)
    return total


def loaded(
    stack: ExitStack, kind: str, places: Sequence[object], folder: Path, *,
    seconds: float, per_packet: int,
) -> list[subprocess.Popen[str]]:  # fmt: skip
    """Start senders of real-time priority that note when each frame was taken."""
    options = ("--fifo", "--rate", RATE, "--seconds", seconds, "--buffer", 0)
    options += ("--per-packet", per_packet, "--sent")
    return [
        start_sender(stack, kind, place, *options, folder / f"sent-{k}.npz")
        for k, place in enumerate(places)
    ]


def undulog(kind: str, folder: Path, seconds: float, per_packet: int, *, granted: bool) -> Shares:
    """Measure our recorder."""
    places = [folder / f"{name}.sock" if kind == "unix" else 0 for name in BUSES]
    before = () if granted else REFUSED_PRIORITY
    with ExitStack() as stack:
        load = partial(loaded, stack, kind, places, folder, seconds=seconds, per_packet=per_packet)
        if kind == "unix":
            recorder = start_undulog(stack, folder, sources_at(kind, places), *before)
            wait_for(places[1].exists)
            senders = load()
        else:
            senders = load()
            recorder = start_undulog(stack, folder, sources_at(kind, served(senders)), *before)
        stack.enter_context(contention(folder))
        cpu = waited(senders, recorder.pid)
        ended(recorder, 0.0)
    with Session.open(folder / "run.mcap") as session:
        stamps = [numbered(session, name, folder / f"sent-{k}.npz") for k, name in enumerate(BUSES)]
    how = "granted" if granted else "refused"
    packets = f", {per_packet} a packet" if kind == "unix" else ""
    name = f"undulog, {'AF_UNIX' if kind == 'unix' else kind}{packets}, priority {how}"
    return judged(name, folder, stamps, cpu)


def numbered(session: Session, name: str, sent: Path) -> dict[int, int]:
    """Return time of arrival of each recorded frame by the sender's number [Unix ns]."""
    frames = session.frames(f"/can/{name}")
    with np.load(sent) as noted:
        apart_ns = frames["t_device_ns"].astype(np.int64) - int(noted["t0_ns"])
    numbers = np.rint(apart_ns * (RATE / 1e9)).astype(np.int64)
    return dict(zip(numbers.tolist(), frames["t_host_ns"].astype(np.int64).tolist(), strict=True))


def python_can(folder: Path, seconds: float) -> Shares:
    """python-can's own Logger on socketcand; it keeps the server's times, none of arrival."""
    with ExitStack() as stack:
        senders = loaded(stack, "socketcand", (0, 0), folder, seconds=seconds, per_packet=1)
        peer = start_peer(stack, "blf", folder, served(senders))
        stack.enter_context(contention(folder))
        cpu = waited(senders, peer.pid)
        frames = int(json.loads(ended(peer).splitlines()[-1])["frames"])
    return judged(PYTHON_CAN, folder, [frames, 0], cpu)  # it doesn't say of which bus


def measure(
    seconds: float, *, runs: int, only: str = "", folder: Path | None = None
) -> list[Shares]:
    """Run every case whose name contains ``only``, and print a line for each run.

    The folder is on the disk to be measured; that of temporary files by default.
    """
    cases = {
        f"{kind} {packet} {'granted' if granted else 'refused'}": partial(
            undulog, kind, seconds=seconds, per_packet=packet, granted=granted
        )
        for granted in (True, False)
        for kind, packet in (("unix", 1), ("unix", 9), ("socketcand", 1))
    }
    cases["python-can"] = partial(python_can, seconds=seconds)
    shares = []
    for name, run in cases.items():
        for _ in range(runs if only in name else 0):
            with tempfile.TemporaryDirectory(prefix="undulog-bench-", dir=folder) as place:
                shares.append(run(folder=Path(place)))
            print(shares[-1].line(), flush=True)
    return shares


def judge(outcomes: Sequence[Shares]) -> bool:
    """Print and keep the figures of the runs by case; return whether all bars are met."""
    good: list[bool] = []
    for name in dict.fromkeys(share.name for share in outcomes if share.name != PYTHON_CAN):
        runs = [share for share in outcomes if share.name == name]
        counts = [(run.offered, run.refused, run.late or 0, run.lost) for run in runs]
        offered, *shares, lost = np.sum(counts, axis=0).tolist()
        refused, late = (100 * count / offered for count in shares)
        what = f"contention, {name}"
        good.append(verdict(f"{what}: accepted frames lost", lost, 0, "frames"))
        bar = 0.0 if "granted" in name else 0.5
        good.append(verdict(f"{what}: refused", refused, bar, "%"))
        if "granted" in name:
            good.append(verdict(f"{what}: stamped > 5 ms off", late, 0.1, "%"))
    peers = [share for share in outcomes if share.name == PYTHON_CAN]
    if peers:
        ours = sum(share.lost for share in outcomes if "socketcand" in share.name)
        peer = f"{versions('python-can')} Logger, BLF, on the same load"
        theirs = sum(share.lost for share in peers)
        what = "contention, socketcand: accepted frames lost"
        good.append(verdict(what, ours, theirs, "frames", peer=peer))
    return all(good)


def main() -> None:
    """Run everything and judge it."""
    parser = arguments(__doc__, runs=3)
    parser.add_argument("seconds", type=float, nargs="?", default=6.0, help="of each run")
    parser.add_argument("--only", default="", help="cases whose name has this text")
    parser.add_argument("--folder", type=Path, help="on the disk to be measured")
    args = parser.parse_args()
    print(HEAD, flush=True)
    shares = measure(args.seconds, runs=args.runs, only=args.only, folder=args.folder)
    sys.exit(not judge(shares))


if __name__ == "__main__":
    main()
