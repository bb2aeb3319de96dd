"""A connection emptied by a thread of its own, as soon as something comes.

The recorder looks once a tick, and may be held up for longer by a disk that is slow. A serial
device or a raw CAN socket holds some ten or hundred milliseconds of a busy bus; then frames are
lost. The thread takes them meanwhile, and stamps what carries no time closer to its arrival.
"""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from collections.abc import Sequence
from typing import Protocol

from ..log.messages.frames import FrameArray
from .events import Tally
from .link import Link

_JOIN_S = 1.0
_MOST_HELD = 2_000_000  # frames: 64 MB, four minutes of a busy bus


class LinkWithFile(Link, Protocol):
    """A link that can be waited for."""

    def fileno(self) -> int:
        """What to wait for."""
        ...


class DrainedLink:
    """The :class:`.capture.sources.link.Link` that empties another one."""

    def __init__(self, link: LinkWithFile, tally: Tally, *, pause_s: float) -> None:
        """Take over an open link, and begin.

        Args:
            link: From now on, only the thread uses it.
            tally: Where to count; the link may have the same.
            pause_s: How long to let frames gather after some came [s]: what carries no time is
                stamped at most this much later.
        """
        self.detail = link.detail
        self._link = link
        self._tally = tally
        self._pause_s = pause_s
        self._held: deque[FrameArray] = deque()
        self._count = 0
        self._taken = 0
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._wake = os.pipe()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="undulog-drain", daemon=True)
        self._thread.start()

    def read(self, now_ns: int) -> Sequence[FrameArray]:  # noqa: ARG002 (stamped by the thread)
        """See :meth:`Link.read`."""
        error = self._error  # before the frames: none comes after it
        found: list[FrameArray] = []
        while self._held:
            found.append(self._held.popleft())
            self._taken += len(found[-1])
        if not found and error is not None:
            raise error
        return found

    def close(self) -> None:
        """End the thread and release the link."""
        if self._closed:
            return
        self._closed = True
        self._stop.set()
        os.write(self._wake[1], b"x")
        self._thread.join(_JOIN_S)
        self._link.close()
        for end in self._wake:
            os.close(end)

    def _run(self) -> None:
        try:
            fileno = self._link.fileno()
            while not self._stop.is_set():
                for frames in self._link.read(self._tally.now_ns()):  # some may be there already
                    self._hold(frames)
                self._stop.wait(self._pause_s)
                select.select([fileno, self._wake[0]], [], [])
        except Exception as error:  # noqa: BLE001 (raised again by read(), in the recorder's thread)
            self._error = error

    def _hold(self, frames: FrameArray) -> None:
        if self._count - self._taken + len(frames) > _MOST_HELD:
            self._tally.counts.dropped = (self._tally.counts.dropped or 0) + len(frames)
            text = "frame dropped, as the recorder was held up for minutes"
            self._tally.events.say("error", text, len(frames))
            return
        self._count += len(frames)
        self._held.append(frames)
