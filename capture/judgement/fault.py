"""What a judgement finds: faults, changes, motion of its own, rests off the command."""

from __future__ import annotations

import math
from dataclasses import dataclass

Span = tuple[float, float]
"""Start and end [s]."""

KINDS: dict[str, tuple[str, str]] = {
    "dead": ("mechanics", "the motor does not drive the joint"),
    "jammed": ("mechanics", "the joint is blocked"),
    "stalled": ("mechanics", "the motor pushes with constant effort and the joint stands still"),
    "inverted": ("mechanics", "the joint moves against its command"),
    "intermittent": ("mechanics", "the joint stops following for some time, again and again"),
    "at_limit": ("mechanics", "the joint is at a limit"),
    "slipped": ("mechanics", "the joint slipped against its motor"),
    "swapped": ("wiring", "two joints carry out each other's command"),
    "frozen_sensor": ("sensor", "the sensor repeats one value"),
    "inverted_sensor": ("sensor", "the sensor counts the wrong way"),
    "stale_sensor": ("sensor", "the sensor repeats old values"),
    "scaled_sensor": ("sensor", "the sensor's scale or unit is wrong"),
    "slipped_sensor": ("sensor", "the sensor's zero moved by a step"),
    "noisy_sensor": ("sensor", "the sensor is noisy for some time"),
    "wrapped_sensor": ("sensor", "the sensor's counter wrapped around"),
    "drifting_sensor": ("sensor", "the sensor's zero drifts"),
    "clipped_sensor": ("sensor", "the sensor's range ends before the motion"),
    "lost_samples": ("record", "samples of the joint are missing"),
}
"""Kind of fault to where it lies and what it is."""


@dataclass(frozen=True)
class Fault:
    """One joint that does not follow its command.

    Attributes:
        kinds: The kinds of :data:`KINDS` that fit and that the data can't separate.
        spans_s: When it holds, from the common origin [s].
        since_s: Start of the first span [s]; None where it holds from the beginning.
        until_s: End of the last span [s]; None where it holds to the end.
        share: Share of the time in which it was asked to move in which it holds, 0 to 1.
        evidence: What the data show, in words.
    """

    joint: str
    kinds: tuple[str, ...]
    spans_s: tuple[Span, ...]
    since_s: float | None
    until_s: float | None
    share: float
    evidence: str

    @property
    def about(self) -> str:
        """``mechanics``, ``wiring``, ``sensor`` or ``record``; several joined by ``or``."""
        return " or ".join(dict.fromkeys(KINDS[kind][0] for kind in self.kinds))


@dataclass(frozen=True)
class ResponseChange:
    """A joint whose response changed during the session: a difference, no fault.

    Attributes:
        quantity: ``gain``, ``lag``, ``offset``, ``noise``, or ``drift`` of the offset.
        change: Relative to before for ``gain``; [s] for ``lag``, [rad] for ``offset`` and from the
            beginning to the end for ``drift``; the ratio to before for ``noise``.
        half_width: Of its simultaneous 95 % interval; of the logarithm for ``noise``.
        from_s: When it began, from the session's start [s].
        until_s: When it was as before again [s]; None for a lasting change.
        onset_s: Interval of the beginning [s].
    """

    joint: str
    quantity: str
    change: float
    half_width: float
    from_s: float
    until_s: float | None
    onset_s: Span

    @property
    def text(self) -> str:
        """What changed, e.g. ``from 16.5 s on gain 40 % less``."""
        if self.quantity == "drift":
            sign = "-" if self.change < 0 else "+"
            return f"its mean drifts by {sign}{_degrees(self.change)}"
        end = "on" if self.until_s is None else f"to {self.until_s:.1f} s"
        return f"from {self.from_s:.1f} s {end} {_size(self.quantity, self.change)}"


def _degrees(angle_rad: float) -> str:
    """Return the size of an angle in words, e.g. ``1 degree``."""
    size = f"{abs(math.degrees(angle_rad)):.2g}"
    return f"{size} {'degree' if size == '1' else 'degrees'}"


def _size(quantity: str, change: float) -> str:
    match quantity:
        case "gain":
            return f"gain {100 * abs(change):.2g} % {'less' if change < 0 else 'more'}"
        case "lag":
            return f"{1e3 * abs(change):.2g} ms {'earlier' if change < 0 else 'later'}"
        case "offset":
            place = "below" if change < 0 else "above"
            return f"its mean {_degrees(change)} {place} what it was"
        case _:
            return f"noise {change:.2g} times as large"


@dataclass(frozen=True)
class ExtraMotion:
    """A joint that also moves at a frequency that isn't its command's.

    Attributes:
        frequency_hz: [Hz].
        amplitude_rad: [rad].
    """

    joint: str
    frequency_hz: float
    amplitude_rad: float

    @property
    def text(self) -> str:
        """E.g. ``also moves at 6.1 Hz, by 11 degrees``."""
        return f"also moves at {self.frequency_hz:.3g} Hz, by {_degrees(self.amplitude_rad)}"


@dataclass(frozen=True)
class RestsOff:
    """A joint that rests off its command.

    Attributes:
        offset_rad: Position less command at rest, the largest [rad].
        range_rad: The least and the largest [rad].
        rests: Number of rests; 0 where the command never rests: then the offset is that of the
            response at the command's median.
    """

    joint: str
    offset_rad: float
    range_rad: tuple[float, float]
    rests: int

    @property
    def text(self) -> str:
        """E.g. ``rests up to 4.2 degrees off its command``."""
        if not self.rests:
            place = "below" if self.offset_rad < 0 else "above"
            return f"is {_degrees(self.offset_rad)} {place} its command"
        return f"rests up to {_degrees(self.offset_rad)} off its command"


@dataclass(frozen=True)
class Apart:
    """A joint whose response lies apart from those of all others.

    Attributes:
        quantity: ``gain`` or ``lag``.
        value: Its gain, or its lag [s].
        others: The least and the largest of the others.
    """

    joint: str
    quantity: str
    value: float
    others: tuple[float, float]

    @property
    def text(self) -> str:
        """E.g. ``lags by 0.21 s, the others by 0.1 to 0.12 s``."""
        low, high = (f"{end:.2g}" for end in self.others)
        if self.quantity == "lag":
            return f"lags by {self.value:.2g} s, the others by {low} to {high} s"
        return f"has a gain of {self.value:.2g}, the others of {low} to {high}"


@dataclass(frozen=True)
class Judgement:
    """What is found of the joints of a session.

    Attributes:
        faults: At most one a joint, in the order of the joints.
        changes: Of joints without a fault.
        extra: Of joints without a fault.
        rests: Of joints without a fault.
        apart: Of joints without a fault, change or motion of their own.
        unexposed: Joints that were not asked to move enough to judge, with the largest motion that
            was asked of them [rad].
        judged: Joints that were.
        naming: What may be wrong with the joints' names, a clause; empty if nothing is.
    """

    faults: tuple[Fault, ...] = ()
    changes: tuple[ResponseChange, ...] = ()
    extra: tuple[ExtraMotion, ...] = ()
    rests: tuple[RestsOff, ...] = ()
    apart: tuple[Apart, ...] = ()
    unexposed: tuple[tuple[str, float], ...] = ()
    judged: tuple[str, ...] = ()
    naming: str = ""


def clause_of(difference: ResponseChange | ExtraMotion | RestsOff | Apart, name: str) -> str:
    """Return a difference of one joint as a clause that begins with the joint's name."""
    return f"{name}{':' if isinstance(difference, ResponseChange) else ''} {difference.text}"


NOTHING = Judgement()
"""Of a session that can't be judged."""
