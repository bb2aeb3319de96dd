"""Results as text and as a notebook's HTML."""

from __future__ import annotations

from collections.abc import Iterable
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
from ..text import render, unidentified
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


def headline_of(result: object) -> str:  # noqa: PLR0911 - one kind of result a case
    """Return the answer in one line, the first of :func:`text_of`.

    Raises:
        TypeError: If it is no result of this package.
    """
    match result:
        case Analysis():
            return f"{Path(result.session.path).name}: {result.answer.sentence}"
        case Experiment():
            count = len(result.sessions)
            return f"{count} session{'s' if count > 1 else ''}: {result.answer}."
        case Comparison():
            return f"{result.answer}."
        case Reversal():
            return _reversal_headline(result)
        case LocalCoupling():
            return kick_answer(result)
        case LinearCoupling():
            return sweep_answer(result)
        case Coupling():
            return f"Coupling: {result.why}" if result.identifiable else unidentified(result)
        case _:
            raise TypeError(f"{type(result).__name__} is no result of analysis")


def _reversal_headline(result: Reversal) -> str:
    runs = f"{result.forward_runs} + {result.reverse_runs} runs"
    differ = pair_order(result.pairs[0]) if result.pairs else "no pair is ordered"
    floor = "" if result.tilt.excluded or not result.pairs else ", or the floor is tilted"
    return f"Reversal, {runs}: {differ}{floor} ({formats.p_value_text(result.p)})"


def text_of(result: object) -> str:
    """Return a result as text, the answer first.

    Raises:
        TypeError: If it is no result of this package.
    """
    detail: Iterable[str] = ()
    match result:
        case Analysis():
            return render(result)
        case Experiment():
            return render_experiment(result)
        case Comparison():
            return render_comparison(result)
        case Reversal():
            detail = reversal_detail(result)
        case LocalCoupling():
            detail = kick_detail(result)
        case LinearCoupling():
            detail = sweep_detail(result)
        case _:
            pass
    return "\n".join(map(plain, [headline_of(result), *detail]))


def html_of(result: Any) -> str:
    """Return the answer, the first table, and the warnings, for a notebook; all text escaped."""
    answer = escape(plain(headline_of(result)))
    name, frame = next(iter(result.frames().items()))
    clean = frame.head(MOST_ROWS).map(_readable)
    shown = clean.to_html(float_format="{:.4g}".format, index=False, na_rep="–")
    left = len(frame) - MOST_ROWS
    more = f", {left} more rows in frames()[{name!r}]" if left > 0 else ""
    remarks = ""
    for kind in ("warnings", "notes"):
        items = "".join(f"<li>{escape(plain(text))}</li>" for text in getattr(result, kind, ()))
        remarks += f"<details><summary>{kind}</summary><ul>{items}</ul></details>" if items else ""
    return f"<p><strong>{answer}</strong></p><p>{escape(name)}{escape(more)}</p>{shown}{remarks}"


def _readable(cell: object) -> object:
    return plain(cell) if isinstance(cell, str) else cell
