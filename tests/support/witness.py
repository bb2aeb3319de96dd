"""How late this computer is, as a process sees it that does next to nothing.

A process for each processor sleeps and works in turn, a few thousandths of a second at a time. What
an iteration takes beyond that is a wait: for a processor that is held, for a virtual machine's
host, for a timer. Where the test's own processes held the processors it says nothing of the
computer; so of each wait counts what other programs ran within it, or what the test's processes
can't have held of it. The lateness is the largest sum of such times within one second.
"""

import os
import select
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

PAUSE_S = 0.003
WORK_S = 0.0005
"""Of each iteration: what is tested needs processors, too, not timers alone."""
LEAST_S = 0.001
"""A wait that is shorter is no lateness: timers and the witness's own calls take so long."""
WINDOW_S = 1.0
PROCESSES_S = 0.02
"""After so long it looks again which processes there are."""


class LateComputerError(Exception):
    """What a test saw of the computer by itself, so that it says nothing of the product."""


class Lateness:
    """The longest time within :data:`WINDOW_S` for which a process had to wait, so far."""

    def __init__(self):
        self._waits, self._sum_s, self.longest_s = deque(), 0.0, 0.0

    def add(self, now_s, wait_s):
        """Take a wait that ended now."""
        while self._waits and self._waits[0][0] < now_s - WINDOW_S:
            self._sum_s -= self._waits.popleft()[1]
        if wait_s >= LEAST_S:
            self._waits.append((now_s, wait_s))
            self._sum_s += wait_s
            self.longest_s = max(self.longest_s, self._sum_s)


def of_others(wait_s, tested_s, others_s):
    """Return how much of a wait is not the test's own doing [s].

    Args:
        wait_s: The wait.
        tested_s: Processor time of the test's processes within it.
        others_s: Processor time of all other processes within it.
    """
    return max(min(wait_s, others_s), wait_s - tested_s)


class ProcessorTimes:
    """What the processes of a test, and all others, have taken of the processors.

    The test's processes are the witness's parent and what descends from it, but the witnesses.
    """

    def __init__(self):
        self._tested = {os.getppid(): True, os.getpid(): None}
        self._taken_s, self._listed_s = {}, 0.0
        self.since(PROCESSES_S)

    def since(self, now_s):
        """Return the processor time [s] since the last call: of the test's processes, of others."""
        if now_s - self._listed_s >= PROCESSES_S:
            self._listed_s = now_s
            self._list()
        sums_s = {True: 0.0, False: 0.0, None: 0.0}
        for process, before_s in self._taken_s.items():
            try:  # clock_getcpuclockid(3) for any process
                taken_s = time.clock_gettime((~process << 3) | 2)
            except OSError:  # it has ended
                continue
            sums_s[self._tested[process]] += taken_s - before_s
            self._taken_s[process] = taken_s
        return sums_s[True], sums_s[False]

    def _list(self):
        processes = {int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()}
        for process in processes:
            self._classify(process)
        self._taken_s = {process: self._taken_s.get(process, 0.0) for process in processes}

    def _classify(self, process):
        """Say whether a process is the test's; None if it is a witness."""
        if process in self._tested:
            return self._tested[process]
        self._tested[process] = False  # the first process has no parent
        try:
            words = Path(f"/proc/{process}/stat").read_bytes().rpartition(b")")[2].split()
            command = Path(f"/proc/{process}/cmdline").read_bytes().split(bytes(1))
        except OSError:  # it has ended
            return False
        parent = int(words[1])
        witness = parent == os.getppid() and __file__.encode() in command
        self._tested[process] = None if witness else bool(parent and self._classify(parent))
        return self._tested[process]


def measure(processor):
    """Measure on one processor; answer each line of standard input with the lateness since."""
    os.sched_setaffinity(0, [processor])
    late, times = Lateness(), ProcessorTimes()
    began_s = time.monotonic()
    while True:
        if select.select([0], [], [], PAUSE_S)[0]:
            if not os.read(0, 1024):
                return
            print(late.longest_s, flush=True)
            late, began_s = Lateness(), time.monotonic()
            continue
        work_s = time.thread_time()
        while time.thread_time() - work_s < WORK_S:
            pass
        now_s = time.monotonic()
        wait_s = now_s - began_s - PAUSE_S - WORK_S
        late.add(now_s, of_others(wait_s, *times.since(now_s)))
        began_s = time.monotonic()


class Witness:
    """The witnesses of all processors that this process may use."""

    def __init__(self):
        words = [sys.executable, "-S", "-E", __file__]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._processes = [
            subprocess.Popen([*words, str(processor)], **pipes)
            for processor in sorted(os.sched_getaffinity(0))
        ]
        self.late_s()

    def late_s(self):
        """Return the lateness since the last call [s], of the processor where it is largest."""
        for process in self._processes:
            process.stdin.write("\n")
            process.stdin.flush()
        return max(float(process.stdout.readline()) for process in self._processes)

    def close(self):
        """End the witnesses."""
        for process in self._processes:
            process.communicate()


if __name__ == "__main__":
    measure(int(sys.argv[1]))
