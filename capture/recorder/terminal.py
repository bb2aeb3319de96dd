"""What an operator sees while a recording runs, on stderr.

A terminal can stop taking text at any time (Ctrl-S, a dead connection, a full pipe), and a write to
it waits then for as long as that lasts. A recording may not: so a thread of its own draws, always
the latest state, and one that is stuck is left behind.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import TextIO

from rich.console import Console
from rich.live import Live

from .screen import event_line, plain_line, screen
from .statuses import EventLine, RecorderSnapshot

LINE_EVERY_S = 10.0
"""How often a line is printed where there is no terminal [s] of the recording."""

PATIENCE_S = 1.0
"""How long the end of a recording waits for what shows it [s]."""

_TOLD = ("warn", "error", "fatal")


class Terminal:
    """Shows a recording: a screen on a terminal, else a line every ten seconds."""

    def __init__(self, stream: TextIO, *, quiet: bool = False) -> None:
        """Start to show; nothing is drawn before the first :meth:`show`.

        Args:
            stream: Where to, e.g. ``sys.stderr``.
            quiet: Show nothing at all.
        """
        self._stream = stream
        self._quiet = quiet
        self._latest: RecorderSnapshot | None = None
        self._wake = threading.Condition()
        self._closing = False
        self._thread: threading.Thread | None = None

    def show(self, snapshot: RecorderSnapshot) -> None:
        """Hand over the latest state; returns at once, also where the terminal is stuck.

        Args:
            snapshot: The recording.
        """
        if self._quiet:
            return
        with self._wake:
            self._latest = snapshot
            self._wake.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
            self._thread.start()

    def close(self) -> bool:
        """End; what was drawn is cleared from a terminal, so that a report can follow.

        Returns:
            Whether the terminal took everything; if not, nothing more should be written to it,
            since that might wait for ever.
        """
        if self._thread is None:
            return True
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(PATIENCE_S)
        return not self._thread.is_alive()

    # -- the thread ------------------------------------------------------------------------

    def _run(self) -> None:
        # The terminal may be gone, or the stream closed: a recording goes on without it.
        with suppress(OSError, ValueError), self._own() as stream:
            if stream.isatty():
                self._draw(stream)
            else:
                self._print(stream)

    @contextmanager
    def _own(self) -> Generator[TextIO]:
        """A stream of our own to the same place.

        A stuck write holds the lock of its stream; were that stderr's, the interpreter could not
        end.
        """
        try:
            number = os.dup(self._stream.fileno())
        except OSError:  # not a file: a test's text in memory
            yield self._stream
            return
        with os.fdopen(number, "w", encoding="utf-8", errors="replace") as stream:
            yield stream

    def _next(self) -> RecorderSnapshot | None:
        """Wait for a state that was not shown yet; None at the end."""
        with self._wake:
            self._wake.wait_for(lambda: self._latest is not None or self._closing)
            latest, self._latest = self._latest, None
            return latest

    def _draw(self, stream: TextIO) -> None:
        console = Console(file=stream)
        with Live(
            console=console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        ) as live:
            while (snapshot := self._next()) is not None:
                width, height = console.size
                live.update(screen(snapshot, width, height - 1), refresh=True)

    def _print(self, stream: TextIO) -> None:
        due_s = 0.0
        told: EventLine | None = None
        while (snapshot := self._next()) is not None:
            for event in _after(snapshot.events, told):
                told = event
                if event.level in _TOLD:
                    stream.write(event_line(event) + "\n")
            if snapshot.elapsed_s >= due_s:
                due_s = snapshot.elapsed_s + LINE_EVERY_S
                stream.write(plain_line(snapshot) + "\n")
            stream.flush()


def _after(events: tuple[EventLine, ...], told: EventLine | None) -> tuple[EventLine, ...]:
    """The events that came after one."""
    return events[events.index(told) + 1 :] if told in events else events
