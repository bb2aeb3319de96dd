"""Command ``view`` with one session and a viewer: the picture comes while it is converted."""

from __future__ import annotations

import os
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture import Session
from undulog.capture.common.console import complain, echo, emit_json, progress
from undulog.capture.common.process import interruptible

from ..samples.content import Layer
from ..viewer import viewer
from .view_options import SingleOptions

if TYPE_CHECKING:
    from ..live.relay import RelayReport


_LIVE_NICENESS = 10


def view_live(path: Path, *, save: Path | None, web: bool, connect: str | None, json: bool) -> None:
    """Show what a recorder on this machine records, until it is closed or interrupted.

    Args:
        path: The socket that the recorder sends to.
        save: Write one session to this file instead.
        web: Serve the viewer to a browser on this machine instead of opening a window.
        connect: Address of a viewer that runs already.
        json: Print the report as one JSON object.

    Raises:
        UsageError: If the socket can't be made, or there is no display for a window.
        UndulogError: If the viewer or the drawing fails.
    """
    from ..live.relay import open_server, open_window, relay_to_file, relay_to_viewer

    if not (web or connect or save):
        viewer.require_display()
    _be_nice(_LIVE_NICENESS)  # it never competes with the recorder
    if save is not None:
        report = relay_to_file(path, save)
    elif connect is not None:
        report = relay_to_viewer(path, None, connect)
    elif web:
        with open_server(echo) as server:
            report = relay_to_viewer(path, server, server.address)
    else:
        with open_window() as window:
            report = relay_to_viewer(path, window, window.address)
    if json:
        emit_json(_facts(report, save))
    else:
        _print_report(report, save)
    if connect is not None and report.complaint:
        complain(f"error: {report.complaint}")
        os._exit(1)  # at once: Rerun would wait at its end for a viewer that takes nothing


def _print_report(report: RelayReport, save: Path | None) -> None:
    where = f"{save}: " if save is not None else ""
    late = "" if report.lag_s is None else f", {report.lag_s[0] * 1e3:.0f} ms late (median)"
    echo(f"{where}{report.shown} messages shown, {report.dropped} dropped{late}")
    if report.unread:
        echo(f"note: {report.unread} messages could not be read")


def _facts(report: RelayReport, save: Path | None) -> dict[str, Any]:
    lag = report.lag_s
    return {
        "path": None if save is None else str(save),
        "sessions": list(report.sessions),
        "shown": report.shown,
        "dropped": report.dropped,
        "unread": report.unread,
        "lag_s": None if lag is None else dict(zip(("p50", "p99", "max"), lag, strict=True)),
    }


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
        known = Layer(None)
        if single.result:
            from ..feed.numbers import read_results

            known = read_results(session, single.result)
        if web:
            process, page = viewer.open_server(viewer.WHOLE_IN_MEMORY)
            stack.enter_context(process).wait_until_it_listens()
            echo(page)
        else:
            process = stack.enter_context(viewer.open_window())
        # Rerun would report a closed window as errors of its own, in colours.
        os.environ.setdefault("RUST_LOG", "off")
        from ..feed.numbers import Analysing
        from ..feed.progressive import NoLongerWantedError, Task, show_session, steps

        analysing = stack.enter_context(Analysing(file, single.topics))
        try:
            with progress("view", total=steps(session)) as bar:
                bar.update(0, note=_FIRST)
                front = single.tab or "session"
                # What is looked at goes before what is converted.
                begun = partial(_be_nice, _NICENESS)
                task = Task(session, known, analysing, front, bar, begun=begun)
                notes = show_session(task, process, stop)
        except NoLongerWantedError:
            return
        echo(f"{file}: {session.duration_s:.1f} s, all of it in the viewer")
        echo(*(f"note: {note}" for note in notes))
        process.wait(stop)


def _be_nice(niceness: int) -> None:
    os.nice(max(niceness - os.nice(0), 0))
