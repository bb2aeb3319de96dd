"""Parts of the analysis that other packages add by entry points (``docs/reference/parts.md``)."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from functools import cache
from typing import Any, ParamSpec, TypeVar, cast

from undulog.capture.common.entry_points import added_objects
from undulog.capture.common.errors import DataError, UndulogError, UsageError

from ..parts.part import Part
from ..parts.shown import Shown
from ..results.analysis import Analysis, plain_result
from .parts import PARTS

ENTRY_POINTS = "undulog.parts"
"""Group of the entry points."""

P = ParamSpec("P")
T = TypeVar("T")

_NAME = re.compile(r"[a-z][a-z0-9_]*")


@cache
def added_parts() -> tuple[Part[Any], ...]:
    """Return the parts that other packages add, by name.

    Raises:
        UsageError: If one can't be loaded, is no part, or claims a name that is taken.
    """
    taken = {part.name for part in PARTS} | {entry.name for entry in dataclasses.fields(Analysis)}
    added: list[Part[Any]] = []
    for name, label, loaded in added_objects(ENTRY_POINTS, "part"):
        part = _usable(name, label, loaded)
        if name in taken:
            raise UsageError(f"{label} claims a key that is taken; give it another name")
        taken.add(part.name)
        added.append(part)
    return tuple(added)


def _usable(name: str, label: str, part: object) -> Part[Any]:
    if not isinstance(part, Part):
        raise UsageError(f"{label} is no undulog.analysis.parts.part.Part")
    added = cast("Part[Any]", part)
    if added.result is None or added.name != name or not _NAME.fullmatch(added.name):
        raise UsageError(
            f"{label} needs a 'result' and the name of its entry point: small letters, digits and _"
        )
    show = None if added.show is None else _guarded(added.name, added.show)
    return dataclasses.replace(added, measure=_guarded(added.name, added.measure), show=show)


def _guarded(name: str, function: Callable[P, T]) -> Callable[P, T]:
    """Return a function of an added part whose failure names the part."""

    def call(*arguments: P.args, **options: P.kwargs) -> T:
        try:
            return function(*arguments, **options)
        except UndulogError:
            raise
        except Exception as error:
            raise DataError(
                f"the part {name!r} failed: {type(error).__name__}: {error}; correct or remove it"
            ) from error

    return call


def checked(part: Part[Any], result: object) -> object:
    """Return the result of an added part, which stands in the JSON.

    Raises:
        DataError: If it is no result of its kind, or can't stand in JSON.
    """
    why = "" if isinstance(result, part.result or ()) else f"it is a {type(result).__name__}"
    try:
        json.dumps(plain_result(result), allow_nan=False)
    except (TypeError, ValueError) as error:
        why = str(error)
    if why:
        raise DataError(f"the result of the part {part.name!r} is none: {why}")
    return result


def shown(name: str, result: object) -> Shown | None:
    """Return tables and figures of the result of a part; None where it shows nothing."""
    part = next((part for part in (*PARTS, *added_parts()) if part.name == name), None)
    if part is None or part.show is None or not isinstance(result, part.result or ()):
        return None
    return part.show(result)
