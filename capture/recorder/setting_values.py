"""One value of each setting, from TOML, from text, or from the command line's own types.

A parser takes what was given and returns the value, or raises a DataError whose text says what
would be valid.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, cast

from ..common.amounts import SIZE_UNITS, parse_duration_s, parse_size
from ..common.errors import DataError

_Number = TypeVar("_Number", int, float)

_YES, _NO = ("true", "1", "yes", "on"), ("false", "0", "no", "off")
_FACT = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")
_SMALLEST_PART = SIZE_UNITS["MB"]


def _flag(value: object) -> bool:
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.lower() in _YES + _NO:
        return value.lower() in _YES
    raise DataError("true or false")


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise DataError("a string")
    return value


def _word(value: object) -> str:
    text = _text(value)
    if not text.strip() or "\n" in text:
        raise DataError("a string, not empty, on one line")
    return text


def _path(value: object) -> Path:
    if isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    if isinstance(value, Path):
        return value
    raise DataError("a path")


def _output(value: object) -> Path:
    path = _path(value)
    if path.suffix.lower() != ".mcap":
        raise DataError("a file that ends in .mcap")
    return path


def _words(value: object) -> list[str]:
    """Strings of an array, or of one text as a shell would split it."""
    if isinstance(value, str):
        try:
            return shlex.split(value)
        except ValueError as error:  # an open quote
            raise DataError("words with every quote closed") from error
    entries = list(cast("list[object]", value)) if isinstance(value, list | tuple) else [None]
    if not all(isinstance(entry, str) for entry in entries):
        raise DataError("an array of strings")
    return cast("list[str]", entries)


def _sources(value: object) -> tuple[str, ...]:
    words = _words(value)
    if not words or not all(":" in word for word in words) or len(set(words)) != len(words):
        raise DataError("one or more different source addresses, e.g. can:socketcan:can0")
    return tuple(words)


def _facts(value: object) -> Mapping[str, str]:
    """Facts of a table, or of ``KEY=VALUE`` words."""
    wanted = "names with strings, e.g. place=tank; a name has letters, digits, _, - and ."
    if isinstance(value, Mapping):
        facts = dict(cast("Mapping[object, object]", value))
    else:
        words = _words(value)
        if not all("=" in word for word in words):
            raise DataError(wanted)
        pairs = [word.split("=", 1) for word in words]
        facts = dict(cast("list[tuple[object, object]]", pairs))
        if len(facts) != len(pairs):
            raise DataError("each name once")
    for name, text in facts.items():
        if not (isinstance(name, str) and _FACT.fullmatch(name) and isinstance(text, str)):
            raise DataError(wanted)
    return MappingProxyType(cast("dict[str, str]", facts))


def _at_least(
    parse: Callable[[object], _Number], least: _Number, valid: str
) -> Callable[[object], _Number]:
    def checked(value: object) -> _Number:
        amount = parse(value)
        if amount < least:
            raise DataError(valid)
        return amount

    return checked


PARSERS: Mapping[str, Callable[[object], Any]] = MappingProxyType(
    {
        "sources": _sources,
        "robot": _word,
        "bus": _word,
        "output": _output,
        "force": _flag,
        "duration": _at_least(parse_duration_s, 0.001, "a duration of at least 1ms"),
        "split_size": _at_least(parse_size, _SMALLEST_PART, "a size of at least 1MB"),
        "split_time": _at_least(parse_duration_s, 1.0, "a duration of at least 1s"),
        "ring": _at_least(parse_duration_s, 1.0, "a duration of at least 1s"),
        "floor": parse_size,
        "socket": _path,
        "live": _flag,
        "operator": _word,
        "notes": _text,
        "metadata": _facts,
        "fast": _flag,
        "quiet": _flag,
    }
)
"""Name of a setting to what reads its value."""
