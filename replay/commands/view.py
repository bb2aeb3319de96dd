"""Command ``view``: one session as a file or in a viewer, or while it is recorded."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog import capture
from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import complain, echo, emit_json, progress
from undulog.capture.common.errors import UsageError

from .view_options import ClipOptions, OverlayOptions, SingleOptions, given

if TYPE_CHECKING:
    from ..live.relay import RelayReport
    from ..recording import Recording
    from ..viewer import Viewer

_NICENESS, _LIVE_NICENESS = 5, 10
_WINDOW, _SERVER = "--memory-limit=1GB", "--server-memory-limit=256MB"  # of a live view


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
    topics: JointTopicOptions = CONTRACT,
    robot: str | None = None,
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
        files: The session, `.mcap`, or its URL; or several.
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
        topics: Where commands and responses are.
        robot: Description of the robot of a log without one, a name or a TOML file.
        force: Replace the recording or the clip if it is there.
        json: Print one JSON object: what was written and what is missing. Needs `--save` or
            `--clip`.
    """
    _check_usage(files, live, save=save, web=web, connect=connect, clip=clip, json=json)
    if beside is not None and len(files) < 2:
        raise UsageError(f"{given(beside)}: needs two sessions or more, side by side")
    if single is not None and (len(files) != 1 or clip is not None):
        raise UsageError(f"{given(single)}: needs one session, and no --clip")
    if shot is not None and clip is None:
        raise UsageError(f"{given(shot)}: an option of clips; give --clip as well")
    if live is not None and robot is not None:
        raise UsageError("--robot is for recorded logs; a recorder sends its robot's description")
    if clip is not None:
        from .view_recorded import view_clip

        filmed = shot or ClipOptions()
        view_clip(files[0], clip, filmed, topics=topics, robot=robot, force=force, json=json)
        return
    if save is not None:
        from undulog.capture.common.files import check_output

        check_output(save, [".rrd"], "a Rerun recording; end its name in .rrd", force=force)
    if live is not None:
        _view_live(live, save=save, web=web, connect=connect, json=json)
    elif len(files) == 1 and save is not None:
        _report(*_convert(files[0], save, single or SingleOptions(), topics, robot), json=json)
    elif len(files) == 1:
        _view_session(files[0], single or SingleOptions(), topics, robot, web=web)
    else:
        from .view_recorded import view_overlay

        laid = beside or OverlayOptions()
        view_overlay(files, laid, topics=topics, robot=robot, save=save, web=web, json=json)


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


def _convert(
    file: Path,
    output: Path,
    single: SingleOptions,
    topics: JointTopicOptions,
    robot: str | None,
) -> tuple[Recording, float]:
    folder = output.parent  # on a disk, so that an hour's columns need not be in memory
    with ExitStack() as stack:
        session = stack.enter_context(capture.Session.open(file, column_folder=folder, robot=robot))
        # Here, not above: a file that can't be opened is reported at once.
        from undulog.analysis.signals.stretch import Options

        from ..numbers import saved

        command, response = topics.names
        options = Options(command_topic=command, response_topic=response)
        bar = stack.enter_context(progress("view", total=2))
        bar.update(0, note="results" if single.result else "analysis")
        layer = saved(session, single.result or (), options)
        session.forget()
        bar.update(1, note="recording")
        # Here, not above: Rerun takes memory that the analysis can use before.
        from ..layout import build_blueprint
        from ..recording import write_recording

        recording = write_recording(
            topics.view(session),
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


def _view_live(
    path: Path, *, save: Path | None, web: bool, connect: str | None, json: bool
) -> None:
    """Show what a recorder on this machine records, until it is closed or interrupted."""
    from .. import viewer
    from ..live.relay import relay_to_file, relay_to_viewer

    if not (web or connect or save):
        viewer.require_display()
    _be_nice(_LIVE_NICENESS)  # it never competes with the recorder
    if save is not None:
        report = relay_to_file(path, save)
    elif connect is not None:
        report = relay_to_viewer(path, None, connect)
    else:
        with _open_viewer(_SERVER if web else _WINDOW, web=web) as process:
            process.wait_until_it_listens()
            report = relay_to_viewer(path, process, process.address)
    _report_live(report, save, json=json)
    if connect is not None and report.complaint:
        complain(f"error: {report.complaint}")
        os._exit(1)  # at once: Rerun would wait at its end for a viewer that takes nothing


def _report_live(report: RelayReport, save: Path | None, *, json: bool) -> None:
    lag = report.lag_s
    if json:
        facts = {
            "path": None if save is None else str(save),
            "sessions": list(report.sessions),
            "shown": report.shown,
            "dropped": report.dropped,
            "unread": report.unread,
            "lag_s": None if lag is None else dict(zip(("p50", "p99", "max"), lag, strict=True)),
        }
        emit_json(facts)
        return
    where = f"{save}: " if save is not None else ""
    late = "" if lag is None else f", {lag[0] * 1e3:.0f} ms late (median)"
    echo(f"{where}{report.shown} messages shown, {report.dropped} dropped{late}")
    if report.unread:
        echo(f"note: {report.unread} messages could not be read")


def _view_session(
    file: Path, single: SingleOptions, topics: JointTopicOptions, robot: str | None, *, web: bool
) -> None:
    """Show a session until the viewer is closed or a stop is requested."""
    from undulog.capture.common.process import interruptible

    from .. import viewer
    from ..samples.content import Layer

    if not web:
        viewer.require_display()
    with ExitStack() as stack:
        stop = stack.enter_context(interruptible())
        session = topics.view(stack.enter_context(capture.Session.open(file, robot=robot)))
        layer = Layer(None)
        if single.result:
            from ..numbers import read_results

            layer = read_results(session, single.result)
        options = [viewer.WHOLE_IN_MEMORY] if web else []
        process = stack.enter_context(_open_viewer(*options, web=web))
        # Rerun would report a closed window as errors of its own, in colours.
        os.environ.setdefault("RUST_LOG", "off")
        from ..numbers import Analysing
        from ..progressive import NoLongerWantedError, Task, show_session, steps

        analysing = stack.enter_context(Analysing(file, topics.names, robot))
        try:
            with progress("view", total=steps(session)) as bar:
                bar.update(0, note="the beginning")
                # What is looked at goes before what is converted.
                begun = partial(_be_nice, _NICENESS)
                task = Task(session, layer, analysing, single.tab or "session", bar, begun)
                notes = show_session(task, process, stop)
        except NoLongerWantedError:
            return
        echo(f"{session.path}: {session.duration_s:.1f} s, all of it in the viewer")
        echo(*(f"note: {note}" for note in notes))
        process.wait(stop)


def _open_viewer(*options: str, web: bool) -> Viewer:
    """Start a window, or a server whose page is printed once it is there."""
    from .. import viewer

    if not web:
        return viewer.open_window(*options)
    server, page = viewer.open_server(*options)
    server.wait_until_it_listens()
    echo(page)
    return server


def _be_nice(niceness: int) -> None:
    os.nice(max(niceness - os.nice(0), 0))
