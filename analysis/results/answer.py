"""The answer of a session: which joints do not follow, which stand out, and the rest's shape.

What is missing or doubtful in a result, by what it changes for the reader.

Whoever computes something takes a function of one sentence (:data:`.Warn`). A
plain sentence is a warning. A :class:`Lacking` is a warning that stands first; a :class:`Note`
changes nothing that a reader does: an optional topic that was not recorded, a figure that does not
apply.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

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


class Lacking(str):
    """What the session was recorded for is null: there is no gait, no command, no response."""

    __slots__ = ()


class Note(str):
    """A fact; nothing that the result states is doubtful for it."""

    __slots__ = ()


class Remarks:
    """Collects sentences, each once."""

    def __init__(self) -> None:
        """Start empty."""
        self._sentences: dict[str, str] = {}

    def __call__(self, sentence: str) -> None:
        """Take a sentence.

        Args:
            sentence: Plain, a :class:`Lacking` or a :class:`Note`.
        """
        self._sentences.setdefault(sentence, sentence)

    def warnings(self, of_the_file: Iterable[str] = ()) -> tuple[str, ...]:
        """Return the warnings, worst first.

        Args:
            of_the_file: What the session's file lacks: it comes after what is null.

        Returns:
            One sentence each.
        """
        every = self._sentences.values()
        lacking = [one for one in every if isinstance(one, Lacking)]
        others = [one for one in every if not isinstance(one, (Lacking, Note))]
        return tuple(map(str, dict.fromkeys([*lacking, *of_the_file, *others])))

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes, in the order in which they came."""
        return tuple(str(one) for one in self._sentences.values() if isinstance(one, Note))


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
            :data:`.capture.following.fault.KINDS`.
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
        quantity: ``gain``, ``lag`` or ``offset``.
        deviation: From the prediction of the others: relative for gain, rad for lag and offset.
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
        stand_out: Joints that stand out, worst first.
        undecided: Why it can't be decided which joint differs, or None.
        shape: Shapes of the rest, those that explain most first; each simultaneous interval
            excludes zero.
        alike: Whether all commanded joints are shown to be alike; None where it is open.
    """

    verdict: Verdict = Verdict.NOTHING
    sentence: str = ""
    detail: str = ""
    not_following: tuple[NotFollowing, ...] = ()
    stand_out: tuple[StandOut, ...] = ()
    undecided: str | None = None
    shape: tuple[Shape, ...] = ()
    alike: bool | None = None
    compared: int = 0
    commanded: int = 0
