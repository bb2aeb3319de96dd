"""A joint that does not follow its command: the kinds of fault that fit the data, and when."""

from __future__ import annotations

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
        share: Share of the session in which it holds, 0 to 1.
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
class Symptom:
    """What a joint's position shows.

    Attributes:
        name: A key of the table of symptoms in ``kinds``.
        spans_s: When [s]; empty for the whole record.
        text: Its size in words; may be empty.
    """

    name: str
    spans_s: tuple[Span, ...]
    text: str
