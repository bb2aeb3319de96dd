"""The verb ``report``: sessions in, one HTML page out."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from capture.console import emit_json, progress, refuse_existing
from capture.errors import UsageError


def report(
    *files: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    force: bool = False,
    json: bool = False,
) -> None:
    """Write the offline report: one HTML page that needs no network and no script.

    Example: `undulog report run.mcap -o run.html`

    Args:
        files: Sessions (MCAP); several share one page.
        output: The page, a name that ends in .html.
        force: Replace the page if it exists.
        json: Print one JSON object: the page and the answer to each session.
    """
    if not files:
        raise UsageError(
            "report needs at least one session, e.g. undulog report run.mcap -o x.html"
        )
    if output.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{output}: the report is an HTML page; end its name in .html")
    refuse_existing(output, force=force)
    from capture import Session

    from ..analyse import analyse
    from . import render
    from .answer import answer

    with ExitStack() as stack, progress("report", total=len(files) + 1) as bar:
        sessions: list[Session] = []
        analyses = []
        for k, file in enumerate(files):
            bar.update(k, note=file.name)
            session = stack.enter_context(Session.open(file))
            analyses.append(analyse(session))
            sessions.append(session)
        bar.update(len(files), note="page")
        page = render(analyses, sessions)
    _write(output, page)
    answers = [answer(analysis) for analysis in analyses]
    if json:
        emit_json(
            {
                "page": str(output),
                "bytes": output.stat().st_size,
                "answers": [
                    {"session": a.session.id, "verdict": told.verdict, "sentence": told.sentence}
                    for a, told in zip(analyses, answers, strict=True)
                ],
            }
        )
        return
    for analysis, told in zip(analyses, answers, strict=True):
        print(told.sentence if len(answers) == 1 else f"{analysis.session.id}: {told.sentence}")
    print(f"{output}: {output.stat().st_size / 1e3:.0f} kB")


def _write(path: Path, page: str) -> None:
    """Write beside and rename, so that nobody ever opens half a page."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(page, encoding="utf-8")
        os.replace(part, path)  # noqa: PTH105  Path.replace would do the same
    finally:
        part.unlink(missing_ok=True)
