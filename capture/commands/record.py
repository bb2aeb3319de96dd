"""Command ``record``, and ``record status``, ``mark``, ``note``, ``split``, ``stop``, ``unit``.

The latter reach running recorders through their control sockets.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from ..common.console import complain, echo, emit, emit_json, refuse_existing
from ..common.errors import ControlError, LogWriteError, UndulogError, UsageError, some_names
from ..common.files import write_text

if TYPE_CHECKING:
    from ..common.process import StopRequest
    from ..recorder.control_client import ControlClient
    from ..recorder.record_report import RecordReport
    from ..recorder.settings import RecordSettings
    from ..recorder.status import RecorderSnapshot
    from ..recorder.systemd import Notifier


_UNITS = Path("/etc/systemd/system")
_Words = Annotated[tuple[str, ...], Parameter(show_default=False)]

_COMPLETE_S = 3600.0
"""Longest wait for a recording to be complete [s]: the recorder itself has no limit on it, since
its data must reach the disk, and goes on where this gives up."""
_FAULTS = ("malformed", "error_frames", "reconnects")


_Text = Annotated[str, Parameter(show_default=False)]


def record(
    *sources: Annotated[str, Parameter(name="SOURCE")],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    robot: Annotated[str | None, Parameter(name=["--robot", "-r"])] = None,
    bus: str | None = None,
    duration: str | None = None,
    split_size: str | None = None,
    split_time: str | None = None,
    ring: str | None = None,
    floor: str | None = None,
    settings: Path | None = None,
    socket: Path | None = None,
    operator: str | None = None,
    notes: str | None = None,
    metadata: Annotated[_Words, Parameter(name="--metadata", negative=())] = (),
    live: bool | None = None,
    fast: bool | None = None,
    force: bool | None = None,
    quiet: bool | None = None,
    json: bool = False,
) -> int:
    """Record a robot, or its twin, into a session that loses nothing.

    A SOURCE is `can:INTERFACE:CHANNEL` (any interface of python-can; it only listens and never
    transmits), `serial:PORT?protocol=feetech` or `dynamixel2` (a line of servos, never written to),
    `unix:PATH` (frames from other processes) or `twin:SCENARIO`; `NAME=` before it
    names it in the session. What was accepted survives the death of the recorder: it is in a
    write-ahead log beside the file. Ctrl-C, SIGTERM and SIGHUP end the recording with a whole
    file. `undulog record status`, `mark`, `note`, `split` and `stop` control it meanwhile.

    Example: `undulog record can:socketcan:can0 --robot snake25 -o run.mcap`

    Two buses, a new file every 10 minutes: `undulog record front=can:socketcan:can0
    rear=can:socketcan:can1 --robot snake25 --bus front --split-time 10min -o run.mcap`

    Servos on a serial line: `undulog record 'serial:/dev/ttyUSB1?protocol=feetech' --robot so101
    -o run.mcap`

    The twin, in real time: `undulog record twin:flat -o twin.mcap --duration 20s`

    Every option can stand in a settings file, table `[record]`, or in the environment as
    `UNDULOG_RECORD_NAME`; the command line beats the environment, which beats the file.

    Args:
        sources: What to record.
        output: The session to write, `.mcap`; `{time}` in it becomes the time of the start.
        robot: A shipped robot (snake25, snake13, snake13-planar, snake12-sts3215, so101,
            arcsnake-joint) or a robot TOML:
            its bus map defines the frames. A twin brings its own.
        bus: Name of the source that is the robot's bus, where there are several.
        duration: End by itself after this time, e.g. `30s`, `1h30min`.
        split_size: Begin a new file after this size, e.g. `1GB`.
        split_time: Begin a new file after this time, e.g. `10min`.
        ring: Keep only this much, in memory, and write it when marked, e.g. `30s`.
        floor: End in good order when less disk than this is free; 500MB by default.
        settings: A settings file, TOML.
        socket: Where `status`, `mark`, `split` and `stop` come in; a usual place by default.
        operator: Who records; kept in the session.
        notes: Free text; kept in the session.
        metadata: A further fact for the session, `NAME=VALUE`. May be repeated.
        live: Show the recording in Rerun while it runs.
        fast: Let a twin run as fast as it can.
        force: Replace an existing output.
        quiet: Nothing on the terminal.
        json: Report as one JSON object at the end.
    """
    options = locals()  # the arguments, by name
    from ..common.process import interruptible
    from ..recorder.settings import PARSERS, resolve
    from ..recorder.systemd import Notifier

    resolved = resolve({name: options[name] for name in PARSERS}, os.environ, settings)
    notifier = Notifier(os.environ)
    with interruptible() as stop:
        report = _run(resolved, stop, notifier)
    emit(report.as_json(), () if resolved.quiet else _lines(report), as_json=json)
    if report.ending.failed:
        complain(f"error: {report.ending.reason}")
    # A service that ends as failed is started again, which its user did not request.
    return int(report.ending.failed and not (report.ending.requested and notifier.is_service))


def _run(settings: RecordSettings, stop: StopRequest, notifier: Notifier) -> RecordReport:
    from ..recorder.recording import RunningRecording
    from ..recorder.screen import Terminal

    terminal = Terminal(sys.stderr, quiet=settings.quiet)
    with ExitStack() as relay:
        recording = RunningRecording(settings, stop, notifier=notifier)
        watch = _live_view(recording.live_socket, relay) if settings.live else str

        def show(snapshot: RecorderSnapshot) -> None:
            if complaint := watch():
                recording.warn("live view", complaint)
            terminal.show(snapshot)

        try:
            return recording.run(show)
        finally:
            terminal.close()


def _live_view(socket: Path, relay: ExitStack) -> Callable[[], str]:
    """Start the live view; return a function that returns, once, why it ended by itself."""
    from ..recorder.live_feed import spawn_relay

    try:
        process = spawn_relay(socket)
    except UndulogError as error:  # the recording goes on without
        complaints = iter([str(error)])
        return lambda: next(complaints, "")
    relay.callback(process.close, leave_window=True)
    ended = False

    def look() -> str:
        nonlocal ended
        code = None if ended else process.poll()
        ended = ended or code is not None
        if not code:
            return ""
        return process.complaint().removeprefix("error: ") or f"has ended, exit code {code}"

    return look


def _lines(report: RecordReport) -> Iterator[str]:
    names = some_names([str(file) for file in report.files], 3)
    yield (
        f"{names or 'nothing written'}: {report.duration_s:.1f} s of {report.robot or 'raw data'}, "
        f"{report.messages} messages, {report.size / 1e6:.1f} MB, verdict {report.verdict}"
    )
    yield f"  ended: {report.ending.reason}"
    for name, counts in report.sources.items():
        dropped = counts["dropped"]
        lost = "losses unknown" if dropped is None else f"{dropped} lost before us"
        facts = [f"{counts['frames']} frames", lost, *counted_faults(counts)]
        yield f"  {name}: {', '.join(facts)}"
    yield from (f"  reason: {reason}" for reason in report.reasons)


def counted_faults(source: Mapping[str, Any]) -> list[str]:
    """Return the counts of faults of a source that are not zero: ``3 error frames``."""
    return [f"{source[key]} {key.replace('_', ' ')}" for key in _FAULTS if source.get(key)]


def status(*, socket: Path | None = None, json: bool = False) -> int:
    """Show the state of the running recordings.

    Example: `undulog record status`

    Args:
        socket: Control socket of one recorder; all that run by default.
        json: Report as one JSON object, `recordings`.
    """
    from ..recorder.control_client import ControlClient

    recordings: list[dict[str, Any]] = []
    silent: list[str] = []
    for path in [socket] if socket is not None else _running():
        try:
            with ControlClient(path) as recorder:
                recordings.append({"socket": str(path), **recorder.ask({"do": "status"})})
        except ControlError as error:
            silent.append(str(error))
    if json:
        emit_json({"recordings": recordings, "silent": silent})
    for recording in [] if json else recordings:
        echo(*_summary(recording))
    for error in silent:
        complain(f"error: {error}")
    return int(bool(silent))


def mark(*text: _Text, level: str = "info", socket: Path | None = None, json: bool = False) -> None:
    """Mark this moment of the running recording; a ring is written to a file.

    Example: `undulog record mark slipped on wet sand`

    Args:
        text: Remark on it; it goes to `/rosout`.
        level: `info`, `warn` or `error`.
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    _ask({"do": "mark", "text": " ".join(text), "level": level}, "marked", socket, as_json=json)


