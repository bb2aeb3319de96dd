"""Formats that other packages add by entry points (``docs/reference/formats.md``)."""

from __future__ import annotations

import re
from collections.abc import Collection
from functools import cache
from typing import Any, cast

from ...common.entry_points import added_objects
from ...common.errors import UsageError
from ..formats.format import Format, Reader, Writer

ENTRY_POINTS = "undulog.formats"
"""Group of the entry points."""

_NAME = re.compile(r"[a-z][a-z0-9_-]*")
_SUFFIX = re.compile(r"\.[a-z0-9_-]+")


@cache
def added_formats(taken: Collection[str] = ()) -> tuple[Format, ...]:
    """Return the formats that other packages add, by name.

    Args:
        taken: Names that they can't have.

    Raises:
        UsageError: If one can't be loaded, is no format, or has a name that is taken.
    """
    names = set(taken)
    added: list[Format] = []
    for name, label, loaded in added_objects(ENTRY_POINTS, "format"):
        form = _checked(name, label, loaded)
        if name in names:
            raise UsageError(f"{label} has a name that is taken; give it another one")
        names.add(form.name)
        added.append(form)
    return tuple(added)


def _checked(name: str, label: str, form: object) -> Format:
    if not isinstance(form, Format):
        raise UsageError(f"{label} is no undulog.capture.exchange.formats.format.Format")
    if form.name != name or not _NAME.fullmatch(form.name):
        raise UsageError(
            f"{label}: its 'name' has to be that of its entry point, of small letters, "
            "digits, - and _"
        )
    if fault := _fault(vars(form)):
        raise UsageError(f"{label}: {fault}")
    return form


def _fault(fields: dict[str, Any]) -> str:
    """Return which field is wrong and what it has to be; empty if none is."""
    title, suffixes, read, write = (fields[n] for n in ("title", "suffixes", "read", "write"))
    are_suffixes = isinstance(suffixes, tuple) and all(map(_is_suffix, cast("Any", suffixes)))
    checks: dict[str, bool] = {
        "its 'title' has to be a text": bool(isinstance(title, str) and title),
        "its 'suffixes' have to be a tuple of texts such as '.abc', in small letters": are_suffixes,
        "its 'sniff' has to be a function of bytes and path": callable(fields["sniff"]),
        "its 'read' has to be a reader": isinstance(read, Reader | None),
        "its 'write' has to be a writer": isinstance(write, Writer | None),
        "it needs 'read' or 'write'": not (read is write is None),
        "its 'write' needs a suffix": write is None or suffixes != (),
    }
    return next((why for why, is_right in checks.items() if not is_right), "")


def _is_suffix(suffix: object) -> bool:
    return isinstance(suffix, str) and _SUFFIX.fullmatch(suffix) is not None
