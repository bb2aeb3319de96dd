"""Command ``view`` with ``--clip``."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture.common.console import echo, emit_json, progress, refuse_existing
from undulog.capture.common.errors import MissingExtraError, UsageError
from undulog.capture.common.process import interruptible

from .view_options import ClipOptions

if TYPE_CHECKING:
    from ..feed.film import Shot
    from ..feed.recording import Recording


def view_clip(file: Path, clip: Path, options: ClipOptions, *, force: bool, json: bool) -> None:
    """Write a moving picture of a session's body.

    Args:
        file: The session.
        clip: The clip, ``.gif`` or ``.mp4``.
        options: How it is filmed.
        force: Replace the clip if it is there.
        json: Print the report as one JSON object.

    Raises:
        UsageError: If the options are wrong.
        UndulogError: If the work fails.
    """
    try:
        from ..feed.film import check_film, film, scene_only
    except ModuleNotFoundError as error:
        raise MissingExtraError("'undulog view --clip'", "replay", error.name or "av") from error
    from undulog.capture import Session

    from ..draw.scene.body import body_title
    from ..feed.recording import write_recording

    refuse_existing(clip, force=force)
    with (
        interruptible() as stop,
        tempfile.TemporaryDirectory(prefix="undulog-clip-") as folder,
        Session.open(file) as session,
    ):
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
    _report(clip, shot, frames, recording, json=json)


def _shot(options: ClipOptions, duration_s: float, file: Path) -> Shot:
    from ..feed.film import Shot

    end_s = duration_s if options.end is None else options.end
    if end_s > duration_s:
        raise UsageError(f"--to {end_s:g}: {file.name} ends at {duration_s:.3f} s")
    size = None if options.size is None else _size(options.size)
    given = {"fps": options.fps, "speed": options.speed, "size": size}
    chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    return Shot(options.start or 0.0, end_s, **chosen)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None:
        raise UsageError(f"--size {text}: expected WIDTHxHEIGHT in pixels, e.g. 960x540")
    return int(match[1]), int(match[2])


def _report(clip: Path, shot: Shot, frames: int, recording: Recording, *, json: bool) -> None:
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
    if json:
        emit_json(facts)
        return
    echo(
        f"{clip}: {facts['duration_s']:.2f} s, {frames} frames of {shot.size[0]}x{shot.size[1]}, "
        f"{facts['bytes'] / 1e6:.2f} MB"
    )
    echo(*(f"note: {warning}" for warning in recording.warnings))
