"""How late this computer is, as a process sees it that does next to nothing.

A process for each processor sleeps and works in turn, a few thousandths of a second at a time. What
an iteration takes beyond that is time in which it had to wait: for a processor that other programs
hold, for a virtual machine's host, for a timer. The lateness is the longest such time within one
second, in all.
"""

import os
import select
import subprocess
import sys
import time
from collections import deque

PAUSE_S = 0.003
WORK_S = 0.0005
"""Of each iteration: what is tested needs processors, too, not timers alone."""
LEAST_S = 0.001
"""A wait that is shorter is no lateness: timers and the witness's own calls take so long."""
WINDOW_S = 1.0


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


def measure(processor):
    """Measure on one processor; answer each line of standard input with the lateness since."""
    os.sched_setaffinity(0, [processor])
    late = Lateness()
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
        late.add(now_s, now_s - began_s - PAUSE_S - WORK_S)
        began_s = now_s


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
