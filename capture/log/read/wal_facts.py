"""Facts of a session of which only the write-ahead log is left, from its definitions."""

from __future__ import annotations

from pathlib import Path

from mcap.records import Channel, Metadata

from ..wal.reader import Recovery
from ..wal.writer import wal_folder
from .facts import RECORDS, LogFacts


def is_wal_alone(path: Path) -> bool:
    """Return whether a session's file is missing or empty, and its write-ahead log is there."""
    is_empty = not path.exists() or (path.is_file() and not path.stat().st_size)
    return is_empty and wal_folder(path).is_dir()


def read_wal_facts(path: Path) -> LogFacts:
    """Read the facts of such a session; its messages are not read.

    Args:
        path: The session's file.

    Raises:
        NotALogError: If no segment of the log can be read.
        LogError: If its folder can't be listed.
    """
    metadata: dict[str, dict[str, str]] = {}
    topics: set[str] = set()
    for item in Recovery(wal_folder(path)).definitions:
        if isinstance(item, Metadata) and item.name in RECORDS:
            metadata.setdefault(item.name, {}).update(item.metadata)
        elif isinstance(item, Channel):
            topics.add(item.topic)
    damage = f"only its write-ahead log is there: undulog log recover {path.name}"
    return LogFacts(topics=tuple(sorted(topics)), metadata=metadata, damage=damage)
