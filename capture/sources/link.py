"""A source over one connection that may break and come back.

A :class:`Link` is an open connection. A :class:`LinkedSource` opens one, reads it, and when it
breaks tries again, ever more seldom. Opening may block (a name to look up, an adapter that answers
slowly), so each attempt has a thread of its own; reading never does.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from ..common.errors import SourceError
from ..log.messages.frames import FrameArray, holds_fd
from ..robot.model import ClockDomain, Robot
from .contract import Polled, SourceAddress, SourceContext, SourceCounts
from .events import BusWatch, Tally

FIRST_NS = 100_000_000
"""Pause before the first new attempt [ns]."""
LONGEST_NS = 5_000_000_000
"""Longest pause between two attempts [ns]."""
_STEADY_NS = 1_000_000_000


class Backoff:
    """Doubling pauses; a connection that held for a second starts them anew.

    One that breaks down at once doesn't, so that a device that comes and goes is not hammered.
    """

    def __init__(self) -> None:
        """Start so that the first attempt is due at once."""
        self._pause_ns = FIRST_NS
        self._due_ns = 0
        self._opened_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        """Whether an attempt may be made.

        Args:
            now_ns: The session's clock [ns].

        Returns:
            True from the end of the pause on.
        """
        return now_ns >= self._due_ns

    def opened(self, now_ns: int) -> None:
        """Note that an attempt succeeded.

        Args:
            now_ns: The session's clock [ns].
        """
        self._opened_ns = now_ns

    def failed(self, now_ns: int) -> None:
        """Note that an attempt failed or a connection was lost.

        Args:
            now_ns: The session's clock [ns].
        """
        if self._opened_ns is not None and now_ns - self._opened_ns >= _STEADY_NS:
            self._pause_ns = FIRST_NS
        self._opened_ns = None
        self._due_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_NS)


_FIRST_ATTEMPT_S = 0.5
_ABSENT = {
    errno.ENOENT,
    errno.ENODEV,
    errno.ENXIO,
    errno.EIO,
    errno.ENETDOWN,
    errno.ECONNREFUSED,
    errno.ECONNRESET,
}
"""What an unplugged device or an ended server answers."""


class Link(Protocol):
    """An open connection; one thread uses it after the one that opened it."""

    @property
    def detail(self) -> str:
        """What is worth telling of it, e.g. ``listen-only``; may be empty."""
        ...

    def read(self, now_ns: int) -> Sequence[FrameArray]:
        """Take what has come, without blocking.

        Args:
            now_ns: The session's clock [Unix ns].

        Returns:
            The frames. Those that came before a break are returned first.

        Raises:
            OSError: If the connection is broken.
        """
        ...

    def close(self) -> None:
        """Release it; never raises for a dead device, safe to call twice."""
        ...


OpenLink = Callable[[Tally], Link]
"""Opens a connection; may block. OSError: try again later. SourceError: it can never work."""


class _Attempt:
    """One try to open a connection, in a thread of its own."""

    def __init__(self, open_link: OpenLink, tally: Tally) -> None:
        self._lock = threading.Lock()
        self._abandoned = False
        self._link: Link | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(
            target=self._run, args=(open_link, tally), name="undulog-connect", daemon=True
        )
        self._thread.start()

    def wait(self, timeout_s: float) -> None:
        self._thread.join(timeout_s)

    @property
    def done(self) -> bool:
        return not self._thread.is_alive()

    def result(self) -> Link:
        """The connection, or the error that was raised."""
        if self._error is not None:
            raise self._error
        if self._link is None:
            raise RuntimeError("the attempt has not ended")
        return self._link

    def abandon(self) -> None:
        """Nobody waits any more: what was or will be opened is closed."""
        with self._lock:
            self._abandoned = True
        if self._link is not None:
            self._link.close()

    def _run(self, open_link: OpenLink, tally: Tally) -> None:
        try:
            link = open_link(tally)
        except Exception as error:  # noqa: BLE001 (raised again by result(), in the recorder's thread)
            self._error = error
            return
        with self._lock:
            abandoned = self._abandoned
            if not abandoned:
                self._link = link
        if abandoned:
            link.close()


class LinkedSource:
    """The :class:`.capture.sources.contract.Source` over a link."""

    robot: Robot | None = None

    def __init__(
        self,
        address: SourceAddress,
        open_link: OpenLink,
        *,
        place: str,
        clock: ClockDomain,
        facts: Mapping[str, str],
        directions: bool = False,
    ) -> None:
        """Describe the source; nothing is opened.

        Args:
            place: What it is connected to, for messages.
            clock: Whose clock the frames' device times are on.
            facts: What the session's metadata say of it.
            directions: Whether the frames tell sent from received.
        """
        self.name = address.name
        self.clock = clock
        self.facts = facts
        self.directions = directions
        self.finished = False  # it was found that it can never work, or it was stopped
        self._open_link = open_link
        self._place = place
        self._tally = Tally(lambda: 0)
        self._watch = BusWatch()
        self._backoff = Backoff()
        self._attempt: _Attempt | None = None
        self._link: Link | None = None
        self._was_up = False
        self._lost_ns: int | None = None
        self._complaint = ""

    @property
    def counts(self) -> SourceCounts:
        """What became of its frames so far."""
        return self._tally.counts

    @property
    def connected(self) -> bool:
        """Whether the connection is open."""
        return self._link is not None

    def start(self, context: SourceContext) -> None:
        """Begin to connect, and wait a moment for what is there to answer.

        Raises:
            SourceError: If it can never work. What is only absent is waited for.
        """
        self._tally = Tally(context.now_ns)
        self._attempt = _Attempt(self._open_link, self._tally)
        self._attempt.wait(_FIRST_ATTEMPT_S)
        if self._attempt.done:
            try:
                self._connect(context.now_ns())
            except SourceError:
                self.finished = True
                raise

    def poll(self) -> Polled:
        """Take what has come."""
        if self.finished:
            return Polled((), self._tally.events.flush())
        now = self._tally.now_ns()
        if self._link is None:
            try:
                self._connect(now)
            except SourceError as error:
                self.finished = True
                self._tally.events.log_event("error", str(error))
        frames = self._read(now)
        for array in frames:
            self._tally.counts.frames += len(array)
            self._watch.look(array, self._tally)
        classic = tuple(array for array in frames if not holds_fd(array))
        fd_frames = tuple(array for array in frames if holds_fd(array))
        return Polled(classic, self._tally.events.take(), fd_frames)

    def stop(self) -> None:
        """End and release everything."""
        self.finished = True
        if self._attempt is not None:
            self._attempt.abandon()
            self._attempt = None
        if self._link is not None:
            self._link.close()
            self._link = None

    def _connect(self, now_ns: int) -> None:
        """Begin an attempt that is due, or take the result of one that ended."""
        if self._attempt is None:
            if self._backoff.due(now_ns):
                self._attempt = _Attempt(self._open_link, self._tally)
            return
        if not self._attempt.done:
            return
        attempt, self._attempt = self._attempt, None
        try:
            self._link = attempt.result()
        except SourceError as error:
            if not self._was_up:
                raise
            self._backoff.failed(now_ns)  # what has worked may work again
            self._complain(str(error))
            return
        except OSError as error:
            self._backoff.failed(now_ns)
            if not (self._was_up and error.errno in _ABSENT):  # its loss was told
                self._complain(f"waits for {self._place}: {_reason(error)}")
            return
        except Exception as error:  # noqa: BLE001 (a fault of one source ends no recording)
            self._backoff.failed(now_ns)
            self._complain(f"can't open {self._place}: {error!r}")
            return
        self._backoff.opened(now_ns)
        self._complaint = ""
        detail = f" ({self._link.detail})" if self._link.detail else ""
        if not self._was_up:
            self._tally.events.log_event("info", f"connected to {self._place}{detail}")
        else:
            self._tally.counts.reconnects += 1
            away_s = (now_ns - (self._lost_ns or now_ns)) / 1e9
            self._tally.events.log_event(
                "info", f"{self._place} is back after {away_s:.1f} s{detail}"
            )
        self._was_up = True

    def _read(self, now_ns: int) -> tuple[FrameArray, ...]:
        if self._link is None:
            return ()
        try:
            return tuple(array for array in self._link.read(now_ns) if len(array))
        except OSError as error:
            reason = _reason(error)
        except Exception as error:  # noqa: BLE001 (a fault of one source ends no recording)
            reason = repr(error)
        self._link.close()
        self._link = None
        self._lost_ns = now_ns
        self._backoff.failed(now_ns)
        self._complain(f"lost {self._place}: {reason}")
        return ()

    def _complain(self, text: str) -> None:
        """Tell why there is no connection, once for each new reason."""
        if text != self._complaint:
            self._complaint = text
            self._tally.events.log_event("warn", text)


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__
