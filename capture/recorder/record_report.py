"""Summary of a recording, for the terminal, JSON and the control socket."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .loop import Ending


@dataclass(frozen=True)
class RecordReport:
    """Summary of a recording.

    Attributes:
        files: The session's files, in order.
        robot: Name of the robot, or None.
        verdict: ``good``, ``degraded`` or ``bad``.
        reasons: Reasons for a verdict that is not good.
        sources: Frame counts by name of the source.
        recorder: Facts about the recorder itself: ticks and so on.
        rescued: Those of the files that are rescue files, in the place of deleted ones.
    """

    files: tuple[Path, ...]
    session_id: str
    robot: str | None
    duration_s: float
    messages: int
    size: int
    verdict: str
    reasons: tuple[str, ...]
    ending: Ending
    sources: Mapping[str, Mapping[str, Any]]
    recorder: Mapping[str, Any]
    rescued: tuple[Path, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return {
            "files": [str(file) for file in self.files],
            "session_id": self.session_id,
            "robot": self.robot,
            "duration_s": self.duration_s,
            "messages": self.messages,
            "size_bytes": self.size,
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "ended": self.ending.reason,
            "failed": self.ending.failed,
            "sources": {name: dict(facts) for name, facts in self.sources.items()},
            "recorder": dict(self.recorder),
            "rescued": [str(file) for file in self.rescued],
        }
