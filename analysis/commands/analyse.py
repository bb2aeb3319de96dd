"""Command ``analyse``: sessions in, numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.common.console import emit_json, progress
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_output

from .options import chosen, opened, show

if TYPE_CHECKING:
    from ..results.analysis import Analysis
    from ..results.experiment import Experiment
    from ..signals.stretch import Options


def analyse(
    *files: Path,
    json: bool = False,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    start: float | None = None,
    stop: float | None = None,
    command_topic: str = "/joint_commands",
    response_topic: str = "/joint_states",
    reference_topic: str | None = None,
    null: Path | None = None,
    force: bool = False,
) -> None:
    """Compute gain and lag, energy and spread over the segments, each with its interval.

    Works on sessions of undulog and on any ROS 2 bag (MCAP) that has JointStates of commands and
    of responses. The first line printed is the answer; the method comes last. Several sessions are
    one experiment: runs of a gait and of its reverse separate boundary from module.
    The glossary of the manual, also at the end of each report, defines the words of results.

    Example: `undulog analyse run.mcap --json -o run.json`

    Args:
        files: Sessions (MCAP); several are runs of one experiment.
        json: Print the result as one JSON object.
        output: Write the JSON to this file too, a name that ends in .json.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        command_topic: JointState topic of the commands.
        response_topic: JointState topic of the responses.
        reference_topic: JointState topic of a second sensor of the same positions, to be compared.
        null: Model of identical modules (see `undulog sim null`) to hold the one session to.
        force: Replace the output file if it exists.
    """
    if not files:
        raise UsageError("analyse needs at least one session, e.g. undulog analyse run.mcap")
    options = chosen(start, stop, command_topic, response_topic, reference_topic)
    if null is not None and len(files) > 1:
        raise UsageError("--null takes one session; with both directions recorded leave it out")
    if output is not None:
        why = "the result file is JSON; end its name in .json (a page is made by undulog report)"
        check_output(output, (".json",), why, force=force)
    alone = len(files) == 1
    result = _one(files[0], options, null) if alone else experiment_of(files, options, "analyse")
    if output is not None:
        result.save(output, force=True)  # refused before the work began, if it was there
    if json:
        emit_json(result.to_dict())
        return
    from ..present.text import render
    from ..results.analysis import Analysis

    def text(width: int, color: bool) -> str:
        if isinstance(result, Analysis):
            return render(result, width=width, color=color)
        from ..present.text_experiment import render_experiment

        return render_experiment(result, width=width, color=color)

    show(text, output)


def _one(file: Path, options: Options, null: Path | None) -> Analysis:
    from undulog.capture import Session

    from ..session.analyse import analyse_session

    with progress("analyse", total=1) as bar:
        bar.update(0, note=file.name)
        with Session.open(file) as session:
            if null is None:
                return analyse_session(session, options)
            from ..experiment.null_model import analyse_with_null

            return analyse_with_null(session, null, options)


def experiment_of(files: Sequence[Path], options: Options, verb: str) -> Experiment:
    """Analyse sessions as one experiment, one open at a time, with a progress bar."""
    from ..experiment.analyse import analyse_experiment

    with progress(verb, total=len(files)) as bar:
        return analyse_experiment(opened(files, bar), options)
