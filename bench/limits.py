"""Time of reading as each dimension of a log is doubled: at most linear.

For each dimension two logs are written, the second twice as large in it, and each command reads
both in a process of its own. Twice as much may cost at most 2.3 times the processor time beyond
that of a small log; what takes less than a tenth of a second in all is not judged.

Run: python bench/limits.py [--runs 3] [DIMENSION...]
"""

from __future__ import annotations

import contextlib
import io
import os
import resource
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hostile_logs import EPOCH_NS, NS, HostileLog, Message, joint_state, zeros
from measuring import arguments
from records import verdict

import undulog

MOST = 2.3
LEAST_S = 0.1
MIB = 1 << 20

VERBS: dict[str, list[str]] = {
    "info": ["log", "info"],
    "check": ["log", "check"],
    "analyse": ["analyse"],
    "recover": ["log", "recover", "-o", "{out}.mcap"],
    "export": ["log", "export", "-o", "{out}.csv"],
}


def base() -> HostileLog:
    """Return a log with commands and states of two joints."""
    log = HostileLog()
    kind = log.schema()
    for topic in ("/joint_commands", "/joint_states"):
        log.channel(topic, kind)
    log.chunk(_ticks(100))
    return log


def _ticks(count: int, joints: int = 2, start_s: int = 0) -> list[Message]:
    names, place = [f"joint{k:06d}" for k in range(joints)], np.arange(joints)
    made: list[Message] = []
    for tick in range(count):
        t_ns = EPOCH_NS + start_s * NS + tick * NS // 100
        position = np.sin(tick / 10 - place)
        made += [(channel, t_ns, joint_state(t_ns, names, position)) for channel in (1, 2)]
    return made


def empty_chunks(log: HostileLog, count: int) -> None:
    """Chunks without a message."""
    for _ in range(count):
        log.chunk()


def small_chunks(log: HostileLog, count: int) -> None:
    """Chunks of one message."""
    for message in _ticks(count // 2, start_s=2):
        log.chunk([message])


def messages(log: HostileLog, count: int) -> None:
    """Messages in chunks of a thousand."""
    every = _ticks(count // 2, start_s=2)
    for first in range(0, count, 1000):
        log.chunk(every[first : first + 1000])


def channels(log: HostileLog, count: int) -> None:
    """Channels of one message each."""
    made = [log.channel(f"/topic{k}", 1) for k in range(count)]
    message = joint_state(EPOCH_NS, ["a"], [1.0])
    log.chunk([(channel, EPOCH_NS + k * 1000, message) for k, channel in enumerate(made)])


def joints(log: HostileLog, count: int) -> None:
    """Joints of one message."""
    log.chunk(_ticks(20, count, start_s=2))


def joint_lists(log: HostileLog, count: int) -> None:
    """Messages that each name another joint."""
    times = [EPOCH_NS + 2 * NS + k * 10_000 for k in range(count)]
    log.chunk([(2, t, joint_state(t, [f"joint{t}"], [0.5])) for t in times])


def listed_again(log: HostileLog, count: int) -> None:
    """A chunk that the summary lists again and again."""
    log.chunk(_ticks(500, start_s=2), listed=count)


def decompressed(log: HostileLog, count: int) -> None:
    """Bytes that chunks have when they are decompressed [MiB]."""
    for _ in range(count // 64):
        log.chunk(packed=zeros(64 * MIB), size=64 * MIB, times=(EPOCH_NS, EPOCH_NS + NS))


DIMENSIONS: dict[str, tuple[Callable[[HostileLog, int], None], int]] = {
    "empty chunks": (empty_chunks, 20_000),
    "small chunks": (small_chunks, 2_000),
    "messages": (messages, 20_000),
    "channels": (channels, 8_000),
    "joints": (joints, 1_000),
    "lists of joints": (joint_lists, 10_000),
    "chunk listed again": (listed_again, 20_000),
    "decompressed MiB": (decompressed, 512),
}


def cost(arguments: list[str]) -> tuple[float, float]:
    """Processor time [s] and peak memory [MiB] of a command, in a fork that has its imports."""
    process = os.fork()
    if not process:
        with Path(os.devnull).open("w") as sink, contextlib.redirect_stdout(sink):
            resource.setrlimit(resource.RLIMIT_CPU, (300, 300))
            code = undulog.run(arguments)
        os._exit(code)
    _, _, used = os.wait4(process, 0)
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> int:
    """Write, read, print; return 1 if any dimension costs more than it may."""
    parser = arguments(__doc__, runs=3)
    parser.add_argument("dimensions", nargs="*", metavar="DIMENSION")
    options = parser.parse_args()
    worst = 0.0
    print(f"{'dimension':<20} {'verb':<8} {'once/s':>7} {'twice/s':>8} {'ratio':>6} {'MiB':>6}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        small = base().write(folder / "small.mcap")
        for verb in VERBS.values():  # everything that is imported lazily is imported now
            with contextlib.redirect_stdout(io.StringIO()):
                undulog.run(_command(verb, small, folder))
        for dimension, (fill, count) in DIMENSIONS.items():
            if options.dimensions and dimension not in options.dimensions:
                continue
            paths: list[Path] = []
            for k in (1, 2):
                log = base()
                fill(log, k * count)
                paths.append(log.write(folder / f"{k}.mcap"))
            for verb, words in VERBS.items():
                costs = [
                    [cost(_command(words, path, folder)) for path in (small, *paths)]
                    for _ in range(options.runs)
                ]
                nothing, once, twice = np.min(np.array(costs)[:, :, 0], axis=0).tolist()
                peak = float(np.max(np.array(costs)[:, :, 1]))
                judged = twice >= LEAST_S
                ratio = (twice - nothing) / max(once - nothing, 1e-3)
                worst = max(worst, ratio if judged else 0.0)
                shown = f"{ratio:6.2f}" if judged else "     -"
                if judged:
                    what = f"twice as many: {dimension}, {verb}"
                    verdict(what, ratio, MOST, "times", peer="linear growth and 15 %")
                print(f"{dimension:<20} {verb:<8} {once:7.2f} {twice:8.2f} {shown} {peak:6.0f}")
    print(f"twice as much costs at most {worst:.2f} times the time; bar {MOST}")
    return int(worst > MOST)


def _command(words: list[str], path: Path, folder: Path) -> list[str]:
    made = [word.format(out=folder / "out") for word in words]
    return [*made, str(path), *(["--force"] if "-o" in made else [])]


if __name__ == "__main__":
    sys.exit(main())
