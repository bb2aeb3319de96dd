"""Artefacts in words."""

from __future__ import annotations

from undulog.capture.common.console import plain

from .result import Artefact

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
    where = f"{artefact.quantity} on {artefact.topic}" if artefact.topic else artefact.quantity
    about = f"{plain(artefact.joint)}, {where}: {artefact.flag}{note}"
    return f"{_ABOUT[artefact.about]}: {about}{': ' if times else ''}{times}"
