"""NumPy's ``.npz``: arrays in a zip."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.errors import ImportFormatError, raised_as
from ..array_table import confined_arrays
from ..column_blocks import MOST_BYTES, UNZIPPING, check_cells, read_entry, refuse
from ..table_format import TableReader
from .format import Format

_NPY_HEADER = 1 << 17
"""Bytes that the header of an array may take."""


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    if not head.startswith(b"PK"):
        return 0.0
    return 0.9 if b".npy" in head else 0.1  # entries that are named further on


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a ``.npz`` file but those of objects.

    Raises:
        ImportFormatError: If it is damaged or expands too far.
    """
    caught = (OSError, ValueError, RuntimeError, *UNZIPPING)
    with (
        raised_as(ImportFormatError, path, "can't be read as .npz", *caught),
        zipfile.ZipFile(path) as archive,
    ):
        size = sum(info.file_size for info in archive.infolist())
        if size > MOST_BYTES:
            refuse(path, f"holds {size} bytes of arrays; {MOST_BYTES} at most")
        check_cells(path, size // 8)
        return {
            info.filename.removesuffix(".npy"): array
            for info in archive.infolist()
            if (array := _npy(read_entry(archive, info), info.filename)) is not None
        }


def _npy(data: bytearray, name: str) -> NDArray[Any] | None:
    """Return one array, None for objects: those would be unpickled."""
    stream = io.BytesIO(memoryview(data)[:_NPY_HEADER])
    try:
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
        shape, fortran, dtype = (header or np.lib.format.read_array_header_2_0)(stream)
    except Exception as error:  # it is a Python expression: its parser's errors have many bases
        raise ValueError(f"{name} has no valid header: {error}") from error
    if dtype.hasobject:
        return None
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize > len(data) - stream.tell():
        raise ValueError(f"{name} declares shape {shape}, more than it holds")
    flat = np.frombuffer(data, dtype, count, stream.tell()) if count else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


FORMAT = Format(
    "npz", "NumPy arrays (.npz)", (".npz",), _sniff,
    TableReader(confined_arrays(f"{__name__}:read_npz", "npz")),
)  # fmt: skip
