"""Options and output shared by the commands of the analysis."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from undulog.capture.common.console import UNLIMITED, Progress, echo
from undulog.capture.common.errors import UsageError

if TYPE_CHECKING:
    from undulog.capture import SessionView

    from ..signals.stretch import Options


PAGES = (".html", ".htm")
"""How the name of a page ends."""


def chosen(
    start: float | None,
    stop: float | None,
    command_topic: str,
    response_topic: str,
    reference_topic: str | None = None,
) -> Options:
    """Check and collect the options of the analysis of each session.

    Args:
        start: From the session's start [s].
        stop: From the session's start [s].
        reference_topic: Of a second sensor.

    Raises:
        UsageError: If the window is empty.
    """
    if start is not None and not start >= 0:
        raise UsageError(f"--start {start:g} is before the session's start, which is 0")
    if stop is not None and not stop > (start or 0.0):
        raise UsageError(f"--stop {stop:g} is not after --start {start or 0.0:g}")
    from ..signals.stretch import Options

    return Options(start, stop, command_topic, response_topic, reference_topic)


def opened(files: Iterable[Path], bar: Progress, done: int = 0) -> Iterator[SessionView]:
    """Open sessions, each until the next one is taken, and show the progress.

    Args:
        done: Sessions of the progress bar that are done before.
    """
    from undulog.capture import Session

    for k, file in enumerate(files, start=done):
        bar.update(k, note=file.name)
        with Session.open(file) as session:
            yield session


def show(render: Callable[[int, bool], str], output: Path | None) -> None:
    """Print a result as text; into a file or a pipe nothing is wrapped: one sentence, one line.

    Args:
        render: Returns the text for a width in columns, with or without bold and dim type.
        output: The file that was written.
    """
    terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if terminal else UNLIMITED
    sys.stdout.write(render(width, terminal))  # its names are escaped; the rest are styles
    if output is not None:
        echo(f"Result: {output}")
