"""What can go wrong with a drive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FaultKind(StrEnum):
    """What went wrong."""

    LOST = "lost"
    SILENT = "silent"
    TRACKING = "tracking"
    CURRENT = "current"
    TEMPERATURE = "temperature"
    VOLTAGE = "voltage"
    LATE = "late"
    BUS_OFF = "bus-off"
    STRANGER = "stranger"
    BUS = "bus"
    GAIT = "gait"
    LOG = "log"


MUTE = frozenset({FaultKind.BUS_OFF, FaultKind.BUS, FaultKind.STRANGER})
"""Faults after which nothing more is sent: nobody hears it, or somebody else commands."""


@dataclass(frozen=True)
class GateFault:
    """Why a drive ends early.

    Attributes:
        kind: What went wrong.
        text: One sentence: joint, value, limit.
        joint: The joint, empty if it is not one joint's.
        value: What was found; None where it is no number.
        limit: What is allowed; None likewise.
        since_s: Since when, on the loop's clock [s]; None where it has no length.
    """

    kind: FaultKind
    text: str
    joint: str = ""
    value: float | None = None
    limit: float | None = None
    since_s: float | None = None
