"""Stop requests by signals, priority of threads, and work in threads.

A recorder or a simulation that is stopped must leave a whole file. Inside :func:`interruptible` the
first SIGINT, SIGTERM or SIGHUP sets ``requested``, so that a loop ends between two samples; another
one of the same kind has its usual effect, for a loop that doesn't check. A loop that has to end in
an orderly way even then takes two: the second one sets ``again``.

Threads that empty the kernel's buffers, which hold milliseconds of a busy bus, get a raised
priority. The lowest real-time priority (SCHED_RR 1) is requested first: where a system groups
processes by session or service, nice values count only within a group. A recorder takes about a
tenth of a core; the kernel leaves other processes at least 5 % of each. A process that was started
with a positive nice value or another policy keeps it.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Generic, TypeVar

from .errors import UsageError

if TYPE_CHECKING:
    import threading
    from concurrent.futures import ThreadPoolExecutor

_NICE = -10  # requested where real-time priority is refused
_REAL_TIME = os.sched_param(1)
_RESET = os.SCHED_RESET_ON_FORK  # for what the recorder starts: a viewer, a shell

_JOIN_SLICES = 20

_MOST_BY_DEFAULT = 4
"""Beyond this the reader itself, which is one thread, is what takes the time."""

MANY = 1 << 18
"""Samples of all channels from which on the work is shared out."""

_SHARES = 16
"""Shares for each thread, so that none waits long for the last."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


_Item = TypeVar("_Item")

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Priority:
    """Result of a request for priority.

    Attributes:
        text: The priority, e.g. ``SCHED_RR 1``, or that it was refused.
    """

    text: str
    refused: bool = False


@contextmanager
def raised_priority() -> Generator[Priority]:
    """Raise the priority of all threads that the process has at the moment, and lower it again."""
    policy, nice = os.sched_getscheduler(0) & ~_RESET, os.getpriority(os.PRIO_PROCESS, 0)
    if policy != os.SCHED_OTHER or nice > 0:
        yield Priority(f"as it was started: {_named(policy, nice)}")
        return
    raised = min(nice, _NICE)
    priority = Priority(f"refused: {_named(policy, nice)}", refused=True)
    for scheduling, value, name in (
        (os.SCHED_RR, nice, "SCHED_RR 1"),
        (os.SCHED_OTHER, raised, f"nice {raised}"),
    ):
        with suppress(PermissionError):
            _set_all(scheduling, value)
            priority = Priority(name)
            break
    try:
        yield priority
    finally:
        _set_all(os.SCHED_OTHER, nice)


def share_priority() -> None:
    """Give the calling thread the priority of the main thread; for threads that begin later."""
    main = os.getpid()
    with suppress(PermissionError):
        _set(0, os.sched_getscheduler(main), os.getpriority(os.PRIO_PROCESS, main))


def _set_all(policy: int, nice: int) -> None:
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it ended meanwhile
            _set(int(task.name), policy, nice)


def _set(thread: int, policy: int, nice: int) -> None:
    if os.getpriority(os.PRIO_PROCESS, thread) != nice:
        os.setpriority(os.PRIO_PROCESS, thread, nice)
    if policy & ~_RESET == os.SCHED_RR:
        os.sched_setscheduler(thread, os.SCHED_RR | _RESET, _REAL_TIME)
    elif os.sched_getscheduler(thread) & ~_RESET != os.SCHED_OTHER:
        os.sched_setscheduler(thread, os.SCHED_OTHER | _RESET, os.sched_param(0))


def _named(policy: int, nice: int) -> str:
    return f"nice {nice}" if policy == os.SCHED_OTHER else f"policy {policy}"


def join_running(thread: threading.Thread, limit_s: float) -> bool:
    """Wait for the end of a thread for a time in which this process runs.

    While the process is stopped (SIGSTOP, a suspended computer) the thread can't end, and that time
    doesn't count.

    Args:
        limit_s: Time limit [s].

    Returns:
        Whether it has ended.
    """
    for _ in range(_JOIN_SLICES):
        thread.join(limit_s / _JOIN_SLICES)
        if not thread.is_alive():
            return True
    return False


def threads_or_default(threads: int | None) -> int:
    """Return the number of threads to use.

    Args:
        threads: Number; None for one a core that this process may use, at most
            four.

    Raises:
        UsageError: If it is less than one.
    """
    if threads is None:
        usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
        return min(usable or os.cpu_count() or 1, _MOST_BY_DEFAULT)
    if threads < 1:
        raise UsageError(f"threads={threads}: give 1 or more, or None for one a core")
    return threads


