"""CDR, the wire format of ROS 2 messages, as fixed layouts.

A message with constant strings and sequence lengths (a JointState with constant names) has every
number at a constant offset. :func:`layout_of` finds those offsets in one example; then a template
encodes a message with a few writes, and numpy decodes thousands at once.

Format: OMG Data Distribution Service Interoperability Wire Protocol (DDSI-RTPS 2.5, section 10),
plain CDR version 1: a four-byte encapsulation header, then each primitive aligned to its size
relative to the first byte after that header.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ...common.arrays import IntArray, frozen
from ...common.errors import DataError
from .definitions import PRIMITIVES, Field, MessageType

LITTLE_ENDIAN_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header of little-endian plain CDR."""

_HEADER_SIZE = 4
_MAX_ELEMENTS = 1_000_000
_ELEMENTS_A_BYTE = 4
"""Most nested messages per byte: messages without a byte could be endless."""


@dataclass(frozen=True)
class Leaf:
    """A number, or a run of equal numbers, in a message of fixed layout.

    Attributes:
        path: Dotted field path, e.g. ``pose.pose.position.x`` or ``transforms[3].child_frame_id``.
        dtype: numpy type string of one number.
        offset: Byte offset from the start of the message, encapsulation header included.
        count: Number of values; 1 unless an array.
        is_array: Whether the field is an array or sequence.
    """

    path: str
    dtype: str
    offset: int
    count: int
    is_array: bool


@dataclass(frozen=True)
class Layout:
    """Offsets of all fields in messages of one fixed layout.

    Attributes:
        length: Message length [byte].
        leaves: All numbers, by path.
        strings: All strings of the example, by path.
        hull: Byte ranges outside the leaves, as (start, stop), half-open, with padding.
        static: Indices of the bytes that are equal in every message of the layout: strings and
            sequence lengths, without padding (which a foreign writer may leave undefined).
    """

    length: int
    leaves: dict[str, Leaf]
    strings: dict[str, str]
    example: bytes
    hull: tuple[tuple[int, int], ...]
    static: IntArray

    def fits(self, message: bytes) -> bool:
        """Whether a message has this layout and equal padding."""
        return len(message) == self.length and all(
            message[start:stop] == self.example[start:stop] for start, stop in self.hull
        )


def layout_of(message_type: MessageType, message: bytes) -> Layout:
    """Find the layout of a message.

    Args:
        message: One CDR message, encapsulation header included.

    Returns:
        The layout that every message with the same strings and sequence lengths shares.

    Raises:
        DataError: If the message is not little-endian plain CDR, is too short for its type, or
            has a ``wstring``.
    """
    if message[:2] != LITTLE_ENDIAN_HEADER[:2]:
        raise DataError(
            f"{message_type.name}: encapsulation {message[:2].hex()} is not little-endian CDR"
        )
    walker = _Walker(message_type.name, message)
    walker.message(message_type, "")
    return Layout(
        length=len(message),
        leaves=walker.leaves,
        strings=walker.strings,
        example=bytes(message),
        hull=tuple(_complement(walker.leaves, len(message))),
        static=frozen(np.concatenate([np.arange(a, b, dtype=np.int64) for a, b in walker.static])),
    )


def _complement(leaves: dict[str, Leaf], length: int) -> Iterator[tuple[int, int]]:
    """Yield the byte ranges that no leaf covers, without empty ones."""
    at = 0
    for leaf in leaves.values():  # in wire order
        if leaf.offset > at:
            yield at, leaf.offset
        at = leaf.offset + leaf.count * np.dtype(leaf.dtype).itemsize
    if length > at:
        yield at, length


