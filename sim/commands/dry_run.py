"""What the verbs say of a dry run: without ``--arm`` nothing is sent, and no bus is opened."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

from undulog.capture.common.console import emit_json, progress, say
from undulog.capture.common.interruption import interruptible
from undulog.capture.robot.model import Robot

from ..drive.driven import Driven
from ..drive.dry_run import dry_run
from ..drive.dry_run_text import reported, told
from ..scenario.scenario import Scenario

_UNLIMITED = 10_000


def run_dry(
    driven: Driven,
    on: str,
    *,
    robot: Robot | None = None,
    world: Scenario | None = None,
    duration_s: float | None = None,
    output: Path | None = None,
    force: bool = False,
    as_json: bool = False,
) -> int:
    """Run it in the twin, and say what it would take.

    Args:
        driven: What to drive.
        on: The bus that it would be driven on, as the command line names it.
        robot: On which robot; the one that it was made for if None.
        world: Where; by default the world that it was made for, and flat ground if that is not
            known.
        duration_s: How long [s]; its own length if None.
        output: The session of the twin to write, or None.
        force: Replace an existing session.
        as_json: Report as one JSON object.

    Returns:
        The exit code: 0 if it would run to its end, 1 if not.

    Raises:
        UsageError: If something of it can't be.
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the session is there and ``force`` is not given.
        LogWriteError: If the session can't be written.
    """
    start = time.monotonic()
    length_s = driven.duration_s if duration_s is None else duration_s
    with interruptible() as stop, progress(f"dry run of {driven.name}", length_s) as bar:

        def show(time_s: float) -> None:
            elapsed_s = max(time.monotonic() - start, 1e-3)
            bar.update(time_s, f"{time_s / elapsed_s:.1f} x real time")

        run = dry_run(
            driven,
            robot=robot,
            world=world,
            duration_s=duration_s,
            output=output,
            force=force,
            stop=stop,
            on_time=show,
        )
    if as_json:
        emit_json({"on": on, **reported(run)})
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else _UNLIMITED
        say(*told(run, width))
        if run.verdict.fit:
            say("", f"To send it to {on}, the same with --arm and -o SESSION.mcap")
    return 0 if run.verdict.fit else 1
