"""Render the report: one self-contained HTML file, the answer first.

No script, no outside reference: style and figures are inside, and a content security policy
(W3C CSP3) makes the browser refuse anything else. Everything that comes from a log is escaped.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import matplotlib.dates
import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from undulog.capture import SessionView
from undulog.capture.commands.several import Line, first_sentence
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import plain
from undulog.capture.common.errors import UsageError
from undulog.capture.common.palette import joint_hex

from ...fleet.fleet import QUANTITIES, Fleet, JointChange, RobotHistory
from ...fleet.fleet import sentence as change_sentence
from ...results import formats
from ...results.analysis import Analysis
from ...results.answer import beyond
from ...results.comparison import Comparison
from ...results.estimate import Provenance
from ...results.experiment import Experiment
from ...results.oscillators import ChainCoupling
from ...session.cycles import CycleMaps
from .. import tables
from ..body_shape import shape_lines
from ..text import chain_detail
from .artefacts import artefact_rows, command_response, flagged_joints, read_traces
from .bode import bode
from .comparison_view import comparison_view
from .experiment_view import experiment_view
from .maps import cycle_drawings
from .matrix import Entries, entries_of, matrix_picture
from .segments import body_motion, segments
from .svg import DASHED, MUTED, REFERENCE, Axes, Drawing, drawing, inline_svg, key, legend
from .tables import (
    Fact,
    cut,
    digits,
    estimate,
    grid,
    is_driven,
    joint_mark,
    key_figures,
    known,
    number,
    p_value,
    sentence,
    softer,
    typeset,
)
from .trials import LEVEL_NOTE, session_trials


def _session_view(
    analysis: Analysis, session: SessionView | None, cycles: CycleMaps | None
) -> dict[str, Any]:
    """Return what the template shows of one session, by name."""
    joints = analysis.joints
    colors = joint_hex(len(joints)) if joints else ()
    traces = read_traces(session, analysis) if session is not None else ()
    body = analysis.body
    answer = analysis.answer
    others = [w for w in map(formats.sentence, analysis.warnings) if w not in answer.detail]
    entries = entries_of(analysis.coupling, tuple(j.name for j in joints if is_driven(j)))
    drawn = [(j.gain.value, j.energy_net_j, j.energy_abs_j) for j in joints]
    numbers = any(value is not None for values in drawn for value in values)
    return {
        "analysis": analysis,
        "answer": answer,
        "notices": [cut(warning) for warning in others[:3]],
        "facts": key_figures(analysis),
        "marks": [
            joint_mark(color, joint.plane, driven=is_driven(joint))
            for color, joint in zip(colors, joints, strict=True)
        ],
        "trials": session_trials(analysis.heterogeneity),
        "segments": segments(joints, "segments-figure") if numbers else None,
        "bode": bode(analysis.frequency_response, "bode-figure"),
        "signals": command_response(traces, len(joints)) if traces else None,
        "maps": () if cycles is None else cycle_drawings(cycles),
        "artefacts": artefact_rows(analysis),
        "flagged": flagged_joints(joints),
        "body": body_motion(body, "body-figure") if body is not None and body.observed else None,
        "entries": entries,
        "matrix": matrix_picture(entries[0], "coupling-figure") if entries else None,
        "chains": [
            chain_view(chain, f"oscillators-{k}")
            for k, chain in enumerate(analysis.oscillators, start=1)
        ],
    }


def chain_view(chain: ChainCoupling, prefix: str) -> dict[str, Any]:
    """Return what the template shows of one chain of oscillators, by name.

    Args:
        prefix: For identifiers, unique in the page.
    """
    lines = list(chain_detail(chain))
    lags = [formats.degrees(link.lag_rad) for link in chain.links]
    rates = chain.oscillators
    return {
        "chain": chain,
        "sentence": lines[0].partition(": ")[2] if chain.identifiable else None,
        "method": lines[-1].removeprefix("Method: ") if chain.identifiable else "",
        "matrix": matrix_picture(_couplings(chain), prefix) if chain.links else None,
        "decimals": (  # of K, of the rates and of the feedback
            formats.decimals_for((link.K for link in chain.links), most=3),
            formats.decimals_for((one.omega for one in rates), most=4),
            formats.decimals_for((one.feedback for one in rates), most=3),
        ),
        "lags": lags,
        "lag_decimals": formats.decimals_for(lags, most=2),
        "fed": any(one.feedback.value is not None for one in rates),
    }


def _couplings(chain: ChainCoupling) -> Entries:
    """Return K as a matrix with NaN for couplings that were not estimated."""
    names = tuple(one.name for one in chain.oscillators)
    place = {name: k for k, name in enumerate(names)}
    value: FloatArray = np.full((len(names), len(names)), np.nan)
    half: FloatArray = np.zeros_like(value)
    for link in chain.links:
        at = place[link.target], place[link.source]
        value[at] = link.K.value or 0.0
        if link.K.ci95 is not None:
            half[at] = (link.K.ci95[1] - link.K.ci95[0]) / 2
    meaning = f"coupling of oscillators, {chain.plane} [1/s]; looked for up to {chain.reach} apart"
    words = ("the oscillator that is turned", "the oscillator that turns it", "is turned by")
    return Entries("K", meaning, names, names, value, half, *words)


LARGEST_BYTES = 3_000_000
"""A page must open on a phone."""


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
        cycles: Of an ``Analysis``, from :func:`.analysis.session.cycles.cycle_maps`, or None.

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
        template, view = "session.html.j2", _session_view(result, session, cycles)
    return _environment().get_template(template).render(v=view, left_out=left_out)


def render_index(lines: Sequence[tuple[str, Line, str | None]]) -> str:
    """Return the index of a folder of pages, one HTML page without outside references.

    Args:
        lines: Name of each session, its line, and the file of its page; None where it has none.
    """
    rows = [
        (name, line, quote(page) if page else None, first_sentence(line.sentence))
        for name, line, page in lines
    ]
    return _environment().get_template("index.html.j2").render(rows=rows)


_DATES: Any = matplotlib.dates  # whose annotations leave arguments unknown
_MOST_FIGURES = 6


def fleet_view(fleet: Fleet, joints: pd.DataFrame, where: str, page: Path) -> dict[str, Any]:
    """Return what the template shows of a fleet, by name.

    Args:
        joints: Rows of the view ``joints`` that the fleet was computed from.
        where: Folder or URL of the sessions.
        page: Where the page goes: links start there.
    """
    return {
        "fleet": fleet,
        "where": where,
        "command": f"undulog report --catalog {shlex.quote(where)} -o {shlex.quote(page.name)}",
        "robots": [
            {
                "history": history,
                "facts": _fleet_facts(history),
                "links": {one.path: _links(one.path, where, page) for one in history.outliers},
                "figures": [
                    _change_drawing(history, change, joints, f"change-{k}-{n}")
                    for n, change in enumerate(history.changes[:_MOST_FIGURES])
                ],
            }
            for k, history in enumerate(fleet.robots)
        ],
    }


def spread_text(quantity: str, value: float | None) -> str:
    """Return a standard deviation as people read it: degrees for lag, percent for the others."""
    if value is None:
        return formats.number(None, 0)
    return (
        f"{formats.number(math.degrees(value), 2)}°"
        if quantity == "lag"
        else f"{formats.number(100 * value, 2)} %"
    )


def change_text(quantity: str, value: float) -> str:
    """Return a change or deviation as :func:`spread_text` does, with its sign."""
    return ("+" if value > 0 else "") + spread_text(quantity, value)


def _fleet_facts(history: RobotHistory) -> list[Fact]:
    return [
        Fact("sessions", str(history.sessions), f"{history.first[:10]} to {history.last[:10]}"),
        Fact("joints compared", str(len(history.joints)), ""),
        Fact("gaits", str(history.conditions), ""),
        Fact("changes", str(len(history.changes)), ""),
        Fact("outliers", str(len(history.outliers)), ""),
    ]


def _links(path: str, where: str, page: Path) -> Mapping[str, str]:
    """Return the addresses of a session and, where it lies beside it, of its page."""
    if "://" in where:
        return {"session": f"{where.rstrip('/')}/{quote(path)}", "page": ""}
    session = Path(where).resolve() / path
    beside = session.with_suffix(".html")
    base = page.resolve().parent
    return {
        "session": _relative(session, base),
        "page": _relative(beside, base) if beside.is_file() else "",
    }


def _relative(path: Path, base: Path) -> str:
    try:
        return quote(PurePosixPath(path.relative_to(base)).as_posix())
    except ValueError:
        return path.as_uri()


def _change_drawing(
    history: RobotHistory, change: JointChange, joints: pd.DataFrame, prefix: str
) -> Drawing:
    """Draw the values of a joint that changes over its sessions, the others behind it."""
    column = {"gain": "gain", "lag": "lag_rad", "energy": "energy_abs_j"}[change.quantity]
    table: Any = joints
    own = table[(table["robot"] == history.robot) & table["joint"].isin(history.joints)]
    own = own.dropna(subset=[column]).sort_values("start")
    values = own[column].map(math.degrees) if change.quantity == "lag" else own[column]
    if change.quantity == "energy":
        values /= own["stop_s"] - own["start_s"]
    colors = dict(zip(history.joints, joint_hex(len(history.joints)), strict=True))
    with drawing(2.4) as figure:
        axes: Axes = figure.subplots()
        for name in history.joints:
            rows = own["joint"] == name
            mine = name == change.joint
            axes.plot(
                own["start"][rows].to_numpy(),
                values[rows].to_numpy(),
                color=colors[name] if mine else REFERENCE,
                marker="o" if mine else None,
                markersize=3,
                linewidth=1.2 if mine else 0.4,
                zorder=3 if mine else 1,
            )
        axes.axvspan(
            pd.Timestamp(change.earliest), pd.Timestamp(change.latest), color=MUTED, alpha=0.25
        )
        axes.axvline(pd.Timestamp(change.date), color=MUTED, linestyle=DASHED, linewidth=0.8)
        label = QUANTITIES[change.quantity].replace("[rad]", "[°]")
        axes.set_ylabel(label)
        locator = _DATES.AutoDateLocator(maxticks=7)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(_DATES.ConciseDateFormatter(locator))
        legend(
            figure,
            key(color=colors[change.joint], marker="o", label=change.joint),
            key(color=REFERENCE, label="the other joints"),
            key(color=MUTED, linestyle=DASHED, label="change, 95 % interval"),
        )
        svg = inline_svg(figure, prefix, f"{change.joint} over the sessions", label)
        return Drawing(svg, f"{change_sentence(change).capitalize()}.")


def render_fleet(fleet: Fleet, joints: pd.DataFrame, where: str, page: Path) -> str:
    """Return the report on many sessions over time.

    Args:
        joints: Rows of the catalogue's view ``joints`` that it was computed from.
        where: Folder or URL of the sessions.
        page: Where the page goes; its links start there.
    """
    view = fleet_view(fleet, joints, where, page)
    template = _environment().get_template("fleet.html.j2")
    return template.render(v=view, change=change_text, spread=spread_text)


def _template_text(name: str) -> str:
    folder = files("undulog.analysis.present.page")
    return folder.joinpath("templates", name).read_text(encoding="utf-8")


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
def _environment() -> Environment:
    environment: Any = Environment(
        loader=PackageLoader("undulog.analysis.present.page"),
        autoescape=True,
        finalize=_without_control,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    shared = (formats.number, formats.utc, plain, formats.filename, formats.scaled)
    for of in (*shared, softer, typeset, cut, digits, sentence):
        environment.filters[of.__name__] = of
    environment.filters.update(decimals=formats.decimals_for, again=_commands_to_reproduce)
    environment.globals.update(
        tables=tables, grid=grid, num=number, est=estimate, p=p_value, known=known
    )
    environment.globals.update(
        style=Markup(_template_text("style.css")),  # noqa: S704  our own file
        words=_glossary(),
        body_gradient=", ".join(joint_hex(9)),
        MISSING=formats.MISSING,
        LEVEL_NOTE=LEVEL_NOTE,
        shape_lines=shape_lines,
    )
    return environment


def _commands_to_reproduce(provenance: Provenance) -> str:
    """Return the commands for the numbers and for this page; compare is one command for both."""
    command = plain(provenance.command)
    numbers = "undulog analyse "
    if not command.startswith(numbers):
        return f"{command} -o comparison.html"
    return f"{command}\nundulog report {command.removeprefix(numbers)} -o report.html"
