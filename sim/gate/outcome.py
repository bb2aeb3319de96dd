"""How a drive through the gate went."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from .faults import GateFault


class How(StrEnum):
    """How it ended."""

    COMPLETE = "complete"
    STOPPED = "stopped"
    FAULT = "fault"


@dataclass(frozen=True)
class Outcome:
    """The end of a drive.

    Attributes:
        how: Its kind.
        why: One sentence; empty where it is complete.
        ended: What was commanded at the end, one sentence.
        fault: The fault, if one ended it.
    """

    how: How
    why: str
    ended: str
    fault: GateFault | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        fault = self.fault
        return {
            "outcome": str(self.how),
            "why": self.why or None,
            "ended": self.ended,
            "fault": None
            if fault is None
            else {
                "kind": str(fault.kind),
                "joint": fault.joint or None,
                "value": fault.value,
                "limit": fault.limit,
                "since_s": fault.since_s,
            },
        }
