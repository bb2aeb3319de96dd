"""Helpers of the benches: command line, processes, and an hour to measure."""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeVar

from undulog.capture.robot.model import Robot

HERE = Path(__file__).parent
HOUR_S = 3600
PEAK_MIB = 'int(open("/proc/self/status").read().partition("VmHWM:")[2].split()[0]) / 1024'
"""Expression for a process's largest resident memory [MiB].

Not ``ru_maxrss``, which in a child is at least what its parent had when it was started.
"""
TICKS_S = os.sysconf("SC_CLK_TCK")
_Figure = TypeVar("_Figure")
_Result = TypeVar("_Result")


class Took(NamedTuple):
    """Cost of some work.

    Attributes:
        wall_s: Wall-clock time.
        processor_s: User and system time, all threads.
    """

    wall_s: float
    processor_s: float


def arguments(doc: str | None, **defaults: float) -> argparse.ArgumentParser:
    """Return a parser with options that take a number; its help is the docstring of the bench."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(default), default=default)
    return parser


def timed(work: Callable[[], _Result]) -> tuple[Took, _Result]:
    """Return the cost of some work, and its result."""
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    return Took(time.perf_counter() - wall, time.process_time() - processor), result


def took(work: Callable[[], object]) -> Took:
    """Return the cost of some work; its result is dropped within that time."""

    def dropped() -> None:
        work()

    return timed(dropped)[0]


def command_took(*command: object, **options: object) -> Took:
    """Run a command to its end; return its cost, its children included."""
    wall = time.perf_counter()
    words = [str(word) for word in command]
    process = subprocess.Popen(words, **{"stdout": subprocess.DEVNULL} | options)
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - wall
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(words)} ended with exit code {process.returncode}")
    return Took(wall, used.ru_utime + used.ru_stime)


def in_turn(runs: int, *works: Callable[[], _Figure]) -> list[tuple[_Figure, ...]]:
    """Return the figures of each work, turn by turn, so that a drift disturbs all alike."""
    return list(zip(*([work() for work in works] for _ in range(runs)), strict=True))


def start(stack: ExitStack, *command: object, **options: object) -> subprocess.Popen[str]:
    """Start a process that is killed when the stack is closed; its output goes to a pipe."""
    options = {"stdout": subprocess.PIPE, "text": True} | options
    process = subprocess.Popen([str(word) for word in command], **options)
    stack.callback(_end, process)
    return process


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def cpu_s(pid: int) -> float:
    """Return the processor time of a process, all its threads [s]."""
    parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(parts[11]) + int(parts[12])) / TICKS_S


def memory(figure: str, pid: int | str = "self") -> int:
    """Return a figure of a process's memory, by its name in ``/proc/PID/status`` [byte]."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{figure}:"))


def wait_for(condition: Callable[[], bool], pause_s: float = 0.01) -> None:
    """Wait until a condition holds, a minute at most."""
    deadline = time.monotonic() + 60
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the condition did not hold within a minute")
        time.sleep(pause_s)


def write_hour(path: Path, seconds: int, *, can: bool, adaptive: bool = False) -> None:
    """Write the session of hour_session.py in another process, so that its memory is apart."""
    code = (
        "import sys; from pathlib import Path; from hour_session import write_session; "
        f"write_session(Path(sys.argv[1]), int(sys.argv[2]), can={can}, adaptive={adaptive})"
    )
    subprocess.run([sys.executable, "-c", code, str(path), str(seconds)], check=True, cwd=HERE)


def add_place(parser: argparse.ArgumentParser, room: str) -> None:
    """Add the options of the hour's file."""
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--folder", type=Path, help=f"a folder with {room} to spare")
    place.add_argument("--keep", type=Path, help="the session, written if it is not there")


@contextmanager
def hour_of(
    options: argparse.Namespace, *, can: bool = False, adaptive: bool = False
) -> Iterator[tuple[Path, int]]:
    """Yield the session that the options place, written if need be, and its length [s]."""
    seconds = max(round(options.minutes * 60), 60)
    with TemporaryDirectory(dir=options.folder) as folder:
        path = (options.keep or Path(folder) / "hour.mcap").resolve()
        if not path.exists():
            write_hour(path, seconds, can=can, adaptive=adaptive)
        yield path, seconds


def chain(robot: Robot, joints: int) -> Robot:
    """Return a robot of another length, of the same modules, without sensors."""
    last, (even, other) = robot.links[-1], robot.joints[:2]
    return dataclasses.replace(
        robot,
        name=f"chain{joints}",
        links=tuple(dataclasses.replace(last, name=f"link{k}") for k in range(joints + 1)),
        joints=tuple(
            dataclasses.replace(other if k % 2 else even, name=f"joint{k}") for k in range(joints)
        ),
        sensors=(),
        bus=None,
        databases=(),
    )
