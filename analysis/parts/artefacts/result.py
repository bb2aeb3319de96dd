"""Artefacts: what is wrong with samples, or at a limit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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
