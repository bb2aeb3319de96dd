"""Strict reading of TOML tables: all faults are collected before an error is raised.

A :class:`StrictTable` returns the values of one TOML table. A value that is missing, of the wrong
type or out of range is added to a :class:`Faults` and replaced by a harmless substitute (NaN for
numbers: comparisons with it are false, so that one fault does not cause another); the caller raises
once at the end. Keys that were not read are faults too: a mistyped key never passes for a default.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar, cast

from .errors import DescriptionFault

_Choice = TypeVar("_Choice", bound=StrEnum)
_Value = TypeVar("_Value")

NAME_PATTERN = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
"""What a name of a robot, link, joint or sensor looks like: it becomes part of topics and files."""


_MOST_FAULTS = 200
"""Faults of one file; nobody reads more, and each takes time to describe."""
_LONGEST_TEXT = 2000
"""Characters of a key, a value or a list of valid words in a message."""
_SMALLEST = 1e-30
"""With the largest, 1e15: powers and quotients of quantities in SI units don't overflow."""

_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    ">": operator.gt,
    ">=": operator.ge,
    "<=": operator.le,
    "other than": operator.ne,
    "0 or of a size from 1e-30 to": lambda number, limit: (
        number == 0 or _SMALLEST <= abs(number) <= limit
    ),
}


def shown(value: object) -> str:
    """Format a TOML value for a fault message: strings quoted, tables by kind, arrays cut."""
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return _cut(str(value), 60)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


def listed(words: Iterable[str], actual: object = None) -> str:
    """List the valid words, ``a, b, c``; ``(did you mean b?)`` if ``actual`` is close to one."""
    valid, near = list(words), list[str]()
    if isinstance(actual, str):
        from difflib import get_close_matches

        near = get_close_matches(actual, valid, n=1)
    return (", ".join(valid) or "none") + (f" (did you mean {near[0]}?)" if near else "")


@dataclass(frozen=True)
class Bound:
    """One bound of a number, in the words of a fault: ``>= 0``."""

    comparison: str
    limit: float

    def holds(self, number: float) -> bool:
        """Return whether a number is within the bound."""
        return _COMPARISONS[self.comparison](number, self.limit)

    def __str__(self) -> str:
        """Return the bound in words."""
        return f"{self.comparison} {self.limit:g}"


def above(limit: float) -> Bound:
    """Require a number greater than the limit."""
    return Bound(">", limit)


def at_least(limit: float) -> Bound:
    """Require a number of at least the limit."""
    return Bound(">=", limit)


def at_most(limit: float) -> Bound:
    """Require a number of at most the limit."""
    return Bound("<=", limit)


NONZERO = Bound("other than", 0.0)
_USUAL = Bound("0 or of a size from 1e-30 to", 1e15)


class Faults:
    """The faults found so far, in order, each once; of very many the first ones."""

    def __init__(self) -> None:
        """Start with none."""
        self._faults: dict[DescriptionFault, None] = {}

    @property
    def full(self) -> bool:
        """Whether there are so many that no further one is noted."""
        return len(self._faults) >= _MOST_FAULTS

    def add(self, key: str, actual: str, valid: str) -> None:
        """Note a fault, long texts cut."""
        if not self.full:
            self._faults[
                DescriptionFault(*(_cut(text, _LONGEST_TEXT) for text in (key, actual, valid)))
            ] = None

    def all(self) -> tuple[DescriptionFault, ...]:
        """Return all faults, in the order found, at most 200."""
        return tuple(self._faults)


