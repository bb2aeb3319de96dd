"""The page: one self-contained HTML file that answers first and proves after.

No script, no outside reference: style and figures are inside, and a content security policy
(W3C CSP3) makes the browser refuse anything else. Everything that comes from a log is escaped.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from undulog.capture import Session
from undulog.capture.common.console import plain
from undulog.capture.common.errors import UsageError
from undulog.capture.common.palette import joint_hex

from ...results import formats
from ...results.analysis import Analysis, BodyPoint, Index
from ...results.comparison import Comparison
from ...results.deciding import beyond
from ...results.estimate import Estimate, Provenance
from ...results.experiment import Experiment
from ...session.cycles import CycleMaps
from .comparison_view import comparison_view
from .driven import is_driven
from .experiment_view import experiment_view
from .session_view import session_view
from .trials import LEVEL_NOTE
from .typeset import cut, digits, sentence, softer, typeset

LARGEST_BYTES = 3_000_000
"""A page must open on a phone."""


def render(
    result: Analysis | Experiment | Comparison,
    session: Session | None = None,
    cycles: CycleMaps | None = None,
) -> str:
    """Write the report on one session, on several of an experiment, or on a comparison.

    A page that would be larger than ``LARGEST_BYTES`` goes without its largest part, and says so:
    of one session the signals and maps, of an experiment the numbers of every run.

    Args:
        result: The numbers.
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
    session: Session | None,
    cycles: CycleMaps | None,
    *,
    left_out: bool,
) -> str:
    style = (
        files("undulog.analysis.present.page")
        .joinpath("templates/style.css")
        .read_text(encoding="utf-8")
    )
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
            body_gradient=", ".join(joint_hex(9)),
            MISSING=formats.MISSING,
            LEVEL_NOTE=LEVEL_NOTE,
        )
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
        "p_value": formats.p_value,
        "degrees": formats.degrees,
        "scaled": formats.scaled,
        "relative": formats.relative,
        "decimals": formats.decimals_for,
        "softer": softer,
        "typeset": typeset,
        "cut": cut,
        "digits": digits,
        "points": _point_rows,
        "index": _index_row,
        "driven": is_driven,
        "sentence": sentence,
        "again": _commands_to_make_it_again,
    }
    environment.filters.update(filters)
    return environment


def _commands_to_make_it_again(provenance: Provenance) -> str:
    """The numbers again, and this page again; compare is one verb for both."""
    command = plain(provenance.command)
    numbers = "undulog analyse "
    if not command.startswith(numbers):
        return f"{command} -o comparison.html"
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
