"""Results to files and back, their pictures, and what a notebook shows of them."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import types
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cache, partial
from html import escape
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union, cast, get_args, get_origin, get_type_hints

from undulog.capture.common.console import plain, refuse_existing
from undulog.capture.common.errors import DataError, MissingExtraError, UsageError
from undulog.capture.common.files import check_output, part_file, read_input, write_text
from undulog.capture.common.untrusted_text import read_json

from ..common import formats
from ..common.estimate import Estimate, PresentedResult
from ..common.formats import degrees, relative
from ..experiment.answer import kick_answer, kick_detail, pair_order, sweep_answer, sweep_detail
from ..results.analysis import Analysis, interval_key
from ..results.comparison import Comparison
from ..results.coupling import Coupling, LinearCoupling, LocalCoupling
from ..results.experiment import Experiment, Reversal
from .data_frames import frames_of as frames
from .text import render, unidentified
from .text_experiment import render_comparison, render_experiment, reversal_detail

if TYPE_CHECKING:
    from .svg import Drawing

__all__ = ["frames", "headline", "html", "load", "picture", "save", "save_tables", "text"]


_KINDS: tuple[type[PresentedResult], ...] = (
    Analysis,
    Experiment,
    Comparison,
    Reversal,
    LocalCoupling,
    LinearCoupling,
    Coupling,
)

MOST_ROWS = 40
"""Rows of a table that a notebook shows."""

_ROOT = re.compile(r":root\s*\{([^}]*)\}")
_VARIABLE = re.compile(r"--([\w-]+):\s*([^;]+);")


_number = count(1)
"""Figures are numbered, so that two of a notebook share no identifiers."""

Pictures = dict[str, "Callable[[str], Drawing]"]


def save(result: PresentedResult, path: Path, *, force: bool) -> Path:
    """Write a result as JSON; see :meth:`.analysis.common.estimate.PresentedResult.save`."""
    check_output(path, (".json",), "the result file is JSON; end its name in .json", force=force)
    write_text(path, json.dumps(result.to_dict(), indent=2, allow_nan=False) + "\n")
    return path


def save_tables(result: PresentedResult, folder: Path, *, force: bool) -> list[Path]:
    """Write the tables as Parquet; see :meth:`.PresentedResult.to_parquet`."""
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

    Args:
        path: A JSON file.

    Returns:
        The result, equal to the one that was written.

    Example::

        undulog.analyse("run.mcap").save("result.json")
        result = undulog.load("result.json")

    Raises:
        InputFileError: If it isn't there or can't be read.
        DataError: If it holds no result.
    """
    path = Path(path)
    try:
        data: Any = read_json(read_input(path))
    except ValueError as error:
        raise DataError(f"{path}: not JSON: {error}") from error
    for kind in _KINDS:
        if isinstance(data, dict) and _required(kind) <= set(cast("dict[str, Any]", data)):
            try:
                return cast("PresentedResult", _build(kind, data))
            except (KeyError, OverflowError, TypeError, ValueError) as error:
                raise DataError(f"{path}: a damaged {kind.__name__}: {error!r}") from error
    kinds = ", ".join(kind.__name__ for kind in _KINDS)
    raise DataError(f"{path}: holds no result; known are {kinds}")


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
        return _build(next(argument for argument in arguments if argument is not type(None)), value)
    if origin in (tuple, dict) or dataclasses.is_dataclass(kind):
        _require(list if origin is tuple else dict, kind, value)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return tuple(_build(arguments[0], part) for part in value)
        return tuple(
            _build(argument, part) for argument, part in zip(arguments, value, strict=True)
        )
    if origin is dict:
        return {key: _build(arguments[1], part) for key, part in value.items()}
    return _dataclass(kind, value) if dataclasses.is_dataclass(kind) else _plain(kind, value)


def _require(container: type, kind: Any, value: object) -> None:
    if not isinstance(value, container):
        raise TypeError(f"{value!r:.40} where {kind} is expected")


def _plain(kind: type[Any], value: Any) -> Any:
    if issubclass(kind, Enum):
        return kind(value)
    accepted = (int, float) if kind is float else kind
    wrong = isinstance(value, bool) and kind is not bool
    if wrong or not isinstance(value, accepted) or (kind is float and not math.isfinite(value)):
        raise TypeError(f"{value!r:.40} where {kind.__name__} is expected")
    return float(value) if kind is float else value


def _dataclass(kind: Any, data: dict[str, Any]) -> Any:
    """Build the matching kind with the most fields."""
    fitting = [
        candidate
        for candidate in (kind, *kind.__subclasses__())
        if _required(candidate) <= set(data)
    ]
    chosen = max(fitting, key=lambda candidate: len(dataclasses.fields(candidate)), default=kind)
    hints = get_type_hints(chosen)
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
    if issubclass(chosen, Analysis):
        others = {name: data[name] for name in data if name not in hints}
        built["more"] = {name: _of_part(name, value) for name, value in others.items()}
    return chosen(**built)


def _of_part(name: str, value: Any) -> Any:
    """Return the result of a part that another package adds; plain values where it isn't there."""
    from ..session.added_parts import added_parts

    part = next((part for part in added_parts() if part.name == name), None)
    return value if part is None else _build(part.result, value)


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


