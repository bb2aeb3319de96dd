"""TOML text of nested tables, for what undulog writes itself (the standard library only reads)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, cast


def toml_text(values: Mapping[str, Any]) -> str:
    """Write nested tables as TOML.

    Args:
        values: Strings, numbers, booleans, arrays of these, and tables, these
            in arrays too; the keys bare words.

    Returns:
        TOML text: plain keys first, then the tables.
    """
    return "\n".join(_lines(values, "")) + "\n"


def _lines(values: Mapping[str, Any], where: str) -> list[str]:
    plain = [f"{key} = {_value(v)}" for key, v in values.items() if not isinstance(v, Mapping)]
    lines = [*([f"\n[{where}]"] if where else []), *plain]
    for key, value in values.items():
        if isinstance(value, Mapping):
            table = cast("Mapping[str, Any]", value)
            lines += _lines(table, f"{where}.{key}" if where else key)
    return lines


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON escapes what TOML wants escaped, but for DEL.
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):  # in an array
        table = cast("Mapping[str, object]", value)
        return "{ " + ", ".join(f"{key} = {_value(v)}" for key, v in table.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_value, cast("Sequence[object]", value))) + "]"
    raise TypeError(f"TOML has no {type(value).__name__}")