class _Walker:
    """Finds the offsets of the fields of one message."""

    def __init__(self, name: str, message: bytes) -> None:
        self._name, self._message = name, message
        self._at = _HEADER_SIZE
        self._left = _ELEMENTS_A_BYTE * len(message)  # strings and nested messages
        self.leaves: dict[str, Leaf] = {}
        self.strings: dict[str, str] = {}
        self.static: list[tuple[int, int]] = [(0, 2)]

    def message(self, message_type: MessageType, prefix: str) -> None:
        for field in message_type.fields:
            path = f"{prefix}{field.name}"
            count = self._uint32() if field.length is None else field.length
            if count > _MAX_ELEMENTS:
                raise DataError(f"{self._name}.{path}: a length of {count} can't be right")
            if field.base in PRIMITIVES:
                self._numbers(path, PRIMITIVES[field.base], count, field.is_array)
                continue
            self._left -= count
            if self._left < 0:
                raise DataError(f"{self._name}.{path}: more elements than the message has bytes")
            for k in range(count):
                item = f"{path}[{k}]" if field.is_array else path
                if field.nested is not None:
                    self.message(field.nested, f"{item}.")
                else:
                    self._string(item, field)

    def _take(self, size: int, align: int) -> int:
        start = _HEADER_SIZE + -(-(self._at - _HEADER_SIZE) // align) * align
        if start + size > len(self._message):
            raise DataError(
                f"{self._name}: the message ends at byte {len(self._message)}, "
                f"its type needs {start + size}"
            )
        self._at = start + size
        return start

    def _uint32(self) -> int:
        start = self._take(4, 4)
        self.static.append((start, start + 4))
        return int(struct.unpack_from("<I", self._message, start)[0])

    def _numbers(self, path: str, dtype: str, count: int, is_array: bool) -> None:
        if count == 0:
            return  # an empty sequence is not padded to its element's alignment
        size = np.dtype(dtype).itemsize
        self.leaves[path] = Leaf(path, dtype, self._take(count * size, size), count, is_array)

    def _string(self, path: str, field: Field) -> None:
        if field.base != "string":
            raise DataError(f"{self._name}.{path}: {field.base} has no fixed layout here")
        size = self._uint32()
        start = self._take(size, 1)
        self.static.append((start, start + size))
        raw = self._message[start : start + max(size - 1, 0)]
        self.strings[path] = raw.decode("utf-8", errors="replace")


def encode(message_type: MessageType, values: Mapping[str, Any]) -> bytes:
    """Encode one message, field by field (for templates and rare messages).

    Args:
        values: Field name to value: numbers, strings, mappings for nested messages, sequences for
            arrays. A missing field is zero, empty, or (fixed array) zeros.

    Returns:
        The CDR message, encapsulation header included.

    Raises:
        DataError: If ``values`` has an unknown name, or a value of a wrong kind.
    """
    out = bytearray(LITTLE_ENDIAN_HEADER)
    _encode_message(out, message_type, values)
    return bytes(out)


def _pad(out: bytearray, align: int) -> None:
    out.extend(bytes(-(len(out) - _HEADER_SIZE) % align))


def _encode_message(out: bytearray, kind: MessageType, values: Mapping[str, Any]) -> None:
    unknown = set(values) - {field.name for field in kind.fields}
    if unknown:
        listed = ", ".join(field.name for field in kind.fields)
        raise DataError(f"{kind.name} has no field {min(unknown)!r}; it has {listed}")
    for field in kind.fields:
        try:
            _encode_field(out, field, values.get(field.name))
        except (TypeError, ValueError, struct.error) as error:
            raise DataError(f"{kind.name}.{field.name}: {error}") from error


def _encode_field(out: bytearray, field: Field, value: Any) -> None:
    default = 0 if field.base in PRIMITIVES else None
    items: Any  # a list or an array
    if field.length is None:
        items = [] if value is None else value
        _pad(out, 4)
        out.extend(struct.pack("<I", len(items)))
    elif field.is_array:
        items = [default] * field.length if value is None else value
        if len(items) != field.length:
            raise ValueError(f"{len(items)} values for an array of {field.length}")
    else:
        items = [default if value is None else value]
    if field.base in PRIMITIVES:
        if len(items) > 0:
            dtype = np.dtype(PRIMITIVES[field.base])
            _pad(out, dtype.itemsize)
            out.extend(np.asarray(items, dtype=dtype).tobytes())
        return
    for item in items:
        if field.nested is not None:
            _encode_message(out, field.nested, cast("Mapping[str, Any]", item or {}))
        else:
            data = str(item or "").encode() + b"\x00"
            _pad(out, 4)
            out.extend(struct.pack("<I", len(data)) + data)
