"""One case: a command line in a forked process under limits of the operating system, and its judge.

The process that forks has imported everything, so a case costs milliseconds. What the command did
is judged by what the kernel reports of it (exit, signal, processor time, peak memory) and by the
bytes that it wrote.
"""

import contextlib
import os
import re
import resource
import signal
import sys
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path

CPU_S = 20
"""Processor time of a case [s]."""
PEAK_BYTES = 1 << 30
"""Resident memory of a case, what the imports take included."""
ADDRESS_ROOM = 2 << 30
"""Address space beyond that of the idle worker [byte]: more than may be used, so that a command
that survives a refused allocation is still seen to need it."""
WALL_S = 120.0
"""A command that takes so long without using the processor hangs."""
LARGEST_FILE = 1 << 30
_ENDING = {signal.SIGINT, signal.SIGTERM}
STRAY = 120
"""Exit code of a process whose command let an exception out."""
MIB = 1 << 20

CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x80-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\u200e\u200f]"
)
"""Characters that change what a terminal shows: only line feed and tab may be printed."""


@dataclass(frozen=True)
class Outcome:
    """The end of a command.

    Attributes:
        code: Exit code; None if a signal ended it.
        signal: That signal, or None.
        killed: Whether the signal was ours, sent on purpose.
        hung: Whether the wall time ran out.
        cpu_s: Processor time of it and its children [s].
        peak: Largest resident memory of the process, of its children, or of all at one time [byte].
        out: Bytes on standard output.
        err: Bytes on standard error.
    """

    code: int | None
    signal: int | None
    killed: bool
    hung: bool
    cpu_s: float
    peak: int
    out: bytes
    err: bytes

    @property
    def errors(self):
        """Return the last characters on standard error."""
        return self.err.decode(errors="replace")[-200:]


@dataclass
class Result:
    """The result of a case of any part.

    Attributes:
        case: What was done, in a few words.
        failures: What is wrong, one line each; empty if nothing is.
        figures: Numbers for the table.
        outcome: The last command's.
    """

    case: str
    failures: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    skipped: str = ""

    def add(self, outcome):
        """Add the failures of a command's run, and keep the largest figures."""
        self.failures += judge(outcome)
        self.measure(outcome)

    def measure(self, outcome):
        """Keep the largest processor time and memory."""
        self.at_most("cpu_s", outcome.cpu_s)
        self.at_most("peak_mib", outcome.peak / MIB)

    def at_most(self, name, value):
        """Keep the larger value of a figure."""
        self.figures[name] = max(self.figures.get(name, 0.0), round(value, 3))


def _limit(room):
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + room
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 2))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))


def _be_child(work, folder, streams):
    """The forked process: never returns."""
    code = STRAY
    try:
        os.setsid()
        os.chdir(folder)
        for number, path in ((0, Path(os.devnull)), (1, streams[0]), (2, streams[1])):
            flags = os.O_RDONLY if number == 0 else os.O_WRONLY
            if number and path.parent != Path("/dev"):
                flags |= os.O_CREAT | os.O_APPEND
            descriptor = os.open(path, flags, 0o600)
            os.dup2(descriptor, number)
            os.close(descriptor)
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
        _limit(ADDRESS_ROOM)
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
            work()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:  # noqa: BLE001 - each one that gets here is what is looked for
            traceback.print_exc()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
    finally:
        os._exit(code)


def front_door(words):
    def work():
        import undulog

        sys.argv = ["undulog", *words]
        undulog.main()

    return work


