"""Command ``view`` with two or more sessions."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture.common.console import echo, emit_json, progress
from undulog.capture.common.process import interruptible

from ..viewer import viewer
from .view_options import OverlayOptions

if TYPE_CHECKING:
    from ..overlay.sessions import Align
    from ..overlay.write import Overlay, Place


def view_overlay(
    files: Sequence[Path],
    options: OverlayOptions,
    *,
    save: Path | None,
    web: bool,
    json: bool,
) -> None:
    """Show or save sessions side by side.

    Args:
        files: Two or more sessions.
        options: How they are aligned, placed and called.
        save: Write the recording there instead of opening the viewer.
        web: Serve it to a browser on this machine.
        json: Print one JSON object.

    Raises:
        UsageError: If the names don't fit, or a session has no gait to be aligned by.
    """
    from ..overlay.sessions import Align, names_of
    from ..overlay.write import Place, combine_sessions, steps

    names = names_of(files, None if options.names is None else options.names.split(","))
    how, place = Align(options.align or Align.TIME), Place(options.place or Place.START)
    if save is None and not web:
        viewer.require_display()
    with ExitStack() as stack:
        path = save
        if path is None:  # it is only looked at
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="undulog-view-"))
            path = Path(folder) / "beside.rrd"
        with interruptible() as stop, progress("view", total=steps(len(files))) as bar:
            beside = combine_sessions(
                files,
                path,
                names=names,
                how=how,
                place=place,
                on_step=bar.update,
                stop=stop,
            )
        _report(beside, how, place, saved=save is not None, json=json)
        if web:
            viewer.serve(path, echo)
        elif save is None:
            viewer.show(path)


def _report(beside: Overlay, how: Align, place: Place, *, saved: bool, json: bool) -> None:
    size = beside.path.stat().st_size
    if json:
        facts = {
            "path": str(beside.path),
            "bytes": size,
            "recording_id": beside.recording_id,
            "align": str(how),
            "place": str(place),
            "sessions": [_session(beside, k) for k in range(len(beside.shown))],
            "warnings": list(beside.warnings),
        }
        emit_json(facts)
        return
    from ..overlay import layout as words

    first, *others = [one.side for one in beside.shown]
    for other in others:
        echo(f"{words.answer(first, other, beside.found[other.name])}.")
    if saved:
        echo(f"{beside.path}: {size / 1e6:.1f} MB; open it with: rerun {beside.path}")
    echo(*(f"note: {warning}" for warning in beside.warnings))


def _session(beside: Overlay, place: int) -> dict[str, Any]:
    from ..overlay import layout as words

    one, first = beside.shown[place], beside.shown[0].side
    side = one.side
    facts: dict[str, Any] = {
        "name": side.name,
        "path": str(side.path),
        "session_id": side.session_id,
        "duration_s": (side.end_ns - side.start_ns) * 1e-9,
        "body": one.body,
    }
    if not place:
        return facts
    found, placed = beside.found[side.name], beside.placements.get(side.name)
    return facts | {
        "answer": words.answer(first, side, found),
        "verdict": None if found.comparison is None else found.comparison.verdict,
        "changed": [{"name": c.name, "a": c.a, "b": c.b} for c in found.changed],
        "joints_compared": [name for series in one.differences for name in series.names],
        "placed": None
        if placed is None
        else {"turn_rad": placed.turn, "x_m": placed.x, "y_m": placed.y},
    }
