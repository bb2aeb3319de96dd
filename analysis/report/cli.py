"""The verb ``report``: sessions in, one HTML page out."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from capture.console import emit_json, progress, refuse_existing
from capture.errors import UsageError
from capture.part_file import part_file

if TYPE_CHECKING:
    from ..result import Analysis


def report(
    *files: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    start: float | None = None,
    stop: float | None = None,
    command_topic: str = "/joint_commands",
    response_topic: str = "/joint_states",
    force: bool = False,
    json: bool = False,
) -> None:
    """Write the offline report: one HTML page that needs no network and no script.

    Example: `undulog report run.mcap -o run.html`

    Args:
        files: Sessions (MCAP); several share one page.
        output: The page, a name that ends in .html.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        command_topic: JointState topic of the commands.
        response_topic: JointState topic of the responses.
        force: Replace the page if it exists.
        json: Print one JSON object: the page and the answer to each session.
    """
    if not files:
        raise UsageError(
            "report needs at least one session, e.g. undulog report run.mcap -o x.html"
        )
    if output.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{output}: the report is an HTML page; end its name in .html")
    if start is not None and stop is not None and stop <= start:
        raise UsageError(f"--stop {stop:g} is not after --start {start:g}")
    refuse_existing(output, force=force)
    from capture import Session

    from ..analyse import analyse_session
    from ..answer import answer
    from ..stretch import Options
    from . import render

    options = Options(start, stop, command_topic, response_topic)
    analyses: list[Analysis] = []
    sessions: list[Session] = []

    with ExitStack() as stack, progress("report", total=len(files) + 1) as bar:
        for k, file in enumerate(files):
            bar.update(k, note=file.name)
            session = stack.enter_context(Session.open(file))
            analyses.append(analyse_session(session, options))
            sessions.append(session)
        bar.update(len(files), note="page")
        page = render(analyses, sessions)
    with part_file(output) as part:
        part.write_text(page, encoding="utf-8")
    answers = [answer(analysis) for analysis in analyses]
    if json:
        emit_json(
            {
                "page": str(output),
                "bytes": output.stat().st_size,
                "answers": [
                    {
                        "session": a.session.id,
                        "path": a.session.path,
                        "verdict": told.verdict,
                        "sentence": told.sentence,
                    }
                    for a, told in zip(analyses, answers, strict=True)
                ],
            }
        )
        return
    for file, told in zip(files, answers, strict=True):
        print(told.sentence if len(answers) == 1 else f"{file.name}: {told.sentence}")
    warnings = sum(len(analysis.warnings) for analysis in analyses)
    said = f", {warnings} warning{'s' if warnings > 1 else ''} in it" if warnings else ""
    print(f"{output}: {output.stat().st_size / 1e3:.0f} kB{said}")
