"""From files to one recording of all of them."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from undulog.capture import Session, SessionView
from undulog.capture.common.files import check_stop
from undulog.capture.common.process import StopRequest

from .alignment import Align, align
from .side import convert, names_of, read_side
from .write import Converted, Overlay, Place, write_overlay


def combine_sessions(
    files: Sequence[Path],
    path: Path,
    *,
    names: Sequence[str] | None = None,
    how: Align = Align.TIME,
    place: Place = Place.START,
    on_step: Callable[[int, str], None] = lambda _done, _note: None,
    stop: StopRequest | None = None,
) -> Overlay:
    """Convert sessions and bring them together.

    Args:
        files: Two or more sessions; differences are from the first.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        names: What they are called, or None for the files' names.
        place: Where the bodies are drawn.
        on_step: Told before each of :func:`steps` how many are done, and what comes.
        stop: Looked at now and then; once an end is asked for, nothing is written.

    Raises:
        UsageError: If the names don't fit, or a session has no gait to be aligned by.
        LogError: If a session can't be read, or the file can't be written.
        DataError: If a session holds nothing that can be drawn.
    """
    done = itertools.count()

    def step(note: str) -> None:
        check_stop(path, stop)
        on_step(next(done), note)

    called = names_of(files, names)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="undulog-beside-")))
        pairs: list[tuple[SessionView, str]] = []
        for file, name in zip(files, called, strict=True):
            session = stack.enter_context(Session.open(file, column_folder=folder))
            pairs.append((session.view(on_read=partial(check_stop, path, stop)), name))
        step("angles")
        # Aligned before the long part, since that may refuse.
        aligned = align([read_side(session, name) for session, name in pairs], how)
        converted: list[Converted] = []
        for k, ((session, name), one) in enumerate(zip(pairs, aligned, strict=True)):
            step(f"recording of {name}")
            converted.append(Converted(one, *convert(session, folder / f"{k}.rrd")))
        step("side by side")
        return write_overlay(converted, path, how, place=place, stop=stop)


def steps(count: int) -> int:
    """How many steps it takes."""
    return count + 2
