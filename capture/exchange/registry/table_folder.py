"""A folder of tables: one of states, one of commands, names of joints and events."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ...common.errors import ImportFormatError, UsageError, some_names
from ...common.files import check_regular
from ..formats.format import DirectReader, Format
from ..table_format import TABLE_OPTIONS

if TYPE_CHECKING:
    from ..import_options import ImportOptions
    from ..reports import ImportReport
    from ..table_file import TableFile
    from ..table_import import TableSet

_COMMAND_FILES = {"control", "command", "commands", "cmd", "action", "actions", "target", "targets"}
_STATE_FILES = {"state", "states", "measured", "response", "feedback", "joint", "joints", "motor"}
_EVENT_FILES = {"event", "events"}

_MOST_NAMES = 1 << 16
"""Bytes of a list of joints."""


def read_folder(
    folder: Path, is_table: Callable[[Path], bool], open_table: Callable[[Path], TableFile]
) -> TableSet:
    """Return the tables of a folder, by their names.

    Args:
        is_table: Returns whether a file is a table, by its suffix.
        open_table: Opens one.

    Raises:
        ImportFormatError: If a file is damaged, or the folder has no table, or too many.
    """
    from ..column_map import COMMANDS, STATES
    from ..session_import import digest_of
    from ..table_file import words
    from ..table_import import TableSet

    by_role: dict[str, list[Path]] = {STATES: [], COMMANDS: [], "events": [], "names": []}
    others: list[str] = []
    for path in sorted(folder.iterdir()):
        labels = set(words(path.stem))
        if path.suffix.lower() == ".txt" and {"list", "names"} & labels:
            by_role["names"].append(path)
        elif not is_table(path):
            others.append(path.name)
        elif labels & _EVENT_FILES:
            by_role["events"].append(path)
        elif labels & _COMMAND_FILES:
            by_role[COMMANDS].append(path)
        elif labels & _STATE_FILES:
            by_role[STATES].append(path)
        else:
            others.append(path.name)
    for role in (STATES, COMMANDS):
        if len(by_role[role]) > 1:
            names = ", ".join(path.name for path in by_role[role])
            raise ImportFormatError(
                folder, f"has several tables of {role}: {names}; give one, and --commands"
            )
    tables = {role: open_table(by_role[role][0]) for role in (STATES, COMMANDS) if by_role[role]}
    if not tables:
        raise ImportFormatError(
            folder,
            "has no table named as states or commands (state*.csv, control.csv); it has "
            f"{some_names(others, 10) or 'nothing'}",
        )
    events = open_table(by_role["events"][0]) if by_role["events"] else None
    files = [path for paths in by_role.values() for path in paths]
    joints = _names(by_role["names"][0]) if by_role["names"] else ()
    digest = partial(digest_of, files)
    return TableSet(folder, tables, digest, joints, events, tuple(others))


def _names(path: Path) -> tuple[str, ...]:
    try:
        check_regular(path)
        if path.stat().st_size > _MOST_NAMES:
            raise ImportFormatError(path, "is no list of joints: too long")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ImportFormatError(path, f"can't be read: {error}") from error
    return tuple(name for name in text.replace(",", "\n").split() if name)


def table_folder(
    is_table: Callable[[Path], bool], open_table: Callable[[Path], TableFile]
) -> Format:
    """Return the format of folders that no other one recognises; see :func:`read_folder`."""

    def read(source: Path, output: Path, options: ImportOptions) -> list[ImportReport]:
        from ..table_import import with_options

        if options.commands is not None:
            raise UsageError(f"{source} is a folder; --commands goes with a table of states")
        return [with_options(read_folder(source, is_table, open_table), output, options)]

    reader = DirectReader(read, "holds tables", TABLE_OPTIONS)
    return Format("folder", "folder of tables", (), lambda _, path: 0.1 * path.is_dir(), reader)
