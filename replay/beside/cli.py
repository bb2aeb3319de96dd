"""The verb ``view`` with two or more sessions."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from capture import Session
from capture.console import emit_json, progress
from capture.interruption import interruptible
from capture.part_file import check_stop

from .. import viewer
from . import words
from .alignment import Align, align
from .options import BesideOptions
from .side import Side, convert, names_of, read_side
from .write import Beside, Converted, Place, write_beside


def view_beside(
    files: Sequence[Path],
    options: BesideOptions,
    *,
    save: Path | None,
    web: bool,
    json: bool,
) -> None:
    """See sessions side by side.

    Args:
        files: Two or more sessions.
        options: How they are aligned, placed and called.
        save: Write the recording there instead of opening the viewer.
        web: Serve it to a browser on this machine.
        json: Print one JSON object.

    Raises:
        UsageError: If the names don't fit, or a session has no gait to be aligned by.
    """
    names = names_of(files, None if options.names is None else options.names.split(","))
    how, place = Align(options.align or Align.TIME), Place(options.place or Place.START)
    if save is None and not web:
        viewer.require_display()
    with tempfile.TemporaryDirectory(prefix="undulog-view-") as folder:
        path = save or Path(folder) / "beside.rrd"
        beside = _write(files, names, path, folder=Path(folder), how=how, place=place)
        if save is not None:
            _report(beside, how, place, json=json)
            return
        for warning in beside.warnings:
            print(f"note: {warning}")
        if web:
            viewer.serve(path, lambda address: print(address, flush=True))
        else:
            viewer.show(path)


def _write(
    files: Sequence[Path],
    names: Sequence[str],
    path: Path,
    *,
    folder: Path,
    how: Align,
    place: Place,
) -> Beside:
    with (
        ExitStack() as stack,
        interruptible() as stop,
        progress("view", total=2 * len(files) + 1) as bar,
    ):
        sessions = [stack.enter_context(Session.open(file)) for file in files]
        sides: list[Side] = []
        for k, (session, name) in enumerate(zip(sessions, names, strict=True)):
            check_stop(path, stop)
            bar.update(k, note=name)
            sides.append(read_side(session, name))
        aligned = align(sides, how)  # before the long part, since it may refuse
        converted: list[Converted] = []
        for k, (session, one) in enumerate(zip(sessions, aligned, strict=True)):
            check_stop(path, stop)
            bar.update(len(files) + k, note=f"recording {one.side.name}")
            converted.append(Converted(one, *convert(session, folder / f"{k}.rrd")))
        bar.update(2 * len(files), note="side by side")
        return write_beside(converted, path, how, place, stop)


def _report(beside: Beside, how: Align, place: Place, *, json: bool) -> None:
    size = beside.path.stat().st_size
    if json:
        emit_json(_facts(beside, how, place, size))
        return
    first, *others = [one.side for one in beside.shown]
    for other in others:
        print(f"{words.answer(first, other, beside.found[other.name])}.")
    print(f"{beside.path}: {size / 1e6:.1f} MB; open it with: rerun {beside.path}")
    for warning in beside.warnings:
        print(f"note: {warning}")


def _facts(beside: Beside, how: Align, place: Place, size: int) -> dict[str, Any]:
    return {
        "path": str(beside.path),
        "bytes": size,
        "recording_id": beside.recording_id,
        "align": str(how),
        "place": str(place),
        "sessions": [_session(beside, k) for k in range(len(beside.shown))],
        "warnings": list(beside.warnings),
    }


def _session(beside: Beside, place: int) -> dict[str, Any]:
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
        "changed": [{"name": c.name, "a": c.a, "b": c.b} for c in found.changed],
        "joints_compared": [name for series in one.differences for name in series.names],
        "placed": None
        if placed is None
        else {"turn_rad": placed.turn, "x_m": placed.x, "y_m": placed.y},
    }
