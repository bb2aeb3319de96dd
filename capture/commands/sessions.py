"""Sessions of a command: paths, folders and patterns in, a table out."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.console import TerminalColumn, emit_json, output_width, progress, table
from ..common.errors import UndulogError

_COLUMNS = (
    TerminalColumn("session", left=True),
    TerminalColumn("robot", left=True, spare=2),
    TerminalColumn("gait", left=True, spare=1),
    TerminalColumn("verdict", left=True),
    TerminalColumn("first sentence", left=True),
)

FAILED = "failed"
"""Verdict of a session that couldn't be worked on; its sentence is why."""


@dataclass(frozen=True)
class SessionLine:
    """A session in the table.

    Attributes:
        robot: Its name; empty without a description.
        gait: Frequency or name of its gait; empty if unknown.
        facts: What the command prints of this session alone with ``--json``.
        good: False if the command would end with exit code 1 for it.
    """

    robot: str = ""
    gait: str = ""
    verdict: str = ""
    sentence: str = ""
    facts: Any = field(default_factory=dict[str, Any])
    good: bool = True


def sessions_of(given: Iterable[Path]) -> list[Path]:
    """Return the sessions that paths, URLs, folders and patterns name, in that order.

    Args:
        given: Of a folder, all sessions (``.mcap``, ``.bag``, ``.db3``) in it and in the folders
            in it, in order of name; a rosbag2 folder and the parts of a split session are one. A
            pattern (``*``, ``?``, ``[...]``, ``**``) is a path that isn't there. What names no
            session stays, for the command to refuse.
    """
    from ..common.remote import as_path

    paths: list[Path] = []
    for path in map(as_path, given):
        named = _named(path)
        paths += [session for session in named if session == path or session not in paths]
    return paths


def are_as_given(paths: Sequence[Path], given: Iterable[Path]) -> bool:
    """Return whether each session was named by its own path or URL: no folder, no pattern."""
    from ..common.remote import as_path

    return list(paths) == [*map(as_path, given)]


def _named(path: Path) -> list[Path]:
    from glob import glob, has_magic

    from ..common.remote import RemotePath

    if isinstance(path, RemotePath):
        return [path]
    if path.is_dir():
        sessions = _in_folder(path)
        alone = len(sessions) == 1 and sessions[0].parent == path
        plain = alone and sessions[0].suffix == ".mcap" and not sessions[0].is_dir()
        return [path] if plain or not sessions else sessions
    if has_magic(str(path)) and not path.exists():
        matches = sorted(map(Path, glob(str(path), recursive=True)))  # noqa: PTH207 - absolute too
        return list(dict.fromkeys(session for match in matches for session in _matched(match))) or [
            path
        ]
    return [path]


def _matched(path: Path) -> list[Path]:
    """Return the sessions that a match of a pattern belongs to."""
    from ..log.file.bag_metadata import is_rosbag2

    if path.is_dir():
        return _in_folder(path)
    return [path.parent if is_rosbag2(path.parent) else _session_of(path)]


def _in_folder(folder: Path) -> list[Path]:
    """Return the sessions in a folder and, behind them, in its folders."""
    from ..log.file.parts import log_paths

    return list(dict.fromkeys(map(_session_of, log_paths(folder))))


def _session_of(path: Path) -> Path:
    """Return the session that a log belongs to: of a part, the first one."""
    from ..log.file.parts import first_part

    return first_part(path) if path.suffix == ".mcap" and not path.is_dir() else path


def each_session(
    what: Sequence[Any], verb: str, work: Callable[[Any], SessionLine]
) -> dict[str, SessionLine]:
    """Do the work on each session, with progress on a terminal; one that fails has a line of why.

    Args:
        what: Paths, or names.
        verb: For the progress.

    Returns:
        Each one's name in the table to its line: its path only where names repeat.
    """
    what = list(dict.fromkeys(what))
    short = [entry.name if isinstance(entry, Path) else str(entry) for entry in what]
    names = [n if short.count(n) == 1 else str(entry) for n, entry in zip(short, what, strict=True)]
    lines: dict[str, SessionLine] = {}
    with progress(verb, total=len(names)) as bar:
        for k, (name, session) in enumerate(zip(names, what, strict=True)):
            bar.update(k, note=name)
            try:
                lines[name] = work(session)
            except (UndulogError, OSError, MemoryError) as error:
                why = str(error).removeprefix(f"{session}: ") or "there is not enough memory"
                facts = {"path": str(session), "error": why}
                lines[name] = SessionLine(verdict=FAILED, sentence=why, facts=facts, good=False)
    return lines


def show(lines: Mapping[str, SessionLine], *, as_json: bool) -> int:
    """Print the table, or a list of JSON objects; return 1 if any line is not good, else 0."""
    if as_json:
        emit_json([line.facts for line in lines.values()])
    else:
        rows = [
            [(text or "-", "") for text in (name, *_cells(line))] for name, line in lines.items()
        ]
        texts, _ = table(_COLUMNS, rows, output_width(), cropped=sys.stdout.isatty())
        sys.stdout.write("".join(f"{text.plain.rstrip()}\n" for text in texts))
    return int(not all(line.good for line in lines.values()))


def _cells(line: SessionLine) -> tuple[str, str, str, str]:
    return line.robot, line.gait, line.verdict, first_sentence(line.sentence)


def first_sentence(text: str) -> str:
    """Return the first sentence of a text, in one line."""
    return re.split(r"(?<=[.!?])\s+(?=[A-Z])|\n", text, maxsplit=1)[0]


def stated_gait(metadata: Mapping[str, Mapping[str, str]]) -> str:
    """Return what drove a session, as its metadata states it; empty if they don't."""
    facts = metadata.get("undulog", {})
    return facts.get("driven.by") or facts.get("scenario") or ""