class StrictTable:
    """One TOML table, with optional defaults behind it.

    Attributes:
        faults: Where its faults are noted.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        where: str,
        faults: Faults,
        defaults: StrictTable | None = None,
    ) -> None:
        """Wrap a table.

        Args:
            where: Its key in the file, empty for the top.
            defaults: Looked into for keys that this table lacks.
        """
        self.values = values
        self.faults = faults
        self._where, self._defaults = where, defaults
        self._asked: dict[str, None] = {}

    def __contains__(self, key: str) -> bool:
        """Return whether the table itself has the key."""
        self._asked[key] = None
        return key in self.values

    def over(self, defaults: StrictTable) -> StrictTable:
        """Return the same table, nothing read yet, with defaults behind it."""
        return StrictTable(self.values, self._where, self.faults, defaults)

    def replaced(self, values: Mapping[str, Any]) -> StrictTable:
        """Return a table of other values in the same place."""
        return StrictTable(values, self._where, self.faults)

    def key(self, key: str) -> str:
        """Return the full key, e.g. ``joints[3].plane``."""
        return f"{self._where}.{key}" if self._where else key

    def fault(self, key: str, valid: str, actual: str | None = None) -> None:
        """Note a fault of one key.

        Args:
            actual: What stands there; by default the value itself, ``nothing`` when absent.
        """
        where, value = self.look(key)
        self.faults.add(where, actual or ("nothing" if value is None else shown(value)), valid)

    def look(self, key: str) -> tuple[str, object]:
        """Look a key up, first here, then in the defaults.

        Returns:
            The full key where it was found and the value; the key here and None where absent.
        """
        self._asked[key] = None
        if self._defaults is not None:
            where, value = self._defaults.look(key)
            if key not in self.values and value is not None:
                return where, value
        return self.key(key), self.values.get(key)

    def _value(
        self,
        key: str,
        default: _Value | None,
        convert: Callable[[object], _Value | None],
        valid: str,
        substitute: _Value,
    ) -> _Value:
        """Return a converted value, the default when absent, the substitute after a fault."""
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        result = convert(value)
        if result is None:
            self.fault(key, valid)
            return substitute
        return result

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string; ``""`` after a fault. Without a default it is required."""
        return self._value(
            key, default, lambda value: value if isinstance(value, str) else None, "a string", ""
        )

    def name(self, key: str, default: str | None = None) -> str:
        """Return a name that can be part of a topic; ``""`` after a fault."""
        valid = "a name of letters, digits, _ and -, beginning with a letter"
        return self._value(key, default, _name, valid, "")

    def choice(
        self, key: str, kinds: Iterable[_Choice], default: _Choice | None = None
    ) -> _Choice | None:
        """Read one of a few words; None after a fault. Without a default it is required."""
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        words = {str(kind): kind for kind in kinds}
        if not isinstance(value, str) or value not in words:
            self.fault(key, listed(words, value))
            return None
        return words[value]

    def number(self, key: str, *bounds: Bound, default: float | None = None) -> float:
        """Read a finite number within the bounds; NaN after a fault. Required without a default.

        A default need not be within the bounds.
        """
        number = finite_number(self.look(key)[1])
        good = number is not None and all(bound.holds(number) for bound in (*bounds, _USUAL))
        limits = " and ".join(_limits(bounds, [] if number is None else [number]))
        valid = f"a finite number {limits}".strip()
        return self._value(key, default, lambda _: number if good else None, valid, math.nan)

    def integer(self, key: str, least: int, default: int | None = None) -> int:
        """Return a whole number from ``least`` on; ``least`` after a fault."""

        def convert(value: object) -> int | None:
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                return None
            return value

        return self._value(key, default, convert, f"a whole number >= {least}", least)

    def flag(self, key: str, *, default: bool) -> bool:
        """Return true or false; the default when absent or after a fault."""
        return self._value(
            key,
            default,
            lambda value: value if isinstance(value, bool) else None,
            "true or false",
            default,
        )

    def numbers(
        self,
        key: str,
        count: int,
        *bounds: Bound,
        default: tuple[float, ...] | None = None,
    ) -> tuple[float, ...]:
        """Read an array of finite numbers, each within the bounds; NaN after a fault.

        Without a default it is required.
        """
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        entries = cast("list[object]", value) if isinstance(value, list) else []
        numbers = [n for n in map(finite_number, entries) if n is not None]
        good = all(bound.holds(number) for bound in (*bounds, _USUAL) for number in numbers)
        if good and len(entries) == len(numbers) == count:
            return tuple(numbers)
        limits = "".join(f", each {word}" for word in _limits(bounds, numbers))
        self.fault(key, f"an array of {count} finite numbers{limits}")
        return (math.nan,) * count

    def words(self, key: str, *, valid: Iterable[str] | None = None) -> tuple[str, ...]:
        """Read an array of different strings; empty when absent, without the invalid ones.

        Args:
            valid: The words to choose from; any string when None.
        """
        value = self.look(key)[1]
        if value is None:
            return ()
        if not isinstance(value, list):
            self.fault(key, "an array of strings")
            return ()
        choices = None if valid is None else list(valid)
        good: dict[str, None] = {}
        for i, word in enumerate(cast("list[object]", value)):
            where = f"{self.look(key)[0]}[{i}]"
            if self.faults.full:
                break
            if not isinstance(word, str):
                self.faults.add(where, shown(word), "a string")
            elif choices is not None and word not in choices:
                self.faults.add(where, shown(word), listed(choices, word))
            elif word in good:
                self.faults.add(where, shown(word), "a key that is not there already")
            else:
                good[word] = None
        return tuple(good)

    def table(self, key: str, defaults: StrictTable | None = None) -> StrictTable:
        """Read a sub-table, with its defaults; an empty one when absent or after a fault."""
        self._asked[key] = None
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            self.fault(key, "a table")
            value = {}
        return StrictTable(cast("dict[str, Any]", value), self.key(key), self.faults, defaults)

    def tables(self, key: str) -> list[StrictTable]:
        """Read an array of tables; empty when absent, without the invalid ones."""
        self._asked[key] = None
        value = self.values.get(key, [])
        if not isinstance(value, list):
            self.fault(key, "an array of tables")
            return []
        good: list[StrictTable] = []
        for i, entry in enumerate(cast("list[object]", value)):
            where = f"{self.key(key)}[{i}]"
            if isinstance(entry, dict):
                good.append(StrictTable(cast("dict[str, Any]", entry), where, self.faults))
            else:
                self.faults.add(where, shown(entry), "a table")
        return good

    def close(self) -> None:
        """Note every key of this table that was not read."""
        for key in self.values:
            if self.faults.full:
                return
            if key not in self._asked:
                self.faults.add(self.key(key), "an unknown key", listed(self._asked, key))


def _name(value: object) -> str | None:
    return value if isinstance(value, str) and NAME_PATTERN.fullmatch(value) else None


def _limits(bounds: Iterable[Bound], numbers: Iterable[float]) -> list[str]:
    """Return the bounds in words; that of the size only where a number violates it."""
    usual = all(map(_USUAL.holds, numbers))
    return [str(bound) for bound in bounds] + ([] if usual else [str(_USUAL)])


def finite_number(value: object) -> float | None:
    """Return a finite number from TOML or JSON, else None; booleans are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:  # an integer beyond the range of a double
        return None
    return number if math.isfinite(number) else None
