"""The windows of a joint, judged beside its neighbours: whether it follows, stands or opposes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ..common.arrays import BoolArray, ComplexArray
from .fault import Span
from .motion import JointMotion, Response

COHERENT = 0.5
"""Explained share above which a window follows its command, with whatever gain and lag."""

NO_RESPONSE = 0.2
"""Gain, as a share of the common one, below which a window shows no response."""

STILL = 0.3
"""Motion, as a share of the usual one, below which a joint stands still."""

OPPOSITE_RAD = np.radians(150.0)
"""Phase against the common response beyond which a joint moves the opposite way."""

DEGREE = float(np.degrees(1.0))

UNIT_SLACK = 1.6
"""Factor within which a gain of 180/pi is a matter of units: a weak servo's gain is in it."""

NEIGHBOURS = 4
"""Joints that one joint is compared with: the nearest ones."""

MIN_WINDOWS = 5
"""Windows (two whole cycles) that a joint's own usual response needs."""

LOADED = 0.7
"""Gain below which a joint's neighbours are held back by a load: then it may be, too."""

MIN_SHARE = 0.5
"""A joint whose windows follow less than this share of the time has no usual response."""

_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Judged:
    """One joint's windows, judged.

    Attributes:
        motion: The joint's signals.
        response: Its response in each window.
        follows: Windows that follow the command, shape (w,).
        still: Windows in which the joint stands still, shape (w,).
        opposite: Windows in which it moves the opposite way, shape (w,).
        ratio: Its usual H; the common one where it has none of its own.
        offset: Its usual offset [rad].
        common: The response that its neighbours have in common.
    """

    motion: JointMotion
    response: Response
    follows: BoolArray
    still: BoolArray
    opposite: BoolArray
    ratio: complex
    offset: float
    common: complex

    @property
    def loaded(self) -> bool:
        """Whether its neighbours are held back by a load: then it may be, too."""
        return abs(self.common) < LOADED

    @property
    def has_usual(self) -> bool:
        """Whether the joint has a usual response of its own."""
        return int(np.count_nonzero(self.follows)) >= MIN_WINDOWS


def own_response(response: Response) -> complex | None:
    """The usual response of one joint.

    Args:
        response: Its windows.

    Returns:
        Median of H over the windows that it explains; None where it explains too few, which is
        no response.
    """
    coherent = response.valid & (response.explained > COHERENT) & (np.abs(response.ratio) > 1e-3)
    if np.count_nonzero(coherent) < max(1, 0.2 * np.count_nonzero(response.valid)):
        return None
    return complex_median(response.ratio[coherent])


def neighbours(values: Sequence[_Value], k: int) -> list[_Value]:
    """The values of the joints nearest to one joint in the chain, without its own.

    Args:
        values: One of each driven joint, e.g. its response, in chain order.
        k: Index of the joint.

    Returns:
        Up to ``NEIGHBOURS`` values: the gain of a loaded chain changes along the body.
    """
    others = sorted((j for j in range(len(values)) if j != k), key=lambda j: (abs(j - k), j))
    return [values[j] for j in others[:NEIGHBOURS]]


def common_response(own: Sequence[complex | None]) -> complex:
    """The response that some joints have in common.

    Args:
        own: Response of each; None for none.

    Returns:
        Median gain at the circular median lag of the joints that respond, with one vote for an
        ideal response, so that two joints of opposite sign are told apart.
    """
    values = np.asarray([1.0 + 0.0j, *(each for each in own if each is not None)])
    unit = values / np.abs(values)
    # The circular median: the phase of the joint that is nearest to all others.
    distance = np.abs(np.angle(unit[:, None] * unit.conj()[None, :])).sum(axis=1)
    gain = float(np.median(np.abs(values[1:]))) if values.size > 1 else 1.0
    return complex(gain * unit[int(np.argmin(distance))])


def judge(motion: JointMotion, response: Response, common: complex) -> Judged:
    """Judge each window of one joint.

    Args:
        motion: The joint.
        response: Its windows.
        common: The response that its neighbours have in common.

    Returns:
        The judged windows.
    """
    relative = response.ratio / common
    coherent = response.explained > COHERENT
    moves = response.spread > STILL * abs(common) * response.asked
    opposite = response.valid & coherent & moves & (np.abs(np.angle(relative)) > OPPOSITE_RAD)
    opposite &= np.abs(relative) < UNIT_SLACK**2
    responds = coherent & (np.abs(relative) > NO_RESPONSE)
    units = (response.explained > 0.9) & (
        np.abs(np.log(np.maximum(np.abs(relative), 1e-12) * DEGREE)) < np.log(UNIT_SLACK)
    )
    follows = response.valid & (responds | units) & ~opposite
    still = response.valid & ~follows & ~opposite & ~moves
    chosen = follows if follows.any() else opposite
    ratio = complex_median(response.ratio[chosen]) if chosen.any() else common
    use = chosen if chosen.any() else response.valid
    offset = float(np.median(response.offset[use])) if use.any() else 0.0
    return Judged(motion, response, follows, still, opposite, ratio, offset, common)


def marked_spans(response: Response, marked: BoolArray) -> tuple[Span, ...]:
    """Marked windows as time spans, neighbours joined.

    Args:
        response: The windows.
        marked: Which of them, shape (w,).

    Returns:
        Start and end of each run [s].
    """
    spans: list[Span] = []
    for start, stop in zip(response.start_s[marked], response.stop_s[marked], strict=True):
        if spans and start <= spans[-1][1]:
            spans[-1] = (spans[-1][0], float(stop))
        else:
            spans.append((float(start), float(stop)))
    return tuple(spans)


def whole_or(spans: tuple[Span, ...], response: Response) -> tuple[Span, ...]:
    """Nothing where the spans cover (nearly) the whole record, i.e. a permanent fault.

    Args:
        spans: Of a symptom.
        response: The windows of its joint.

    Returns:
        The spans, or none.
    """
    if len(spans) == 1 and response.start_s.size:
        cycle = response.period_s
        begin, end = response.start_s[0], response.stop_s[-1]
        if spans[0][0] - begin < cycle and end - spans[0][1] < cycle:
            return ()
    return spans


def complex_median(values: ComplexArray) -> complex:
    """Median of the real and of the imaginary parts.

    Args:
        values: One or more, shape (n,).

    Returns:
        Both together.
    """
    return complex(np.median(values.real), np.median(values.imag))
