"""Command ``analyse``: sessions in, numbers out; what the other commands of analysis share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.commands.sessions import SessionLine, are_as_given, each_session, sessions_of
from undulog.capture.commands.sessions import show as show_table
from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import Progress, echo, emit_json, output_width, progress
from undulog.capture.common.errors import UndulogError, UsageError
from undulog.capture.common.files import write_text

from .data_set import check_result_file, is_data_set, show_data_set

if TYPE_CHECKING:
    from undulog.capture import SessionView

    from ..results.analysis import Analysis
    from ..results.experiment import Experiment
    from ..signals.stretch import Options

PAGES = (".html", ".htm")
"""How the name of a page ends."""


def analyse(
    *files: Path,
    json: bool = False,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    csv: Path | None = None,
    start: float | None = None,
    stop: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    reference_topic: str | None = None,
    excitation_topic: str | None = None,
    period: float | None = None,
    robot: str | None = None,
    null: Path | None = None,
    separately: Annotated[bool, Parameter(name="--each")] = False,
    force: bool = False,
) -> int:
    """Compute gain and lag, energy and spread over the segments, each with its interval.

    Works on sessions of undulog and on any ROS bag that has joints, whose topics are found by type
    where they have other names. The first line printed is the answer; the method comes last.
    Several sessions are one experiment: runs of a gait and of its reverse separate boundary from
    module. A folder, a pattern, or `--each` give a table instead, a line for each session; one that
    fails stops none. The folder of a LeRobot data set gives a table of its episodes, worst first,
    and a list of those to leave out.
    The glossary of the manual, also at the end of each report, defines the words of results.

    Example: `undulog analyse run.mcap --json -o run.json`

    For a spreadsheet: `undulog analyse runs/ --csv joints.csv`

    A data set for learning: `undulog analyse DATASET --csv episodes.csv`

    Args:
        files: Sessions (MCAP), or their URLs; several are runs of one experiment. Folders of
            sessions or patterns, such as 'runs/**/*.mcap', give a table.
        json: Print the result as one JSON object; a table as a list of them.
        output: Write the JSON to this file too, a name that ends in .json.
        csv: Write a row for each joint and session to this file, estimates with both ends of their
            intervals; of one result a folder gets a file for each of its tables.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        topics: Where commands and responses are.
        reference_topic: JointState topic of a second sensor of the same positions, to be compared.
        excitation_topic: JointState topic of what the commands follow from outside, where they
            depend on measured motion, too; frequency responses are by the indirect method then.
        period: Period of a motion without commands whose rhythm wanders [s]; mean cycles, lags and
            waves are measured at it.
        robot: Description of the robot of a log without one, a name or a TOML file.
        null: Model of identical modules (see `undulog sim null`) to hold the one session to.
        separately: Analyse several sessions one by one instead of as one experiment.
        force: Replace the output file if it exists.
    """
    if not files:
        raise UsageError("analyse needs at least one session, e.g. undulog analyse run.mcap")
    options = chosen(start, stop, topics, reference_topic, excitation_topic, period=period)
    if any(is_data_set(file) for file in files):
        _check_data_set(files, options, [null, robot, separately or None])
        return show_data_set(files[0], output, csv, force=force, as_json=json)
    paths = sessions_of(files)
    if null is not None and len(paths) > 1:
        raise UsageError("--null takes one session; with both directions recorded leave it out")
    check_result_file(output, force=force)
    one_by_one = len(paths) > 1 and (separately or not are_as_given(paths, files))
    if csv is not None:
        from ..present.data_frames import check_csv

        check_csv(csv, force=force, several=one_by_one)
    if one_by_one:
        return _table(paths, options, robot, output, csv, as_json=json)
    if len(paths) == 1:
        result = _one(paths[0], options, null, robot)
    else:
        result = _experiment(paths, options, robot, as_json=json)
    if output is not None:
        result.save(output, force=True)  # refused before the work began, if it was there
    if csv is not None:
        from ..present.data_frames import write_csv

        write_csv([result], csv, force=force)
    if json:
        emit_json(result.to_dict())
        return 0
    from ..present.text import render
    from ..results.analysis import Analysis

    def text(width: int, color: bool) -> str:
        if isinstance(result, Analysis):
            return render(result, width=width, color=color)
        from ..present.text_experiment import render_experiment

        return render_experiment(result, width=width, color=color)

    show(text, output)
    return 0


def _check_data_set(files: Sequence[Path], options: Options, others: Sequence[object]) -> None:
    """Refuse what isn't for a data set.

    Raises:
        UsageError: If there are several paths, or options of sessions.
    """
    from ..signals.stretch import Options

    if len(files) > 1:
        raise UsageError("a LeRobot data set is analysed alone: give one folder")
    if options != Options() or any(other is not None for other in others):
        raise UsageError(
            f"{files[0]} is a LeRobot data set: of the options --json, --output, --csv and --force "
            "are for it; undulog import makes a session of each episode"
        )


def _one(file: Path, options: Options, null: Path | None, robot: str | None) -> Analysis:
    from undulog.capture import Session

    from ..session.analyse import analyse_session

    with progress("analyse", total=1) as bar:
        bar.update(0, note=file.name)
        with Session.open(file, robot=robot) as session:
            if null is None:
                return analyse_session(session, options)
            from ..experiment.null_model import analyse_with_null

            return analyse_with_null(session, null, options)


def _experiment(
    files: Sequence[Path], options: Options, robot: str | None, *, as_json: bool
) -> Experiment:
    """Analyse sessions as one experiment; if one of them fails, print a table of all of them."""
    try:
        return experiment_of(files, options, "analyse", robot=robot)
    except UndulogError:
        lines = each_session(files, "analyse", partial(_line, options=options, robot=robot))
        if not all(line.good for line in lines.values()):
            show_table(lines, as_json=as_json)
        raise


def _table(
    paths: Sequence[Path],
    options: Options,
    robot: str | None,
    output: Path | None,
    csv: Path | None,
    *,
    as_json: bool,
) -> int:
    """Analyse sessions one by one and print a table, or a list of results."""
    analysis: list[Analysis] = []
    work = partial(_line, options=options, robot=robot, analyses=None if csv is None else analysis)
    lines = each_session(paths, "analyse", work)
    if csv is not None:
        from ..present.data_frames import write_csv

        write_csv(analysis, csv, force=True)  # refused before the work began, if it was there
    if output is not None:
        facts = [line.facts for line in lines.values()]
        write_text(output, dumps(facts, indent=2, allow_nan=False) + "\n")
    return show_table(lines, as_json=as_json)


def _line(
    file: Path, *, options: Options, robot: str | None, analyses: list[Analysis] | None = None
) -> SessionLine:
    from undulog.capture import Session

    from ..session.analyse import analyse_session

    with Session.open(file, robot=robot) as session:
        analysis = analyse_session(session, options)
    if analyses is not None:
        analyses.append(analysis)
    return line_of(analysis)


def line_of(analysis: Analysis) -> SessionLine:
    """Return the line of a session in a table."""
    from ..parts.gait.show import gait_frequency

    answer, periodic = analysis.answer, analysis.gait.frequency_hz.value is not None
    return SessionLine(
        robot=analysis.session.robot or "",
        gait=gait_frequency(analysis.gait) if periodic else "",
        verdict=answer.verdict,
        sentence=answer.sentence,
        facts=analysis.to_dict(),
    )


def experiment_of(
    files: Sequence[Path], options: Options, verb: str, *, robot: str | None = None
) -> Experiment:
    """Analyse sessions as one experiment, one open at a time, with a progress bar."""
    from ..experiment.analyse import analyse_experiment

    with progress(verb, total=len(files)) as bar:
        return analyse_experiment(opened(files, bar, robot=robot), options)


def chosen(
    start: float | None,
    stop: float | None,
    topics: JointTopicOptions = CONTRACT,
    reference_topic: str | None = None,
    excitation_topic: str | None = None,
    *,
    period: float | None = None,
) -> Options:
    """Check and collect the options of the analysis of each session.

    Args:
        start: From the session's start [s].
        stop: From the session's start [s].
        reference_topic: Of a second sensor.
        excitation_topic: Of what the commands follow from outside.
        period: Of a motion without commands [s].

    Raises:
        UsageError: If the window is empty, or the period isn't positive.
    """
    if start is not None and not start >= 0:
        raise UsageError(f"--start {start:g} is before the session's start, which is 0")
    if stop is not None and not stop > (start or 0.0):
        raise UsageError(f"--stop {stop:g} is not after --start {start or 0.0:g}")
    if period is not None and not 0 < period < float("inf"):
        raise UsageError(f"--period {period:g} is no period in seconds, e.g. --period 0.5")
    from ..signals.stretch import Options

    return Options(start, stop, *topics.names, reference_topic, excitation_topic, period)


def opened(
    files: Iterable[Path], bar: Progress, done: int = 0, *, robot: str | None = None
) -> Iterator[SessionView]:
    """Open sessions, each until the next one is taken, and show the progress.

    Args:
        done: Sessions of the progress bar that are done before.
        robot: Description for logs without one.
    """
    from undulog.capture import Session

    for k, file in enumerate(files, start=done):
        bar.update(k, note=file.name)
        with Session.open(file, robot=robot) as session:
            yield session


def show(render: Callable[[int, bool], str], output: Path | None) -> None:
    """Print a result as text; into a file or a pipe nothing is wrapped: one sentence, one line.

    Args:
        render: Returns the text for a width in columns, with or without bold and dim type.
        output: The file that was written.
    """
    sys.stdout.write(
        render(output_width(), sys.stdout.isatty())
    )  # its names are escaped; the rest are styles
    if output is not None:
        echo(f"Result: {output}")