@dataclass(frozen=True, repr=False)
class Picture:
    """A figure of the report by itself.

    Attributes:
        svg: The ``<svg>`` element; its colours are the page's variables.
        caption: One or two sentences, plain text.
    """

    svg: str
    caption: str

    def __repr__(self) -> str:
        """Return the caption."""
        return f"<Picture: {plain(self.caption)}>"

    def _repr_html_(self) -> str:
        """Return the figure on paper, whatever the notebook's theme, and its caption."""
        colors = "".join(f"--{name}:{value};" for name, value in paper_colors().items())
        rules = f"<style>{figure_rules()}</style>"
        style = f"{colors}background:var(--paper);color:var(--ink);max-width:60rem;padding:.5rem"
        return (
            f'<figure style="{style};margin:0">{rules}{self.svg}<figcaption>{escape(self.caption)}'
            "</figcaption></figure>"
        )

    def to_svg(self) -> str:
        """Return the text of an SVG file, with colours instead of variables, on paper."""
        name = 'xmlns="http://www.w3.org/2000/svg"'
        svg = self.svg.replace("<svg ", f"<svg {name} ", 1)
        inside = svg.index(">") + 1
        paper = '<rect width="100%" height="100%" style="fill: var(--paper)"/>'
        svg = f"{svg[:inside]}<style>{figure_rules()}</style>{paper}{svg[inside:]}\n"
        for name, value in paper_colors().items():
            svg = svg.replace(f"var(--{name})", value)
        return svg

    def save(self, path: Path | str, *, force: bool = False) -> Path:
        """Write the figure.

        Args:
            path: A name that ends in .svg.
            force: Replace the file if it exists.

        Raises:
            UsageError: If the name ends in anything else.
            OutputExistsError: If it is there and ``force`` is not given.
            LogWriteError: If it can't be written.
        """
        path = Path(path)
        check_output(path, (".svg",), "pictures are SVG; end the name in .svg", force=force)
        write_text(path, self.to_svg())
        return path


@cache
def paper_colors() -> dict[str, str]:
    """Return the report's colours on light ground, by name of the variable."""
    light = _ROOT.search(_style())
    return dict(_VARIABLE.findall(light[1])) if light is not None else {}


@cache
def figure_rules() -> str:
    """Return the report's CSS rules for figures, whose selectors all begin with ``svg.``."""
    return "\n".join(line for line in _style().splitlines() if line.startswith("svg."))


def _style() -> str:
    folder = files("undulog.analysis.present")
    return folder.joinpath("templates", "style.css").read_text(encoding="utf-8")


def picture(result: object, what: str | None = None) -> Picture:
    """Draw a result; see :meth:`.analysis.common.estimate.PresentedResult.plot`.

    Args:
        result: A result of this package.
        what: Which picture; the first by default.

    Raises:
        UsageError: If there is no such picture; the message lists those that are.
        MissingExtraError: If matplotlib is not installed.
    """
    try:
        pictures = pictures_of(result)
        name = next(iter(pictures)) if what is None else what
        if name not in pictures:
            raise UsageError(
                f"there is no picture {name!r} of it; there are: {', '.join(pictures)}"
            )
        drawing = pictures[name](f"figure{next(_number)}")
    except ImportError as error:
        raise MissingExtraError("plot()", "report", "matplotlib") from error
    return Picture(drawing.svg, drawing.caption)


def pictures_of(result: object) -> Pictures:
    """Return the pictures of a result.

    Returns:
        Name to a function that draws it, given a prefix for identifiers; the main one first.

    Raises:
        UsageError: If it has none.
    """
    match result:
        case Analysis():
            return _of_analysis(result)
        case Experiment():
            return _of_experiment(result)
        case Comparison():
            return _of_comparison(result)
        case Reversal():
            return {"mirror": partial(_mirror_differences, result)}
        case Coupling() if result.matrix is None:
            raise UsageError(f"{result!r}: there is no matrix to draw")
        case Coupling():
            from .matrix import entries_of, matrix_picture

            return {
                entries.symbol: partial(matrix_picture, entries)
                for entries in entries_of(result, ())
            }
        case _:
            raise UsageError(f"{result!r}: nothing in it can be drawn")


def _of_analysis(result: Analysis) -> Pictures:
    from .segments import body_motion, segments

    body = {} if result.body is None else {"body": partial(body_motion, result.body)}
    return {"segments": partial(segments, result.joints, tracking=result.tracking), **body}


def _of_experiment(result: Experiment) -> Pictures:
    from .experiment_view import mirror_profile, profiles

    reversal = result.reversal
    pictures: Pictures = {}
    if reversal is not None:
        pictures["mirror"] = partial(mirror_profile, profiles(result, reversal), reversal)
    if result.coupling.matrix is not None:
        pictures |= pictures_of(result.coupling)
    if not pictures:
        raise UsageError(f"{result!r}: nothing to draw together; plot its sessions one by one")
    return pictures


def _of_comparison(result: Comparison) -> Pictures:
    from .comparison_view import differences_of, waveforms_drawing

    waves = {"waveforms": partial(waveforms_drawing, result)} if result.waveforms else {}
    return {"differences": partial(differences_of, result), **waves}


def _mirror_differences(result: Reversal, prefix: str) -> Drawing:
    from .comparison_view import Panel, differences_drawing

    gains = [relative(joint.log_gain_difference) for joint in result.joints]
    lags = [degrees(joint.lag_difference_rad) for joint in result.joints]
    return differences_drawing(
        [joint.name for joint in result.joints],
        [Panel("gain [%]", gains, 2.0), Panel("lag [°]", lags, 1.0)],
        title="Each joint against its mirror joint with the wave reversed",
        prefix=prefix,
    )
