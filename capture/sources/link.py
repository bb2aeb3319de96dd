"""A source over one connection that may break and come back.

A :class:`BusConnection` is an open connection. A :class:`LinkedSource` opens one, reads it, and
opens it again after a break, with growing pauses. Opening may block (a name to look up, an adapter
that answers slowly), so each attempt has a thread of its own; reading never does.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError, wait
from contextlib import suppress
from typing import Protocol

from ..common.errors import SourceError
from ..log.messages.frames import FrameArray, holds_fd
from ..robot.model import ClockDomain, Robot
from .contract import Polled, SourceAddress, SourceContext, SourceCounts
from .events import BusWatch, Tally

_FIRST_NS = 100_000_000
_LONGEST_NS = 5_000_000_000
_STEADY_NS = 1_000_000_000

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
"""Errors of an unplugged device or an ended server."""


class Backoff:
    """Pauses between attempts: 0.1 s, doubled up to 5 s.

    A connection that held for a second resets them; a shorter one doesn't.
    """

    def __init__(self) -> None:
        """Make the first attempt due at once."""
        self._pause_ns = _FIRST_NS
        self._due_ns = 0
        self._opened_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the pause is over."""
        return now_ns >= self._due_ns

    def opened(self, now_ns: int) -> None:
        """Note a successful attempt."""
        self._opened_ns = now_ns

    def failed(self, now_ns: int) -> None:
        """Note a failed attempt or a lost connection."""
        if self._opened_ns is not None and now_ns - self._opened_ns >= _STEADY_NS:
            self._pause_ns = _FIRST_NS
        self._opened_ns = None
        self._due_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, _LONGEST_NS)


class BusConnection(Protocol):
    """An open connection; after the thread that opened it, one thread uses it."""

    @property
    def detail(self) -> str:
        """Description for messages, e.g. ``listen-only``; may be empty."""
        ...

    def read(self, now_ns: int) -> Sequence[FrameArray]:
        """Return the received frames, without blocking.

        Args:
            now_ns: The session's clock [Unix ns].

        Raises:
            OSError: If the connection is broken, after all frames were returned.
        """
        ...

    def close(self) -> None:
        """Release it, also a dead device; safe to call twice."""


OpenLink = Callable[[Tally], BusConnection]
"""Opens a connection; may block. OSError: try again later. SourceError: it can never work."""


def _open_in_thread(open_link: OpenLink, tally: Tally) -> Future[BusConnection]:
    """Open a connection in a thread of its own; one that is cancelled is closed."""
    opening: Future[BusConnection] = Future()

    def run() -> None:
        try:
            link = open_link(tally)
        except Exception as error:  # noqa: BLE001 (raised again by result(), in the recorder's thread)
            with suppress(InvalidStateError):  # cancelled
                opening.set_exception(error)
            return
        try:
            opening.set_result(link)
        except InvalidStateError:  # cancelled
            link.close()

    threading.Thread(target=run, name="undulog-connect", daemon=True).start()
    return opening


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
            place: Device or server, for messages.
            clock: Clock of the frames' device times.
            facts: Facts for the session's metadata.
            directions: Whether the frames distinguish sent from received.
        """
        self.name = address.name
        self.clock = clock
        self.facts = facts
        self.directions = directions
        self.finished = False  # it can never work, or it was stopped
        self._open_link, self._place = open_link, place
        self._tally = Tally(lambda: 0)
        self._watch = BusWatch()
        self._backoff = Backoff()
        self._opening: Future[BusConnection] | None = None
        self._link: BusConnection | None = None
        self._was_up = False
        self._lost_ns: int | None = None
        self._lost = False
        self._complaint = ""

    @property
    def counts(self) -> SourceCounts:
        """Counts of its frames so far."""
        return self._tally.counts

    @property
    def connected(self) -> bool:
        """Whether the connection is open."""
        return self._link is not None

    @property
    def lost(self) -> bool:
        """Whether the connection broke, and has not come back."""
        return self._lost

    def start(self, context: SourceContext) -> None:
        """Begin to connect, and wait a moment for the result.

        Raises:
            SourceError: If it can never work. An absent device or server is waited for.
        """
        self._tally = Tally(context.now_ns)
        self._opening = _open_in_thread(self._open_link, self._tally)
        if wait([self._opening], _FIRST_ATTEMPT_S).done:
            try:
                self._connect(context.now_ns())
            except SourceError:
                self.finished = True
                raise

    def poll(self) -> Polled:
        """Return new frames and events."""
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
        if self._opening is not None:
            if not self._opening.cancel() and self._opening.exception() is None:
                self._opening.result().close()
            self._opening = None
        if self._link is not None:
            self._link.close()
            self._link = None

    def _connect(self, now_ns: int) -> None:
        """Begin an attempt that is due, or take the result of a finished one."""
        if self._opening is None:
            if self._backoff.due(now_ns):
                self._opening = _open_in_thread(self._open_link, self._tally)
            return
        if not self._opening.done():
            return
        opening, self._opening = self._opening, None
        try:
            self._link = opening.result()
        except SourceError as error:
            if not self._was_up:
                raise
            complaint = str(error)  # a device that has worked may work again
        except OSError as error:
            complaint = f"waits for {self._place}: {_reason(error)}"
            if self._was_up and error.errno in _ABSENT:  # its loss is reported already
                complaint = self._complaint
        except Exception as error:  # noqa: BLE001 (a fault of one source ends no recording)
            complaint = f"can't open {self._place}: {error!r}"
        else:
            self._connected(self._link, now_ns)
            return
        self._backoff.failed(now_ns)
        self._complain(complaint)

    def _connected(self, link: BusConnection, now_ns: int) -> None:
        self._backoff.opened(now_ns)
        self._complaint = ""
        text = f"connected to {self._place}"
        if self._was_up:
            self._tally.counts.reconnects += 1
            away_s = (now_ns - (self._lost_ns or now_ns)) / 1e9
            text = f"{self._place} is back after {away_s:.1f} s"
        self._tally.events.log_event("info", text + (f" ({link.detail})" if link.detail else ""))
        self._was_up, self._lost = True, False

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
        self._lost_ns, self._lost = now_ns, True
        self._backoff.failed(now_ns)
        self._complain(f"lost {self._place}: {reason}")
        return ()

    def _complain(self, text: str) -> None:
        """Report why there is no connection, once for each new reason."""
        if text != self._complaint:
            self._complaint = text
            self._tally.events.log_event("warn", text)


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__
