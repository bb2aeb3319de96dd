"""Render the report, of one session or several: one self-contained HTML file, or a PDF.

No outside reference: style, figures and one script (values under the pointer, zoom) are inside, and
a content security policy (W3C CSP3) makes the browser refuse anything else. Without the script the
page is complete. Everything that comes from a log is escaped. It needs the extra ``report``.

::

    from undulog.analysis.present.page import render
    from undulog.capture import Session

    with Session.open("run.mcap") as session:
        page = render(analysis, session)  # one page; a sequence of both for several sessions
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from undulog.capture import SessionView
from undulog.capture.commands.sessions import SessionLine, first_sentence
from undulog.capture.common.console import plain
from undulog.capture.common.errors import UndulogError, UsageError
from undulog.capture.common.files import part_file
from undulog.capture.common.palette import joint_hex
from undulog.capture.common.process import interrupted_later
from undulog.capture.common.waits import end_process

from ..catalog.fleet import Fleet
from ..common import formats
from ..common.answer import beyond
from ..common.estimate import Provenance
from ..parts.body.show import point_table, shape_lines
from ..parts.free_motion.show import local_waves_table, motion_table, wave_table
from ..parts.frequency_response.show import frequency_table
from ..parts.gaits.show import gait_joint_table, gait_table
from ..parts.ground_contact.show import contact_lines
from ..parts.heterogeneity.show import index_table
from ..parts.shown import AnyTable
from ..parts.tracking.show import tracking_table
from ..results.analysis import Analysis
from ..results.comparison import Comparison
from ..results.experiment import Experiment
from ..session.cycle_maps import CycleMaps
from . import tables
from .comparison_view import change_text, comparison_view, fleet_view, spread_text
from .experiment_view import experiment_view
from .page_tables import (
    LEVEL_NOTE,
    digits,
    escaped,
    estimate,
    grid,
    number,
    p_value,
    sentence,
    softer,
    typeset,
)
from .session_view import session_view

LARGEST_BYTES = 3_000_000
"""A page must open on a phone."""

VARIABLE = "UNDULOG_BROWSER"
"""Environment variable that names the browser."""

_NAMES = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "microsoft-edge-stable", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
)

LONGEST_S = 120.0
"""After which a browser is ended [s]."""

_FLAGS = (
    *("--headless", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
    *("--no-default-browser-check", "--disable-extensions", "--disable-default-apps"),
    # No network: neither by the page, whose policy forbids it, nor by the browser itself.
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-domain-reliability", "--disable-features=NetworkTimeServiceQuerying,MediaRouter"),
    *("--host-resolver-rules=MAP * ~NOTFOUND", "--proxy-server=127.0.0.1:9"),  # port 9: discard
    *("--no-pdf-header-footer", "--generate-pdf-document-outline"),
)


_PART_TABLES: tuple[Callable[..., AnyTable], ...] = (
    *(point_table, local_waves_table, motion_table, wave_table, frequency_table),
    *(gait_joint_table, gait_table, index_table, tracking_table),
)
"""Tables of parts, by which templates name them."""


def render(
    result: Analysis | Experiment | Comparison,
    session: SessionView | None = None,
    cycles: CycleMaps | None = None,
) -> str:
    """Return the report on one session, an experiment or a comparison.

    A page larger than ``LARGEST_BYTES`` omits its largest part, with a note: for one session the
    signals and maps, for an experiment the numbers of every run.

    Args:
        session: The open session of an ``Analysis``, to draw its samples, or None.
        cycles: Of an ``Analysis``, from
            :func:`.analysis.parts.over_time.measure.cycle_maps`, or None.

    Returns:
        One HTML page without outside references; the same input gives the same text.

    Raises:
        UsageError: If the page would still be too large.
    """
    page = _page(result, session, cycles, left_out=False)
    if len(page.encode()) > LARGEST_BYTES:
        page = _page(result, None, None, left_out=True)
    size = len(page.encode())
    if size > LARGEST_BYTES:
        count = len(getattr(result, "sessions", getattr(result, "a", ("",))))
        count += len(getattr(result, "b", ()))
        whose = f"{count} sessions" if count > 1 else "one session"
        megabytes = beyond(size / 1e6, LARGEST_BYTES / 1e6, 3)
        raise UsageError(
            f"the page on {whose} would be {megabytes} MB, more than {LARGEST_BYTES / 1e6:g} "
            "MB: put fewer sessions on it, or less of one with --start and --stop"
        )
    return page


def _page(
    result: Analysis | Experiment | Comparison,
    session: SessionView | None,
    cycles: CycleMaps | None,
    *,
    left_out: bool,
) -> str:
    if isinstance(result, Experiment):
        template, view = "experiment.html.j2", experiment_view(result)
    elif isinstance(result, Comparison):
        template, view = "comparison.html.j2", comparison_view(result)
    else:
        template, view = "session.html.j2", session_view(result, session, cycles)
    return environment().get_template(template).render(v=view, left_out=left_out)


def render_index(lines: Sequence[tuple[str, SessionLine, str | None]]) -> str:
    """Return the index of a folder of pages, one HTML page without outside references.

    Args:
        lines: Name of each session, its line, and the file of its page; None where it has none.
    """
    rows = [
        (name, line, quote(page) if page else None, first_sentence(line.sentence))
        for name, line, page in lines
    ]
    return environment().get_template("index.html.j2").render(rows=rows)


def render_fleet(fleet: Fleet, joints: pd.DataFrame, where: str, page: Path) -> str:
    """Return the report on many sessions over time.

    Args:
        joints: Rows of the catalogue's view ``joints`` that it was computed from.
        where: Folder or URL of the sessions.
        page: Where the page goes; its links start there.
    """
    view = fleet_view(fleet, joints, where, page)
    template = environment().get_template("fleet.html.j2")
    return template.render(v=view, change=change_text, spread=spread_text)


def _template_text(name: str) -> str:
    folder = files("undulog.analysis.present")
    return folder.joinpath("templates", name).read_text(encoding="utf-8")


def _script() -> str:
    """Return the page's script without comments and indentation."""
    lines = map(str.strip, _template_text("figures.js").splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//")) + "\n"


def _glossary() -> list[tuple[str, str]]:
    """Return terms of the results and their meanings, from the rows of the manual's tables."""
    rows = re.findall(r"^\| (.+?) \| (.+) \|$", _template_text("glossary.md"), re.MULTILINE)
    links = re.compile(r"\[([^]]*)\]\([^)]*\)")
    return [
        (word.replace("`", ""), re.sub(r"[`*]", "", links.sub(r"\1", meaning)))
        for word, meaning in rows
        if word != "word"
    ]


def _without_control(value: object) -> object:
    """Return a value of a template; text that isn't markup without control characters."""
    if isinstance(value, Markup) or not isinstance(value, str):
        return value
    return "\n".join(plain(line) for line in value.split("\n"))


@cache
def environment() -> Environment:
    """Return the templates, with their filters and what all pages share."""
    made: Any = Environment(
        loader=PackageLoader("undulog.analysis.present"),
        autoescape=True,
        finalize=_without_control,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    shared = (formats.number, formats.utc, plain, formats.filename, formats.scaled)
    for of in (*shared, softer, typeset, digits, sentence):
        made.filters[of.__name__] = of
    made.filters.update(decimals=formats.decimals_for, again=_commands_to_reproduce)
    made.globals.update(tables=tables, grid=grid, escaped=escaped)
    for table_of in _PART_TABLES:
        made.globals[table_of.__name__] = table_of
    made.globals.update(num=number, est=estimate, p=p_value)
    script = _script()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    made.globals.update(
        script=Markup(script),  # noqa: S704  our own file
        script_hash=f"sha256-{digest}",
        style=Markup(_template_text("style.css")),  # noqa: S704  our own file
        words=_glossary(),
        at="",
        top=1,
        body_gradient=", ".join(joint_hex(9)),
        MISSING=formats.MISSING,
        LEVEL_NOTE=LEVEL_NOTE,
        shape_lines=shape_lines,
        contact_lines=contact_lines,
    )
    return made


def _commands_to_reproduce(provenance: Provenance) -> str:
    """Return the commands for the numbers and for this page; compare is one command for both."""
    command = plain(provenance.command)
    numbers = "undulog analyse "
    if not command.startswith(numbers):
        return f"{command} -o comparison.html"
    return f"{command}\nundulog report {command.removeprefix(numbers)} -o report.html"


@dataclass
class _Part:
    analysis: Analysis
    at: str
    html: str


class SessionsPage:
    """Collects sessions, one open at a time, and keeps within ``LARGEST_BYTES``.

    Where the page would grow larger, the samples and the cycles of all sessions are left out.
    """

    def __init__(self) -> None:
        """Start with no session."""
        self._parts: dict[Path, _Part] = {}
        self._left_out = False

    def add(
        self, path: Path, analysis: Analysis, session: SessionView, cycles: CycleMaps | None
    ) -> None:
        """Add a session that is still open."""
        at = f"s{len(self._parts) + 1}-"
        drawn = (None, None) if self._left_out else (session, cycles)
        self._parts[path] = _Part(analysis, at, self._rendered(analysis, at, *drawn))
        if self._bytes() > LARGEST_BYTES and not self._left_out:
            self._left_out = True
            for part in self._parts.values():
                part.html = self._rendered(part.analysis, part.at)

    def check_size(self) -> None:
        """Check whether the page is not too large yet, even without samples and cycles.

        Raises:
            UsageError: If it is.
        """
        if self._bytes() > LARGEST_BYTES:
            raise UsageError(
                f"{len(self._parts)} sessions make a page of more than {LARGEST_BYTES / 1e6:g} MB: "
                "put fewer on it, or give each a page of its own with -o FOLDER"
            )

    def render(self, lines: Sequence[tuple[Path, tuple[str, SessionLine]]]) -> str:
        """Return the page.

        Args:
            lines: Path, name and line of every session; one that was not added has a line only.

        Raises:
            UsageError: If the page would be too large even without samples and cycles.
        """
        self.check_size()
        targets = {path: f"#{part.at}answer" for path, part in self._parts.items()}
        rows = [
            (name, line, targets.get(path), first_sentence(line.sentence))
            for path, (name, line) in lines
        ]
        parts = [
            (part.at, Markup(part.html))  # noqa: S704  rendered above
            for part in self._parts.values()
        ]
        return environment().get_template("sessions.html.j2").render(rows=rows, parts=parts)

    def _bytes(self) -> int:
        return sum(len(part.html.encode()) for part in self._parts.values())

    def _rendered(
        self,
        analysis: Analysis,
        at: str,
        session: SessionView | None = None,
        cycles: CycleMaps | None = None,
    ) -> str:
        view = session_view(analysis, session, cycles, at)
        template = environment().get_template("session_part.html.j2")
        return template.render(v=view, at=at, top=2, left_out=self._left_out)


def find_browser(given: str | None = None) -> str:
    """Return the path of the browser that prints.

    Args:
        given: Name or path; None for that of ``UNDULOG_BROWSER`` or else the first that is found.

    Raises:
        UsageError: If there is none.
    """
    source = "--browser"
    if given is None:
        given, source = os.environ.get(VARIABLE) or None, VARIABLE
    if given is not None:
        if (path := shutil.which(given)) is None:
            raise UsageError(f"{source}: there is no program {given} to print with")
        return path
    if path := next(filter(None, map(shutil.which, _NAMES)), None):
        return path
    raise UsageError(
        "a PDF needs a browser to print with, and none of Chromium, Google Chrome and Microsoft "
        f"Edge is on the path: install one (Debian: apt-get install chromium), name it by "
        f"--browser or {VARIABLE}, or write the page with -o PAGE.html and print it by hand"
    )


def write_pdf(page: str, output: Path, browser: str, longest_s: float = LONGEST_S) -> None:
    """Print a page; the browser and its processes have ended when this returns or raises.

    Args:
        page: HTML without outside references.
        output: The PDF file, under a partial name until it is complete.
        browser: From :func:`find_browser`.
        longest_s: Time limit [s].

    Raises:
        UndulogError: If the browser fails or exceeds the time limit.
    """
    # Beside the output, since a confined browser reads and writes in no temporary folder.
    with (
        tempfile.TemporaryDirectory(
            prefix="undulog-pdf-", dir=output.parent, ignore_cleanup_errors=True
        ) as scratch,
        part_file(output) as part,
    ):
        folder = Path(scratch).resolve()
        source, printed = folder / "page.html", folder / "page.pdf"
        source.write_text(page, encoding="utf-8")
        flags = [*_FLAGS, f"--user-data-dir={folder / 'profile'}", f"--print-to-pdf={printed}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            flags.append("--no-sandbox")  # Chromium has no sandbox for the superuser
        _run([browser, *flags, source.as_uri()], folder / "messages", longest_s)
        if not printed.is_file() or printed.read_bytes()[:5] != b"%PDF-":
            raise _failure(browser, "wrote no PDF", folder / "messages")
        shutil.copyfile(printed, part)


def _run(command: list[str], messages: Path, longest_s: float) -> None:
    """Run a browser and end the group of its processes, whatever happens."""
    with messages.open("wb") as log:
        process = None
        try:
            with interrupted_later():
                process = subprocess.Popen(  # noqa: S603  our own arguments
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    process_group=0,  # a Ctrl-C ends it through us
                )
            code = process.wait(longest_s)
        except subprocess.TimeoutExpired:
            why = f"did not print the page within {longest_s:g} s and was ended"
            raise _failure(command[0], why, messages) from None
        finally:
            if process is not None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                end_process(process, command[0])
    if code:
        raise _failure(command[0], f"ended with exit code {code}", messages)


def _failure(browser: str, why: str, messages: Path) -> UndulogError:
    lines = messages.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    detail = f"; its last message: {lines[-1]}" if lines else ""
    return UndulogError(
        f"{browser} {why}{detail}; name another browser by --browser, or write the page with "
        "-o PAGE.html and print it by hand"
    )
