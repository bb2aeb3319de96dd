"""The page: one self-contained HTML file that answers first and proves after.

No script, no outside reference: style and figures are inside, and a content security policy
(W3C CSP3) makes the browser refuse anything else. Everything that comes from a log is escaped.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from undulog.capture import SessionView
from undulog.capture.common.console import plain
from undulog.capture.common.errors import UsageError
from undulog.capture.common.palette import joint_hex

from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.answer import Answer, beyond
from ...results.comparison import Comparison
from ...results.estimate import Provenance
from ...results.experiment import Experiment
from ...session.cycles import CycleMaps
from .. import tables
from .artefacts import ArtefactRow, artefact_rows, command_response, flagged_joints, read_traces
from .comparison_view import comparison_view
from .experiment_view import experiment_view
from .maps import cycle_drawings
from .matrix import Entries, entries_of, matrix_picture
from .motion import body_motion
from .oscillators import ChainView, chain_views
from .segments import segments
from .svg import Drawing
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
from .trials import LEVEL_NOTE, Trial, session_trials


@dataclass(frozen=True)
class AnalysisView:
    """All that the template shows of one session.

    Attributes:
        answer: The answer in one sentence.
        notices: The first few warnings, cut to a line or two.
        signals: Command against response, or None.
        maps: Joints against cycles, or none.
        body: Head, middle, tail, or None.
        artefacts: What is wrong with samples, and when.
        flagged: Flag in the analysed cycles, and the joints that have it.
        entries: The coupling matrix, or none.
        matrix: Its picture, or None.
        chains: Couplings of the oscillators that drove it, one a plane.
    """

    analysis: Analysis
    answer: Answer
    notices: tuple[str, ...]
    facts: tuple[Fact, ...]
    marks: tuple[Markup, ...]
    trials: tuple[Trial, ...]
    segments: Drawing | None
    signals: Drawing | None
    maps: tuple[Drawing, ...]
    body: Drawing | None
    artefacts: tuple[ArtefactRow, ...]
    flagged: tuple[tuple[str, str], ...]
    entries: tuple[Entries, ...]
    matrix: Drawing | None
    chains: tuple[ChainView, ...]


def session_view(
    analysis: Analysis, session: SessionView | None, cycles: CycleMaps | None
) -> AnalysisView:
    """Prepare what the template shows of one session.

    Args:
        session: Open, or None.
        cycles: Its cycles, or None.
    """
    joints = analysis.joints
    colors = joint_hex(len(joints)) if joints else ()
    traces = read_traces(session, analysis) if session is not None else ()
    body = analysis.body
    driven = tuple(joint.name for joint in joints if is_driven(joint))
    told = analysis.answer
    others = [w for w in map(formats.sentence, analysis.warnings) if w not in told.detail]
    entries = entries_of(analysis.coupling, driven)
    return AnalysisView(
        analysis=analysis,
        answer=told,
        notices=tuple(cut(warning) for warning in others[:3]),
        facts=tuple(key_figures(analysis)),
        marks=tuple(
            joint_mark(color, joint.plane, driven=is_driven(joint))
            for color, joint in zip(colors, joints, strict=True)
        ),
        trials=session_trials(analysis.heterogeneity),
        segments=segments(joints, "segments-figure") if _anything(joints) else None,
        signals=command_response(traces, len(joints), "signals-figure") if traces else None,
        maps=() if cycles is None else cycle_drawings(cycles, "map"),
        artefacts=artefact_rows(analysis),
        flagged=flagged_joints(joints),
        body=body_motion(body, "body-figure") if body is not None and body.observed else None,
        entries=entries,
        matrix=matrix_picture(entries[0], "coupling-figure") if entries else None,
        chains=chain_views(analysis.oscillators),
    )


def _anything(joints: Sequence[JointResult]) -> bool:
    """Whether any joint has something that the figure of segments shows."""
    return any(
        v is not None for j in joints for v in (j.gain.value, j.energy_net_j, j.energy_abs_j)
    )


LARGEST_BYTES = 3_000_000
"""A page must open on a phone."""


def render(
    result: Analysis | Experiment | Comparison,
    session: SessionView | None = None,
    cycles: CycleMaps | None = None,
) -> str:
    """Write the report on one session, on several of an experiment, or on a comparison.

    A page that would be larger than ``LARGEST_BYTES`` goes without its largest part, and says so:
    of one session the signals and maps, of an experiment the numbers of every run.

    Args:
        session: The open session of an ``Analysis``, for what is drawn from its samples; None
            where it is not at hand.
        cycles: Of an ``Analysis``, from :func:`.analysis.session.cycles.cycle_maps`; None: no maps.

    Returns:
        One HTML page without outside references; the same input gives the same text.

    Raises:
        UsageError: If the page would be too large all the same.
    """
    page = _page(result, session, cycles, left_out=False)
    if len(page.encode()) > LARGEST_BYTES:
        page = _page(result, None, None, left_out=True)
    size = len(page.encode())
    if size > LARGEST_BYTES:
        count = _sessions(result)
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
    style = _template_text("style.css")
    if isinstance(result, Experiment):
        template, view = "experiment.html.j2", experiment_view(result)
    elif isinstance(result, Comparison):
        template, view = "comparison.html.j2", comparison_view(result)
    else:
        template, view = "session.html.j2", session_view(result, session, cycles)
    return (
        _environment()
        .get_template(template)
        .render(
            v=view,
            left_out=left_out,
            style=Markup(style),  # noqa: S704  our own file
            words=_glossary(),
            body_gradient=", ".join(joint_hex(9)),
            MISSING=formats.MISSING,
            LEVEL_NOTE=LEVEL_NOTE,
        )
    )


def _template_text(name: str) -> str:
    folder = files("undulog.analysis.present.page")
    return folder.joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _glossary() -> tuple[tuple[str, str], ...]:
    """Words of the results and their meanings: the rows of the manual's tables."""
    rows = re.findall(r"^\| (.+?) \| (.+) \|$", _template_text("glossary.md"), re.MULTILINE)
    links = re.compile(r"\[([^]]*)\]\([^)]*\)")
    return tuple(
        (word.replace("`", ""), re.sub(r"[`*]", "", links.sub(r"\1", meaning)))
        for word, meaning in rows
        if word != "word"
    )


