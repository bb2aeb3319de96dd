"""Command ``report``: sessions in, one HTML page out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from undulog.capture.commands.sessions import (
    CONTRACT,
    FAILED,
    JointTopicOptions,
    Line,
    each,
    sessions_of,
    show,
)
from undulog.capture.common.console import echo, emit_json, progress, refuse_existing
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_output, write_text

from .analyse import PAGES, chosen, experiment_of, line_of

if TYPE_CHECKING:
    from ..results.analysis import Analysis
    from ..signals.stretch import Options


_Format = Literal["svg", "png", "pdf"]


def report(
    *files: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    catalog: str | None = None,
    find: Annotated[str, Parameter(name="--where")] = "",
    start: float | None = None,
    stop: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    robot: str | None = None,
    plots: Path | None = None,
    format_: Annotated[_Format, Parameter(name="--format")] = "svg",
    force: bool = False,
    json: bool = False,
) -> int:
    """Write the offline report: one HTML page that needs no network and no script.

    Several sessions are one experiment, as for `undulog analyse`: runs of a gait and of its reverse
    separate boundary from module, kicks of single joints identify the coupling. If `-o` names a
    folder, each session gets a page of its own in it, and index.html lists them. With `--catalog`
    the page is on all sessions of a folder over time: joints that change, trends, outliers.

    Example: `undulog report run.mcap -o run.html`

    A page a session: `undulog report runs/ -o pages/`

    Its figures as files: `undulog report run.mcap -o run.html --plots figures --format pdf`

    Args:
        files: Sessions (MCAP), their URLs, folders of them or patterns such as 'runs/**/*.mcap';
            several are runs of one experiment.
        output: The page, a name that ends in .html; for several sessions also a folder.
        catalog: Folder or URL of sessions to compare over time, instead of files; those without
            results are analysed first.
        find: Condition on the sessions of the catalogue, as for `undulog catalog`.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        topics: Where commands and responses are.
        robot: Description of the robot of a log without one, a name or a TOML file.
        plots: Write each figure of the page to a file in this folder; of several pages, in a folder
            of the page's name in it.
        format_: Format of these files.
        force: Replace the page, and figures, if they exist.
        json: Print one JSON object: the page, the answer, and the answer to each session; of a
            folder of pages a list of them.
    """
    if not files and catalog is None:
        raise UsageError(
            "report needs at least one session, e.g. undulog report run.mcap -o x.html"
        )
    if files and catalog is not None:
        raise UsageError("--catalog takes the place of files; name its sessions by --where")
    if find and catalog is None:
        raise UsageError("--where is a condition on the sessions of --catalog")
    options = chosen(start, stop, topics)
    if catalog is not None and options != chosen(None, None):
        raise UsageError("--catalog shows results as they are; leave out window and topics")
    paths = sessions_of(files)
    figures = None if plots is None else _Figures(plots, format_, force=force)
    if len(paths) > 1 and (output.is_dir() or not output.suffix):
        return _pages(paths, options, robot, output, figures, force=force, as_json=json)
    check_output(output, PAGES, "the report is an HTML page; end its name in .html", force=force)
    with _keeping(figures) as drawn:
        if catalog is not None:
            page, facts, warnings = _fleet(catalog, find, output)
        elif len(paths) == 1:
            page, facts, warnings = _one(paths[0], options, robot)
        else:
            page, facts, warnings = _several(paths, options, robot)
    write_text(output, page)
    written = figures.save(page, drawn) if figures else []
    size = output.stat().st_size
    if json:
        more = {"plots": [str(path) for path in written]} if figures else {}
        emit_json({"page": str(output), "bytes": size, **facts, **more})
        return 0
    echo(facts["answer"])
    noted = f", {warnings} warning{'s' if warnings > 1 else ''} in it" if warnings else ""
    echo(f"{output}: {size / 1e3:.0f} kB{noted}")
    if figures:
        echo(f"{plots}: {', '.join(path.name for path in written) or 'no figure in the page'}")
    return 0


def _keeping(figures: _Figures | None) -> AbstractContextManager[Mapping[str, Any]]:
    """Keep the figures that are drawn, if they are wanted."""
    if figures is None:
        return nullcontext({})
    from ..present.page.svg import kept_figures

    return kept_figures()


class _Figures:
    """Where the figures of pages go, and as what."""

    def __init__(self, folder: Path, kind: _Format, *, force: bool) -> None:
        from ..present.notebook.plot_files import check_plots

        check_plots(folder, kind, force=force)
        self._folder, self._force = folder, force
        self._kind: _Format = kind

    def save(self, page: str, drawn: Mapping[str, Any], name: str | None = None) -> list[Path]:
        """Write the figures of a page, into a folder of a name in the folder if there is one."""
        from ..present.notebook.plot_files import save_plots

        folder = self._folder
        if name is not None:
            folder.mkdir(exist_ok=True)
            folder /= name
        return save_plots(page, drawn, folder, self._kind, force=self._force)


def _one(file: Path, options: Options, robot: str | None) -> tuple[str, dict[str, Any], int]:
    """Return the page on one session, its answer, and the number of warnings."""
    with progress("report", total=2) as bar:
        bar.update(0, note=file.name)
        page, analysis = _page(file, options, robot, lambda: bar.update(1, note="page"))
    summary = _summary(analysis)
    return page, {"answer": summary["sentence"], "answers": [summary]}, len(analysis.warnings)


def _page(
    file: Path, options: Options, robot: str | None, on_page: Callable[[], None] = lambda: None
) -> tuple[str, Analysis]:
    from undulog.capture import Session

    from ..present.page.page import render
    from ..session.analyse import measure_session
    from ..session.cycles import cycle_maps

    with Session.open(file, robot=robot) as session:
        measured = measure_session(session, options)
        on_page()
        return render(measured.analysis, session, cycle_maps(measured)), measured.analysis


def _pages(
    paths: Sequence[Path],
    options: Options,
    robot: str | None,
    folder: Path,
    figures: _Figures | None,
    *,
    force: bool,
    as_json: bool,
) -> int:
    """Write a page for each session into a folder, and an index of them."""
    from ..present.page.page import render_index

    index = folder / "index.html"
    folder.mkdir(exist_ok=True)
    refuse_existing(index, force=force)
    paths = list(dict.fromkeys(paths))
    pages = _page_names(paths)

    def written(path: Path) -> Line:
        page = folder / pages[path]
        refuse_existing(page, force=force)
        with _keeping(figures) as drawn:
            text, analysis = _page(path, options, robot)
        write_text(page, text)
        if figures:
            figures.save(text, drawn, page.stem)
        return replace(line_of(analysis), facts={"page": str(page), **_summary(analysis)})

    lines = each(paths, "report", written)
    rows = [
        (name, line, pages[path] if line.verdict != FAILED else None)
        for path, (name, line) in zip(paths, lines.items(), strict=True)
    ]
    write_text(index, render_index(rows))
    code = show(lines, as_json=as_json)
    if not as_json:
        echo(f"{index}: {sum(page is not None for *_, page in rows)} pages")
    return code


def _page_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return a file name for each session's page; those that would be the same get a number."""
    names: dict[Path, str] = {}
    taken = {"index"}
    for path in paths:
        stem = name = path.stem or "session"
        number = 2
        while name in taken:
            name, number = f"{stem}-{number}", number + 1
        taken.add(name)
        names[path] = f"{name}.html"
    return names


def _fleet(where: str, find: str, output: Path) -> tuple[str, dict[str, Any], int]:
    """Return the page on the sessions of a catalogue, its result, and the number of warnings."""
    from ..catalog.catalog import Catalog
    from ..catalog.fleet import analyse_fleet
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


def _several(
    files: Sequence[Path], options: Options, robot: str | None
) -> tuple[str, dict[str, Any], int]:
    """Return the page on an experiment, all answers, and the number of warnings."""
    from ..present.page.page import render

    experiment = experiment_of(files, options, "report", robot=robot)
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
