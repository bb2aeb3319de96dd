"""Command ``view`` of recorded sessions: a clip, several sessions side by side."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog import capture
from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import echo, emit, progress, refuse_existing
from undulog.capture.common.errors import MissingExtraError, UsageError
from undulog.capture.common.process import interruptible

from .view_options import ClipOptions, OverlayOptions

if TYPE_CHECKING:
    from ..film import Shot
    from ..overlay.sessions import Align
    from ..overlay.write import Overlay, Place
    from ..recording import Recording


def view_clip(
    file: Path,
    clip: Path,
    options: ClipOptions,
    *,
    topics: JointTopicOptions = CONTRACT,
    robot: str | None = None,
    force: bool,
    json: bool,
) -> None:
    """Write a moving picture of a session's body.

    Args:
        file: The session.
        clip: The clip, ``.gif`` or ``.mp4``.
        options: How it is filmed.
        topics: Where commands and responses are.
        robot: Description for a log without one.
        force: Replace the clip if it is there.
        json: Print the report as one JSON object.

    Raises:
        UsageError: If the options are wrong.
        UndulogError: If the work fails.
    """
    try:
        from ..film import check_film, film, scene_only
    except ModuleNotFoundError as error:
        raise MissingExtraError("'undulog view --clip'", "replay", error.name or "av") from error
    from tempfile import TemporaryDirectory

    from ..draw.body import body_title
    from ..recording import write_recording

    refuse_existing(clip, force=force)
    with (
        interruptible() as stop,
        TemporaryDirectory(prefix="undulog-clip-") as folder,
        capture.Session.open(file, robot=robot) as opened,
    ):
        session = topics.view(opened)
        shot = _shot(options, session.duration_s, file)
        check_film(clip.suffix.lower(), shot.size, shot.fps)
        with progress(f"clip of {file.name}", total=len(shot.times_s)) as bar:
            bar.update(0, note="recording")
            recording = write_recording(session, Path(folder) / "clip.rrd", layout=scene_only)
            frames = film(
                recording.path,
                shot,
                clip,
                legend=body_title(recording.content),
                on_frame=bar.update,
                stop=stop,
            )
    _report_clip(clip, shot, frames, recording, json=json)


def _shot(options: ClipOptions, duration_s: float, file: Path) -> Shot:
    from ..film import Shot

    end_s = duration_s if options.end is None else options.end
    if end_s > duration_s:
        raise UsageError(f"--to {end_s:g}: {file.name} ends at {duration_s:.3f} s")
    given: dict[str, Any] = {"fps": options.fps, "speed": options.speed}
    chosen = {name: value for name, value in given.items() if value is not None}
    if options.size is not None:
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", options.size)
        if match is None:
            text = "expected WIDTHxHEIGHT in pixels, e.g. 960x540"
            raise UsageError(f"--size {options.size}: {text}")
        chosen["size"] = int(match[1]), int(match[2])
    return Shot(options.start or 0.0, end_s, **chosen)


def _report_clip(clip: Path, shot: Shot, frames: int, recording: Recording, *, json: bool) -> None:
    facts: dict[str, Any] = {
        "path": str(clip),
        "bytes": clip.stat().st_size,
        "frames": frames,
        "fps": shot.fps,
        "duration_s": frames / shot.fps,
        "from_s": shot.start_s,
        "to_s": shot.end_s,
        "speed": shot.speed,
        "size": list(shot.size),
        "warnings": list(recording.warnings),
    }
    size = f"{shot.size[0]}x{shot.size[1]}, {facts['bytes'] / 1e6:.2f} MB"
    lines = [f"{clip}: {facts['duration_s']:.2f} s, {frames} frames of {size}"]
    emit(facts, [*lines, *(f"note: {text}" for text in recording.warnings)], as_json=json)


def view_overlay(
    files: Sequence[Path],
    options: OverlayOptions,
    *,
    topics: JointTopicOptions = CONTRACT,
    robot: str | None = None,
    save: Path | None,
    web: bool,
    json: bool,
) -> None:
    """Show or save sessions side by side.

    Args:
        files: Two or more sessions.
        options: How they are aligned, placed and called.
        topics: Where commands and responses are.
        robot: Description for logs without one.
        save: Write the recording there instead of opening the viewer.
        web: Serve it to a browser on this machine.
        json: Print one JSON object.

    Raises:
        UsageError: If the names don't fit, or a session has no gait to be aligned by.
    """
    from tempfile import TemporaryDirectory

    from .. import viewer
    from ..overlay.sessions import Align, names_of
    from ..overlay.write import Place, combine_sessions, steps

    names = names_of(files, None if options.names is None else options.names.split(","))
    how, place = Align(options.align or Align.TIME), Place(options.place or Place.START)
    if save is None and not web:
        viewer.require_display()
    with ExitStack() as stack:
        path = save
        if path is None:  # it is only looked at
            folder = stack.enter_context(TemporaryDirectory(prefix="undulog-view-"))
            path = Path(folder) / "beside.rrd"
        with interruptible() as stop, progress("view", total=steps(len(files))) as bar:
            beside = combine_sessions(
                files,
                path,
                topics=topics.names,
                robot=robot,
                names=names,
                how=how,
                place=place,
                on_step=bar.update,
                stop=stop,
            )
        _report_overlay(beside, how, place, saved=save is not None, json=json)
        if web:
            viewer.serve(path, echo)
        elif save is None:
            viewer.show(path)


def _report_overlay(beside: Overlay, how: Align, place: Place, *, saved: bool, json: bool) -> None:
    from ..overlay import layout as words

    size = beside.path.stat().st_size
    facts = {
        "path": str(beside.path),
        "bytes": size,
        "recording_id": beside.recording_id,
        "align": str(how),
        "place": str(place),
        "sessions": [_session(beside, k) for k in range(len(beside.shown))],
        "warnings": list(beside.warnings),
    }
    first, *others = [content.side for content in beside.shown]
    lines = [f"{words.answer(first, other, beside.outcomes[other.name])}." for other in others]
    if saved:
        lines.append(f"{beside.path}: {size / 1e6:.1f} MB; open it with: rerun {beside.path}")
    emit(facts, [*lines, *(f"note: {text}" for text in beside.warnings)], as_json=json)


def _session(beside: Overlay, place: int) -> dict[str, Any]:
    from ..overlay import layout as words

    content, first = beside.shown[place], beside.shown[0].side
    side = content.side
    facts: dict[str, Any] = {
        "name": side.name,
        "path": str(side.path),
        "session_id": side.session_id,
        "duration_s": (side.end_ns - side.start_ns) * 1e-9,
        "body": content.body,
    }
    if not place:
        return facts
    outcome, placed = beside.outcomes[side.name], beside.placements.get(side.name)
    return facts | {
        "answer": words.answer(first, side, outcome),
        "verdict": None if outcome.comparison is None else outcome.comparison.verdict,
        "changed": [{"name": c.name, "a": c.a, "b": c.b} for c in outcome.changed],
        "joints_compared": [name for series in content.differences for name in series.names],
        "placed": None
        if placed is None
        else {"turn_rad": placed.turn, "x_m": placed.x, "y_m": placed.y},
    }
