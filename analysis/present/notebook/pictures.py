"""Pictures of results for notebooks and files."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from html import escape
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from undulog.capture.common.console import plain
from undulog.capture.common.errors import MissingExtraError, UsageError
from undulog.capture.common.files import check_output, write_text

from ...results.analysis import Analysis
from ...results.comparison import Comparison
from ...results.coupling import Coupling
from ...results.experiment import Experiment, Reversal
from ...results.formats import degrees, relative

if TYPE_CHECKING:
    from ..page.svg import Drawing


_ROOT = re.compile(r":root\s*\{([^}]*)\}")
_VARIABLE = re.compile(r"--([\w-]+):\s*([^;]+);")


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
    folder = files("undulog.analysis.present.page")
    return folder.joinpath("templates", "style.css").read_text(encoding="utf-8")


_number = count(1)
"""Figures are numbered, so that two of a notebook share no identifiers."""


def picture_of(result: object, what: str | None = None) -> Picture:
    """Draw a result; see :meth:`.analysis.results.shown.PresentedResult.plot`.

    Args:
        result: A result of this package.
        what: Which picture; the first by default.

    Raises:
        UsageError: If there is no such picture; the message lists those that are.
        MissingExtraError: If matplotlib is not installed.
    """
    try:
        known = pictures_of(result)
        name = next(iter(known)) if what is None else what
        if name not in known:
            raise UsageError(f"there is no picture {name!r} of it; there are: {', '.join(known)}")
        drawing = known[name](f"figure{next(_number)}")
    except ImportError as error:
        raise MissingExtraError("plot()", "report", "matplotlib") from error
    return Picture(drawing.svg, drawing.caption)


Pictures = dict[str, "Callable[[str], Drawing]"]


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
            from ..page.matrix import entries_of, matrix_picture

            return {one.symbol: partial(matrix_picture, one) for one in entries_of(result, ())}
        case _:
            raise UsageError(f"{result!r}: nothing in it can be drawn")


def _of_analysis(result: Analysis) -> Pictures:
    from ..page.segments import body_motion, segments

    body = {} if result.body is None else {"body": partial(body_motion, result.body)}
    return {"segments": partial(segments, result.joints), **body}


def _of_experiment(result: Experiment) -> Pictures:
    from ..page.experiment_view import mirror_profile, profiles

    reversal = result.reversal
    known: Pictures = {}
    if reversal is not None:
        known["mirror"] = partial(mirror_profile, profiles(result, reversal), reversal)
    if result.coupling.matrix is not None:
        known |= pictures_of(result.coupling)
    if not known:
        raise UsageError(f"{result!r}: nothing to draw together; plot its sessions one by one")
    return known


def _of_comparison(result: Comparison) -> Pictures:
    from ..page.comparison_view import differences_of, waveforms_drawing

    waves = {"waveforms": partial(waveforms_drawing, result)} if result.waveforms else {}
    return {"differences": partial(differences_of, result), **waves}


def _mirror_differences(result: Reversal, prefix: str) -> Drawing:
    from ..page.comparison_view import Panel, differences_drawing

    gains = [relative(one.log_gain_difference) for one in result.joints]
    lags = [degrees(one.lag_difference_rad) for one in result.joints]
    return differences_drawing(
        [one.name for one in result.joints],
        [Panel("gain [%]", gains, 2.0), Panel("lag [°]", lags, 1.0)],
        title="Each joint against its mirror joint with the wave reversed",
        prefix=prefix,
    )
