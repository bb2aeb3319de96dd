"""The command as a process whose time and memory the kernel reports, those of its children too."""

import json
import sys
from dataclasses import dataclass

from support.processes import UNDULOG, run

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


_LAUNCHER = """
import json, os, subprocess, sys
streams = [open(path, "wb") for path in sys.argv[1:3]]
running = subprocess.Popen(sys.argv[3:], stdin=subprocess.DEVNULL, stdout=streams[0],
                           stderr=streams[1])
_, status, used = os.wait4(running.pid, 0)
running.returncode = os.waitstatus_to_exitcode(status)
print(json.dumps([running.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024]))
"""
"""A small process: a child counts the memory of the one that starts it as its own."""


def undulog_measured(*words, cwd):
    """Run a command to its end."""
    paths = [cwd / name for name in ("measured.out", "measured.err")]
    launcher = (sys.executable, "-I", "-S", "-c", _LAUNCHER, *paths)
    done = run(*launcher, *UNDULOG, *words, cwd=cwd, code=0)
    code, cpu_s, peak = json.loads(done.stdout)
    texts = [path.read_text(errors="replace") for path in paths]
    for path in paths:
        path.unlink()
    return Measured(code, *texts, cpu_s, peak)


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
