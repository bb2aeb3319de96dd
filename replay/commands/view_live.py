"""The verb ``view`` with ``--live``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from undulog.capture.common.console import complain, emit_json, say

if TYPE_CHECKING:
    from ..live.relay import RelayReport


_NICENESS = 10


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
    from ..live.relay import relay_to_file, relay_to_viewer
    from ..live.target import open_server, open_window
    from ..viewer import viewer

    if not (web or connect or save):
        viewer.require_display()
    os.nice(max(_NICENESS - os.nice(0), 0))  # it never competes with the recorder
    if save is not None:
        report = relay_to_file(path, save)
    elif connect is not None:
        report = relay_to_viewer(path, None, connect)
    elif web:
        with open_server(say) as server:
            report = relay_to_viewer(path, server, server.address)
    else:
        with open_window() as window:
            report = relay_to_viewer(path, window, window.address)
    if json:
        emit_json(_facts(report, save))
    else:
        _tell(report, save)
    if connect is not None and report.complaint:
        _leave(report.complaint)


def _leave(complaint: str) -> NoReturn:
    """End the process at once: Rerun would wait at its end for a viewer that takes nothing."""
    complain(f"error: {complaint}")
    os._exit(1)


def _tell(report: RelayReport, save: Path | None) -> None:
    where = f"{save}: " if save is not None else ""
    late = "" if report.lag_s is None else f", {report.lag_s[0] * 1e3:.0f} ms late (median)"
    say(f"{where}{report.shown} messages shown, {report.dropped} dropped{late}")
    if report.unread:
        say(f"note: {report.unread} messages could not be read")


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
