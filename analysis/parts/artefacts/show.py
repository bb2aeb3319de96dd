"""Artefacts in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from undulog.capture.common.console import plain

from .result import KINDS, Artefact

_ABOUT = {
    "sensor": "Artefact of the sensor",
    "sensor or joint": "Sensor or joint",
    "sensor or limit": "Sensor or limit",
    "record": "Artefact of the record",
    "limit": "At a limit",
}

_SPANS = 3
"""Stretches of an artefact that a line names at most."""


def artefact_line(artefact: Artefact) -> str:
    """Return the line of an artefact: what it is about, whose it is, and when."""
    spans = [f"{start:.2f} to {stop:.2f} s" for start, stop in artefact.spans_s[:_SPANS]]
    more = len(artefact.spans_s) - _SPANS
    times = ", ".join(spans) + (f" and {more} more" if more > 0 else "")
    note = f" ({artefact.note})" if artefact.note else ""
    about = f"{plain(artefact.joint)}, {_quantity(artefact)}: {artefact.flag}{note}"
    return f"{_ABOUT[artefact.about]}: {about}{': ' if times else ''}{times}"


def warnings_of(artefacts: Iterable[Artefact]) -> list[str]:
    """Return a sentence for each kind of artefact, with its joints.

    Gaps of the whole session have none: those that matter are in the joints' flags.
    """
    joined: dict[tuple[str, str, str], list[Artefact]] = {}
    for artefact in artefacts:
        if artefact.flag != "gaps":
            key = artefact.flag, artefact.quantity, artefact.topic
            joined.setdefault(key, []).append(artefact)
    return [_warning(same) for same in joined.values()]


def _warning(same: Sequence[Artefact]) -> str:
    """Return the sentence for artefacts of one kind on one topic."""
    first = same[0]
    nulls = "; gain and lag are null" if first.falsifies("position") else ""
    meaning = {
        "sensor": f"an artefact of the sensor, not mechanics{nulls}",
        "sensor or joint": f"the sensor or the joint itself, see the answer{nulls}",
        "sensor or limit": "the sensor or a limit of the servo",
        "record": "an artefact of the record, not mechanics",
        "limit": "a limit of the robot, not a fault of the sensor",
    }[first.about]
    notes = ", ".join(dict.fromkeys(artefact.note for artefact in same if artefact.note))
    named = f"{first.flag}, {notes}" if notes else first.flag
    names = ", ".join(artefact.joint for artefact in same)
    return f"{names}: {_quantity(first)}: values {KINDS[first.flag][1]} ({named}): {meaning}"


def _quantity(artefact: Artefact) -> str:
    """Return e.g. ``position on /joint_states``."""
    return f"{artefact.quantity} on {artefact.topic}" if artefact.topic else artefact.quantity
