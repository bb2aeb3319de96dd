"""What a recording was, when it has ended."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.errors import LogWriteError
from .recorder import Ending


def machine_facts() -> Mapping[str, str]:
    """Host, kernel and versions, for the session's metadata."""
    system = platform.uname()
    return {
        "host": system.node,
        "kernel": f"{system.system} {system.release} {system.machine}",
        "python": platform.python_version(),
    }


def free_space(path: Path) -> int:
    """Bytes that are free for us where a file is.

    Args:
        path: The file, which need not be there yet.

    Returns:
        Free bytes.

    Raises:
        LogWriteError: If the folder can't be asked.
    """
    try:
        return shutil.disk_usage(path.parent).free
    except OSError as error:
        raise LogWriteError(
            path, f"its folder can't be used: {os.strerror(error.errno or 0)}"
        ) from error


@dataclass(frozen=True)
class RecordReport:
    """What was recorded.

    Attributes:
        files: The session's files, in order.
        session_id: Its id.
        robot: Name of the robot, or None.
        duration_s: Time from start to end [s].
        messages: Messages accepted.
        size: Bytes of the files.
        verdict: ``good``, ``degraded`` or ``bad``.
        reasons: Why it is not better.
        ending: Why it ended.
        sources: By name: what became of the frames.
        recorder: Of the recorder itself: ticks and so on.
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
    recorder: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def as_json(self) -> dict[str, Any]:
        """Plain JSON."""
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
        }
