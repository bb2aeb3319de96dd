"""Sizes and durations as text: ``500MB``, ``1GiB``, ``10min``, ``1h30min``.

A number without a unit is in bytes or seconds. Units are spelt as in their standards (``kB`` is
1000 bytes, ``KiB`` 1024) and case matters. Arithmetic is exact: an amount that is not a whole
number of bytes or nanoseconds is an error, not rounded.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from itertools import pairwise

from .errors import DataError

SIZE_UNITS: Mapping[str, int] = {
    "B": 1,
    "kB": 1000,
    "MB": 1000**2,
    "GB": 1000**3,
    "TB": 1000**4,
    "KiB": 1024,
    "MiB": 1024**2,
    "GiB": 1024**3,
    "TiB": 1024**4,
}
"""Bytes in each unit of size."""

DURATION_UNITS: Mapping[str, int] = {
    "d": 86_400_000_000_000,
    "h": 3_600_000_000_000,
    "min": 60_000_000_000,
    "s": 1_000_000_000,
    "ms": 1_000_000,
    "us": 1_000,
    "ns": 1,
}
"""Nanoseconds in each unit of time, from long to short."""

LARGEST = 2**62
"""No size [B] or duration [ns] is larger: both fit a signed 64-bit number with room to add."""

_AMOUNT = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?([A-Za-z]*)")
_LONGEST_TEXT = 64


def parse_size(value: object) -> int:
    """Return a size as whole bytes.

    Args:
        value: ``500MB``, ``1.5 GiB``, or a bare whole number of bytes, as text or number.

    Raises:
        DataError: If it is no size; the message describes a valid one.
    """
    valid = "a size such as 500MB or 1GiB"
    match = _AMOUNT.fullmatch(_text(value, valid))
    if match is None:
        raise DataError(valid)
    return _whole(Fraction(match[1]) * _factor(match[2] or "B", SIZE_UNITS, "size"), "bytes")


def parse_duration_ns(value: object) -> int:
    """Return a duration as whole nanoseconds.

    Args:
        value: ``30s``, ``10min``, ``1h30min`` (long units first), or a bare number of seconds, as
            text or number.

    Raises:
        DataError: If it is no duration; the message describes a valid one.
    """
    valid = "a duration such as 30s, 10min or 1h30min"
    text = _text(value, valid)
    parts = _AMOUNT.findall(text)
    if not parts or "".join(number + unit for number, unit in parts) != text.replace(" ", ""):
        raise DataError(valid)
    if len(parts) == 1:
        if _AMOUNT.fullmatch(text) is None:  # more than one space
            raise DataError(valid)
        parts = [(parts[0][0], parts[0][1] or "s")]
    factors = [_factor(unit, DURATION_UNITS, "time") for _, unit in parts]
    if any(later >= earlier for earlier, later in pairwise(factors)):
        raise DataError(f"{valid}: each unit once, the longest first")
    amounts = zip(parts, factors, strict=True)
    total = sum((Fraction(number) * factor for (number, _), factor in amounts), Fraction(0))
    return _whole(total, "nanoseconds")


def parse_duration_s(value: object) -> float:
    """Return a duration in seconds, as :func:`parse_duration_ns`."""
    return parse_duration_ns(value) / 1e9


def format_size(size: int) -> str:
    """Format a size [B] in decimal units, e.g. ``12.3 MB``."""
    for unit in ("TB", "GB", "MB", "kB"):
        if size >= 0.9995 * SIZE_UNITS[unit]:  # 999.6 kB would show as 1e+03 kB
            return f"{size / SIZE_UNITS[unit]:.3g} {unit}"
    return f"{size} B"


def _text(value: object, valid: str) -> str:
    """Return an amount as a text of limited length."""
    if isinstance(value, int) and not 0 <= value <= LARGEST:  # slow to convert if huge
        raise DataError(valid)
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise DataError(valid)
    text = value.strip() if isinstance(value, str) else repr(value)
    if len(text) > _LONGEST_TEXT:
        raise DataError(valid)
    return text


def _factor(unit: str, units: Mapping[str, int], what: str) -> int:
    if unit not in units:
        by_case = {name.casefold(): name for name in units} | {"m": "min"}
        near = by_case.get(unit.casefold())
        hint = f" (did you mean {near}?)" if near in units else ""
        raise DataError(f"a {what} in {', '.join(units)}{hint}")
    return units[unit]


def _whole(amount: Fraction, unit: str) -> int:
    if amount.denominator != 1 or amount > LARGEST:
        raise DataError(f"a whole number of {unit}, at most 2^62")
    return int(amount)
