"""Sizes and durations as people write them: ``500MB``, ``1GiB``, ``10min``, ``1h30min``.

A number needs its unit, except that a bare one is bytes or seconds. Units are spelt as their
standards have them (``kB`` is 1000 bytes, ``KiB`` 1024), case included: ``mb`` might be anything.
Arithmetic is exact: what is no whole number of bytes or nanoseconds is refused, not rounded.
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
    """A size as whole bytes.

    Args:
        value: ``500MB``, ``1.5 GiB``, or a bare whole number of bytes, as text or number.

    Returns:
        The size [B], at least 0.

    Raises:
        DataError: If it is no size; says what would be.
    """
    number, unit = _split(value, "a size such as 500MB or 1GiB")
    factor = _factor(unit or "B", SIZE_UNITS, "size")
    return _whole(number * factor, "bytes")


def parse_duration_ns(value: object) -> int:
    """A duration as whole nanoseconds.

    Args:
        value: ``30s``, ``10min``, ``1h30min`` (long units first), or a bare number of seconds, as
            text or number.

    Returns:
        The duration [ns], at least 0.

    Raises:
        DataError: If it is no duration; says what would be.
    """
    wanted = "a duration such as 30s, 10min or 1h30min"
    text = value.strip() if isinstance(value, str) else value
    parts = _AMOUNT.findall(text) if isinstance(text, str) and len(text) <= _LONGEST_TEXT else []
    if len(parts) < 2 or not isinstance(text, str):
        number, unit = _split(text, wanted)
        return _whole(number * _factor(unit or "s", DURATION_UNITS, "time"), "nanoseconds")
    if "".join(number + unit for number, unit in parts) != text.replace(" ", ""):
        raise DataError(wanted)
    factors = [_factor(unit, DURATION_UNITS, "time") for _, unit in parts]
    if any(later >= earlier for earlier, later in pairwise(factors)):
        raise DataError(f"{wanted}: each unit once, the longest first")
    total = Fraction(0)
    for (number, _), factor in zip(parts, factors, strict=True):
        total += Fraction(number) * factor
    return _whole(total, "nanoseconds")


def parse_duration_s(value: object) -> float:
    """A duration in seconds.

    Args:
        value: As :func:`parse_duration_ns` takes it.

    Returns:
        The duration [s], at least 0.

    Raises:
        DataError: If it is no duration; says what would be.
    """
    return parse_duration_ns(value) / 1e9


def format_size(size: int) -> str:
    """A size as people read it.

    Args:
        size: [B].

    Returns:
        E.g. ``12.3 MB``; decimal units.
    """
    for unit in ("TB", "GB", "MB", "kB"):
        if size >= 0.9995 * SIZE_UNITS[unit]:  # 999.6 kB would show as 1e+03 kB
            return f"{size / SIZE_UNITS[unit]:.3g} {unit}"
    return f"{size} B"


def _split(value: object, wanted: str) -> tuple[Fraction, str]:
    """A number and its unit; the unit is empty where there is none."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        text = repr(value) if isinstance(value, float) else _digits(value, wanted)
    elif isinstance(value, str):
        text = value.strip()
    else:
        raise DataError(wanted)
    found = _AMOUNT.fullmatch(text) if len(text) <= _LONGEST_TEXT else None
    if found is None:
        raise DataError(wanted)
    return Fraction(found[1]), found[2]


def _digits(value: int, wanted: str) -> str:
    if not 0 <= value <= LARGEST:  # also spares the slow conversion of huge numbers
        raise DataError(wanted)
    return str(value)


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
