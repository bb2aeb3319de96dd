"""A link read by a thread, for devices whose kernel buffer is small.

The loop polls once a tick, and may be delayed by another program that has the processor, by a disk,
or by decoding. A serial device or a raw CAN socket holds some ten or hundred milliseconds of a busy
bus: :class:`DrainedLink` reads such a link in a thread, and stamps frames without a time closer to
their arrival.
"""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from collections.abc import Sequence
from typing import Protocol

from ..common.process import join_running
from ..log.messages.frames import FrameArray
from .events import Tally
from .link import BusConnection

_JOIN_S = 1.0
_MOST_HELD = 2_000_000  # frames: 64 MB, four minutes of a busy bus


class LinkWithFile(BusConnection, Protocol):
    """A link with a file descriptor to wait for."""

    def fileno(self) -> int:
        """Return its file descriptor."""
        ...


class DrainedLink:
    """The :class:`.capture.sources.link.BusConnection` that reads another one in a thread."""

    def __init__(
        self, link: LinkWithFile, tally: Tally, *, pause_s: float, longest_s: float | None = None
    ) -> None:
        """Take over an open link, and begin.

        Args:
            link: From now on, only the thread uses it.
            tally: Counts lost frames; the link may have the same.
            pause_s: Pause after each read [s]: frames without a time are stamped at most this much
                later.
            longest_s: Read again after so long without a byte [s], so that the link notices.
        """
        self.detail = link.detail
        self._link, self._tally, self._pause_s = link, tally, pause_s
        self._longest_s = longest_s
        self._held: deque[FrameArray] = deque()
        self._count = self._taken = 0
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._wake = os.pipe()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="undulog-drain", daemon=True)
        self._thread.start()

    def read(self, now_ns: int) -> Sequence[FrameArray]:  # noqa: ARG002 (stamped by the thread)
        """See :meth:`BusConnection.read`."""
        error = self._error  # before the frames: none comes after it
        arrays: list[FrameArray] = []
        while self._held:
            arrays.append(self._held.popleft())
            self._taken += len(arrays[-1])
        if not arrays and error is not None:
            raise error
        return arrays

    def close(self) -> None:
        """End the thread and close the link."""
        if self._closed:
            return
        self._closed = True
        self._stop.set()
        os.write(self._wake[1], b"x")
        join_running(self._thread, _JOIN_S)
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
                select.select([fileno, self._wake[0]], [], [], self._longest_s)
        except Exception as error:  # noqa: BLE001 (raised again by read(), in the recorder's thread)
            self._error = error

    def _hold(self, frames: FrameArray) -> None:
        if self._count - self._taken + len(frames) > _MOST_HELD:
            text = "frame dropped, as the recorder was held up for minutes"
            self._tally.lost(text, len(frames), "error")
            return
        self._count += len(frames)
        self._held.append(frames)