def in_threads(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    samples: int,
    after: Callable[[], None] = lambda: None,
) -> list[_Result]:
    """Apply a function to independent items, in threads where there is much to do.

    Args:
        function: Spends its time in NumPy, which lets other threads run.
        items: What it is applied to.
        samples: All that it will look at.
        after: Called after each item, by the thread that worked on it.

    Returns:
        Its results, in the order of the items; the same bits however many threads there are.
    """
    threads = threads_or_default(None)

    def work(some: Sequence[_Item]) -> list[_Result]:
        results = list[_Result]()
        for item in some:
            results.append(function(item))
            after()
        return results

    if samples < MANY or threads == 1:
        return work(items)
    from concurrent.futures import ThreadPoolExecutor

    # Shares of many items, since handing out one costs some 30 us.
    size = max(1, len(items) // (threads * _SHARES))
    shares = [items[first : first + size] for first in range(0, len(items), size)]
    with ThreadPoolExecutor(threads) as pool:
        return [result for share in pool.map(work, shares) for result in share]


class WorkPiece(Generic[_Result]):
    """A piece of work that is done by a helper thread, or by the caller if none has begun it."""

    def __init__(self, work: Callable[[], _Result], helpers: ThreadPoolExecutor | None) -> None:
        """Submit it to the helper threads, if any."""
        self._work = work
        self._taken = None if helpers is None else helpers.submit(work)
        self._done: list[_Result] = []

    def hurry(self) -> None:
        """Do the work now unless a helper has begun it."""
        if not self._done and (self._taken is None or self._taken.cancel()):
            self._taken = None
            self._done.append(self._work())

    def result(self) -> _Result:
        """Return the result, or raise the error of the work; waits for it."""
        self.hurry()
        return self._done[0] if self._taken is None else self._taken.result()


@contextmanager
def helpers(threads: int) -> Generator[ThreadPoolExecutor | None]:
    """Start helper threads, which end with the block.

    Args:
        threads: Number of threads, with the caller's own.

    Yields:
        The other threads; None if there are none.
    """
    if threads == 1:
        yield None
        return
    from concurrent.futures import ThreadPoolExecutor

    pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="undulog-helper")
    try:
        yield pool
    finally:  # also when the caller stops early: pending work is cancelled
        pool.shutdown(cancel_futures=True)


class StopRequest:
    """Whether a stop was requested, and by which signal."""

    def __init__(self) -> None:
        """Start without a request."""
        self.signal: signal.Signals | None = None
        self.again = False
        """Whether a stop was requested a second time."""
        self.continued = 0
        """How often the process was continued (SIGCONT) after it had been suspended."""

    @property
    def requested(self) -> bool:
        """Whether a stop was requested."""
        return self.signal is not None


@contextmanager
def interrupted_later() -> Generator[None]:
    """Raise a KeyboardInterrupt at the end of the block instead of within it.

    A ``Popen`` that it ends has started a process that nobody knows.
    """
    came: list[tuple[int, FrameType | None]] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append((number, frame))

    try:
        former = signal.signal(signal.SIGINT, note)
    except ValueError:  # not in the main thread, which alone is interrupted
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
    if came and callable(former):
        former(*came[0])


@contextmanager
def interruptible(*, twice: bool = False) -> Generator[StopRequest]:
    """Turn the first SIGINT, SIGTERM or SIGHUP into a request to stop.

    Only for the main thread, as Python has it for signal handlers. The former handlers are back
    on leaving.

    Args:
        twice: Take a second SIGINT or SIGTERM as a request, too; only the third acts as it would
            have. A terminal that closes sends more than one SIGHUP: these only count once.

    Yields:
        The request; look at ``requested`` between two samples.
    """
    request = StopRequest()
    former = {number: signal.getsignal(number) for number in (*_SIGNALS, signal.SIGCONT)}

    def note(number: int, _frame: FrameType | None) -> None:
        kind = signal.Signals(number)
        request.again = request.again or (request.requested and kind is not signal.SIGHUP)
        request.signal = request.signal or kind
        if not twice or (request.again and kind is not signal.SIGHUP):
            signal.signal(number, former[kind])

    def count(_number: int, _frame: FrameType | None) -> None:
        request.continued += 1

    try:
        if former[signal.SIGCONT] is signal.SIG_DFL:
            signal.signal(signal.SIGCONT, count)
        for number in _SIGNALS:
            if former[number] is not signal.SIG_IGN:  # nohup stays in force
                signal.signal(number, note)
        yield request
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
