"""The answer of a session: which joints do not follow, which stand out, and the rest's shape.

With it comes what qualifies it: artefacts and dead bands of joints, and remarks on what is missing
or doubtful, by what they change for the reader.

Whoever computes something takes a function of one sentence (:data:`.Warn`). A
plain sentence is a warning. A :class:`Lacking` is a warning that stands first; a :class:`Note`
changes nothing that a reader does: an optional topic that was not recorded, a figure that does not
apply.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from undulog.capture.judgement.fault import Apart, ExtraMotion, ResponseChange, RestsOff

_MOST = 12
"""Digits after which two numbers are taken for equal."""

EITHER = "stick or play, not separable"
STICK = "stick"
PLAY = "play"

KINDS = {
    "frozen": ("sensor or joint", "stay exactly the same while the joint is commanded to move"),
    "stale": ("sensor", "repeat old samples at new times"),
    "wrapped": ("sensor", "are off by whole turns of a counter that wraps around"),
    "jump": ("sensor", "make steps that no joint can make"),
    "clipped": ("sensor", "have flat tops at the end of the sensor's range"),
    "cut_off": (
        "sensor or limit",
        "have flat tops: all that the servo gives, or the sensor sees",
    ),
    "wrong_sign": ("sensor or joint", "have the opposite sign"),
    "wrong_unit": ("sensor", "are larger or smaller by 180/pi: degrees for radians"),
    "scale_mismatch": ("sensor", "differ in scale from another measure of the same motion"),
    "gaps": ("record", "have gaps"),
    "nan": ("record", "are partly not numbers"),
    "duplicate_stamps": ("record", "have several samples of one time"),
    "not_recorded": ("record", "were not recorded"),
    "saturated": ("limit", "are at a limit of the robot"),
    "stalled": ("limit", "show a joint that stands still at its full torque"),
}
"""Name to what it is about and to what the values then do."""

FALSIFYING = frozenset(
    name for name, (about, _) in KINDS.items() if about.startswith("sensor") and name != "stale"
)
"""These make a position unusable; a stale one is late by half a hold."""


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


class Leading(Lacking):
    """A :class:`Lacking` that the answer begins with: the record itself can't show it."""

    __slots__ = ()


class Refusal(Leading):
    """A :class:`Leading` for which no response of any kind can be told from the record."""

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
        lacking = [sentence for sentence in every if isinstance(sentence, Lacking)]
        others = [sentence for sentence in every if not isinstance(sentence, (Lacking, Note))]
        return tuple(map(str, dict.fromkeys([*lacking, *of_the_file, *others])))

    @property
    def leading(self) -> tuple[str, ...]:
        """What the answer begins with; refusals alone if there are any."""
        kind = Refusal if self.refused else Leading
        return tuple(
            str(sentence) for sentence in self._sentences.values() if isinstance(sentence, kind)
        )

    @property
    def refused(self) -> bool:
        """Whether there is a :class:`Refusal`."""
        return any(isinstance(sentence, Refusal) for sentence in self._sentences.values())

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes, in the order in which they came."""
        return tuple(
            str(sentence) for sentence in self._sentences.values() if isinstance(sentence, Note)
        )


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


@dataclass(frozen=True)
class DeadBandEnd:
    """The dead band at one end of the motion.

    Attributes:
        travel_rad: W: travel of the command from its reversal to the onset of motion, the joint's
            delay taken off [rad].
        travel_ci95: Its 95 % interval [rad].
        step_rad: B: what the joint catches up at the onset, beyond following the command from
            there [rad]; 0 for play and for friction that is no less in motion than at rest.
        step_ci95: Its 95 % interval [rad].
        rest_s: How long it rests, median over the cycles [s].
    """

    travel_rad: float
    travel_ci95: tuple[float, float]
    step_rad: float
    step_ci95: tuple[float, float]
    rest_s: float


@dataclass(frozen=True)
class DeadBand:
    """Stick or play of one joint; mechanics, not an artefact.

    Attributes:
        kind: :data:`EITHER`, :data:`STICK` or :data:`PLAY`.
        evidence: What decides the kind, or what is lacking.
        top: After the command's maxima.
        gain_change: Factor that the dead band alone makes on the gain, at this command.
        lag_change_rad: What it alone adds to the lag, at this command [rad].
    """

    kind: str
    evidence: str
    top: DeadBandEnd
    bottom: DeadBandEnd
    gain_change: float
    lag_change_rad: float
    cycles: int


Span = tuple[float, float]
"""Start and end [s]."""


@dataclass(frozen=True)
class Artefact:
    """Something wrong with the samples of one joint, or a limit that it is at.

    Attributes:
        quantity: ``command``, ``position``, ``velocity``, ``effort``, ``current``, ``voltage`` or
            ``reference`` (a second sensor of the position).
        flag: One of :data:`KINDS`.
        spans_s: Stretches in which it holds, from the session's start [s]; none where it is not
            a matter of time.
        note: What else is known, e.g. the size of a counter's turn; may be empty.
    """

    joint: str
    topic: str
    quantity: str
    flag: str
    spans_s: tuple[Span, ...]
    note: str = ""

    @property
    def about(self) -> str:
        """``sensor``, ``sensor or joint`` (positions alone can't tell), ``record`` or ``limit``.

        Also ``sensor or limit``, of efforts.
        """
        return KINDS[self.flag][0]

    def falsifies(self, *quantities: str) -> bool:
        """Return whether an artefact makes one of some quantities unusable.

        Args:
            quantities: E.g. ``position``.

        Returns:
            False for an artefact of another quantity.
        """
        return self.quantity in quantities and self.flag in FALSIFYING

    def within(self, start_s: float, stop_s: float) -> bool:
        """Return whether it holds at any time of a window.

        Args:
            start_s: From the session's start [s].
            stop_s: Its end, not included [s].

        Returns:
            True also if it is not a matter of time.
        """
        return not self.spans_s or overlapping(self.spans_s, start_s, stop_s)


def flags_by_joint(artefacts: Iterable[Artefact]) -> dict[str, list[str]]:
    """Return flags of each joint.

    Returns:
        Joint name to flags, each once.
    """
    by_joint: dict[str, list[str]] = {}
    for artefact in artefacts:
        flags = by_joint.setdefault(artefact.joint, [])
        if artefact.flag not in flags:
            flags.append(artefact.flag)
    return by_joint


def overlapping(spans: Sequence[Span], start_s: float, stop_s: float) -> bool:
    """Return whether an interval overlaps a window.

    Args:
        start_s: Start of the window [s].
        stop_s: Its end, not included [s].

    Returns:
        Touching at an end does not count, unless the stretch is an instant.
    """
    return any(
        (start < stop_s and stop > start_s) or start_s <= start == stop < stop_s
        for start, stop in spans
    )
