"""Arrays of NumPy's ``.npz`` and MATLAB's ``.mat`` files."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import ImportFormatError
from .packing import MOST_BYTES, UNZIPPING, check_cells, read_entry, refuse

_COMPRESSED, _PIECE = 15, 1 << 16  # of .mat
_NPY_HEADER = 1 << 17  # bytes


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a ``.npz`` file but those of objects.

    Raises:
        ImportFormatError: If it is damaged or expands too far.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > MOST_BYTES:
                refuse(path, f"holds {size} bytes of arrays; {MOST_BYTES} at most")
            check_cells(path, size // 8)
            return {
                info.filename.removesuffix(".npy"): array
                for info in archive.infolist()
                if (array := _npy(read_entry(archive, info), info.filename)) is not None
            }
    except ImportFormatError:
        raise
    except (OSError, ValueError, RuntimeError, *UNZIPPING) as error:
        raise ImportFormatError(path, f"can't be read as .npz: {error}") from error


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


def read_mat(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers of a ``.mat`` file, up to version 7.

    Raises:
        ImportFormatError: If it is damaged, of another version or expands too far.
    """
    from scipy.io import loadmat, whosmat

    try:
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
        found = loadmat(path, variable_names=names) if names else {}
    except ImportFormatError:
        raise
    except Exception as error:  # scipy raises whatever a damaged file leads to
        raise ImportFormatError(path, f"can't be read as .mat: {error}") from error
    return {name: found[name] for name in names if isinstance(found.get(name), np.ndarray)}


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
