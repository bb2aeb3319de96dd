"""Ending on request: a signal becomes a flag, so that a loop ends between two samples.

A recorder or a simulation that is told to stop must leave a whole file. Inside
:func:`interruptible` the first SIGINT, SIGTERM or SIGHUP sets ``requested``; a second one of the
same kind acts as it would have without us, for a loop that doesn't look.
"""

from __future__ import annotations

import signal
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Whether, and by which signal, an end was asked for."""

    def __init__(self) -> None:
        """Start without a request."""
        self.signal: signal.Signals | None = None

    @property
    def requested(self) -> bool:
        """Whether an end was asked for."""
        return self.signal is not None


@contextmanager
def interruptible() -> Generator[StopRequest]:
    """Turn the first SIGINT, SIGTERM or SIGHUP into a request to stop.

    Only for the main thread, as Python has it for signal handlers. The former handlers are back
    on leaving.

    Yields:
        The request; look at ``requested`` between two samples.
    """
    request = StopRequest()
    former = {number: signal.getsignal(number) for number in _SIGNALS}

    def note(number: int, _frame: FrameType | None) -> None:
        request.signal = signal.Signals(number)
        signal.signal(number, former[signal.Signals(number)])

    try:
        for number in _SIGNALS:
            if former[number] is not signal.SIG_IGN:  # nohup stays in force
                signal.signal(number, note)
        yield request
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
