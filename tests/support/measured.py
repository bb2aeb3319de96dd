"""The command as a process whose time and memory the kernel reports, those of its children too."""

import os
import subprocess
from dataclasses import dataclass

from support.processes import UNDULOG

CPU_S = 20.0
PEAK_BYTES = 1 << 30


@dataclass(frozen=True)
class Measured:
    """The end of a command.

    Attributes:
        code: Its exit code; negative for a signal.
        err: What is on standard error.
        cpu_s: Processor time of it and its children [s].
        peak: Largest resident memory of any of these processes [byte].
    """

    code: int
    out: str
    err: str
    cpu_s: float
    peak: int


def undulog_measured(*words, cwd):
    """Run a command to its end."""
    paths = [cwd / name for name in ("measured.out", "measured.err")]
    with paths[0].open("wb") as out, paths[1].open("wb") as err:
        running = subprocess.Popen(
            [*UNDULOG, *map(str, words)], cwd=cwd, stdin=subprocess.DEVNULL, stdout=out, stderr=err
        )
        _, status, used = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
    texts = [path.read_text(errors="replace") for path in paths]
    for path in paths:
        path.unlink()
    cpu_s = used.ru_utime + used.ru_stime
    return Measured(running.returncode, *texts, cpu_s, used.ru_maxrss * 1024)


def refused(path, *words):
    """Run a command on a hostile file: a sentence that names it, within the bounds; return it."""
    done = undulog_measured(*words, cwd=path.parent)
    assert done.code == 1, done
    lines = done.err.splitlines()
    assert len(lines) == 1, done
    assert lines[0].startswith(f"error: {path.name}: "), done
    assert done.cpu_s < CPU_S, done
    assert done.peak < PEAK_BYTES, done
    assert not list(path.parent.glob("new*")), "nothing is left"
    return lines[0]
