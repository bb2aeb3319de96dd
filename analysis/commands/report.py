"""Command ``report``: sessions in, one HTML page out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.common.console import echo, emit_json, progress
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_output, write_text

from .analyse import PAGES, chosen, experiment_of

if TYPE_CHECKING:
    from ..results.analysis import Analysis
    from ..signals.stretch import Options


def report(
    *files: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    catalog: str | None = None,
    find: Annotated[str, Parameter(name="--where")] = "",
    start: float | None = None,
    stop: float | None = None,
    command_topic: str = "/joint_commands",
    response_topic: str = "/joint_states",
    force: bool = False,
    json: bool = False,
) -> None:
    """Write the offline report: one HTML page that needs no network and no script.

    Several sessions are one experiment, as for `undulog analyse`: runs of a gait and of its reverse
    separate boundary from module, kicks of single joints identify the coupling. With `--catalog`
    the page is on all sessions of a folder over time: joints that change, trends, outliers.

    Example: `undulog report run.mcap -o run.html`

    Args:
        files: Sessions (MCAP); several are runs of one experiment.
        output: The page, a name that ends in .html.
        catalog: Folder or URL of sessions to compare over time, instead of files; those without
            results are analysed first.
        find: Condition on the sessions of the catalogue, as for `undulog catalog`.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        command_topic: JointState topic of the commands.
        response_topic: JointState topic of the responses.
        force: Replace the page if it exists.
        json: Print one JSON object: the page, the answer, and the answer to each session.
    """
    if not files and catalog is None:
        raise UsageError(
            "report needs at least one session, e.g. undulog report run.mcap -o x.html"
        )
    if files and catalog is not None:
        raise UsageError("--catalog takes the place of files; name its sessions by --where")
    if find and catalog is None:
        raise UsageError("--where is a condition on the sessions of --catalog")
    options = chosen(start, stop, command_topic, response_topic)
    if catalog is not None and options != chosen(None, None, "/joint_commands", "/joint_states"):
        raise UsageError("--catalog shows results as they are; leave out window and topics")
    check_output(output, PAGES, "the report is an HTML page; end its name in .html", force=force)
    if catalog is not None:
        page, facts, warnings = _fleet(catalog, find, output)
    else:
        alone = len(files) == 1
        page, facts, warnings = _one(files[0], options) if alone else _several(files, options)
    write_text(output, page)
    size = output.stat().st_size
    if json:
        emit_json({"page": str(output), "bytes": size, **facts})
        return
    echo(facts["answer"])
    noted = f", {warnings} warning{'s' if warnings > 1 else ''} in it" if warnings else ""
    echo(f"{output}: {size / 1e3:.0f} kB{noted}")


def _one(file: Path, options: Options) -> tuple[str, dict[str, Any], int]:
    """Return the page on one session, its answer, and the number of warnings."""
    from undulog.capture import Session

    from ..present.page.page import render
    from ..session.analyse import measure_session
    from ..session.cycles import cycle_maps

    with progress("report", total=2) as bar:
        bar.update(0, note=file.name)
        with Session.open(file) as session:
            measured = measure_session(session, options)
            analysis = measured.analysis
            bar.update(1, note="page")
            page = render(analysis, session, cycle_maps(measured))
    summary = _summary(analysis)
    return page, {"answer": summary["sentence"], "answers": [summary]}, len(analysis.warnings)


def _fleet(where: str, find: str, output: Path) -> tuple[str, dict[str, Any], int]:
    """Return the page on the sessions of a catalogue, its result, and the number of warnings."""
    from ..catalog.catalog import Catalog
    from ..fleet.fleet import analyse_fleet
    from ..present.page.page import render_fleet

    found = Catalog(where)
    with progress("report", total=2) as bar:
        found.scan()
        missing = found.find(find).query("status == 'not analysed' and damage.isna()")["path"]
        faults = found.analyse(
            missing.to_list(), on_done=lambda k, n: bar.update(k / n, f"{k} of {n} analysed")
        )
        bar.update(1, note="page")
        sessions, joints = found.find(find), found.find(joints=True)
        fleet = analyse_fleet(sessions, joints)
        warnings = [*fleet.warnings, *(f"{name}: {why}" for name, why in faults.items())]
        fleet = replace(fleet, warnings=tuple(warnings))
        page = render_fleet(fleet, joints, where, output)
    return page, fleet.to_dict(), len(warnings)


def _several(files: Sequence[Path], options: Options) -> tuple[str, dict[str, Any], int]:
    """Return the page on an experiment, all answers, and the number of warnings."""
    from ..present.page.page import render

    experiment = experiment_of(files, options, "report")
    page = render(experiment)
    facts = {
        "answer": f"{len(files)} sessions: {experiment.answer}.",
        "answers": [_summary(one) for one in experiment.sessions],
    }
    return page, facts, len(experiment.warnings)


def _summary(analysis: Analysis) -> dict[str, Any]:
    session, answer = analysis.session, analysis.answer
    facts = {"session": session.id, "path": session.path}
    return facts | {"verdict": answer.verdict, "sentence": answer.sentence}
