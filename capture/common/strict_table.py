"""Strict reading of TOML tables: every fault noted, none raised until all are known.

A :class:`Table` hands out the values of one TOML table. A value that is missing, of the wrong type
or out of range is noted in a :class:`Faults` and replaced by a harmless stand-in (NaN for numbers,
so that comparisons with it are false and one fault does not beget another); the caller raises once
at the end. Keys that nobody asked for are faults too: a mistyped key never passes for a default.
"""

from __future__ import annotations

import difflib
import math
import operator
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar, cast

from .errors import Fault

_Choice = TypeVar("_Choice", bound=StrEnum)

NAME_PATTERN = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
"""What a name of a robot, link, joint or sensor looks like: it becomes part of topics and files."""


_DEEPEST = 64
"""Tables and arrays in each other; deeper ones would end what walks them by a full stack."""
_INTEGERS = range(-(2**63), 2**63)
_LARGEST = 1e15
_SMALLEST = 1e-30
"""No quantity in SI units is beyond; powers and quotients of those within don't overflow."""


def read_toml(text: str) -> dict[str, Any]:
    """Read a TOML text of any origin.

    Returns:
        Its tables: at most 64 of them, or arrays, in each other, and integers of 64 bits.

    Raises:
        ValueError: If it is no such TOML; says what is wrong.
    """
    try:
        values = tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"nested more than {_DEEPEST} deep") from None
    level: list[object] = [values]
    for _ in range(_DEEPEST):
        inner: list[object] = []
        for value in level:
            if isinstance(value, dict):
                inner += cast("dict[str, object]", value).values()
            elif isinstance(value, list):
                inner += cast("list[object]", value)
            elif isinstance(value, int) and value not in _INTEGERS:
                raise ValueError("an integer of more than 64 bits")
        if not inner:
            return values
        level = inner
    raise ValueError(f"nested more than {_DEEPEST} deep")


def shown(value: object) -> str:
    """A TOML value as a fault message shows it: strings quoted, tables by kind, arrays cut."""
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def listed(words: Iterable[str], found: object = None) -> str:
    """The valid words, ``a, b, c``; where ``found`` is nearly one, ``(did you mean b?)`` after."""
    valid = list(words)
    near = difflib.get_close_matches(found, valid, n=1) if isinstance(found, str) else []
    hint = f" (did you mean {near[0]}?)" if near else ""
    return (", ".join(valid) or "none") + hint


_COMPARISONS = {
    ">": operator.gt,
    ">=": operator.ge,
    "<=": operator.le,
    "other than": operator.ne,
}


@dataclass(frozen=True)
class Bound:
    """One bound of a number, in words as a fault shows it: ``>= 0``."""

    comparison: str
    limit: float

    def holds(self, number: float) -> bool:
        """Whether a number is within the bound."""
        return _COMPARISONS[self.comparison](number, self.limit)

    def __str__(self) -> str:
        """The bound in words."""
        return f"{self.comparison} {self.limit:g}"


def above(limit: float) -> Bound:
    """The number must be greater than the limit."""
    return Bound(">", limit)


def at_least(limit: float) -> Bound:
    """The number must not be less than the limit."""
    return Bound(">=", limit)


def at_most(limit: float) -> Bound:
    """The number must not be greater than the limit."""
    return Bound("<=", limit)


NONZERO = Bound("other than", 0.0)


class Faults:
    """The faults found so far, in order, each once."""

    def __init__(self) -> None:
        """Start with none."""
        self._faults: dict[Fault, None] = {}

    def add(self, key: str, found: str, valid: str) -> None:
        """Note a fault.

        Args:
            key: Where it is, e.g. ``joints[3].plane``.
        """
        self._faults[Fault(key, found, valid)] = None

    def all(self) -> tuple[Fault, ...]:
        """All faults, in the order found."""
        return tuple(self._faults)


