"""The verb ``analyse``: sessions in, numbers out."""

from __future__ import annotations

import json as json_text
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from capture.console import emit_json, progress, refuse_existing
from capture.errors import UsageError
from capture.part_file import part_file

if TYPE_CHECKING:
    from .result import Analysis
    from .result_experiment import Experiment
    from .stretch import Options


def analyse(
    *files: Path,
    json: bool = False,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    start: float | None = None,
    stop: float | None = None,
    command_topic: str = "/joint_commands",
    response_topic: str = "/joint_states",
    force: bool = False,
) -> None:
    """Compute gain and lag, energy and spread over the segments, each with its interval.

    Works on sessions of undulog and on any ROS 2 bag (MCAP) that has JointStates of commands and
    of responses. The first line printed is the answer; the method comes last. Several sessions are
    one experiment: runs of a gait and of its reverse tell boundary from module.

    Example: `undulog analyse run.mcap --json -o run.json`

    Args:
        files: Sessions (MCAP); several are runs of one experiment.
        json: Print the result as one JSON object.
        output: Write the JSON to this file too, a name that ends in .json.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        command_topic: JointState topic of the commands.
        response_topic: JointState topic of the responses.
        force: Replace the output file if it exists.
    """
    if not files:
        raise UsageError("analyse needs at least one session, e.g. undulog analyse run.mcap")
    if start is not None and stop is not None and stop <= start:
        raise UsageError(f"--stop {stop:g} is not after --start {start:g}")
    if output is not None:
        if output.suffix.lower() != ".json":
            raise UsageError(f"{output}: the result file is JSON; end its name in .json")
        refuse_existing(output, force=force)
    from .stretch import Options

    options = Options(start, stop, command_topic, response_topic)
    result = _one(files[0], options) if len(files) == 1 else _several(files, options)
    whole = result.to_dict()
    if output is not None:
        text = json_text.dumps(whole, indent=2, allow_nan=False) + "\n"
        with part_file(output) as part:
            part.write_text(text, encoding="utf-8")
    if json:
        emit_json(whole)
        return
    from .experiment_table import render_experiment
    from .result_experiment import Experiment
    from .table import UNLIMITED, render

    # Into a file or a pipe nothing is wrapped: one sentence, one line.
    terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if terminal else UNLIMITED
    if isinstance(result, Experiment):
        print(render_experiment(result, width=width, color=terminal), end="")
    else:
        print(render(result, width=width, color=terminal), end="")
    if output is not None:
        print(f"Result: {output}")


def _one(file: Path, options: Options) -> Analysis:
    from capture import Session

    from .analyse import analyse_session

    with progress("analyse", total=1) as bar:
        bar.update(0, note=file.name)
        with Session.open(file) as session:
            return analyse_session(session, options)


def _several(files: Sequence[Path], options: Options) -> Experiment:
    from capture import Session

    from .experiment import analyse_experiment

    with progress("analyse", total=len(files)) as bar:

        def opened() -> Iterator[Session]:
            for k, file in enumerate(files):
                bar.update(k, note=file.name)
                with Session.open(file) as session:
                    yield session

        return analyse_experiment(opened(), options)
