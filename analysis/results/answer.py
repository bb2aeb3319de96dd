"""The answer of a session: which joints do not follow, which stand out, and the rest's shape."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


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
        joint: Joint name.
        kinds: Kinds of fault that fit and that the data can't tell apart: keys of
            :data:`.capture.following.fault.KINDS`.
        since_s: From the session's start [s]; None where it holds from the beginning.
        until_s: Its end [s]; None where it holds to the end.
        share: Share of the session in which it holds, 0 to 1.
        evidence: What the data show.
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
        joint: Joint name.
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
        verdict: Its kind.
        sentence: One to three sentences; plain text, intervals in square brackets.
        detail: What qualifies it, one or two sentences.
        not_following: Joints that do not follow their command, in chain order.
        stand_out: Joints that stand out, worst first.
        undecided: Why it can't be decided which joint differs, or None.
        shape: Shapes of the rest, largest first; each simultaneous interval excludes zero.
        alike: Whether all commanded joints are shown to be alike; None where it is open.
        compared: Joints compared.
        commanded: Joints whose command moves.
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
