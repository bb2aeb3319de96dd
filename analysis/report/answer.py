"""The answer in one sentence: do the segments move alike?

The sentence claims no more than a test or an interval carries: a small p-value or a boundary
contrast whose interval leaves out zero says "not alike"; only an equivalence test says "alike";
everything else is "could not be shown".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from ..result import Analysis, Estimate, Index, JointResult
from . import formats

SIGNIFICANT = 0.05
"""Family-wise level of the sentence."""


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


def is_driven(joint: JointResult) -> bool:
    """Whether a joint was given a periodic command.

    Args:
        joint: Its result.

    Returns:
        True if it has a gain, or a command with an amplitude.
    """
    return joint.gain.value is not None or bool(joint.command_amplitude_rad)


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
            _why_not(analysis),
        )
    if not known:
        return Answer(
            Verdict.NOTHING,
            "No joint could be compared with its command.",
            _why_not(analysis),
        )
    if len(known) == 1:
        joint = known[0]
        lag = formats.estimate(formats.degrees(joint.lag_rad), unit="°")
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


def answer_to_all(answers: Sequence[Answer]) -> Answer:
    """One headline over several sessions.

    Args:
        answers: One a session, at least two.

    Returns:
        How many of them say what.
    """
    count = {verdict: sum(a.verdict is verdict for a in answers) for verdict in Verdict}
    phrases = {
        Verdict.UNLIKE: "the segments do not move alike",
        Verdict.ALIKE: "the segments move alike within the stated margins",
        Verdict.OPEN: "no difference between the segments could be shown",
        Verdict.SINGLE: "one joint alone was driven",
        Verdict.NOTHING: "there is nothing to compare",
    }
    parts = [f"in {count[v]} of {len(answers)} sessions {phrases[v]}" for v in Verdict if count[v]]
    whole = [phrases[v] for v in Verdict if count[v] == len(answers)]
    sentence = f"In all {len(answers)} sessions {whole[0]}." if whole else "; ".join(parts) + "."
    return Answer(
        max(Verdict, key=lambda v: count[v]),
        sentence[0].upper() + sentence[1:],
        "Each session is answered for itself; nothing is pooled across them.",
    )


def find(indices: dict[str, Index], *words: str) -> Index | None:
    """The first index whose name holds all these words and that has a value.

    Args:
        indices: Name to index.
        words: Parts of the name, e.g. ``boundary``, ``lag``.

    Returns:
        The index, or None.
    """
    for name, index in indices.items():
        if index.value is not None and all(word in name for word in words):
            return index
    return None


def _verdict(analysis: Analysis) -> Verdict:
    indices = analysis.heterogeneity
    equal = [find(indices, "equivalence", quantity) for quantity in ("gain", "lag")]
    if all(index is not None and _small(index.p) for index in equal):
        # Different for certain they may be, but by less than the margins: that has the last word.
        return Verdict.ALIKE
    contrasts = [find(indices, "boundary", quantity) for quantity in ("gain", "lag")]
    if any(index is not None and _leaves_out_zero(index) for index in contrasts):
        return Verdict.UNLIKE
    tests = [i.p for name, i in indices.items() if "common_response" in name and i.p is not None]
    return Verdict.UNLIKE if tests and _small(min(tests) * len(tests)) else Verdict.OPEN


def _small(p: float | None) -> bool:
    return p is not None and p < SIGNIFICANT


def _leaves_out_zero(index: Index) -> bool:
    return index.ci95 is not None and (index.ci95[0] > 0 or index.ci95[1] < 0)


def _numbers(analysis: Analysis) -> str:
    """The contrast and the spread, each with its interval."""
    indices = analysis.heterogeneity
    parts: list[str] = []
    contrast = find(indices, "boundary", "lag")
    if contrast is not None and contrast.value is not None:
        size = formats.estimate(formats.degrees(_size(contrast)), unit="°")
        joints = _joints_word(analysis)
        parts.append(
            f"the middle {joints} lag {size} more than the ends"
            if contrast.value < 0
            else f"the {joints} at the ends lag {size} more than the middle"
        )
    else:
        spread = find(indices, "lag", "sd")
        if spread is not None:
            size = formats.degrees(Estimate(spread.value, spread.ci95))
            parts.append(f"lag spreads by {formats.estimate(size, unit='°')}")
    spread = find(indices, "gain", "cv")
    if spread is not None:
        size = formats.scaled(Estimate(spread.value, spread.ci95), 100.0)
        parts.append(f"gain spreads by {formats.estimate(size, unit=' %')}")
    return " and ".join(parts)


def _margins(analysis: Analysis) -> str:
    """The margins of the equivalence tests, from their labels."""
    tests = [i for name, i in analysis.heterogeneity.items() if "equivalence" in name]
    return " and ".join(test.label.rpartition("H1: ")[2] for test in tests)


def _size(index: Index) -> Estimate:
    """A contrast without its sign; the words carry it."""
    if index.value is None or index.value >= 0:
        return Estimate(index.value, index.ci95)
    ci95 = None if index.ci95 is None else (-index.ci95[1], -index.ci95[0])
    return Estimate(-index.value, ci95)


def _joints_word(analysis: Analysis) -> str:
    planes = {j.plane for j in analysis.joints if j.gain.value is not None}
    return {"horizontal": "yaw joints", "vertical": "pitch joints"}.get(
        str(planes.pop()) if len(planes) == 1 else "", "joints"
    )


def _extremes(analysis: Analysis, known: Sequence[JointResult]) -> str:
    rhythm = analysis.gait.frequency_hz
    frequency = formats.estimate(rhythm, formats.decimals_for([rhythm], most=4), " Hz")
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
    flagged = sum(bool(j.flags) for j in analysis.joints)
    if not flagged:
        return ""
    return f" {flagged} joint{' is' if flagged == 1 else 's are'} flagged; see the table of joints."


def _why_not(analysis: Analysis) -> str:
    if analysis.warnings:
        return formats.plain(analysis.warnings[0])
    return "The result gives no reason."
