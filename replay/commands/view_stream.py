"""The verb ``view`` with one session and a viewer: the picture comes while it is converted."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

from undulog.capture import Session, SessionView
from undulog.capture.common.console import progress, say
from undulog.capture.common.interruption import interruptible

from ..content.layer import Layer
from ..viewer import viewer
from .view_single import SingleOptions

_FIRST = "the beginning"
_NICENESS = 5


def view_session(file: Path, single: SingleOptions, *, web: bool) -> None:
    """Show a session until the viewer is closed or an end is asked for.

    Args:
        file: The session.
        single: How it is shown.
        web: Serve the viewer to browsers on this machine instead of opening a window.

    Raises:
        UsageError: If there is no display for a window.
        LogError: If the session or a result can't be read.
        DataError: If it holds nothing that can be drawn.
        UndulogError: If the viewer fails.
    """
    if not web:
        viewer.require_display()
    with ExitStack() as stack:
        stop = stack.enter_context(interruptible())
        session = single.view(stack.enter_context(Session.open(file)))
        known = _known(session, single)
        if web:
            process, page = viewer.open_server(viewer.WHOLE_IN_MEMORY)
        else:
            process, page = viewer.open_window(), ""
        stack.enter_context(process)
        if page:
            process.wait_until_it_listens()
            say(page)
        # Rerun would tell a closed window as errors of its own, in colours.
        os.environ.setdefault("RUST_LOG", "off")
        from ..stream.apart import Analysing
        from ..stream.show import NoLongerWantedError, Task, show_session, steps

        analysing = stack.enter_context(Analysing(file, single.topics))
        try:
            with progress("view", total=steps(session)) as bar:
                bar.update(0, note=_FIRST)
                front = single.tab or "session"
                task = Task(session, known, analysing, front, bar, begun=_make_way)
                notes = show_session(task, process, stop)
        except NoLongerWantedError:
            return
        say(f"{file}: {session.duration_s:.1f} s, all of it in the viewer")
        for note in notes:
            say(f"note: {note}")
        process.wait(stop)


def _make_way() -> None:
    """Have what is looked at go before what is converted."""
    os.nice(max(_NICENESS - os.nice(0), 0))


def _known(session: SessionView, single: SingleOptions) -> Layer:
    """What results say of it."""
    if not single.result:
        return Layer(None)
    from ..record.results import found_before

    return found_before(session, single.result)
