"""Parameters that are declared once: frozen dataclasses read from strict tables, and written.

The annotation of a field declares the values of its key, its default the value without a key::

    @dataclass(frozen=True)
    class Turns:
        largest: NonNegative = 0.15                          # a finite number >= 0
        share: Annotated[float, at_least(0), at_most(1)] = 0.5
        start: Annotated[tuple[float, float], Key("from")]   # two numbers, the key is `from`
        wave: Wave                                           # a StrEnum: one of its words
        filter: Filter = Filter()                            # another such class: a sub-table
        target: Target | None = None                         # None where there is no such key

What fields may not hold together is for a method ``contradictions``, which yields the key and what
would be valid, and what stands there where that isn't the value itself.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from enum import StrEnum
from types import UnionType
from typing import (
    Annotated,
    Any,
    NamedTuple,
    TypeAlias,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from .strict_table import Bound, StrictTable, above, at_least

_Class = TypeVar("_Class")

Positive: TypeAlias = Annotated[float, above(0.0)]
NonNegative: TypeAlias = Annotated[float, at_least(0.0)]
Count: TypeAlias = Annotated[int, at_least(1)]

_NAME = object()
Name: TypeAlias = Annotated[str, _NAME]
"""A name that can be part of a topic."""


class Key(NamedTuple):
    """The key of a field whose name is another."""

    key: str


class Declared(NamedTuple):
    """What a dataclass declares of one field.

    Attributes:
        key: Its key in the table.
        default: None where it is required.
        optional: Whether it may be None.
        bounds: Of its number, or of each of its numbers.
        read: Reads it, given the default.
    """

    key: str
    default: Any
    optional: bool
    bounds: tuple[Bound, ...]
    read: Callable[[StrictTable, Any], Any]


@functools.cache
def declared(cls: type[Any]) -> dict[str, Declared]:
    """Return the declarations of a dataclass's fields, by name."""
    hints = get_type_hints(cls, include_extras=True)
    return {item.name: _declared(item, hints[item.name]) for item in dataclasses.fields(cls)}


def _declared(item: dataclasses.Field[Any], hint: Any) -> Declared:
    optional = get_origin(hint) in (Union, UnionType) and type(None) in get_args(hint)
    if optional:
        hint = get_args(hint)[0]
    kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    key = next((extra.key for extra in extras if isinstance(extra, Key)), item.name)
    bounds = tuple(extra for extra in extras if isinstance(extra, Bound))
    default = None if item.default is dataclasses.MISSING else item.default
    return Declared(key, default, optional, bounds, _reader(kind, key, bounds, _NAME in extras))


def _reader(
    kind: Any, key: str, bounds: tuple[Bound, ...], is_name: bool
) -> Callable[[StrictTable, Any], Any]:
    if get_origin(kind) is tuple:
        count = len(get_args(kind))
        return lambda table, default: table.numbers(key, count, *bounds, default=default)
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return lambda table, default: table.choice(key, kind, default)
    if dataclasses.is_dataclass(cast("object", kind)):
        part = cast("type[Any]", kind)
        return lambda table, _: read(table.table(key), part)
    readers: dict[Any, Callable[[StrictTable, Any], Any]] = {
        float: lambda table, default: table.number(key, *bounds, default=default),
        int: lambda table, default: table.integer(key, int(bounds[0].limit), default),
        bool: lambda table, default: table.flag(key, default=default),
        str: lambda table, default: table.text(key, default),
    }
    if is_name:
        return lambda table, default: table.name(key, default)
    return readers.get(kind, _no_reader)


def _no_reader(*_: Any) -> Any:
    raise TypeError("this field is read in a way of its own")


def read(table: StrictTable, cls: type[_Class], **readers: Callable[[], Any]) -> _Class:
    """Read a table as a dataclass declares it; unknown keys are faults.

    Args:
        table: The table; faults are noted in its list.
        readers: What gives the value of a field that is read in another way, called in its turn.

    Returns:
        The value; of use only if no fault was noted.
    """
    value = read_fields(table, cls, **readers)
    table.close()
    return value


def read_fields(table: StrictTable, cls: type[_Class], **readers: Callable[[], Any]) -> _Class:
    """Read the fields of a dataclass from a table that the caller closes, as :func:`read` does."""
    values = {
        name: readers[name]()
        if name in readers
        else _value(table, declaration, declaration.default)
        for name, declaration in declared(cls).items()
    }
    value = cls(**values)
    for fault in getattr(value, "contradictions", tuple)():
        table.fault(*fault)
    return value


def read_field(table: StrictTable, cls: type[Any], name: str, default: Any = None) -> Any:
    """Read one field of a dataclass.

    Args:
        table: The table; faults are noted in its list.
        default: In place of the one that the class declares.
    """
    declaration = declared(cls)[name]
    return _value(table, declaration, declaration.default if default is None else default)


def read_required(table: StrictTable, cls: type[Any], name: str) -> Any:
    """Read one field of a dataclass that has to be there, whatever the class declares."""
    return declared(cls)[name].read(table, None)


def _value(table: StrictTable, declaration: Declared, default: Any) -> Any:
    if declaration.optional and default is None and table.look(declaration.key)[1] is None:
        return None
    return declaration.read(table, default)


def write(value: Any) -> dict[str, Any]:
    """Return the table that gives a dataclass's value when it is read; None is left out."""
    table: dict[str, Any] = {}
    for name, declaration in declared(value.__class__).items():
        part = getattr(value, name)
        if part is not None:
            table[declaration.key] = (
                write(part) if dataclasses.is_dataclass(cast("object", part)) else part
            )
    return table
