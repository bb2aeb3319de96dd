"""PyTorch's ``.pt``: tensors, read without running what the file's pickle names.

The file is a zip: ``*/data.pkl`` names tensors by storage, shape and stride, ``*/data/KEY`` holds
the raw numbers. The pickle's opcodes are followed by a small machine of its own, which knows
dictionaries, lists, numbers, texts and the rebuilding of tensors; what a pickle would call besides
is not run: its result is an object without a value.
"""

from __future__ import annotations

import math
import pickletools
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
_TENSOR = ("torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_tensor")
_PARAMETER = "torch._utils _rebuild_parameter"
_ORDERED = "collections OrderedDict"
_MARK = object()
_NOT_RUN = object()
_PUSHED = {
    "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4",
    "FLOAT", "BINFLOAT", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "STRING",
    "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
}  # fmt: skip
_CONSTANT = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PUT = {"PUT", "BINPUT", "LONG_BINPUT"}
_GET = {"GET", "BINGET", "LONG_BINGET"}

_ENTRY_NAME = slice(30, 4096)
"""Where the name of a zip's first entry is."""


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    return 0.9 * (head.startswith(b"PK") and b"data.pkl" in head[_ENTRY_NAME])


@dataclass(frozen=True)
class _Global:
    name: str


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
    faults = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError)
    with (
        raised_as(ImportFormatError, path, "is no zip by torch.save", *UNZIPPING),
        raised_as(ImportFormatError, path, "is no file of tensors by torch.save", *faults),
        zipfile.ZipFile(path) as archive,
    ):
        (pickle,) = (name for name in archive.namelist() if name.endswith("data.pkl"))
        root = pickle.removesuffix("data.pkl")
        if archive.getinfo(pickle).file_size > _MOST_PICKLE:
            refuse(path, "its data.pkl is too large to name tensors only")
        value = _Machine(path).run(bytes(read_entry(archive, archive.getinfo(pickle))))
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


class _Machine:
    """The opcodes of a pickle that names tensors."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, data: bytes) -> object:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name == "STOP":
                break
            self._step(opcode.name, argument)
        return self._stack.pop()

    def _step(self, name: str, argument: Any) -> None:  # noqa: C901, PLR0912 - a table of opcodes
        stack = self._stack
        if name in {"PROTO", "FRAME"}:
            return
        if name in _PUSHED:
            stack.append(_CONSTANT.get(name, argument))
        elif name == "MARK":
            stack.append(_MARK)
        elif name in {"EMPTY_DICT", "EMPTY_LIST", "EMPTY_TUPLE"}:
            stack.append({"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}[name]())
        elif name in _PUT:
            self._memo[int(argument)] = stack[-1]
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = stack[-1]
        elif name in _GET:
            stack.append(self._memo[int(argument)])
        elif name == "GLOBAL":
            stack.append(_Global(str(argument)))
        elif name == "STACK_GLOBAL":
            member, module = stack.pop(), stack.pop()
            if not isinstance(module, str) or not isinstance(member, str):
                raise ImportFormatError(self._path, "its pickle names something else than tensors")
            stack.append(_Global(f"{module} {member}"))
        elif name == "TUPLE":
            stack.append(tuple(self._marked()))
        elif name in _TUPLES:
            count = _TUPLES[name]
            items = tuple(stack[-count:])
            del stack[-count:]
            stack.append(items)
        elif name in {"APPEND", "APPENDS"}:
            items = [stack.pop()] if name == "APPEND" else self._marked()
            cast("list[Any]", stack[-1]).extend(items)
        elif name in {"SETITEM", "SETITEMS"}:
            items = [stack.pop(-2), stack.pop()] if name == "SETITEM" else self._marked()
            if not all(isinstance(key, str | int) for key in items[::2]):
                raise ImportFormatError(self._path, "its pickle has a key that is no name")
            cast("dict[Any, Any]", stack[-1]).update(zip(items[::2], items[1::2], strict=True))
        elif name == "BINPERSID":
            stack.append(self._storage(stack.pop()))
        elif name == "REDUCE":
            arguments = stack.pop()
            stack.append(self._rebuilt(stack.pop(), arguments))
        elif name == "BUILD":  # the state of a dictionary of weights: metadata only
            stack.pop()
        else:
            raise ImportFormatError(self._path, f"its pickle has {name}, which names no tensor")

    def _marked(self) -> list[Any]:
        at = len(self._stack) - 1
        while at >= 0 and self._stack[at] is not _MARK:
            at -= 1
        if at < 0:
            raise ValueError("its pickle takes more than it gave")
        items = self._stack[at + 1 :]
        del self._stack[at:]
        return items

    def _storage(self, words: Any) -> _Storage:
        kind, storage, key = words[0], words[1], words[2]
        plain = kind == "storage" and isinstance(storage, _Global) and isinstance(key, str)
        if not plain:
            raise ImportFormatError(self._path, "its pickle names something else than storages")
        dtype = _DTYPES.get(storage.name.removeprefix("torch "), "")
        return _Storage(dtype, key)

    def _rebuilt(self, function: Any, arguments: Any) -> object:
        name = function.name if isinstance(function, _Global) else ""
        if name == _ORDERED:
            return {}
        if name == _PARAMETER:
            return arguments[0]
        if name not in _TENSOR or not isinstance(arguments[0], _Storage):
            return _NOT_RUN
        shape, stride = (tuple(map(int, numbers[:_DEEPEST])) for numbers in arguments[2:4])
        if max((*shape, *stride, int(arguments[1])), default=0) > MOST_BYTES:
            raise ValueError(f"a tensor of more than {MOST_BYTES} numbers")
        return _Tensor(arguments[0], int(arguments[1]), shape, stride)


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
    "pt",
    "PyTorch tensors (.pt)",
    (".pt", ".pth"),
    _sniff,
    TableReader(confined_arrays(f"{__name__}:read_tensors", "pt")),
)
