"""The page: one self-contained HTML file that answers first and proves after.

No script, no outside reference: style and figures are inside, and a content security policy
(W3C CSP3) makes the browser refuse anything else. Everything that comes from a log is escaped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from capture import Session
from capture.errors import UsageError
from capture.palette import joint_hex

from .. import formats
from ..answer import Answer, answer, answer_to_all
from ..result import Analysis, BodyPoint, Estimate, Index, JointResult
from .drawn import Drawing
from .driven import is_driven
from .matrix import coupling_matrix
from .motion import body_motion
from .segments import segments
from .signals import command_response, read_traces
from .tables import Column, Fact, energy_columns, key_figures, response_columns

LARGEST_BYTES = 3_000_000
"""A page must open on a phone."""


@dataclass(frozen=True)
class SessionView:
    """All that the template shows of one session.

    Attributes:
        key: Prefix of every identifier of this session in the page.
        analysis: The numbers.
        answer: The answer in one sentence.
        notices: The first few warnings, cut to a line or two.
        facts: Key figures.
        colors: One colour a joint.
        response: Columns of the table of responses.
        energy: Columns of the table of energies.
        segments: Gain, lag and energy.
        signals: Command against response, or None.
        body: Head, middle, tail, or None.
        matrix: Coupling, or None.
    """

    key: str
    analysis: Analysis
    answer: Answer
    notices: tuple[str, ...]
    facts: tuple[Fact, ...]
    colors: tuple[str, ...]
    response: tuple[Column, ...]
    energy: tuple[Column, ...]
    segments: Drawing | None
    signals: Drawing | None
    body: Drawing | None
    matrix: Drawing | None


def render(
    analyses: Analysis | Sequence[Analysis],
    sessions: Session | Sequence[Session | None] | None = None,
) -> str:
    """Write the report on one or several sessions.

    A page that would be larger than ``LARGEST_BYTES`` goes without signal plots, and says so.

    Args:
        analyses: The results, one a session.
        sessions: The open sessions in the same order, for the signal plots; None where a session
            is not at hand.

    Returns:
        One HTML page without outside references; the same input gives the same text.

    Raises:
        ValueError: If there is no analysis, or not one session an analysis.
        UsageError: If the page would be too large without signal plots, too.
    """
    results = [analyses] if isinstance(analyses, Analysis) else list(analyses)
    if sessions is None:
        opened: list[Session | None] = [None] * len(results)
    elif isinstance(sessions, Session):
        opened = [sessions]
    else:
        opened = list(sessions)
    if not results or len(results) != len(opened):
        raise ValueError(f"{len(results)} analyses and {len(opened)} sessions: one each, please")
    page = _page(results, opened)
    if len(page.encode()) > LARGEST_BYTES:
        page = _page(results, [None] * len(results), left_out=True)
    size = len(page.encode())
    if size > LARGEST_BYTES:
        raise UsageError(
            f"{len(results)} sessions make a page of {size / 1e6:.1f} MB, more than "
            f"{LARGEST_BYTES / 1e6:g} MB: put fewer on a page"
        )
    return page


def _page(
    results: Sequence[Analysis], sessions: Sequence[Session | None], *, left_out: bool = False
) -> str:
    views = [
        view(result, session, f"s{k + 1}")
        for k, (result, session) in enumerate(zip(results, sessions, strict=True))
    ]
    environment = Environment(
        loader=PackageLoader("analysis.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters: dict[str, Callable[..., object]] = {
        "number": formats.number,
        "utc": formats.utc,
        "plain": formats.plain,
        "filename": _filename,
        "p_value": formats.p_value,
        "degrees": formats.degrees,
        "scaled": formats.scaled,
        "softer": _softer,
        "points": _point_rows,
        "index": _index_row,
        "driven": is_driven,
        "sentence": formats.sentence,
        "again": _commands_to_make_it_again,
    }
    environment.filters.update(filters)
    style = files("analysis.report").joinpath("templates/style.css").read_text(encoding="utf-8")
    return environment.get_template("page.html.j2").render(
        views=views,
        headline=views[0].answer if len(views) == 1 else answer_to_all([v.answer for v in views]),
        style=Markup(style),  # noqa: S704  our own file
        body_gradient=", ".join(joint_hex(9)),
        left_out=left_out,
        MISSING=formats.MISSING,
    )


def view(analysis: Analysis, session: Session | None, key: str) -> SessionView:
    """Prepare what the template shows of one session.

    Args:
        analysis: The numbers.
        session: Open, or None.
        key: Prefix of every identifier, unique in the page.

    Returns:
        The view.
    """
    joints = analysis.joints
    traces = read_traces(session, analysis) if session is not None else ()
    body, matrix = analysis.body, analysis.coupling.matrix
    driven = [joint.name for joint in joints if is_driven(joint)]
    told = answer(analysis)
    others = [w for w in map(formats.sentence, analysis.warnings) if w not in told.detail]
    return SessionView(
        key=key,
        analysis=analysis,
        answer=told,
        notices=tuple(_cut(warning) for warning in others[:3]),
        facts=tuple(key_figures(analysis)),
        colors=joint_hex(len(joints)) if joints else (),
        response=response_columns(joints),
        energy=energy_columns(joints),
        segments=segments(joints, f"{key}-segments") if _anything(joints) else None,
        signals=command_response(traces, len(joints), f"{key}-signals") if traces else None,
        body=body_motion(body, f"{key}-body") if body is not None and body.observed else None,
        matrix=coupling_matrix(matrix, driven, f"{key}-coupling") if matrix is not None else None,
    )


def _anything(joints: Sequence[JointResult]) -> bool:
    """Whether any joint has something that the figure of segments shows."""
    return any(
        v is not None for j in joints for v in (j.gain.value, j.energy_net_j, j.energy_abs_j)
    )


def _softer(sentence: str) -> Markup:
    """Set the intervals of a sentence smaller, so that the sentence is read first."""
    escaped = str(escape(formats.plain(sentence)))
    parts: list[str] = []
    rest = escaped
    while (start := rest.find("[")) >= 0 and (stop := rest.find("]", start)) >= 0:
        parts += [rest[:start], '<span class="ci">', rest[start : stop + 1], "</span>"]
        rest = rest[stop + 1 :]
    return Markup("".join([*parts, rest]))  # noqa: S704  escaped above


def _filename(path: str) -> str:
    """Last part of a path of any system."""
    return formats.plain(path.replace("\\", "/").rstrip("/").rpartition("/")[2] or path)


def _cut(text: str, most: int = 130) -> str:
    """The beginning of a long sentence, up to a whole word."""
    if len(text) <= most:
        return text
    return text[:most].rpartition(" ")[0] + " \N{HORIZONTAL ELLIPSIS}"


def _commands_to_make_it_again(analysis: Analysis) -> str:
    """The numbers again, and this page again: both verbs take the same options."""
    command = formats.plain(analysis.provenance.command)
    numbers = "undulog analyse "
    if not command.startswith(numbers):
        return command
    return f"{command}\nundulog report {command.removeprefix(numbers)} -o report.html"


def _point_rows(analysis: Analysis) -> list[tuple[str, BodyPoint]]:
    """Observed points and their nulls, place by place: label and point."""
    body = analysis.body
    if body is None:
        return []
    rows: list[tuple[str, BodyPoint]] = []
    for point in body.observed:
        rows.append(("measured", point))
        for name, nulls in body.null.items():
            rows += [(f"perfect tracking, {name}", n) for n in nulls if n.place == point.place]
    return rows


def _index_row(index: Index) -> tuple[Estimate, str, int]:
    """An index in the unit people read: value, unit, decimals."""
    quantity = Estimate(index.value, index.ci95)
    unit = index.unit
    if unit == "rad":
        quantity, unit = formats.degrees(quantity), "°"
    elif unit == "1":
        unit = ""
    return quantity, unit, formats.decimals_for([quantity], least=0)
