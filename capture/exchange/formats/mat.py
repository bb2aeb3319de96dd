"""MATLAB's ``.mat``, up to version 7."""

from __future__ import annotations

import io
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.errors import ImportFormatError, raised_as
from ..array_table import confined_arrays
from ..column_blocks import MOST_BYTES, check_cells, refuse
from ..table_format import TableReader
from .format import Format

_COMPRESSED, _PIECE = 15, 1 << 16


def _sniff(head: bytes, path: Path) -> float:
    """Recognise versions 5 and 7, and by the suffix 7.3, which is HDF5 and refused by name."""
    hdf5 = head.startswith(b"\x89HDF") and path.suffix.lower() == ".mat"
    return float(head.startswith(b"MATLAB ") or hdf5)


def read_mat(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers of a ``.mat`` file, up to version 7.

    Raises:
        ImportFormatError: If it is damaged, of another version or expands too far.
    """
    from scipy.io import loadmat, whosmat

    # scipy raises whatever a damaged file leads to
    with raised_as(ImportFormatError, path, "can't be read as .mat", Exception):
        with path.open("rb") as stream:
            start = stream.read(128)
        if start.startswith((b"MATLAB 7.3", b"\x89HDF")):
            refuse(path, "is a .mat of version 7.3 (HDF5), which is not supported; save with -v7")
        _check_mat(path)
        listed = whosmat(path)
        size = sum(8 * math.prod(shape) for _, shape, _ in listed)
        if size > MOST_BYTES:
            refuse(path, f"declares {size} bytes of arrays; {MOST_BYTES} at most")
        check_cells(path, size // 8)
        numeric = ("double", "single", "logical", "int", "uint")
        names = [name for name, _, kind in listed if kind.startswith(numeric)]
        arrays = loadmat(path, variable_names=names) if names else {}
        return {name: arrays[name] for name in names if isinstance(arrays.get(name), np.ndarray)}


def _check_mat(path: Path) -> None:
    """Refuse a file of which an element expands too far; what the elements declare may be less.

    Layout: MAT-File Format, "Level 5 MAT-Files": tags of type and size [byte], and zlib streams.
    """
    left = MOST_BYTES
    with path.open("rb") as stream:
        order = "little" if stream.read(128)[126:128] == b"IM" else "big"
        while len(tag := stream.read(8)) == 8:
            kind, size = (int.from_bytes(part, order) for part in (tag[:4], tag[4:]))
            if kind != _COMPRESSED:
                stream.seek(size, io.SEEK_CUR)
                continue
            packed, end = zlib.decompressobj(), stream.tell() + size
            while left > 0 and not packed.eof and (some := stream.read(min(_PIECE, size))):
                size -= len(some)
                while left > 0 and some:
                    left -= len(packed.decompress(some, _PIECE))
                    some = packed.unconsumed_tail
            if left <= 0:
                refuse(path, f"expands to more than {MOST_BYTES} bytes")
            stream.seek(end)


FORMAT = Format(
    "mat", "MATLAB arrays (.mat)", (".mat",), _sniff,
    TableReader(confined_arrays(f"{__name__}:read_mat", "mat")),
)  # fmt: skip
