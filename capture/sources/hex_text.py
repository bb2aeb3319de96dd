"""Hexadecimal text, many fields at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Text = NDArray[np.uint8]
"""Bytes of text, or fields cut from it."""

NO_DIGIT = 0xFF
"""What :data:`NIBBLES` holds for a byte that is no hexadecimal digit."""


def _nibbles() -> Text:
    table = np.full(256, NO_DIGIT, dtype=np.uint8)
    for digit in b"0123456789abcdefABCDEF":
        table[digit] = int(chr(digit), 16)
    table.setflags(write=False)
    return table


NIBBLES = _nibbles()
"""Byte to the value of the hexadecimal digit, shape (256,)."""


def cut(text: Text, starts: NDArray[np.intp], width: int) -> Text:
    """Cut a field of one width from many places.

    Args:
        text: The text, shape (n,), not empty.
        starts: Where the fields begin, shape (m,); what lies outside is read as the nearest byte.
        width: Their width.

    Returns:
        The fields, shape (m, width).
    """
    return text.take(starts[:, None] + np.arange(width), mode="clip")


def identifiers(
    text: Text, starts: NDArray[np.intp], widths: NDArray[np.intp]
) -> tuple[NDArray[np.uint32], NDArray[np.bool_]]:
    """Read identifiers of up to eight hexadecimal digits.

    Args:
        text: The text, shape (n,), not empty.
        starts: Where they begin, shape (m,).
        widths: How many digits they have, 1 to 8, shape (m,).

    Returns:
        The values, and which of them are made of digits only; shape (m,) both.
    """
    nibbles = NIBBLES[cut(text, starts + widths - 8, 8)]
    nibbles[np.arange(8) < 8 - widths[:, None]] = 0
    good = (nibbles != NO_DIGIT).all(axis=1)
    packed = (nibbles[:, ::2] << 4) | (nibbles[:, 1::2] & 0xF)
    return packed.view(">u4")[:, 0].astype(np.uint32), good


def data_bytes(
    text: Text, starts: NDArray[np.intp], lengths: NDArray[np.intp]
) -> tuple[Text, NDArray[np.bool_]]:
    """Read up to eight data bytes, two hexadecimal digits each, without blanks.

    Args:
        text: The text, shape (n,), not empty.
        starts: Where they begin, shape (m,).
        lengths: How many bytes there are, 0 to 8, shape (m,).

    Returns:
        The bytes, zero beyond the length, shape (m, 8); and which fields are made of digits only,
        shape (m,).
    """
    nibbles = NIBBLES[cut(text, starts, 16)]
    nibbles[np.arange(16) >= 2 * lengths[:, None]] = 0
    good = (nibbles != NO_DIGIT).all(axis=1)
    data: Text = (nibbles[:, ::2] << np.uint8(4)) | nibbles[:, 1::2]
    return data, good
