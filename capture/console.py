"""What every verb says in the same way: progress, JSON, and the refusal to overwrite."""

from __future__ import annotations

import json
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from .errors import OutputExistsError, UsageError


class Progress(Protocol):
    """What a long work reports to."""

    def update(self, done: float, note: str = "") -> None:
        """Say how far the work is.

        Args:
            done: In the units of the total.
            note: A few words, e.g. the real-time factor.
        """
        ...


class _Silent:
    def update(self, done: float, note: str = "") -> None:
        """Say nothing."""


@contextmanager
def progress(description: str, total: float) -> Generator[Progress]:
    """A progress bar on stderr, or silence where stderr is not a terminal.

    Args:
        description: What is being done.
        total: What ``done`` will reach.

    Yields:
        The object to report to.
    """
    if not sys.stderr.isatty():
        yield _Silent()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(description, total=total, note="")

        class _Bar:
            def update(self, done: float, note: str = "") -> None:
                bars.update(task, completed=done, note=note)

        yield _Bar()


def emit_json(value: Any) -> None:
    """Print one JSON value on stdout.

    Args:
        value: Plain JSON values; NaN is refused, since it is not JSON.
    """
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def refuse_existing(path: Path, *, force: bool) -> None:
    """Check an output path before any work is done.

    Args:
        path: Where the output will go.
        force: Whether an existing file may be replaced.

    Raises:
        OutputExistsError: If it is there and ``force`` is not given.
        UsageError: If it is a folder, or its folder doesn't exist.
    """
    if path.is_dir():
        raise UsageError(f"{path} is a folder; name a file in it")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: the folder {path.parent} doesn't exist")
    if path.exists() and not force:
        raise OutputExistsError(path)
