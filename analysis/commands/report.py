"""Command ``report``: sessions in, one HTML page out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from cyclopts import Parameter

from undulog.capture.commands.sessions import (
    FAILED,
    SessionLine,
    are_as_given,
    each_session,
    sessions_of,
    show,
)
from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
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
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    pdf: Path | None = None,
    browser: str | None = None,
    separately: Annotated[bool, Parameter(name="--each")] = False,
    catalog: str | None = None,
    find: Annotated[str, Parameter(name="--where")] = "",
    start: float | None = None,
    stop: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    period: float | None = None,
    robot: str | None = None,
    plots: Path | None = None,
    format_: Annotated[_Format, Parameter(name="--format")] = "svg",
    force: bool = False,
    json: bool = False,
) -> int:
    """Write the offline report: one HTML page that needs no network, or the same on paper as PDF.

    The page states question, answer, evidence, limits and method. Pointing at a value of a figure
    shows it with its interval, and figures zoom; without scripts the page is complete all the same.

    Named sessions are one experiment, as for `undulog analyse`: runs of a gait and of its reverse
    separate boundary from module, kicks of single joints identify the coupling. A folder, a
    pattern, or `--each` give one page with an index, and below it the report on each session by
    itself. If `-o` names a folder, each session gets a page of its own in it, and index.html lists
    them. With `--catalog` the page is on all sessions of a folder over time: joints that change,
    trends, outliers.

    Example: `undulog report run.mcap -o run.html`

    On paper: `undulog report run.mcap --pdf run.pdf`

    One page with an index: `undulog report runs/ -o runs.html`

    A page a session: `undulog report runs/ -o pages/`

    Its figures as files: `undulog report run.mcap -o run.html --plots figures --format pdf`

    Args:
        files: Sessions (MCAP), their URLs, folders of them or patterns such as 'runs/**/*.mcap';
            several named ones are runs of one experiment.
        output: The page, a name that ends in .html, or in .pdf for paper; for several sessions also
            a folder.
        pdf: Print the page to this PDF file, besides or instead of `-o`; takes an installed
            Chromium, Chrome or Edge, which runs without network.
        browser: Name or path of the browser that prints; else that of UNDULOG_BROWSER, or the first
            on the path.
        separately: Report on several sessions one by one on one page instead of as one experiment.
        catalog: Folder or URL of sessions to compare over time, instead of files; those without
            results are analysed first.
        find: Condition on the sessions of the catalogue, as for `undulog catalog`.
        start: Start of what is analysed, from the session's start [s]; chosen if not given.
        stop: Its end [s].
        topics: Where commands and responses are.
        period: Period of a motion without commands whose rhythm wanders [s], as for `undulog
            analyse`.
        robot: Description of the robot of a log without one, a name or a TOML file.
        plots: Write each figure of the page to a file in this folder; of several pages, in a folder
            of the page's name in it.
        format_: Format of these files.
        force: Replace the page, and figures, if they exist.
        json: Print one JSON object: the page, the answer, and the answer to each session; of a
            folder of pages a list of them.
    """
    options = chosen(start, stop, topics, period=period)
    _check_sources(files, catalog, find, options)
    paths = sessions_of(files)
    several = len(paths) > 1
    if several and output is not None and (output.is_dir() or not output.suffix):
        if pdf is not None:
            raise UsageError("--pdf prints one page; with it name a page, -o PAGE.html, no folder")
        figures = None if plots is None else _Figures(plots, format_, force=force)
        return _pages(paths, options, robot, output, figures, force=force, as_json=json)
    outputs = _Outputs(output, pdf, browser, force=force)
    figures = None if plots is None else _Figures(plots, format_, force=force)
    with _keeping(figures) as drawn:
        if catalog is not None:
            made = _fleet(catalog, find, outputs.first)
        elif not several:
            made = _one(paths[0], options, robot)
        elif separately or not are_as_given(paths, files):
            made = _one_by_one(paths, options, robot)
        else:
            made = _several(paths, options, robot)
    outputs.write(made.html)
    written = figures.save(made.html, drawn) if figures else []
    if json:
        more = {"plots": [str(path) for path in written]} if figures else {}
        emit_json({**outputs.facts(), **made.facts, **more})
        return made.code
    if made.lines:
        show(made.lines, as_json=False)
    else:
        echo(made.facts["answer"])
    count = made.warnings
    noted = f", {count} warning{'s' if count > 1 else ''} in it" if count else ""
    echo(*(f"{path}: {path.stat().st_size / 1e3:.0f} kB{noted}" for path in outputs.paths))
    if figures:
        echo(f"{plots}: {', '.join(path.name for path in written) or 'no figure in the page'}")
    return made.code


class _Page(NamedTuple):
    """A page, its answers, its number of warnings, and a line for each session by itself."""

    html: str
    facts: dict[str, Any]
    warnings: int = 0
    lines: Mapping[str, SessionLine] = {}

    @property
    def code(self) -> int:
        """The exit code."""
        return int(not all(line.good for line in self.lines.values()))


def _check_sources(files: Sequence[Path], catalog: str | None, find: str, options: Options) -> None:
    """Check that there are sessions, or a catalogue with what goes with one."""
    if not files and catalog is None:
        raise UsageError(
            "report needs at least one session, e.g. undulog report run.mcap -o x.html"
        )
    if files and catalog is not None:
        raise UsageError("--catalog takes the place of files; name its sessions by --where")
    if find and catalog is None:
        raise UsageError("--where is a condition on the sessions of --catalog")
    if catalog is not None and options != chosen(None, None):
        raise UsageError("--catalog shows results as they are; leave out window and topics")


class _Outputs:
    """The page, the PDF file, or both; checked before any work is done."""

    def __init__(
        self, page: Path | None, pdf: Path | None, browser: str | None, *, force: bool
    ) -> None:
        if page is not None and page.suffix.lower() == ".pdf":
            if pdf is not None:
                raise UsageError(f"{page}: with --pdf the page's own name (-o) ends in .html")
            page, pdf = None, page
        if page is None and pdf is None:
            raise UsageError("report needs --output (-o) PAGE.html, or --pdf PAGE.pdf, or both")
        if page is not None:
            why = "the report is a page; end its name in .html, or in .pdf for paper"
            check_output(page, PAGES, why, force=force)
        if pdf is not None:
            check_output(pdf, (".pdf",), "end the name of the PDF file in .pdf", force=force)
        elif browser is not None:
            raise UsageError("--browser is the browser that prints; add --pdf PAGE.pdf")
        self._page, self._pdf = page, pdf
        self.paths = [path for path in (page, pdf) if path is not None]
        self.first = self.paths[0]
        self._browser = ""
        if pdf is not None:
            from ..present.page import find_browser

            self._browser = find_browser(browser)

    def write(self, page: str) -> None:
        if self._page is not None:
            write_text(self._page, page)
        if self._pdf is not None:
            from ..present.page import write_pdf

            with progress("print", total=1) as bar:
                bar.update(0, note=self._pdf.name)
                write_pdf(page, self._pdf, self._browser)

    def facts(self) -> dict[str, Any]:
        page = {} if self._page is None else {"page": str(self._page)}
        pdf = {} if self._pdf is None else {"pdf": str(self._pdf)}
        return page | pdf | {"bytes": self.first.stat().st_size}


def _keeping(figures: _Figures | None) -> AbstractContextManager[Mapping[str, Any]]:
    """Keep the figures that are drawn, if they are wanted."""
    if figures is None:
        return nullcontext({})
    from ..present.svg import kept_figures

    return kept_figures()


class _Figures:
    """Where the figures of pages go, and as what."""

    def __init__(self, folder: Path, kind: _Format, *, force: bool) -> None:
        from ..present.plot_files import check_plots

        check_plots(folder, kind, force=force)
        self._folder, self._force = folder, force
        self._kind: _Format = kind

    def save(self, page: str, drawn: Mapping[str, Any], name: str | None = None) -> list[Path]:
        """Write the figures of a page, into a folder of a name in the folder if there is one."""
        from ..present.plot_files import save_plots

        folder = self._folder
        if name is not None:
            folder.mkdir(exist_ok=True)
            folder /= name
        return save_plots(page, drawn, folder, self._kind, force=self._force)


def _one(file: Path, options: Options, robot: str | None) -> _Page:
    """Return the page on one session."""
    with progress("report", total=2) as bar:
        bar.update(0, note=file.name)
        page, analysis = _page(file, options, robot, lambda: bar.update(1, note="page"))
    summary = _summary(analysis)
    facts = {"answer": summary["sentence"], "answers": [summary]}
    return _Page(page, facts, len(analysis.warnings))


def _page(
    file: Path, options: Options, robot: str | None, on_page: Callable[[], None] = lambda: None
) -> tuple[str, Analysis]:
    from undulog.capture import Session

    from ..present.page import render
    from ..session.analyse import measure_session
    from ..session.cycle_maps import cycle_maps

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
    from ..present.page import render_index

    index = folder / "index.html"
    folder.mkdir(exist_ok=True)
    refuse_existing(index, force=force)
    paths = list(dict.fromkeys(paths))
    pages = _page_names(paths)

    def written(path: Path) -> SessionLine:
        page = folder / pages[path]
        refuse_existing(page, force=force)
        with _keeping(figures) as drawn:
            text, analysis = _page(path, options, robot)
        write_text(page, text)
        if figures:
            figures.save(text, drawn, page.stem)
        return replace(line_of(analysis), facts={"page": str(page), **_summary(analysis)})

    lines = each_session(paths, "report", written)
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


def _fleet(where: str, find: str, output: Path) -> _Page:
    """Return the page on the sessions of a catalogue."""
    from ..catalog.catalog import Catalog
    from ..catalog.fleet import analyse_fleet
    from ..present.page import render_fleet

    catalog = Catalog(where)
    with progress("report", total=2) as bar:
        catalog.scan()
        missing = catalog.find(find).query("status == 'not analysed' and damage.isna()")["path"]
        faults = catalog.analyse(
            missing.to_list(), on_done=lambda k, n: bar.update(k / n, f"{k} of {n} analysed")
        )
        bar.update(1, note="page")
        sessions, joints = catalog.find(find), catalog.find(joints=True)
        fleet = analyse_fleet(sessions, joints)
        warnings = [*fleet.warnings, *(f"{name}: {why}" for name, why in faults.items())]
        fleet = replace(fleet, warnings=tuple(warnings))
        page = render_fleet(fleet, joints, where, output)
    return _Page(page, fleet.to_dict(), len(warnings))


def _one_by_one(files: Sequence[Path], options: Options, robot: str | None) -> _Page:
    """Return one page on sessions by themselves."""
    from undulog.capture import Session

    from ..present.page import SessionsPage
    from ..session.analyse import measure_session
    from ..session.cycle_maps import cycle_maps

    page = SessionsPage()

    def added(path: Path) -> SessionLine:
        page.check_size()
        with Session.open(path, robot=robot) as session:
            measured = measure_session(session, options)
            analysis = measured.analysis
            page.add(path, analysis, session, cycle_maps(measured))
        return replace(line_of(analysis), facts=_summary(analysis))

    lines = each_session(files, "report", added)
    paths = dict.fromkeys(files)
    text = page.render(list(zip(paths, lines.items(), strict=True)))
    facts = {
        "answer": f"{len(lines)} sessions, each by itself",
        "answers": [line.facts for line in lines.values()],
    }
    return _Page(text, facts, lines=lines)


def _several(files: Sequence[Path], options: Options, robot: str | None) -> _Page:
    """Return the page on an experiment."""
    from ..present.page import render

    experiment = experiment_of(files, options, "report", robot=robot)
    page = render(experiment)
    facts = {
        "answer": f"{len(files)} sessions: {experiment.answer}.",
        "answers": [_summary(session) for session in experiment.sessions],
    }
    return _Page(page, facts, len(experiment.warnings))


def _summary(analysis: Analysis) -> dict[str, Any]:
    session, answer = analysis.session, analysis.answer
    facts = {"session": session.id, "path": session.path}
    return facts | {"verdict": answer.verdict, "sentence": answer.sentence}
