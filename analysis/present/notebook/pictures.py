"""Which pictures a result has."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, singledispatch
from itertools import count
from typing import TYPE_CHECKING

from undulog.capture.common.errors import MissingExtraError, UsageError

from ...results.analysis import Analysis
from ...results.comparison import Comparison
from ...results.coupling import Coupling
from ...results.experiment import Experiment, Reversal
from ...results.formats import degrees, relative
from .picture import Picture, of

if TYPE_CHECKING:
    from ..page.drawn import Drawing
    from ..page.entries import Entries


_number = count(1)
"""Identifiers of a figure are its own in a notebook: figures are numbered as they are drawn."""


def picture_of(result: object, what: str | None = None) -> Picture:
    """Draw a result; see :meth:`.analysis.results.shown.Shown.plot`.

    Args:
        result: A result of this package.
        what: Which picture; the first by default.

    Returns:
        The picture.

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
    from ..page.entries import entries_of

    return {one.symbol: partial(_matrix, one) for one in entries_of(result, ())}


@pictures_of.register(Reversal)
def _(result: Reversal) -> Pictures:
    def draw(prefix: str) -> Drawing:
        from ..page.differences import Panel, differences_drawing

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
        from ..page.waveforms import waveforms_drawing

        return waveforms_drawing(result, prefix)

    return {"differences": differences} | ({"waveforms": waveforms} if result.waveforms else {})


def _matrix(entries: Entries, prefix: str) -> Drawing:
    from ..page.matrix import matrix_picture

    return matrix_picture(entries, prefix)
