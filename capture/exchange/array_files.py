"""Arrays of files of NumPy (``.npz``), MATLAB (``.mat``) and PyTorch (``.pt``), in a child process.

A ``.pt`` file is read without running what its pickle names. It is a zip: ``*/data.pkl`` names
tensors by storage, shape and stride, ``*/data/KEY`` holds the raw numbers. The pickle's opcodes are
followed by a small machine of its own, which knows dictionaries, lists, numbers, texts and the
rebuilding of tensors; what a pickle would call besides is not run: its result is an object without
a value.
"""

from __future__ import annotations

import io
import math
import pickletools
import sys
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..common.confined import Confined
from ..common.confined_child import Send
from ..common.errors import ImportFormatError, raised_as
from ..common.packets import Packet, is_plain
from .column_blocks import MOST_BYTES, UNZIPPING, check_cells, read_entry, refuse

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

_COMPRESSED, _PIECE = 15, 1 << 16  # of .mat
_NPY_HEADER = 1 << 17  # bytes


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


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by its suffix; one that is no array of numbers holds None.

    They are not to be written.

    Raises:
        ImportFormatError: If it is damaged, of another version, or takes too much memory or time.
    """
    with closing(Confined(ImportFormatError)) as reader:
        packet = reader.call(f"{__name__}:parse", path)
    none = np.array(None)
    return {name: packet.arrays.get(name, none) for name in packet.facts["names"]}


def parse(path: Path, send: Send) -> None:
    """Send the arrays of a file; runs in the child process."""
    readers = {".npz": read_npz, ".mat": read_mat}
    arrays = readers.get(path.suffix.lower(), read_tensors)(path)
    plain = {name: array for name, array in arrays.items() if is_plain(array)}
    send(Packet({"names": list(arrays)}, plain))


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
