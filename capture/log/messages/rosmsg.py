"""ROS 2 message definitions: the ``ros2msg`` schema text of an MCAP channel as a tree of types.

Grammar: https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html, concatenated as
the MCAP registry has it (https://mcap.dev/spec/registry#ros2msg): the main definition, then each
dependency after a line of ``=`` and a line ``MSG: package/Type``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from ...common.errors import DataError

PRIMITIVES: dict[str, str] = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
"""Fixed-size primitive to numpy type string."""

_FLOATS = ("float32", "float64")

_DEEPEST = 64
"""Types nested in each other, at most; those of ROS are seldom deeper than five."""

_MOST_FIELDS = 4096
"""Fields of a type and of all nested ones, at most: twenty short lines can spell a million."""

_LONGEST_NUMBER = 9
"""Digits of an array's length, at most."""

_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"^(?P<base>[A-Za-z][\w/]*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)"
    r"(?P<rest>.*)$"
)


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        name: Field name.
        base: A key of :data:`PRIMITIVES`, ``string``, ``wstring``, or None for a nested message.
        nested: The nested message type, or None.
        length: 1 for a plain field, n for a fixed array, None for a sequence.
        is_array: Whether it is a fixed array or a sequence.
    """

    name: str
    base: str | None
    nested: MessageType | None
    length: int | None
    is_array: bool


@dataclass(frozen=True)
class MessageType:
    """A message type with its fields, nested types resolved.

    Attributes:
        name: Full name, e.g. ``sensor_msgs/msg/JointState``.
        fields: In wire order; constants left out.
        size: Number of fields, those of nested types among them.
        has_floats: Whether any of them is a float, which may be NaN.
    """

    name: str
    fields: tuple[Field, ...]
    size: int = field(default=0, compare=False)
    has_floats: bool = field(default=False, compare=False)


def parse_message_type(name: str, text: str) -> MessageType:
    """Parse a ``ros2msg`` schema.

    Args:
        name: Full name of the main type, e.g. ``sensor_msgs/msg/JointState``.
        text: The schema text.

    Returns:
        The type with all dependencies resolved.

    Raises:
        DataError: If a line cannot be parsed or a dependency is missing or circular.
    """
    sections = _SEPARATOR.split(text)
    bodies = {_short(name): sections[0]}
    for section in sections[1:]:
        head, _, body = section.lstrip().partition("\n")
        if not head.startswith("MSG:"):
            raise DataError(f"schema {name}: a section starts with {head!r}, not with 'MSG: TYPE'")
        bodies[_short(head.removeprefix("MSG:").strip())] = body
    return _Parser(name, bodies).message(_short(name), ())


def _short(name: str) -> str:
    """``package/msg/Type`` or ``package/Type`` as ``package/Type``."""
    return name.replace("/msg/", "/")


class _Parser:
    """Resolves the sections of one schema."""

    def __init__(self, name: str, bodies: dict[str, str]) -> None:
        self._name = name
        self._bodies = bodies
        self._done: dict[str, MessageType] = {}

    def message(self, short: str, path: tuple[str, ...]) -> MessageType:
        if short in path:
            raise DataError(f"schema {self._name}: {short} contains itself")
        if len(path) == _DEEPEST:
            raise DataError(f"schema {self._name}: types nested more than {_DEEPEST} deep")
        if short not in self._done:
            if short not in self._bodies:
                known = ", ".join(sorted(self._bodies))
                raise DataError(f"schema {self._name}: no definition of {short}; it has {known}")
            lines = self._bodies[short].splitlines()
            parsed = (self._field(line, short, (*path, short)) for line in lines)
            fields = tuple(part for part in parsed if part is not None)
            self._done[short] = self._type(short, fields)
        return self._done[short]

    def _type(self, short: str, fields: tuple[Field, ...]) -> MessageType:
        package, _, type_name = short.partition("/")
        nested = [part.nested for part in fields if part.nested is not None]
        size = len(fields) + sum(each.size for each in nested)
        if size > _MOST_FIELDS:
            raise DataError(
                f"schema {self._name}: {short} has {size} fields, more than {_MOST_FIELDS}"
            )
        floats = any(part.base in _FLOATS for part in fields) or any(
            each.has_floats for each in nested
        )
        return MessageType(f"{package}/msg/{type_name}", fields, size, floats)

    def _field(self, line: str, owner: str, path: tuple[str, ...]) -> Field | None:
        line = line.partition("#")[0].strip()
        if not line:
            return None
        match = _FIELD.match(line)
        if match is None:
            raise DataError(f"schema {self._name}: cannot read the line {line!r} of {owner}")
        if match["rest"].lstrip().startswith("="):
            return None  # a constant takes no bytes on the wire
        base, array = match["base"], match["array"]
        digits = array.strip("[]<=") if array else "1"
        if len(digits) > _LONGEST_NUMBER:
            raise DataError(f"schema {self._name}: no array has the length {digits[:20]}...")
        length = None if array and (not digits or "<=" in array) else int(digits)
        if base in PRIMITIVES or base in {"string", "wstring"}:
            return Field(match["name"], base, None, length, array is not None)
        if "/" not in base:
            standard = {"Header": "std_msgs/Header"}
            base = standard.get(base, f"{owner.partition('/')[0]}/{base}")
        nested = self.message(_short(base), path)
        return Field(match["name"], None, nested, length, array is not None)
