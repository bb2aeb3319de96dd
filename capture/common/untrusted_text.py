"""TOML, JSON and YAML of any origin: bounds of length, depth and key length.

The standard parsers take time that grows with the square of a dotted key's length, and end in a
RecursionError where values nest; here such text is refused by a sentence before or after.
"""

from __future__ import annotations

import json
import re
from typing import Any, cast

_DEEPEST = 64
"""Tables and arrays in each other; recursion over deeper ones would overflow the stack."""
_MOST_PARTS = 64
"""Parts of a dotted key or table header; each is a table in another, so no more than those."""
_LONGEST = 4 << 20
"""Characters of a TOML text; the largest robot descriptions have some 100,000. The parser takes
about a second for each million."""
_MOST_FLOW = 20_000
"""Items of YAML in brackets, for which its parser takes 50 us each."""
_INTEGERS = range(-(2**63), 2**63)
_DIGITS = 20
"""Characters that an integer of 64 bits may take, its sign included."""
_TOO_DEEP = f"nested more than {_DEEPEST} deep"
_TOO_LARGE = "an integer of more than 64 bits"

# An unclosed text reaches to the end of the line or file, so that the search stays linear.
_TOKEN = re.compile(
    r'"""[^"\\]*(?:(?:\\.|"{1,2}(?!"))[^"\\]*)*(?:"{3,5}|\Z)'  # texts of several lines
    r"|'''[^']*(?:'{1,2}(?!')[^']*)*(?:'{3,5}|\Z)"
    r"|(?P<comment>\#[^\n]*)"
    r"""|(?P<part>"(?:\\.|[^"\\\n])*"?|'[^'\n]*'?|[A-Za-z0-9_-]+)"""
    r"|(?P<space>[ \t]+)"
    r"|(?P<dot>\.)"
    r"|(?P<open>[\[{])"
    r"|(?P<close>[\]}])"
    r"|.",
    re.DOTALL,
)


def read_toml(text: str) -> dict[str, Any]:
    """Read a TOML text of any origin.

    Raises:
        ValueError: If it is not TOML, longer than 4 MiB, has an integer of more than 64 bits, a
            dotted key of more than 64 parts, or nests tables and arrays more than 64 deep.
    """
    import tomllib

    if len(text) > _LONGEST:
        raise ValueError(f"longer than {_LONGEST >> 20} MiB")
    _check_shape(text)
    try:
        values = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # more digits than Python turns into a number
        raise ValueError(_TOO_LARGE) from error
    _check_values(values)
    return values


def read_json(text: str | bytes) -> Any:
    """Read a JSON text of any origin.

    Raises:
        ValueError: If it is not JSON in UTF-8, has an integer of more than 64 bits, or nests more
            than 64 deep.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    try:
        values = json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _check_values(values)
    return values


def check_yaml(text: str) -> None:
    """Check the shape of a YAML text before it is parsed, by brackets and commas wherever they are.

    Aliases are no danger where values stay texts and merges aren't computed: they share an object.

    Raises:
        ValueError: If brackets nest more than 64 deep, or hold more than 20,000 items.
    """
    depth = 0
    for items, mark in enumerate(re.finditer(r"[\[\]{},]", text)):
        depth += (mark[0] in "[{") - (mark[0] in "]}" and depth > 0)
        if depth > _DEEPEST:
            raise ValueError(_TOO_DEEP)
        if items > _MOST_FLOW:
            raise ValueError(f"more than {_MOST_FLOW} items in brackets")


def _integer(text: str) -> int:
    if len(text) > _DIGITS:
        raise ValueError(_TOO_LARGE)
    return int(text)


def _check_shape(text: str) -> None:
    """Check the depth of brackets and the length of dotted keys, outside texts and comments."""
    depth = parts = 0
    after_dot = False
    for token in _TOKEN.finditer(text):
        kind = token.lastgroup
        if kind == "space":
            continue
        if kind == "part":
            parts = parts + 1 if after_dot else 1
            if parts > _MOST_PARTS:
                raise ValueError(f"a dotted key of more than {_MOST_PARTS} parts")
        elif kind == "open":
            depth += 1
            if depth > _DEEPEST:
                raise ValueError(_TOO_DEEP)
        elif kind == "close":
            depth = max(0, depth - 1)
        if kind not in ("part", "dot"):
            parts = 0
        after_dot = kind == "dot"


def _check_values(values: object) -> None:
    level: list[object] = [values]
    for _ in range(_DEEPEST):
        inner: list[object] = []
        for value in level:
            if isinstance(value, dict):
                inner += cast("dict[str, object]", value).values()
            elif isinstance(value, list):
                inner += cast("list[object]", value)
            elif isinstance(value, int) and value not in _INTEGERS:
                raise ValueError(_TOO_LARGE)
        if not inner:
            return
        level = inner
    raise ValueError(_TOO_DEEP)
