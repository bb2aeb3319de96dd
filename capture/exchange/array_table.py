"""Files of named arrays as tables; the arrays are read in a child process."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.confined import Confined
from ..common.confined_child import Send
from ..common.errors import ImportFormatError
from ..common.packets import Packet, is_plain
from .column_blocks import WIDEST, Block, check_rows, rows_of_block
from .table_file import TableFile


def confined_arrays(reader: str, form: str) -> Callable[[Path], TableFile]:
    """Return a function that opens a file of arrays as a table.

    Args:
        reader: ``module:function``; called in a child process with the path, it returns the arrays
            by name. One that is no array of numbers may hold None.
        form: Of the table.
    """

    def open_arrays(path: Path) -> TableFile:
        with closing(Confined(ImportFormatError)) as child:
            packet = child.call(f"{__name__}:parse", path, reader=reader)
        none = np.array(None)
        arrays = {name: packet.arrays.get(name, none) for name in packet.facts["names"]}
        return array_table(path, arrays, form)

    return open_arrays


def parse(path: Path, send: Send, *, reader: str) -> None:
    """Send the arrays of a file; runs in the child process."""
    module, _, function = reader.partition(":")
    arrays: dict[str, NDArray[Any]] = getattr(import_module(module), function)(path)
    plain = {name: array for name, array in arrays.items() if is_plain(array)}
    send(Packet({"names": list(arrays)}, plain))


def array_table(path: Path, arrays: Mapping[str, NDArray[Any]], form: str) -> TableFile:
    """Take the arrays as columns whose first axis is the longest common one.

    Raises:
        ImportFormatError: If none of them holds numbers in one or two dimensions.
    """
    plain = {
        name: np.squeeze(array) for name, array in arrays.items() if array.dtype.kind in "fiub"
    }
    plain = {
        name: array for name, array in plain.items() if array.ndim in {1, 2} and array.size > 1
    }
    if not plain:
        raise ImportFormatError(path, "holds no arrays of numbers with one or two dimensions")
    vectors = [array.shape[0] for array in plain.values() if array.ndim == 1]
    lengths = [max(array.shape) for array in plain.values()]
    rows = max(vectors or lengths, key=lambda n: (lengths.count(n), n))
    check_rows(path, rows)
    columns: Block = {}
    for name, column in plain.items():
        upright = column.T if column.ndim == 2 and column.shape[0] != rows else column
        if upright.shape[0] != rows or math.prod(upright.shape[1:]) > WIDEST:
            continue
        if upright.ndim == 1:
            columns[name] = upright
        else:
            columns |= {f"{name}[{i}]": upright[:, i] for i in range(upright.shape[1])}

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        step = rows_of_block(len(names))
        for at in range(0, rows, step):
            yield {name: columns[name][at : at + step] for name in names}

    kept = {name.partition("[")[0] for name in columns}
    left_out = tuple(name for name in arrays if name not in kept)
    return TableFile(path, tuple(columns), read, form=form, left_out=left_out)
