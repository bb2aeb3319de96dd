"""What every import has in common: the new session file, and the report on it."""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.console import refuse_existing
from ..common.files import part_file
from ..log.write.writer import SessionWriter
from ..robot.model import Robot

_NS = 1_000_000_000


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
        return (self.end_ns - self.start_ns) / _NS

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


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def imported_session(
    source: Path,
    output: Path,
    robot: Robot,
    *,
    epoch_ns: int,
    facts: Mapping[str, str],
    force: bool,
) -> Generator[SessionWriter]:
    """Write an imported session, which appears under its name only when it is whole.

    The same log gives the same session id and, with the same robot, the same bytes: no clock and
    no path of this machine enters the file.

    Args:
        robot: The robot that made the log.
        epoch_ns: Time of its first sample [Unix ns].
        facts: For the session's metadata.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    refuse_existing(output, force=force)
    digest = file_digest(source)
    metadata = {"source": source.name, "source.sha256": digest, **facts}
    with (
        part_file(output) as part,
        SessionWriter(
            part,
            session_id=f"import-{digest[:16]}",
            epoch_ns=epoch_ns,
            robot=robot,
            clock={"log": str(robot.clock)},
            metadata=metadata,
            force=True,
        ) as writer,
    ):
        yield writer
