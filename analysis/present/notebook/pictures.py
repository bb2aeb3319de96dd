"""Which pictures a result has."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial, singledispatch
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
    from ..page.matrix import Entries
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
        """The caption."""
        return f"<Picture: {plain(self.caption)}>"

    def _repr_html_(self) -> str:
        """The figure on paper, whatever the notebook's theme, and its caption."""
        colors = "".join(f"--{name}:{value};" for name, value in paper_colors().items())
        rules = f"<style>{figure_rules()}</style>"
        style = f"{colors}background:var(--paper);color:var(--ink);max-width:60rem;padding:.5rem"
        return (
            f'<figure style="{style};margin:0">{rules}{self.svg}<figcaption>{escape(self.caption)}'
            "</figcaption></figure>"
        )

    def to_svg(self) -> str:
        """The figure as a file of its own.

        Returns:
            SVG with colours in the place of variables, on paper.
        """
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


def of(drawing: Drawing) -> Picture:
    """A figure of the report as a picture."""
    return Picture(drawing.svg, drawing.caption)


@cache
def paper_colors() -> dict[str, str]:
    """The report's colours on light ground.

    Returns:
        Name of a variable to colour.
    """
    light = _ROOT.search(_style())
    return dict(_VARIABLE.findall(light[1])) if light is not None else {}


@cache
def figure_rules() -> str:
    """The report's rules for what is inside its figures.

    Returns:
        CSS whose selectors all begin with ``svg.``.
    """
    return "\n".join(line for line in _style().splitlines() if line.startswith("svg."))


def _style() -> str:
    return (
        files("undulog.analysis.present.page")
        .joinpath("templates/style.css")
        .read_text(encoding="utf-8")
    )


_number = count(1)
"""Identifiers of a figure are its own in a notebook: figures are numbered as they are drawn."""


def picture_of(result: object, what: str | None = None) -> Picture:
    """Draw a result; see :meth:`.analysis.results.shown.PresentedResult.plot`.

    Args:
        result: A result of this package.
        what: Which picture; the first by default.

    Raises:
        UsageError: If there is no such picture; the message lists those that are.
        MissingExtraError: If matplotlib is not installed.
    """
    known = pictures_of(result)
    name = next(iter(known)) if what is None else what
    if name not in known:
        raise UsageError(f"there is no picture {name!r} of it; there are: {', '.join(known)}")
    try:
        return of(known[name](f"figure{next(_number)}"))
    except ImportError as error:
        raise MissingExtraError("plot()", "report", "matplotlib") from error


Pictures = dict[str, "Callable[[str], Drawing]"]


@singledispatch
def pictures_of(result: object) -> Pictures:
    """The pictures that a result has.

    Args:
        result: A result of this package.

    Returns:
        Name to what draws it, given a prefix for identifiers; the most telling first.

    Raises:
        UsageError: If it has none.
    """
    raise UsageError(f"{result!r}: nothing in it can be drawn")


@pictures_of.register(Analysis)
def _(result: Analysis) -> Pictures:
    def draw(prefix: str) -> Drawing:
        from ..page.segments import segments

        return segments(result.joints, prefix)

    body = result.body
    if body is None:
        return {"segments": draw}

    def move(prefix: str) -> Drawing:
        from ..page.motion import body_motion

        return body_motion(body, prefix)

    return {"segments": draw, "body": move}


@pictures_of.register(Experiment)
def _(result: Experiment) -> Pictures:
    reversal = result.reversal
    known: Pictures = {}
    if reversal is not None:

        def mirror(prefix: str) -> Drawing:
            from ..page.mirror import mirror_profile, profiles

            return mirror_profile(profiles(result, reversal), reversal, prefix)

        known["mirror"] = mirror
    if result.coupling.matrix is not None:
        known |= pictures_of(result.coupling)
    if not known:
        raise UsageError(f"{result!r}: nothing to draw together; plot its sessions one by one")
    return known


@pictures_of.register(Coupling)
def _(result: Coupling) -> Pictures:
    if result.matrix is None:
        raise UsageError(f"{result!r}: there is no matrix to draw")
    from ..page.matrix import entries_of

    return {one.symbol: partial(_matrix, one) for one in entries_of(result, ())}


@pictures_of.register(Reversal)
def _(result: Reversal) -> Pictures:
    def draw(prefix: str) -> Drawing:
        from ..page.comparison_view import Panel, differences_drawing

        gains = [relative(one.log_gain_difference) for one in result.joints]
        lags = [degrees(one.lag_difference_rad) for one in result.joints]
        return differences_drawing(
            [one.name for one in result.joints],
            [Panel("gain [%]", gains, 2.0), Panel("lag [°]", lags, 1.0)],
            title="Each joint against its mirror joint with the wave reversed",
            prefix=prefix,
        )

    return {"mirror": draw}


@pictures_of.register(Comparison)
def _(result: Comparison) -> Pictures:
    def differences(prefix: str) -> Drawing:
        from ..page.comparison_view import differences_of

        return differences_of(result, prefix)

    def waveforms(prefix: str) -> Drawing:
        from ..page.motion import waveforms_drawing

        return waveforms_drawing(result, prefix)

    return {"differences": differences} | ({"waveforms": waveforms} if result.waveforms else {})


def _matrix(entries: Entries, prefix: str) -> Drawing:
    from ..page.matrix import matrix_picture

    return matrix_picture(entries, prefix)
