"""Ending on request: a signal becomes a flag, so that a loop ends between two samples.

A recorder or a simulation that is told to stop must leave a whole file. Inside
:func:`interruptible` the first SIGINT, SIGTERM or SIGHUP sets ``requested``; a second one of the
same kind acts as it would have without us, for a loop that doesn't look. A loop that has to end in
an orderly way even then takes two: the second one sets ``again``.
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
        self.again = False
        """Whether it was asked for a second time."""

    @property
    def requested(self) -> bool:
        """Whether an end was asked for."""
        return self.signal is not None


@contextmanager
def interruptible(*, twice: bool = False) -> Generator[StopRequest]:
    """Turn the first SIGINT, SIGTERM or SIGHUP into a request to stop.

    Only for the main thread, as Python has it for signal handlers. The former handlers are back
    on leaving.

    Args:
        twice: Take a second SIGINT or SIGTERM as a request, too; only the third acts as it would
            have. A terminal that goes says so by more than one SIGHUP: these only count once.

    Yields:
        The request; look at ``requested`` between two samples.
    """
    request = StopRequest()
    former = {number: signal.getsignal(number) for number in _SIGNALS}

    def note(number: int, _frame: FrameType | None) -> None:
        kind = signal.Signals(number)
        request.again = request.again or (request.requested and kind is not signal.SIGHUP)
        request.signal = request.signal or kind
        if not twice or (request.again and kind is not signal.SIGHUP):
            signal.signal(number, former[kind])

    try:
        for number in _SIGNALS:
            if former[number] is not signal.SIG_IGN:  # nohup stays in force
                signal.signal(number, note)
        yield request
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
