"""The verb ``analyse``: sessions in, numbers out."""

from __future__ import annotations

import json as json_text
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from capture.console import emit_json, progress, refuse_existing
from capture.errors import UsageError
from capture.part_file import part_file

if TYPE_CHECKING:
    from .result import Analysis


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
    of responses. The first line printed is the answer; the method comes last.

    Example: `undulog analyse run.mcap --json -o run.json`

    Args:
        files: Sessions (MCAP); several give a list of results.
        json: Print the result as JSON: one object, or a list for several files.
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
    from capture import Session

    from .analyse import analyse_session
    from .stretch import Options

    options = Options(start, stop, command_topic, response_topic)
    results: list[Analysis] = []
    with progress("analyse", total=len(files)) as bar:
        for k, file in enumerate(files):
            bar.update(k, note=file.name)
            with Session.open(file) as session:
                results.append(analyse_session(session, options))
    plain = [result.to_dict() for result in results]
    whole: Any = plain[0] if len(plain) == 1 else plain
    if output is not None:
        text = json_text.dumps(whole, indent=2, allow_nan=False) + "\n"
        with part_file(output) as part:
            part.write_text(text, encoding="utf-8")
    if json:
        emit_json(whole)
        return
    from .table import UNLIMITED, render

    # Into a file or a pipe nothing is wrapped: one sentence, one line.
    terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if terminal else UNLIMITED
    texts = [render(one, width=width, color=terminal) for one in results]
    print("\n".join(texts), end="")
    if output is not None:
        print(f"Result: {output}")