def run_forked(
    work, folder, *, end_after_s=None, end_by=signal.SIGKILL, stdout=None, meanwhile=None
):
    """Run a function in a forked process under limits.

    Args:
        work: The function.
        folder: Working folder; the streams go to files beside it.
        end_after_s: Time until a signal is sent [s].
        end_by: That signal.
        stdout: Another standard output, e.g. ``/dev/full``.
        meanwhile: Called with the process number; the process is awaited when it returns.
    """
    streams = tuple(folder.parent / f"{folder.name}.{name}" for name in ("out", "err"))
    for path in streams:
        path.unlink(missing_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    # A signal before the child is itself would be the worker's exception.
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    child = os.fork()
    if not child:
        _be_child(work, folder, (stdout or streams[0], streams[1]))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
    if meanwhile is not None:
        meanwhile(child)
    began = time.monotonic()
    killed = hung = False
    wait_s, together = 0.0005, 0
    while True:
        together = max(together, resident(child))
        ended, status, used = os.wait4(child, os.WNOHANG)
        if ended:
            break
        spent = time.monotonic() - began
        if end_after_s is not None and spent >= end_after_s and not killed:
            os.kill(child, end_by)
            killed = True
        if spent > WALL_S + (end_after_s or 0.0):
            os.kill(child, signal.SIGKILL)
            hung = True
        wait_s = min(2 * wait_s, 0.01)
        time.sleep(wait_s)
    code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else None
    by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else None
    texts = [path.read_bytes() if path.exists() else b"" for path in streams]
    cpu_s = used.ru_utime + used.ru_stime
    peak = max(used.ru_maxrss * 1024, together)
    return Outcome(code, by, killed, hung, cpu_s, peak, *texts)


def resident(process):
    """Return the resident memory of a process and its children [byte].

    What processes share counts once where it is a file in memory, as the largest share.
    """
    numbers, private, shared = [process], 0, 0
    for number in numbers:
        try:
            pages = Path(f"/proc/{number}/statm").read_text().split()
            children = Path(f"/proc/{number}/task/{number}/children").read_text().split()
        except OSError:  # it ended
            continue
        private += int(pages[1]) - int(pages[2])
        shared = max(shared, int(pages[2]))
        numbers += map(int, children)
    return (private + shared) * resource.getpagesize()


def run_command(words, folder, **options):
    """Run ``undulog WORDS...`` by its entry function; options as :func:`run_forked` has them."""
    return run_forked(front_door([str(word) for word in words]), folder, **options)


def last_line(err):
    """Return the last line of a traceback, with its last line of code in the product."""
    text = err.decode("utf-8", "replace")
    places = re.findall(r'File "[^"]*/((?:capture|sim|analysis|replay)/[^"]+)", line (\d+)', text)
    at = ":".join(places[-1]) if places else "?"
    after = text[text.rfind("Traceback (most recent call last)") :]
    raised = [line for line in after.splitlines() if re.match(r"[A-Za-z_][\w.]*(:|$)", line)]
    last = raised[-1] if raised else text.strip().splitlines()[-1:]
    return f"{str(last)[:160]} [{at}]"


def control_characters(data):
    """Return the characters of an output that act on a terminal."""
    return sorted(set(CONTROL.findall(data.decode("utf-8", "replace"))))


def judge(outcome):
    """Return the failures of a command's run; each begins with its kind."""
    failures = []
    if outcome.hung:
        failures.append(f"hang: no end within {WALL_S:.0f} s")
    elif outcome.signal == signal.SIGXCPU or outcome.cpu_s > CPU_S:
        failures.append(f"time: over {CPU_S} s of processor time")
    elif outcome.signal is not None and not outcome.killed:
        failures.append(f"signal: ended by {signal.Signals(outcome.signal).name}")
    if outcome.peak > PEAK_BYTES:
        failures.append(f"memory: {outcome.peak / MIB:.0f} MiB")
    bad = (b"Traceback (most recent call last)", b"Exception ignored", b"Fatal Python error")
    if outcome.code == STRAY or any(word in outcome.err for word in bad):
        failures.append(f"traceback: {last_line(outcome.err)}")
    elif outcome.code is not None and outcome.code not in (0, 1, 2):
        failures.append(f"exit code: {outcome.code}")
    elif outcome.code and not outcome.out.strip() and not outcome.err.strip():
        failures.append(f"silent: exit code {outcome.code} without a word")
    for name, data in (("stdout", outcome.out), ("stderr", outcome.err)):
        if characters := control_characters(data):
            failures.append(f"escape: raw {', '.join(map(ascii, characters[:8]))} on {name}")
    return failures
