"""PyTorch's ``.pt``: tensors, read without running what the file's pickle names.

The file is a zip: ``*/data.pkl`` names tensors by storage, shape and stride, ``*/data/KEY`` holds
the raw numbers. The unpickler finds nothing but dictionaries and the rebuilding of tensors; what a
pickle would call besides is not run: its result is an object without a value.
"""

from __future__ import annotations

import io
import math
import pickle
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...common.errors import ImportFormatError, raised_as
from ..array_table import confined_arrays
from ..column_blocks import MOST_BYTES, UNZIPPING, read_entry, refuse
from ..table_format import TableReader
from .format import Format

_MOST_PICKLE, _MOST_NAMES, _LONGEST_NAME, _DEEPEST = 1 << 20, 1 << 16, 4096, 64
_DTYPES = {
    "FloatStorage": "f4", "DoubleStorage": "f8", "HalfStorage": "f2", "LongStorage": "i8",
    "IntStorage": "i4", "ShortStorage": "i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?",
}  # fmt: skip
_TENSORS = {"torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_tensor"}
_PARAMETER = "torch._utils _rebuild_parameter"
_ORDERED = "collections OrderedDict"


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    if not head.startswith(b"PK"):
        return 0.0
    return 0.9 if b"data.pkl" in head else 0.1  # entries that are named further on


@dataclass(frozen=True)
class _Global:
    """What a pickle names, which is not imported."""

    name: str

    def __call__(self, *_: object) -> _NotRun:
        return _NotRun()


@dataclass(frozen=True)
class _Storage:
    dtype: str
    key: str


@dataclass(frozen=True)
class _Tensor:
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


def read_tensors(path: Path) -> dict[str, NDArray[Any]]:
    """Return the tensors that a file's dictionary names; those of nested ones as ``outer.inner``.

    What is no tensor of numbers has an array that holds None.

    Raises:
        ImportFormatError: If it is no such zip, or its pickle does more than name tensors.
    """
    faults = (
        OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, OverflowError,
        pickle.UnpicklingError,
    )  # fmt: skip
    with (
        raised_as(ImportFormatError, path, "is no zip by torch.save", *UNZIPPING),
        raised_as(ImportFormatError, path, "is no file of tensors by torch.save", *faults),
        zipfile.ZipFile(path) as archive,
    ):
        (entry,) = (name for name in archive.namelist() if name.endswith("data.pkl"))
        root = entry.removesuffix("data.pkl")
        if archive.getinfo(entry).file_size > _MOST_PICKLE:
            refuse(path, "its data.pkl is too large to name tensors only")
        value = _Tensors(io.BytesIO(read_entry(archive, archive.getinfo(entry)))).load()
        storages = _Storages(path, archive, root)
        return {
            name: storages.array(tensor) if tensor is not None else np.array(None)
            for name, tensor in _named(value).items()
        }


def _byte_order(archive: zipfile.ZipFile, root: str) -> str:
    if f"{root}byteorder" not in archive.namelist():
        return "<" if sys.byteorder == "little" else ">"
    with archive.open(f"{root}byteorder") as stream:
        return ">" if stream.read(4) == b"big" else "<"


class _NotRun:
    """Stands for what a pickle calls: it has no value."""

    def __setstate__(self, _: object) -> None:
        """Drop the state."""


class _Dictionary(dict[Any, Any], _NotRun):
    """Stands for an OrderedDict, whose state is metadata."""


