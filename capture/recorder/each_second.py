"""What is due once a second, spread over the second, so that no tick of the recorder is long."""

from __future__ import annotations

from collections.abc import Callable, Sequence

_NS = 1_000_000_000


class EachSecond:
    """Runs tasks once a second each, at most one a call.

    By the clock, not by counting calls: under load these come more often, or less.
    """

    def __init__(self, tasks: Sequence[Callable[[], object]], now_ns: int) -> None:
        """Begin in a second from now, in the order given.

        Args:
            tasks: What to do.
            now_ns: A monotonic clock [ns].
        """
        self._tasks = tuple(tasks)
        step_ns = _NS // (len(tasks) + 1)
        self._due_ns = [now_ns + (k + 1) * step_ns for k in range(len(tasks))]

    def run(self, now_ns: int) -> None:
        """Run the task that has waited for longest, if one is due.

        Args:
            now_ns: The same clock [ns].
        """
        if not self._tasks:
            return
        k = min(range(len(self._due_ns)), key=self._due_ns.__getitem__)
        if self._due_ns[k] > now_ns:
            return
        late = now_ns - self._due_ns[k] >= _NS
        self._due_ns[k] = now_ns + _NS if late else self._due_ns[k] + _NS
        self._tasks[k]()
