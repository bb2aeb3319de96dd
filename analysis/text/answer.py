"""The answer in one sentence: do the segments move alike?

The sentence claims no more than a test or an interval carries: a small p-value or a boundary
contrast whose interval leaves out zero says "not alike"; only an equivalence test says "alike";
everything else is "could not be shown".
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from ..results.analysis import (
    Analysis,
    Estimate,
    Index,
    JointResult,
    leaves_out_zero,
)
from . import formats

SIGNIFICANT = 0.05
"""Family-wise level of the sentence."""

_NAMED = 6
"""Flagged joints that the answer names at most."""


class Verdict(StrEnum):
    """What kind of answer a session gives."""

    UNLIKE = "unlike"
    ALIKE = "alike"
    OPEN = "open"
    SINGLE = "single"
    NOTHING = "nothing"


@dataclass(frozen=True)
class Answer:
    """The first thing the report says.

    Attributes:
        verdict: Its kind.
        sentence: One sentence; plain text, intervals in square brackets.
        detail: What qualifies it, one or two sentences.
    """

    verdict: Verdict
    sentence: str
    detail: str


def answer(analysis: Analysis) -> Answer:
    """Answer from the numbers of one session.

    Args:
        analysis: Its numbers.

    Returns:
        The answer.
    """
    known = [j for j in analysis.joints if j.gain.value is not None]
    if analysis.gait.frequency_hz.value is None:
        return Answer(
            Verdict.NOTHING,
            "No gait was found in this session, so there is no gain and no lag to compare.",
            _why_not(analysis, "no gait"),
        )
    if not known:
        return Answer(
            Verdict.NOTHING,
            "No joint could be compared with its command.",
            _why_not(analysis, "gain and lag are null"),
        )
    if len(known) == 1:
        joint = known[0]
        lag = formats.estimate(formats.degrees(joint.lag_rad), "°", most=2)
        return Answer(
            Verdict.SINGLE,
            f"One joint was driven: its gain is {formats.estimate(joint.gain)}, "
            f"its lag {lag} behind the command.",
            "There is no second joint to compare it with." + _caveat(analysis),
        )
    verdict = _verdict(analysis)
    lead = {
        Verdict.UNLIKE: "The segments do not move alike",
        Verdict.ALIKE: f"The segments move alike, {_margins(analysis)}",
    }.get(verdict, "No difference between the segments could be shown")
    numbers = _numbers(analysis)
    return Answer(
        verdict,
        f"{lead}: {numbers}." if numbers else f"{lead}.",
        _extremes(analysis, known) + _caveat(analysis),
    )


def find(indices: dict[str, Index], stem: str) -> dict[str, Index]:
    """The indices of one kind that have a value, by plane and group.

    Args:
        indices: Name to index; where both planes are driven, names end in the plane, where joints
            of one plane have several frequencies, in the group.
        stem: Name without the plane, e.g. ``gain_cv``.

    Returns:
        End of the name, e.g. ``horizontal``, ``vertical_group1`` or an empty string, to the index.
    """
    pattern = re.compile(rf"{re.escape(stem)}_?((?:horizontal|vertical)?(?:_?group\d+)?)")
    found = {name: pattern.fullmatch(name) for name in indices}
    return {
        match[1]: indices[name]
        for name, match in found.items()
        if match is not None and indices[name].value is not None
    }


def _verdict(analysis: Analysis) -> Verdict:
    indices = analysis.heterogeneity
    equal = [find(indices, f"equivalence_{quantity}") for quantity in ("gain", "lag")]
    if all(equal) and all(_small(index.p) for kind in equal for index in kind.values()):
        # Different for certain they may be, but by less than the margins: that has the last word.
        return Verdict.ALIKE
    contrasts = [find(indices, f"boundary_contrast_{quantity}") for quantity in ("gain", "lag")]
    if any(leaves_out_zero(index.ci95) for kind in contrasts for index in kind.values()):
        return Verdict.UNLIKE
    tests = [i.p for i in find(indices, "common_response").values() if i.p is not None]
    return Verdict.UNLIKE if tests and _small(min(tests) * len(tests)) else Verdict.OPEN


def _small(p: float | None) -> bool:
    return p is not None and p < SIGNIFICANT


def _numbers(analysis: Analysis) -> str:
    """Contrast and spread with their intervals, plane by plane."""
    indices = analysis.heterogeneity
    contrasts = find(indices, "boundary_contrast_lag")
    spreads = find(indices, "lag_sd")
    gains = find(indices, "gain_cv")
    told: list[str] = []
    for plane in dict.fromkeys([*contrasts, *spreads, *gains]):
        joints = _joints_word(analysis, plane)
        parts: list[str] = []
        if plane in contrasts:
            parts.append(_contrast(contrasts[plane], joints))
        elif plane in spreads:
            spread = Estimate(spreads[plane].value, spreads[plane].ci95)
            lag = formats.estimate(formats.degrees(spread), "°", most=2)
            parts.append(f"the lag of the {joints} spreads by {lag}")
        if plane in gains:
            spread = formats.scaled(Estimate(gains[plane].value, gains[plane].ci95), 100.0)
            whose = "" if parts else f" of the {joints}"
            parts.append(_gain_spread(spread, whose))
        told.append(" and ".join(parts))
    return "; ".join(told)


def _gain_spread(spread: Estimate, whose: str) -> str:
    if spread.value == 0.0 and spread.ci95 is not None:  # noise explains all of it
        most = formats.number(spread.ci95[1], formats.decimals_for([spread], most=2))
        return f"gain{whose} spreads by no more than noise, {most} % at most"
    return f"gain{whose} spreads by {formats.estimate(spread, ' %', most=2)}"


def _contrast(index: Index, joints: str) -> str:
    """Who is late: the index is ends minus middle."""
    size = formats.estimate(formats.degrees(_size(index)), "°", most=2)
    if (index.value or 0.0) < 0:
        return f"the middle {joints} lag {size} more than the ends"
    return f"the {joints} at the ends lag {size} more than the middle"


def _margins(analysis: Analysis) -> str:
    """The margins of the equivalence tests, from their labels."""
    tests = [i for name, i in analysis.heterogeneity.items() if "equivalence" in name]
    stated = [test.label.rpartition("H1: ")[2] for test in tests]
    return " and ".join(dict.fromkeys(stated))  # both planes are held to the same


def _size(index: Index) -> Estimate:
    """A contrast without its sign; the words carry it."""
    if index.value is None or index.value >= 0:
        return Estimate(index.value, index.ci95)
    ci95 = None if index.ci95 is None else (-index.ci95[1], -index.ci95[0])
    return Estimate(-index.value, ci95)


def _joints_word(analysis: Analysis, end: str) -> str:
    """What to call the joints that an index is about, from the end of its name."""
    plane, _, group = end.partition("group")
    plane = plane.rstrip("_")
    planes = {plane} if plane else {j.plane for j in analysis.joints if j.gain.value is not None}
    words = {"horizontal": "yaw joints", "vertical": "pitch joints"}
    word = words.get(str(next(iter(planes))), "joints") if len(planes) == 1 else "joints"
    if not group:
        return word
    frequency = analysis.gait.groups[int(group)].frequency_hz
    return f"{word} at {formats.number(frequency.value, 3)} Hz"


def _extremes(analysis: Analysis, known: Sequence[JointResult]) -> str:
    frequency = formats.gait_frequency(analysis.gait)
    text = f"{len(known)} of {len(analysis.joints)} joints respond to a gait of {frequency}"
    lags = [j for j in known if j.lag_rad.value is not None]
    if lags:
        first = min(lags, key=lambda j: j.lag_rad.value or 0.0)
        last = max(lags, key=lambda j: j.lag_rad.value or 0.0)
        text += "; lag runs from " + " to ".join(
            f"{formats.number(math.degrees(j.lag_rad.value or 0.0), 1)}° ({formats.plain(j.name)})"
            for j in (first, last)
        )
    return text + "."


def _caveat(analysis: Analysis) -> str:
    named = [f"{formats.plain(j.name)} ({', '.join(j.flags)})" for j in analysis.joints if j.flags]
    if not named:
        return ""
    more = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
    return f" Flagged, see the table of joints: {', '.join(named[:_NAMED])}{more}."


def _why_not(analysis: Analysis, lacking: str) -> str:
    """The warning that says what is lacking, or else speaks of a gait, or the first."""
    if not analysis.warnings:
        return "The result gives no reason."
    verdict = [one for one in analysis.warnings if lacking in one and "held still" not in one]
    about = [warning for warning in analysis.warnings if "gait" in warning.lower()]
    return formats.sentence((verdict or about or analysis.warnings)[0])
