"""What an import and an export report."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.arrays import NS


@dataclass
class ImportReport:
    """What an import did.

    Attributes:
        start_ns: First sample or frame [Unix ns].
        end_ns: Last sample or frame [Unix ns].
        frames: Number of raw frames kept; None where the log has none.
        samples: Topic to number of messages.
        problems: What is missing or wrong, one sentence each.
        notes: What is in order and worth knowing, one sentence each.
        complete: False if the import was stopped on request.
    """

    source: Path
    output: Path
    robot: str
    start_ns: int = 0
    end_ns: int = 0
    frames: int | None = None
    samples: dict[str, int] = field(default_factory=dict[str, int])
    problems: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])
    complete: bool = True

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample or frame [s]."""
        return (self.end_ns - self.start_ns) / NS

    @property
    def verdict(self) -> str:
        """``good``, or ``degraded`` where something is missing or wrong."""
        return "good" if self.complete and not self.problems else "degraded"

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "source": str(self.source),
            "output": str(self.output),
            "robot": self.robot,
            "duration_s": self.duration_s,
            "frames": self.frames,
            "messages": self.samples,
            "verdict": self.verdict,
            "problems": self.problems,
            "notes": self.notes,
            "complete": self.complete,
        }


@dataclass(frozen=True)
class ExportReport:
    """Result of an export.

    Attributes:
        what: What was written, as a phrase.
        facts: The same for JSON.
        warnings: Facts that the format doesn't hold or the session lacks, one sentence each.
    """

    what: str
    facts: dict[str, Any]
    warnings: list[str]
