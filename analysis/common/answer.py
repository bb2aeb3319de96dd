"""The answer of a session: which joints do not follow, which stand out, and the rest's shape."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from undulog.capture.judgement.fault import Apart, ExtraMotion, ResponseChange, RestsOff

_MOST = 12
"""Digits after which two numbers are taken for equal."""


def percent(share: float, limit: float) -> str:
    """Print a share so that it reads as on the side of a limit that it is on.

    Args:
        limit: What it was compared with.

    Returns:
        In percent with no digits more than needed, e.g. ``79.97 %`` for a limit of 0.8.
    """
    for decimals in range(_MOST):
        text = f"{100 * share:.{decimals}f}"
        if _same_side(float(text) / 100, share, limit):
            return f"{text} %"
    return f"{100 * share!r} %"


def beyond(value: float, limit: float, digits: int = 2) -> str:
    """Print a value so that it reads as on the side of a limit that it is on.

    Args:
        limit: What it was compared with.
        digits: Significant digits, at least.

    Returns:
        The value, e.g. ``101`` for a limit of 100, where two digits would be 1e+02.
    """
    for count in range(digits, _MOST):
        text = f"{value:.{count}g}"
        if _same_side(float(text), value, limit):
            return text
    return repr(value)


def _same_side(printed: float, value: float, limit: float) -> bool:
    return value == limit or (printed != limit and (printed > limit) == (value > limit))


def distinct(first: float, second: float) -> tuple[str, str]:
    """Print two numbers so that they read as different if they are.

    Returns:
        Both with the same number of significant digits, at least 4.
    """
    for count in range(4, _MOST):
        texts = f"{first:.{count}g}", f"{second:.{count}g}"
        if texts[0] != texts[1] or first == second:
            return texts
    return repr(first), repr(second)


class Verdict(StrEnum):
    """What kind of answer a session gives."""

    UNLIKE = "unlike"
    ALIKE = "alike"
    OPEN = "open"
    SINGLE = "single"
    NOTHING = "nothing"


@dataclass(frozen=True)
class NotFollowing:
    """A joint that does not follow its command.

    Attributes:
        kinds: Kinds of fault that fit and that the data can't separate: keys of
            :data:`.capture.judgement.fault.KINDS`.
        since_s: From the session's start [s]; None where it holds from the beginning.
        until_s: Its end [s]; None where it holds to the end.
        share: Share of the session in which it holds, 0 to 1.
    """

    joint: str
    kinds: tuple[str, ...]
    since_s: float | None
    until_s: float | None
    share: float
    evidence: str


@dataclass(frozen=True)
class StandOut:
    """A joint that responds differently from the prediction of the others.

    Attributes:
        plane: ``horizontal``, ``vertical`` or ``chain``.
        group: Index of its rhythm group.
        rank: 1 for the joint that deviates most.
        quantity: ``gain``, ``lag`` or ``offset``, or ``delay`` where there is no gait.
        deviation: From the prediction of the others: relative for gain, rad for lag and offset, s
            for a delay.
        ci95: Simultaneous 95 % interval over all statements of the answer.
    """

    joint: str
    plane: str
    group: int
    rank: int
    quantity: str
    deviation: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Shape:
    """A shape that the rest of the joints has along the body.

    Attributes:
        kind: ``ends`` (end joints minus middle joints), ``trend`` (tail minus head), ``mirror``
            (outer minus inner half, symmetric to the middle) or ``each`` (largest deviation of
            one joint from the common value).
        quantity: ``gain`` or ``lag``.
        plane: ``horizontal``, ``vertical`` or ``chain``.
        group: Index of its rhythm group.
        value: Relative for gain, rad for lag.
        ci95: Simultaneous 95 % interval.
        joint: Of ``each``: the joint.
    """

    kind: str
    quantity: str
    plane: str
    group: int
    value: float
    ci95: tuple[float, float]
    joint: str | None = None


@dataclass(frozen=True)
class Answer:
    """The first thing that every output shows.

    Attributes:
        sentence: One to three sentences; plain text, intervals in square brackets.
        detail: What qualifies it, one or two sentences.
        not_following: Joints that do not follow their command, in chain order.
        changes: Changes of joints that follow, during the session.
        extra: Motion at frequencies that aren't the commands'.
        rests: Joints that rest off their command.
        apart: Joints whose gain or lag lies apart from those of all others.
        stand_out: Joints that stand out, worst first.
        undecided: Why it can't be decided which joint differs, or what else may; None otherwise.
        shape: Shapes of the rest, those that explain most first; each simultaneous interval
            excludes zero.
        alike: Whether all commanded joints are shown to be alike; None where it is open.
    """

    verdict: Verdict = Verdict.NOTHING
    sentence: str = ""
    detail: str = ""
    not_following: tuple[NotFollowing, ...] = ()
    changes: tuple[ResponseChange, ...] = ()
    extra: tuple[ExtraMotion, ...] = ()
    rests: tuple[RestsOff, ...] = ()
    apart: tuple[Apart, ...] = ()
    stand_out: tuple[StandOut, ...] = ()
    undecided: str | None = None
    shape: tuple[Shape, ...] = ()
    alike: bool | None = None
    compared: int = 0
    commanded: int = 0


def led(answer: Answer, leading: Sequence[str]) -> Answer:
    """Begin an answer with what the record itself can't show.

    Args:
        leading: Of :attr:`Remarks.leading`: clauses up to the first semicolon or bracket are said.

    Returns:
        The answer; what it says of joints follows, and a sentence that there is nothing to compare
        is replaced.
    """
    if not leading:
        return answer
    parts = [_first_clause(text) for text in leading]
    if answer.verdict is not Verdict.NOTHING or answer.not_following:
        parts.append(answer.sentence)
    return replace(answer, sentence=" ".join(parts))


def _first_clause(text: str) -> str:
    clause = re.split(r"; | \(", text.removeprefix("no gait: "))[0]
    return f"{clause[:1].upper()}{clause[1:]}{'' if clause.endswith('...') else '.'}"
