"""Results as text and as a notebook's HTML."""

from __future__ import annotations

from functools import singledispatch
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture.common.console import plain

from ...experiment.answer import kick_answer, kick_detail, pair_order, sweep_answer, sweep_detail
from ...results import formats
from ...results.analysis import Analysis
from ...results.comparison import Comparison
from ...results.coupling import Coupling, LinearCoupling, LocalCoupling
from ...results.experiment import Experiment, Reversal
from ..text import render
from ..text_experiment import render_comparison, render_experiment, reversal_detail

if TYPE_CHECKING:
    import pandas as pd

    from ...results.shown import PresentedResult
    from .pictures import Picture


class Presenter:
    """A :class:`.Presentation`; each method imports what it needs when called."""

    def text(self, result: PresentedResult) -> str:  # noqa: D102

        return text_of(result)

    def headline(self, result: PresentedResult) -> str:  # noqa: D102

        return headline_of(result)

    def html(self, result: PresentedResult) -> str:  # noqa: D102

        return html_of(result)

    def frames(self, result: PresentedResult) -> dict[str, pd.DataFrame]:  # noqa: D102
        from .frames import frames_of

        return frames_of(result)

    def picture(self, result: PresentedResult, what: str | None) -> Picture:  # noqa: D102
        from .pictures import picture_of

        return picture_of(result, what)

    def save(self, result: PresentedResult, path: Path, *, force: bool) -> Path:  # noqa: D102
        from .files import save

        return save(result, path, force=force)

    def save_tables(self, result: PresentedResult, folder: Path, *, force: bool) -> list[Path]:  # noqa: D102
        from .files import save_tables

        return save_tables(result, folder, force=force)


MOST_ROWS = 40
"""Rows of a table that a notebook shows."""


@singledispatch
def headline_of(result: object) -> str:
    """The answer in one line, the first of :func:`text_of`.

    Args:
        result: A result of this package.

    Returns:
        One line, without its end.

    Raises:
        TypeError: If it is no result.
    """
    raise TypeError(f"{type(result).__name__} is no result of analysis")


@headline_of.register
def _(result: Analysis) -> str:
    return f"{Path(result.session.path).name}: {result.answer.sentence}"


@headline_of.register
def _(result: Experiment) -> str:
    count = len(result.sessions)
    return f"{count} session{'s' if count > 1 else ''}: {result.answer}."


@headline_of.register
def _(result: Comparison) -> str:
    return f"{result.answer}."


@headline_of.register
def _(result: Reversal) -> str:
    runs = f"{result.forward_runs} + {result.reverse_runs} runs"
    differ = pair_order(result.pairs[0]) if result.pairs else "no pair is ordered"
    floor = "" if result.tilt.excluded or not result.pairs else ", or the floor is tilted"
    return f"Reversal, {runs}: {differ}{floor} ({formats.p_value_text(result.p)})"


@headline_of.register
def _(result: Coupling) -> str:
    if not result.identifiable:
        record = f" To identify it, record {result.record}." if result.record else ""
        return f"Coupling: not identifiable: {result.why}.{record}"
    return f"Coupling: {result.why}"


@headline_of.register
def _(result: LocalCoupling) -> str:
    return kick_answer(result)


@headline_of.register
def _(result: LinearCoupling) -> str:
    return sweep_answer(result)


@singledispatch
def text_of(result: object) -> str:
    """A result as text, the answer first.

    Args:
        result: A result of this package.

    Raises:
        TypeError: If it is no result.
    """
    raise TypeError(f"{type(result).__name__} is no result of analysis")


@text_of.register
def _(result: Analysis) -> str:
    return render(result)


@text_of.register
def _(result: Experiment) -> str:
    return render_experiment(result)


@text_of.register
def _(result: Comparison) -> str:
    return render_comparison(result)


@text_of.register
def _(result: Reversal) -> str:
    return "\n".join(map(plain, [headline_of(result), *reversal_detail(result)]))


@text_of.register
def _(result: Coupling) -> str:
    return plain(headline_of(result))


@text_of.register
def _(result: LocalCoupling) -> str:
    return "\n".join(map(plain, [headline_of(result), *kick_detail(result)]))


@text_of.register
def _(result: LinearCoupling) -> str:
    return "\n".join(map(plain, [headline_of(result), *sweep_detail(result)]))


def html_of(result: Any) -> str:
    """What a notebook shows of a result.

    Args:
        result: A result of this package.

    Returns:
        The answer, the first table, and the warnings; names from logs are escaped.
    """
    told = escape(plain(headline_of(result)))
    name, frame = next(iter(result.frames().items()))
    clean = frame.head(MOST_ROWS).map(_readable)
    shown = clean.to_html(float_format="{:.4g}".format, index=False, na_rep="–")
    left = len(frame) - MOST_ROWS
    more = f", {left} more rows in frames()[{name!r}]" if left > 0 else ""
    said = ""
    for kind in ("warnings", "notes"):
        items = "".join(f"<li>{escape(plain(text))}</li>" for text in getattr(result, kind, ()))
        said += f"<details><summary>{kind}</summary><ul>{items}</ul></details>" if items else ""
    return f"<p><strong>{told}</strong></p><p>{escape(name)}{escape(more)}</p>{shown}{said}"


def _readable(cell: object) -> object:
    return plain(cell) if isinstance(cell, str) else cell