def note(*text: _Text, level: str = "info", socket: Path | None = None, json: bool = False) -> None:
    """Write a remark into the running recording, to `/rosout`.

    Example: `undulog record note battery changed`

    Args:
        text: The remark.
        level: `info`, `warn` or `error`.
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    if not text:
        raise UsageError("a note needs a text: undulog record note battery changed")
    _ask({"do": "note", "text": " ".join(text), "level": level}, "noted", socket, as_json=json)


def split(*, socket: Path | None = None, json: bool = False) -> None:
    """Begin a new part of the running recording.

    Example: `undulog record split`

    Args:
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    _ask({"do": "split"}, "split", socket, as_json=json)


def stop(*, wait: bool = False, socket: Path | None = None, json: bool = False) -> int:
    """End the running recording in good order.

    Example: `undulog record stop --wait`

    Args:
        wait: Wait until the file is complete, and print its name.
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    # Finalising takes as long as it takes; without --wait the answer comes at once.
    with _recorder(socket, patience_s=_COMPLETE_S if wait else None) as recorder:
        reply = recorder.ask({"do": "stop", "wait": True} if wait else {"do": "stop"})
    if json or not wait:
        _print_reply("stopping", reply, as_json=json)
    else:
        files = ", ".join(str(file) for file in reply.get("files", []))
        echo(f"{files or 'nothing written'}: {_facts(reply)}", *_reasons(reply))
    return int(bool(reply.get("failed", False)))


def unit(*, install: bool = False, folder: Path = _UNITS, force: bool = False) -> None:
    """Print or install a systemd unit for recordings that start with the computer.

    It is hardened, runs as a user of its own and reads its settings from `/etc/undulog/NAME.toml`.

    Example: `undulog record unit --install`

    Args:
        install: Write the unit to the folder instead of printing it; needs the rights to do so.
        folder: Folder of units, for `--install`.
        force: Replace the unit if it is there.
    """
    from ..recorder.systemd import UNIT_NAME, hidden_folder, installed_program, unit_text

    program = installed_program()
    text = unit_text(program)
    if install:
        path = folder / UNIT_NAME
        refuse_existing(path, force=force)
        if not os.access(folder, os.W_OK):
            raise LogWriteError(path, f"no right to write; sudo {program} record unit --install")
        write_text(path, text)
        path.chmod(0o644)
        echo(
            f"{path}: runs {program}",
            "next, for the settings /etc/undulog/NAME.toml:",
            "  systemctl daemon-reload && systemctl enable --now undulog-record@NAME",
        )
    else:
        echo(*text.splitlines())
    if (hidden := hidden_folder(program)) is not None:
        complain(
            f"warning: {program} lies below {hidden}, which this unit hides from the service; "
            "install undulog elsewhere, e.g. in /opt/undulog"
        )


def _running() -> list[Path]:
    from ..recorder.control_client import find_sockets

    paths = find_sockets(os.environ)
    if not paths:
        raise ControlError("no recorder runs here; --socket names one elsewhere")
    return paths


def _recorder(socket: Path | None, *, patience_s: float | None = None) -> ControlClient:
    """Connect to the recorder of a socket, or to the only one that runs."""
    from ..recorder.control_client import PATIENCE_S, ControlClient

    if socket is None:
        paths = _running()
        if len(paths) > 1:
            listed = "\n".join(f"  --socket {path}" for path in paths)
            raise UsageError(f"{len(paths)} recorders run; which one?\n{listed}")
        socket = paths[0]
    return ControlClient(socket, patience_s=patience_s or PATIENCE_S)


def _summary(recording: Mapping[str, Any]) -> list[str]:
    """Return the status of a recording, the most important line first."""
    return [
        f"{recording.get('output')}: {recording.get('state', 'recording')}, {_facts(recording)}",
        *_reasons(recording),
        *(f"  {_source(source)}" for source in recording.get("sources", [])),
        f"  socket: {recording['socket']}",
    ]


def _reasons(reply: Mapping[str, Any]) -> list[str]:
    return [f"  reason: {reason}" for reason in reply.get("reasons", [])]


def _source(source: Mapping[str, Any]) -> str:
    """Return the state of a source in one line."""
    ended = "has ended" if source.get("finished") else "not connected"
    parts = ["connected" if source.get("connected") and not source.get("finished") else ended]
    if (frames := source.get("frames")) is not None:
        parts.append(f"{frames} frames")
    if (rate_hz := source.get("rate_hz")) is not None:
        parts.append(f"{rate_hz:.0f} frames/s")
    if source.get("dropped"):
        parts.append(f"{source['dropped']} lost before us")
    parts += counted_faults(source)
    return f"{source.get('name')}: {', '.join(parts)}"


def _facts(reply: Mapping[str, Any]) -> str:
    """Return duration, messages, size and verdict, as far as they are known."""
    from ..common.amounts import format_size

    facts: tuple[tuple[Any, Callable[[Any], str]], ...] = (
        (reply.get("elapsed_s", reply.get("duration_s")), "{:.1f} s".format),
        (reply.get("messages"), "{} messages".format),
        (reply.get("bytes", reply.get("size_bytes")), format_size),
        (reply.get("free"), lambda size: f"{format_size(size)} free"),
        (reply.get("verdict"), "verdict {}".format),
        (reply.get("ended"), "ended: {}".format),
    )
    return ", ".join(text(value) for value, text in facts if value is not None)


def _ask(request: Mapping[str, Any], done: str, socket: Path | None, *, as_json: bool) -> None:
    with _recorder(socket) as recorder:
        reply = recorder.ask(request)
    _print_reply(done, reply, as_json=as_json)


def _print_reply(done: str, reply: Mapping[str, Any], *, as_json: bool) -> None:
    if as_json:
        emit_json(dict(reply))
    elif reply:
        echo(f"{done}: {', '.join(f'{name} {value}' for name, value in reply.items())}")
    else:
        echo(done)
