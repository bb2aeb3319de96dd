"""Strict reading of TOML tables: every fault noted, none raised until all are known.

A :class:`Table` hands out the values of one TOML table. A value that is missing, of the wrong type
or out of range is noted in a :class:`Faults` and replaced by a harmless stand-in (NaN for numbers,
so that comparisons with it are false and one fault does not beget another); the caller raises once
at the end. Keys that nobody asked for are faults too: a mistyped key never passes for a default.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
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

    Args:
        text: The text.

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
    """A value as a fault message shows it.

    Args:
        value: Anything TOML can hold.

    Returns:
        Strings quoted, tables and long arrays by kind.
    """
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def listed(words: Iterable[str], found: object = None) -> str:
    """The valid words, nearest first named where ``found`` looks like a slip.

    Args:
        words: The valid words.
        found: What stands there.

    Returns:
        ``a, b, c`` and, for a near miss, ``; did you mean b?``.
    """
    valid = list(words)
    near = difflib.get_close_matches(found, valid, n=1) if isinstance(found, str) else []
    hint = f" (did you mean {near[0]}?)" if near else ""
    return (", ".join(valid) or "none") + hint


class Faults:
    """The faults found so far, in order, each once."""

    def __init__(self) -> None:
        """Start with none."""
        self._faults: dict[Fault, None] = {}

    def add(self, key: str, found: str, valid: str) -> None:
        """Note a fault.

        Args:
            key: Where it is, e.g. ``joints[3].plane``.
            found: What stands there.
            valid: What would be valid.
        """
        self._faults[Fault(key, found, valid)] = None

    def all(self) -> tuple[Fault, ...]:
        """All faults, in the order found."""
        return tuple(self._faults)


class Table:
    """One TOML table, with optional defaults behind it."""

    def __init__(
        self,
        values: Mapping[str, Any],
        where: str,
        faults: Faults,
        defaults: Table | None = None,
    ) -> None:
        """Wrap a table.

        Args:
            values: The parsed table.
            where: Its key in the file, empty for the top.
            faults: Where faults are noted.
            defaults: Looked into for keys that this table lacks.
        """
        self._values = values
        self._where = where
        self._faults = faults
        self._defaults = defaults
        self._asked: dict[str, None] = {}

    def __contains__(self, key: str) -> bool:
        """Whether the table itself has the key."""
        self._asked[key] = None
        return key in self._values

    def key(self, key: str) -> str:
        """The full key, e.g. ``joints[3].plane``.

        Args:
            key: Key in this table.

        Returns:
            Key from the top of the file.
        """
        return f"{self._where}.{key}" if self._where else key

    @property
    def faults(self) -> Faults:
        """Where faults of this table are noted."""
        return self._faults

    def fault(self, key: str, valid: str, found: str | None = None) -> None:
        """Note a fault of one key.

        Args:
            key: Key in this table.
            valid: What would be valid.
            found: What stands there; by default the value itself, ``nothing`` when absent.
        """
        where, value = self.look(key)
        text = found or ("nothing" if value is None else shown(value))
        self._faults.add(where, text, valid)

    def look(self, key: str) -> tuple[str, object]:
        """Look a key up, first here, then in the defaults.

        Args:
            key: Key in this table.

        Returns:
            The full key where it was found and the value; the key here and None where absent.
        """
        self._asked[key] = None
        if self._defaults is not None:
            where, value = self._defaults.look(key)
            if key not in self._values and value is not None:
                return where, value
        return self.key(key), self._values.get(key)

    def text(self, key: str, default: str | None = None) -> str:
        """A string; ``""`` after a fault.

        Args:
            key: Key in this table.
            default: Taken when absent; None makes it required.

        Returns:
            The string.
        """
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        if not isinstance(value, str):
            self.fault(key, "a string")
            return ""
        return value

    def name(self, key: str) -> str:
        """A name that can be part of a topic; ``""`` after a fault.

        Args:
            key: Key in this table.

        Returns:
            The name.
        """
        value = self.look(key)[1]
        if not isinstance(value, str) or not NAME_PATTERN.fullmatch(value):
            self.fault(key, "a name of letters, digits, _ and -, beginning with a letter")
            return ""
        return value

    def choice(self, key: str, kinds: Iterable[_Choice]) -> _Choice | None:
        """One of a few words; None after a fault.

        Args:
            key: Key in this table.
            kinds: The words.

        Returns:
            The member.
        """
        value = self.look(key)[1]
        words = {str(kind): kind for kind in kinds}
        if not isinstance(value, str) or value not in words:
            self.fault(key, listed(words, value))
            return None
        return words[value]

    def number(
        self,
        key: str,
        *,
        default: float | None = None,
        above: float | None = None,
        at_least: float | None = None,
        at_most: float | None = None,
        nonzero: bool = False,
    ) -> float:
        """A finite number; NaN after a fault.

        Args:
            key: Key in this table.
            default: Taken when absent; None makes it required.
            above: The value must be greater.
            at_least: The value must not be less.
            at_most: The value must not be greater.
            nonzero: The value must not be zero.

        Returns:
            The number.
        """
        value = self.look(key)[1]
        if value is None and default is not None:
            return default
        number = finite_number(value)
        fits = (
            number is not None
            and (above is None or number > above)
            and (at_least is None or number >= at_least)
            and (at_most is None or number <= at_most)
            and not (nonzero and number == 0)
            and _is_usual(number)
        )
        if number is None or not fits:
            bounds = [
                *([f"> {above:g}"] if above is not None else []),
                *([f">= {at_least:g}"] if at_least is not None else []),
                *([f"<= {at_most:g}"] if at_most is not None else []),
                *(["other than 0"] if nonzero else []),
            ]
            if number is not None and not _is_usual(number):
                bounds.append(_USUAL)
            self.fault(key, " ".join(["a finite number", " and ".join(bounds)]).strip())
            return math.nan
        return number

    def integer(self, key: str, *, at_least: int) -> int:
        """A whole number; the least valid one after a fault.

        Args:
            key: Key in this table.
            at_least: The value must not be less.

        Returns:
            The number.
        """
        value = self.look(key)[1]
        if isinstance(value, bool) or not isinstance(value, int) or value < at_least:
            self.fault(key, f"a whole number >= {at_least}")
            return at_least
        return value

    def flag(self, key: str, *, default: bool) -> bool:
        """True or false; the default after a fault.

        Args:
            key: Key in this table.
            default: Taken when absent.

        Returns:
            The truth value.
        """
        value = self.look(key)[1]
        if value is None or isinstance(value, bool):
            return default if value is None else value
        self.fault(key, "true or false")
        return default

    def triple(
        self,
        key: str,
        *,
        default: tuple[float, float, float] | None = None,
        above: float | None = None,
    ) -> tuple[float, float, float]:
        """Three finite numbers; NaN after a fault.

        Args:
            key: Key in this table.
            default: Taken when absent; None makes it required.
            above: Each value must be greater.

        Returns:
            The numbers.
        """
        if default is not None and self.look(key)[1] is None:
            return default
        x, y, z = self._numbers(key, 3, above)
        return x, y, z

    def pair(
        self,
        key: str,
        *,
        default: tuple[float, float] | None = None,
        above: float | None = None,
    ) -> tuple[float, float]:
        """Two finite numbers; NaN after a fault.

        Args:
            key: Key in this table.
            default: Taken when absent; None makes it required.
            above: Each value must be greater.

        Returns:
            The numbers.
        """
        if default is not None and self.look(key)[1] is None:
            return default
        x, y = self._numbers(key, 2, above)
        return x, y

    def _numbers(self, key: str, count: int, above: float | None) -> list[float]:
        """An array of finite numbers; NaN after a fault."""
        value = self.look(key)[1]
        entries = cast("list[object]", value) if isinstance(value, list) else []
        numbers = [n for n in map(finite_number, entries) if n is not None and _is_usual(n)]
        bad = above is not None and any(number <= above for number in numbers)
        if len(entries) != count or len(numbers) != count or bad:
            bound = f", each > {above:g}" if above is not None else ""
            if any(not _is_usual(n) for n in map(finite_number, entries) if n is not None):
                bound += f", each {_USUAL}"
            self.fault(key, f"an array of {count} finite numbers{bound}")
            return [math.nan] * count
        return numbers

    def words(self, key: str, *, valid: Iterable[str] | None = None) -> tuple[str, ...]:
        """An array of different strings; empty when absent, without the bad ones after a fault.

        Args:
            key: Key in this table.
            valid: The words to choose from; any string when None.

        Returns:
            The words.
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
                self._faults.add(where, shown(word), "a string")
            elif choices is not None and word not in choices:
                self._faults.add(where, shown(word), listed(choices, word))
            elif word in good:
                self._faults.add(where, shown(word), "a word that is not there already")
            else:
                good[word] = None
        return tuple(good)

    def table(self, key: str, defaults: Table | None = None) -> Table:
        """A sub-table; an empty one when absent or after a fault.

        Args:
            key: Key in this table.
            defaults: Defaults of the sub-table.

        Returns:
            The sub-table.
        """
        self._asked[key] = None
        value = self._values.get(key, {})
        if not isinstance(value, dict):
            self.fault(key, "a table")
            value = {}
        return Table(cast("dict[str, Any]", value), self.key(key), self._faults, defaults)

    def tables(self, key: str) -> list[tuple[dict[str, Any], str]]:
        """An array of tables; empty when absent, without the bad ones after a fault.

        Args:
            key: Key in this table.

        Returns:
            Each table with its full key, ready for :class:`Table`.
        """
        self._asked[key] = None
        value = self._values.get(key, [])
        if not isinstance(value, list):
            self.fault(key, "an array of tables")
            return []
        good: list[tuple[dict[str, Any], str]] = []
        for i, entry in enumerate(cast("list[object]", value)):
            where = f"{self.key(key)}[{i}]"
            if isinstance(entry, dict):
                good.append((cast("dict[str, Any]", entry), where))
            else:
                self._faults.add(where, shown(entry), "a table")
        return good

    def close(self) -> None:
        """Note every key of this table that nobody asked for."""
        for key in self._values:
            if key not in self._asked:
                near = listed(self._asked, key)
                self._faults.add(self.key(key), "an unknown key", near)


_USUAL = f"0 or of a size from {_SMALLEST:g} to {_LARGEST:g}"


def _is_usual(number: float) -> bool:
    return number == 0 or _SMALLEST <= abs(number) <= _LARGEST


def finite_number(value: object) -> float | None:
    """A finite number, else None; booleans are not numbers.

    Args:
        value: From TOML or JSON.

    Returns:
        The number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:  # an integer beyond the range of a double
        return None
    return number if math.isfinite(number) else None
