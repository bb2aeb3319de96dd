"""Command ``view``."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.common.console import echo, emit_json, progress
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_output

from .view_film import view_clip
from .view_options import ClipOptions, OverlayOptions, SingleOptions

if TYPE_CHECKING:
    from ..feed.recording import Recording


def view(
    *files: Path,
    live: Path | None = None,
    save: Path | None = None,
    web: bool = False,
    connect: str | None = None,
    single: Annotated[SingleOptions | None, Parameter(name="*")] = None,
    clip: Path | None = None,
    shot: Annotated[ClipOptions | None, Parameter(name="*")] = None,
    beside: Annotated[OverlayOptions | None, Parameter(name="*")] = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """See a session in Rerun, or several side by side: body, joints, power and response.

    Opens the viewer on the beginning, sends the rest and the session's numbers while one looks, and
    waits until its window is closed. The recording that it shows is a cache: it can be made again
    from the session at any time. The session stays on this machine; the viewer counts its own use
    on its makers' server, which `rerun analytics disable` ends.

    With `--live` it shows a session while it is recorded; the recorder never waits for it.

    Several sessions lie in one view: bodies overlaid, plots of all of them, and the differences
    of the others from the first.

    Example: `undulog view run.mcap --save run.rrd`

    Robot and twin: `undulog view robot.mcap twin.mcap --align phase --names robot,twin`

    Args:
        files: The session, `.mcap`, or several.
        live: Instead of a file, the socket that a recorder on this machine sends to.
        save: Write the recording to this `.rrd` file instead of opening the viewer. Of what is
            recorded live, one session, when it has ended.
        web: Serve the viewer to a browser on this machine (127.0.0.1 only) until interrupted.
        connect: With `--live`: send to a Rerun viewer that runs already, by its address, e.g.
            `rerun+http://127.0.0.1:9876/proxy`.
        single: How one session is shown.
        clip: Write a moving picture of the body to this `.gif` or `.mp4` file instead of opening
            the viewer; it is drawn off screen.
        shot: How the clip is filmed.
        beside: How several sessions are put side by side.
        force: Replace the recording or the clip if it is there.
        json: Print one JSON object: what was written and what is missing. Needs `--save` or
            `--clip`.
    """
    _check_usage(files, live, save=save, web=web, connect=connect, clip=clip, json=json)
    if beside is not None and len(files) < 2:
        raise UsageError(f"{', '.join(beside.given)}: needs two sessions or more, side by side")
    if single is not None and (len(files) != 1 or clip is not None):
        raise UsageError(f"{', '.join(single.given)}: needs one session, and no --clip")
    if shot is not None and clip is None:
        raise UsageError(f"{', '.join(shot.given)}: an option of clips; give --clip as well")
    if clip is not None:
        view_clip(files[0], clip, shot or ClipOptions(), force=force, json=json)
        return
    if save is not None:
        check_output(save, [".rrd"], "a Rerun recording; end its name in .rrd", force=force)
    if live is not None:
        from .view_viewer import view_live

        view_live(live, save=save, web=web, connect=connect, json=json)
    elif len(files) == 1:
        _view_file(files[0], single or SingleOptions(), save=save, web=web, json=json)
    else:
        from .view_overlay import view_overlay

        view_overlay(files, beside or OverlayOptions(), save=save, web=web, json=json)


def _check_usage(
    files: Sequence[Path],
    live: Path | None,
    *,
    save: Path | None,
    web: bool,
    connect: str | None,
    clip: Path | None,
    json: bool,
) -> None:
    if bool(files) == (live is not None):
        raise UsageError("give a session to see, or --live with the recorder's socket")
    if clip is not None and (live is not None or save is not None or web or len(files) > 1):
        raise UsageError("--clip films one session's file, without --live, --save and --web")
    if connect is not None and live is None:
        raise UsageError("--connect sends what is recorded now; give --live as well")
    if connect is not None and (web or save is not None):
        raise UsageError("--connect sends to a viewer; give it without --web and --save")
    if save is not None and web:
        raise UsageError("--save writes a file and --web serves one; give one of them")
    if json and save is None and clip is None:
        raise UsageError(
            "--json reports what was written; give --save X.rrd or --clip X.mp4 as well"
        )


def _view_file(
    file: Path, single: SingleOptions, *, save: Path | None, web: bool, json: bool
) -> None:
    if save is not None:
        _report(*_convert(file, save, single), json=json)
    else:
        from .view_viewer import view_session

        view_session(file, single, web=web)


def _convert(file: Path, output: Path, single: SingleOptions) -> tuple[Recording, float]:
    from undulog.analysis.signals.stretch import Options
    from undulog.capture import Session

    from ..feed.numbers import saved

    command, response = single.topics
    options = Options(command_topic=command, response_topic=response)
    folder = output.parent  # on a disk, so that an hour's columns need not be in memory
    with ExitStack() as stack:
        session = stack.enter_context(Session.open(file, column_folder=folder))
        bar = stack.enter_context(progress("view", total=2))
        bar.update(0, note="results" if single.result else "analysis")
        layer = saved(session, single.result or (), options)
        session.forget()
        bar.update(1, note="recording")
        # Here, not above: Rerun takes memory that the analysis can use before.
        from ..feed.recording import write_recording
        from ..layout import build_blueprint

        recording = write_recording(
            single.view(session),
            output,
            analysis=layer.analysis,
            steady=layer.steady,
            named=layer.named,
            notes=layer.notes,
            layout=partial(build_blueprint, front=single.tab or "session"),
        )
        return recording, session.duration_s


def _report(recording: Recording, duration_s: float, *, json: bool) -> None:
    size = recording.path.stat().st_size
    if json:
        facts = {
            "path": str(recording.path),
            "bytes": size,
            "recording_id": recording.recording_id,
            "duration_s": duration_s,
            "body": recording.content.start is not None,
            "joints": [name for series in recording.content.measured for name in series.names],
            "warnings": list(recording.warnings),
        }
        emit_json(facts)
        return
    path = recording.path
    echo(f"{path}: {duration_s:.1f} s, {size / 1e6:.1f} MB; open it with: rerun {path}")
    echo(*(f"note: {warning}" for warning in recording.warnings))
