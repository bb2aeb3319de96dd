"""Results to files and back, and as a notebook shows them."""

from __future__ import annotations

import dataclasses
import json
import math
import types
from collections.abc import Iterable
from enum import Enum
from html import escape
from pathlib import Path
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

from undulog.capture.common.console import plain, refuse_existing
from undulog.capture.common.errors import DataError, MissingExtraError
from undulog.capture.common.files import check_output, part_file, read_input, write_text

from ...experiment.answer import kick_answer, kick_detail, pair_order, sweep_answer, sweep_detail
from ...results import analysis, formats, oscillators
from ...results.analysis import Analysis, interval_key
from ...results.comparison import Comparison
from ...results.coupling import Coupling, LinearCoupling, LocalCoupling
from ...results.estimate import Estimate
from ...results.experiment import Experiment, Reversal
from ...results.shown import PresentedResult
from ..text import render, unidentified
from ..text_experiment import render_comparison, render_experiment, reversal_detail
from .frames import frames_of as frames
from .pictures import picture_of as picture

__all__ = ["frames", "headline", "html", "load", "picture", "save", "save_tables", "text"]


_NAMES = {**vars(oscillators), **vars(analysis)}
"""Types that :mod:`.analysis.results.analysis` names for type checkers only."""

_KINDS: tuple[type[PresentedResult], ...] = (
    Analysis,
    Experiment,
    Comparison,
    Reversal,
    LocalCoupling,
    LinearCoupling,
    Coupling,
)


def save(result: PresentedResult, path: Path, *, force: bool) -> Path:
    """Write a result as JSON; see :meth:`.analysis.results.shown.PresentedResult.save`."""
    check_output(path, (".json",), "the result file is JSON; end its name in .json", force=force)
    write_text(path, json.dumps(result.to_dict(), indent=2, allow_nan=False) + "\n")
    return path


def save_tables(result: PresentedResult, folder: Path, *, force: bool) -> list[Path]:
    """Write the tables as Parquet; see :meth:`.results.shown.PresentedResult.to_parquet`."""
    frames = result.frames()
    folder.mkdir(parents=True, exist_ok=True)
    paths = {folder / f"{name}.parquet": frame for name, frame in frames.items()}
    for path in paths:
        refuse_existing(path, force=force)
    for path, frame in paths.items():
        with part_file(path) as part:
            try:
                frame.to_parquet(part, index=False, engine="pyarrow")
            except ImportError as error:
                raise MissingExtraError("to_parquet()", "parquet", "pyarrow") from error
    return list(paths)


def load(path: Path | str) -> PresentedResult:
    """Read a result that ``save`` wrote, or ``undulog analyse`` and ``compare`` with ``-o``.

    Returns:
        The result, equal to the one that was written.

    Raises:
        InputFileError: If it isn't there or can't be read.
        DataError: If it holds no result.
    """
    path = Path(path)
    try:
        data: Any = json.loads(read_input(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not JSON: {error}") from error
    for kind in _KINDS:
        if isinstance(data, dict) and _required(kind) <= set(cast("dict[str, Any]", data)):
            try:
                return cast("PresentedResult", _build(kind, data))
            except (KeyError, OverflowError, TypeError, ValueError) as error:
                raise DataError(f"{path}: a damaged {kind.__name__}: {error!r}") from error
    known = ", ".join(kind.__name__ for kind in _KINDS)
    raise DataError(f"{path}: holds no result; known are {known}")


def _required(kind: type[Any]) -> set[str]:
    return {
        field.name
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }


def _build(kind: Any, value: Any) -> Any:  # noqa: PLR0911 - one kind of type a line
    """Return a value of an annotated type from plain JSON values."""
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if value is None:
        if types.NoneType not in arguments:
            raise TypeError(f"null where {kind} is expected")
        return None
    if origin in (Union, types.UnionType):
        return _build(next(one for one in arguments if one is not type(None)), value)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return tuple(_build(arguments[0], one) for one in value)
        return tuple(_build(one, part) for one, part in zip(arguments, value, strict=True))
    if origin is dict:
        return {key: _build(arguments[1], one) for key, one in value.items()}
    return _dataclass(kind, value) if dataclasses.is_dataclass(kind) else _plain(kind, value)


def _plain(kind: type[Any], value: Any) -> Any:
    if issubclass(kind, Enum):
        return kind(value)
    wanted = (int, float) if kind is float else kind
    wrong = isinstance(value, bool) and kind is not bool
    if wrong or not isinstance(value, wanted) or (kind is float and not math.isfinite(value)):
        raise TypeError(f"{value!r:.40} where {kind.__name__} is expected")
    return float(value) if kind is float else value


def _dataclass(kind: Any, data: dict[str, Any]) -> Any:
    """Build the matching kind with the most fields."""
    fitting = [one for one in (kind, *kind.__subclasses__()) if _required(one) <= set(data)]
    chosen = max(fitting, key=lambda one: len(dataclasses.fields(one)), default=kind)
    hints = get_type_hints(chosen, localns=_NAMES)
    built: dict[str, Any] = {}
    for field in dataclasses.fields(chosen):
        name = field.name
        if name not in data:
            continue
        if hints[name] is Estimate and not isinstance(data[name], dict):
            hint = get_type_hints(Estimate)
            value = _build(hint["value"], data[name])
            built[name] = Estimate(value, _build(hint["ci95"], data[interval_key(name)]))
        else:
            built[name] = _build(hints[name], data[name])
    return chosen(**built)


MOST_ROWS = 40
"""Rows of a table that a notebook shows."""


def headline(result: object) -> str:  # noqa: PLR0911 - one kind of result a case
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


def text(result: object) -> str:
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
    return "\n".join(map(plain, [headline(result), *detail]))


def html(result: Any) -> str:
    """Return the answer, the first table, and the warnings, for a notebook; all text escaped."""
    answer = escape(plain(headline(result)))
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