class Table:
    """One TOML table, with optional defaults behind it.

    Attributes:
        faults: Where its faults are noted.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        where: str,
        faults: Faults,
        defaults: Table | None = None,
    ) -> None:
        """Wrap a table.

        Args:
            where: Its key in the file, empty for the top.
            defaults: Looked into for keys that this table lacks.
        """
        self.values = values
        self.faults = faults
        self._where = where
        self._defaults = defaults
        self._asked: dict[str, None] = {}

    def __contains__(self, key: str) -> bool:
        """Whether the table itself has the key."""
        self._asked[key] = None
        return key in self.values

    def over(self, defaults: Table) -> Table:
        """The same table, nothing read yet, with defaults behind it."""
        return Table(self.values, self._where, self.faults, defaults)

    def replaced(self, values: Mapping[str, Any]) -> Table:
        """A table of other values in the same place."""
        return Table(values, self._where, self.faults)

    def key(self, key: str) -> str:
        """The full key, e.g. ``joints[3].plane``."""
        return f"{self._where}.{key}" if self._where else key

    def fault(self, key: str, valid: str, found: str | None = None) -> None:
        """Note a fault of one key.

        Args:
            found: What stands there; by default the value itself, ``nothing`` when absent.
        """
        where, value = self.look(key)
        text = found or ("nothing" if value is None else shown(value))
        self.faults.add(where, text, valid)

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

    def text(self, key: str, default: str | None = None) -> str:
        """A string; ``""`` after a fault. Without a default it is required."""
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        if not isinstance(value, str):
            self.fault(key, "a string")
            return ""
        return value

    def name(self, key: str, default: str | None = None) -> str:
        """A name that can be part of a topic; ``""`` after a fault."""
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        if not isinstance(value, str) or not NAME_PATTERN.fullmatch(value):
            self.fault(key, "a name of letters, digits, _ and -, beginning with a letter")
            return ""
        return value

    def choice(
        self, key: str, kinds: Iterable[_Choice], default: _Choice | None = None
    ) -> _Choice | None:
        """One of a few words; None after a fault. Without a default it is required."""
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        words = {str(kind): kind for kind in kinds}
        if not isinstance(value, str) or value not in words:
            self.fault(key, listed(words, value))
            return None
        return words[value]

    def number(self, key: str, *bounds: Bound, default: float | None = None) -> float:
        """A finite number within the bounds; NaN after a fault. Without a default it is required.

        A default need not be within the bounds.
        """
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        number = finite_number(value)
        usual = number is None or _is_usual(number)
        if number is not None and usual and all(bound.holds(number) for bound in bounds):
            return number
        words = [str(bound) for bound in bounds] + ([] if usual else [_USUAL])
        self.fault(key, f"a finite number {' and '.join(words)}".strip())
        return math.nan

    def integer(self, key: str, least: int, default: int | None = None) -> int:
        """A whole number from ``least`` on, which stands in after a fault."""
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            self.fault(key, f"a whole number >= {least}")
            return least
        return value

    def flag(self, key: str, *, default: bool) -> bool:
        """True or false; the default when absent or after a fault."""
        value = self.look(key)[1]
        if value is None or isinstance(value, bool):
            return default if value is None else value
        self.fault(key, "true or false")
        return default

    def numbers(
        self,
        key: str,
        count: int,
        *bounds: Bound,
        default: tuple[float, ...] | None = None,
    ) -> tuple[float, ...]:
        """An array of finite numbers, each within the bounds; NaN after a fault.

        Without a default it is required.
        """
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        entries = cast("list[object]", value) if isinstance(value, list) else []
        numbers = [n for n in map(finite_number, entries) if n is not None]
        usual = all(_is_usual(number) for number in numbers)
        bad = any(not bound.holds(number) for bound in bounds for number in numbers)
        if len(entries) != count or len(numbers) != count or bad or not usual:
            words = [str(bound) for bound in bounds] + ([] if usual else [_USUAL])
            each = "".join(f", each {word}" for word in words)
            self.fault(key, f"an array of {count} finite numbers{each}")
            return (math.nan,) * count
        return tuple(numbers)

    def words(self, key: str, *, valid: Iterable[str] | None = None) -> tuple[str, ...]:
        """An array of different strings; empty when absent, without the bad ones after a fault.

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
            if not isinstance(word, str):
                self.faults.add(where, shown(word), "a string")
            elif choices is not None and word not in choices:
                self.faults.add(where, shown(word), listed(choices, word))
            elif word in good:
                self.faults.add(where, shown(word), "a key that is not there already")
            else:
                good[word] = None
        return tuple(good)

    def table(self, key: str, defaults: Table | None = None) -> Table:
        """A sub-table, with its defaults; an empty one when absent or after a fault."""
        self._asked[key] = None
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            self.fault(key, "a table")
            value = {}
        return Table(cast("dict[str, Any]", value), self.key(key), self.faults, defaults)

    def tables(self, key: str) -> list[Table]:
        """An array of tables; empty when absent, without the bad ones after a fault."""
        self._asked[key] = None
        value = self.values.get(key, [])
        if not isinstance(value, list):
            self.fault(key, "an array of tables")
            return []
        good: list[Table] = []
        for i, entry in enumerate(cast("list[object]", value)):
            where = f"{self.key(key)}[{i}]"
            if isinstance(entry, dict):
                good.append(Table(cast("dict[str, Any]", entry), where, self.faults))
            else:
                self.faults.add(where, shown(entry), "a table")
        return good

    def close(self) -> None:
        """Note every key of this table that nobody asked for."""
        for key in self.values:
            if key not in self._asked:
                self.faults.add(self.key(key), "an unknown key", listed(self._asked, key))


_USUAL = f"0 or of a size from {_SMALLEST:g} to {_LARGEST:g}"


def _is_usual(number: float) -> bool:
    return number == 0 or _SMALLEST <= abs(number) <= _LARGEST


def finite_number(value: object) -> float | None:
    """A finite number from TOML or JSON, else None; booleans are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:  # an integer beyond the range of a double
        return None
    return number if math.isfinite(number) else None
