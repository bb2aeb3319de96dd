"""The terminal that a drive was started from: is it still there?"""

from __future__ import annotations

import os
import select

_STREAMS = (0, 1, 2)


class ConsoleWatch:
    """Notices that a terminal hung up; one that never was is not missed."""

    def __init__(self) -> None:
        """Look which of the standard streams are terminals."""
        self._terminals = [stream for stream in _STREAMS if os.isatty(stream)]
        self._poll = select.poll()
        for stream in self._terminals:
            self._poll.register(stream, 0)  # a hang-up is told in any case

    def gone(self) -> bool:
        """Whether the terminal is gone; once it is, nothing is written to it any more."""
        if not self._terminals:
            return False
        if not self._poll.poll(0):
            return False
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in self._terminals:
            self._poll.unregister(stream)
            os.dup2(nowhere, stream)
        os.close(nowhere)
        self._terminals = []
        return True
