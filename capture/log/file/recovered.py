"""What became of a session that was not finalised, in numbers and in a sentence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Recovered:
    """What was put together of a session that was not finalised.

    Attributes:
        folder: Its write-ahead log.
        live: Whether its recorder is still writing.
        in_files: Messages that the files have.
        from_wal: Messages that only the write-ahead log has.
        accepted: Messages that the recorder accepted; None where nothing tells.
        looked: Whether all was read to count them; else summaries were believed, or something of
            the write-ahead log can't be read.
    """

    folder: Path
    live: bool
    in_files: int
    from_wal: int
    accepted: int | None
    looked: bool

    @property
    def missing(self) -> int | None:
        """Messages that were accepted and are in neither; None where nothing tells."""
        if self.accepted is None:
            return None
        return max(0, self.accepted - self.in_files - self.from_wal)

    @property
    def warning(self) -> str:
        """One sentence, and what to do."""
        advice = "" if self.live else "; 'undulog log recover' writes a whole file"
        return f"{self}{advice}"

    def __str__(self) -> str:
        """One sentence."""
        total = self.in_files + self.from_wal
        if self.live:
            return (
                f"this recording is running: its first {total} messages are read, "
                f"{self.from_wal} of them from its write-ahead log"
            )
        if self.missing is None:
            missing = "how many are missing can't be told"
        elif self.missing:
            missing = f"{self.missing} of {self.accepted} are missing"
        elif self.looked:
            missing = "none is missing"
        else:
            missing = "none is missing as far as can be told"
        return (
            f"the recorder did not finish: {total} messages are read, {self.from_wal} of them "
            f"from its write-ahead log; {missing}"
        )
