"""Command ``record``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..common.console import complain, emit
from ..common.errors import UndulogError, some_names
from .record_control import counted_faults

if TYPE_CHECKING:
    from ..common.process import StopRequest
    from ..recorder.recording import RecordReport
    from ..recorder.settings import RecordSettings
    from ..recorder.status import RecorderSnapshot


_Words = Annotated[tuple[str, ...], Parameter(show_default=False)]


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

    resolved = resolve({name: options[name] for name in PARSERS}, os.environ, settings)
    with interruptible() as stop:
        report = _run(resolved, stop)
    emit(report.as_json(), () if resolved.quiet else _lines(report), as_json=json)
    if report.ending.failed:
        complain(f"error: {report.ending.reason}")
    return int(report.ending.failed)


def _run(settings: RecordSettings, stop: StopRequest) -> RecordReport:
    from ..recorder.recording import Recording
    from ..recorder.screen import Terminal
    from ..recorder.systemd import Notifier

    terminal = Terminal(sys.stderr, quiet=settings.quiet)
    with ExitStack() as relay:
        recording = Recording(settings, stop, notifier=Notifier(os.environ))
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