def _sessions(result: Analysis | Experiment | Comparison) -> int:
    if isinstance(result, Comparison):
        return len(result.a) + len(result.b)
    return len(result.sessions) if isinstance(result, Experiment) else 1


def _shown(value: object) -> object:
    """A value of a template; text that isn't markup yet without control characters."""
    if isinstance(value, Markup) or not isinstance(value, str):
        return value
    return "\n".join(plain(line) for line in value.split("\n"))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("undulog.analysis.present.page"),
        autoescape=True,
        finalize=_shown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters: dict[str, Callable[..., object]] = {
        "number": formats.number,
        "utc": formats.utc,
        "plain": plain,
        "filename": formats.filename,
        "scaled": formats.scaled,
        "decimals": formats.decimals_for,
        "softer": softer,
        "typeset": typeset,
        "cut": cut,
        "digits": digits,
        "sentence": sentence,
        "again": _commands_to_make_it_again,
    }
    environment.filters.update(filters)
    functions: dict[str, Any] = {
        "tables": tables,
        "grid": grid,
        "num": number,
        "est": estimate,
        "p": p_value,
        "known": known,
    }
    environment.globals.update(functions)
    return environment


def _commands_to_make_it_again(provenance: Provenance) -> str:
    """The numbers again, and this page again; compare is one command for both."""
    command = plain(provenance.command)
    numbers = "undulog analyse "
    if not command.startswith(numbers):
        return f"{command} -o comparison.html"
    return f"{command}\nundulog report {command.removeprefix(numbers)} -o report.html"
