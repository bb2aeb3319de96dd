"""The systemd unit that ships with the recorder, fitted to where undulog is installed."""

from __future__ import annotations

import sys
from importlib import resources
from pathlib import Path

from ..common.errors import UsageError

UNIT_NAME = "undulog-record@.service"
"""File name of the unit; what stands after the @ names the settings."""

HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - named, not used
"""Folders that the unit hides from the recorder."""

_REFUSED = "\"'\\*?["  # systemd takes no program's name with these
_SHIPPED_PROGRAM = "/usr/local/bin/undulog"


def unit_text(program: Path) -> str:
    """The unit for a program at that path.

    Args:
        program: Absolute path of the ``undulog`` command.

    Returns:
        The unit file's text.

    Raises:
        UsageError: If the path can't stand in a unit.
    """
    text = str(program)
    odd = [letter for letter in text if letter in _REFUSED or not letter.isprintable()]
    if not program.is_absolute() or odd:
        raise UsageError(
            f"{program}: a unit needs an absolute path of the command, without "
            "quotes, backslashes, *, ? and ["
        )
    place = resources.files("undulog.capture.recorder") / "shipped" / UNIT_NAME
    quoted = text.replace("%", "%%")  # which begins a specifier
    quoted = f'"{quoted}"' if " " in quoted or ";" in quoted else quoted
    return place.read_text(encoding="utf-8").replace(_SHIPPED_PROGRAM, quoted)


def installed_program() -> Path:
    """The ``undulog`` command beside the interpreter that runs this.

    Returns:
        Its absolute path.

    Raises:
        UsageError: If there is none: not installed as a package.
    """
    program = Path(sys.executable).parent / "undulog"
    if not program.is_file():
        raise UsageError(f"{program} is not there; install undulog as a package")
    return program


def hidden_folder(program: Path) -> str | None:
    """The folder above a program that the unit hides, so that the service could not start.

    Args:
        program: Path of the command.

    Returns:
        One of :data:`HIDDEN`, or None.
    """
    where = (program.absolute(), program.resolve())
    return next(
        (folder for folder in HIDDEN if any(Path(folder) in p.parents for p in where)), None
    )
