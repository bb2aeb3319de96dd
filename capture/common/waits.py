"""Waits with a limit, on what may stop for reasons outside this code.

A library's thread may have ended, another program may be frozen, a disk may be gone: whoever waits
for one without a limit stands still with it. A limit counts time without progress, where progress
can be seen, and time in which this process itself was stopped doesn't count.
"""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from .clock import REAL, Clock
from .errors import NoAnswerError

LIMIT_S = 120.0
"""Longest wait without progress on a thread or a disk of this computer [s]. A busy computer may
let a thread rest for seconds; a network drive that comes back does so within a minute."""

KILLED_S = 60.0
"""Longest wait for a process that was killed [s]: the kernel ends one within milliseconds, unless a
device that does not answer holds it; a viewer of many threads and gigabytes took more than ten
seconds beside four busy programs on two cores."""

_LOOK_S = 0.05  # between two looks: a request to stop is noticed as fast as one sees
_MOST_S = 1.0  # that one look counts [s]; more, and this process was stopped itself

_Result = TypeVar("_Result")

_given_up: list[threading.Thread] = []


def calls_go_on() -> bool:
    """Return whether a call that :func:`attended` has given up goes on.

    A process with such calls has to end by ``os._exit``: one that asks for Python's lock while the
    interpreter is taken down has its thread unwound through the library's frames, which aborts the
    process (Python before 3.14).
    """
    return any(thread.is_alive() for thread in _given_up)


class Standstill:
    """Time without progress, as looks at it find it."""

    def __init__(self, limit_s: float, clock: Clock = REAL) -> None:
        """Begin now.

        Args:
            limit_s: Time without progress that is allowed [s].
            clock: Tells the time of each look.
        """
        self._clock = clock
        self.limit_s = limit_s
        self._progress: object = None
        self._still_s, self._looked_s = 0.0, clock.monotonic_ns() * 1e-9

    def reached(self, progress: object = None) -> bool:
        """Look; return whether the limit is reached.

        Args:
            progress: Anything that changes with progress.
        """
        now_s = self._clock.monotonic_ns() * 1e-9
        self._still_s += min(now_s - self._looked_s, _MOST_S)
        self._looked_s = now_s
        if progress != self._progress:
            self._progress, self._still_s = progress, 0.0
        return self._still_s >= self.limit_s


def attended(
    call: Callable[[], _Result],
    what: str,
    advice: str,
    *,
    limit_s: float = LIMIT_S,
    progress: Callable[[], object] = lambda: None,
    look: Callable[[], None] = lambda: None,
) -> _Result:
    """Make a call that may never return, and wait for it while there is progress.

    The call is made in a thread of its own, which stays behind where this gives up: see
    :func:`calls_go_on`.

    Args:
        what: What is waited for, the subject of the message.
        advice: What to do, for the message.
        limit_s: Longest time without progress [s].
        progress: Returns anything that changes with progress.
        look: Called now and then while the call lasts; may raise to end the wait.

    Returns:
        The result of the call; its exception is raised here.

    Raises:
        NoAnswerError: If there is no progress within the limit.
    """
    results: list[_Result] = []
    failures: list[BaseException] = []

    def run() -> None:
        try:
            results.append(call())
        except BaseException as error:  # noqa: BLE001  raised again by the waiting thread
            failures.append(error)

    thread = threading.Thread(target=run, name=f"undulog: {what}", daemon=True)
    still = Standstill(limit_s)
    thread.start()
    try:
        while True:
            thread.join(_LOOK_S)
            if not thread.is_alive():
                break
            look()
            if still.reached(progress()):
                raise NoAnswerError(what, limit_s, advice)
    finally:
        if thread.is_alive():
            _given_up.append(thread)
    if failures:
        raise failures[0]
    return results[0]


def end_process(process: subprocess.Popen[bytes], what: str, *, grace_s: float = 0.0) -> None:
    """End a process and wait until it is gone; safe to call twice.

    Args:
        what: What it is, for the message.
        grace_s: Time between the request to end and the kill [s]; 0 kills it at once.

    Raises:
        NoAnswerError: If it is still there some time after the kill.
    """
    if process.poll() is None and grace_s:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(grace_s)
    if process.poll() is None:
        process.kill()
    try:
        process.wait(KILLED_S)
    except subprocess.TimeoutExpired as error:
        advice = f"it was killed, but the kernel holds it; look at process {process.pid}"
        raise NoAnswerError(what, KILLED_S, advice) from error


def processor_time(pids: Iterable[int]) -> tuple[int, ...]:
    """Return the processor time of processes [clock ticks], as a measure of progress.

    Returns:
        User and system time of each; 0 for one that is gone.
    """
    return tuple(_ticks(pid) for pid in pids)


def _ticks(pid: int) -> int:
    try:
        facts = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return 0
    return int(facts[11]) + int(facts[12])