class _Tensors(pickle.Unpickler):
    """Reads a pickle that names tensors; of what it names nothing else is imported or called."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        name = f"{module_name} {global_name}"
        if name in _TENSORS:
            return _tensor
        if name == _PARAMETER:
            return lambda tensor, *_: tensor  # pyright: ignore[reportUnknownLambdaType, reportUnknownVariableType]
        return _Dictionary if name == _ORDERED else _Global(name)

    def persistent_load(self, pid: Any, /) -> _Storage:
        kind, storage, key = pid[:3]
        if kind != "storage" or not isinstance(storage, _Global) or not isinstance(key, str):
            raise ValueError("its pickle names something else than storages")
        return _Storage(_DTYPES.get(storage.name.removeprefix("torch "), ""), key)


def _tensor(storage: Any, offset: Any, *layout: Any) -> object:
    if not isinstance(storage, _Storage):
        return _NotRun()
    shape, stride = (tuple(map(int, numbers[:_DEEPEST])) for numbers in layout[:2])
    if max((*shape, *stride, int(offset)), default=0) > MOST_BYTES:
        raise ValueError(f"a tensor of more than {MOST_BYTES} numbers")
    return _Tensor(storage, int(offset), shape, stride)


def _named(value: object) -> dict[str, _Tensor | None]:
    """Return the tensors of nested dictionaries, by their path of keys.

    Raises:
        ValueError: If there are too many, as of dictionaries that hold each other many times.
    """
    tensors: dict[str, _Tensor | None] = {}
    waiting: list[tuple[str, object, int]] = [("", value, 0)]
    seen = 0
    while waiting:
        name, item, depth = waiting.pop()
        seen += 1
        if seen > _MOST_NAMES or depth > _DEEPEST or len(name) > _LONGEST_NAME:
            raise ValueError(f"more than {_MOST_NAMES} names, or one of {name[:40]!r} is too long")
        if isinstance(item, _Tensor):
            tensors[name or "tensor"] = item if item.storage.dtype else None
        elif isinstance(item, Mapping):
            inner = list(cast("Mapping[object, object]", item).items())
            if not all(isinstance(key, str | int) for key, _ in inner):
                raise ValueError("a dictionary has a key that is no name")
            waiting += [
                (f"{name}.{key}" if name else str(key), nested, depth + 1)
                for key, nested in inner[::-1]
            ]
        else:
            tensors[name] = None
    return tensors


class _Storages:
    """The numbers of a file: each storage is read once, all together at most :data:`MOST_BYTES`."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, root: str) -> None:
        self._path, self._archive, self._root = path, archive, root
        self._order = _byte_order(archive, root)
        self._read: dict[str, bytearray] = {}
        self._size = 0

    def array(self, tensor: _Tensor) -> NDArray[Any]:
        """Return the view of its storage that a tensor is."""
        dtype = np.dtype(self._order + tensor.storage.dtype)
        data = self._bytes(tensor.storage.key)
        numbers, size = len(data) // dtype.itemsize, math.prod(tensor.shape)
        last = tensor.offset + sum(
            (count - 1) * step for count, step in zip(tensor.shape, tensor.stride, strict=True)
        )
        sound = min((*tensor.shape, *tensor.stride, tensor.offset), default=0) >= 0
        if not sound or last >= max(numbers, 1) or size > max(numbers, 1):
            refuse(self._path, f"a tensor of shape {tensor.shape} exceeds its storage")
        if not size or not numbers:
            return np.zeros(tensor.shape, dtype)
        flat = np.frombuffer(data, dtype, numbers)[tensor.offset :]
        strides = tuple(step * dtype.itemsize for step in tensor.stride)
        return np.lib.stride_tricks.as_strided(flat, tensor.shape, strides, writeable=False)

    def _bytes(self, key: str) -> bytearray:
        if key not in self._read:
            info = self._archive.getinfo(f"{self._root}data/{key}")
            self._size += info.file_size
            if self._size > MOST_BYTES:
                refuse(self._path, f"tensors of {self._size} bytes; {MOST_BYTES} at most")
            self._read[key] = read_entry(self._archive, info)
        return self._read[key]


FORMAT = Format(
    "pt", "PyTorch tensors (.pt)", (".pt", ".pth"), _sniff,
    TableReader(confined_arrays(f"{__name__}:read_tensors", "pt")),
)  # fmt: skip
