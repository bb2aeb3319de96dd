"""Priority of the threads that empty the kernel's buffers: these hold milliseconds of a busy bus.

Real-time priority is asked for first, and of that the lowest (SCHED_RR 1): where a system groups
processes by session or service, nice values count only within a group. A recorder takes some tenth
of a core; the kernel leaves others at least 5 % of each. Who started it with a positive nice value
or a policy of its own is left in peace.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

NICE = -10
"""Asked for where real-time priority is refused."""

_REAL_TIME = os.sched_param(1)
_RESET = os.SCHED_RESET_ON_FORK  # for what the recorder starts: a viewer, a shell


@dataclass(frozen=True)
class Priority:
    """What became of the request.

    Attributes:
        text: The priority, e.g. ``SCHED_RR 1``, or that it was refused.
        refused: Whether it was.
    """

    text: str
    refused: bool = False


@contextmanager
def raised_priority() -> Generator[Priority]:
    """Raise the priority of all threads that the process has at the moment, and lower it again.

    Yields:
        What they have got.
    """
    policy, nice = os.sched_getscheduler(0) & ~_RESET, os.getpriority(os.PRIO_PROCESS, 0)
    if policy != os.SCHED_OTHER or nice > 0:
        yield Priority(f"as it was started: {_named(policy, nice)}")
        return
    try:
        _set_all(os.SCHED_RR, nice)
        got = Priority("SCHED_RR 1")
    except PermissionError:
        try:
            _set_all(os.SCHED_OTHER, min(nice, NICE))
            got = Priority(f"nice {min(nice, NICE)}")
        except PermissionError:
            got = Priority(f"refused: {_named(policy, nice)}", refused=True)
    try:
        yield got
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
