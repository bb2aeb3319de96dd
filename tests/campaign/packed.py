"""Faults in the structure of .npz, .pt, .parquet and .mat files.

Bytes changed at random seldom pass their checksums and headers; here a file is made again, sound
outside, with something inside that no program would write.
"""

import contextlib
import io
import struct
import subprocess
import sys
import warnings
import zipfile
import zlib
from functools import cache

import numpy as np
import pyarrow as pa
from pyarrow import parquet
from scipy.io import loadmat, savemat

from .foreign import tensor
from .mutate import HUGE, WORDS, mutate_bytes, mutate_text

MIB = 1 << 20
ODD_FLOATS = [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 2.0**63, 0.0]


def one_of(*faults):
    """Return a function that makes one of some faults."""

    def remake(data, rng):
        with contextlib.suppress(zipfile.BadZipFile, pa.ArrowException):  # it was cut before
            return rng.choice(faults)(data, rng)
        return data

    return remake


@cache
def deflated_zeros(size):
    """Return zeros as a raw deflate stream; ``size`` in whole MiB."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(MIB)) + packer.flush(zlib.Z_FULL_FLUSH)
    return block * (size // MIB) + zlib.compressobj(9, zlib.DEFLATED, -15).flush()


# -- zip: .npz and .pt ---------------------------------------------------------------------


def _entries(data):
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [(info.filename, archive.read(info)) for info in archive.infolist()]


def _zipped(entries, method=zipfile.ZIP_DEFLATED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # duplicate names
        for name, content in entries:
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=method)
    return out.getvalue()


def zip_of_stream(name, stream, *, declared, twins=0):
    """Pack a zip of one deflated stream by hand; ``twins`` more entries name the same bytes."""
    fixed = (20, 0, zipfile.ZIP_DEFLATED, 0, 0x21, 0, len(stream), declared)
    local = struct.pack("<IHHHHHIIIHH", 0x04034B50, *fixed, len(name), 0) + name + stream
    names = [name, *(b"%d.npy" % k for k in range(twins))]
    central = b"".join(
        struct.pack("<IHHHHHHIIIHHHHHII", 0x02014B50, 20, *fixed, len(name), 0, 0, 0, 0, 0, 0)
        + name
        for name in names
    )
    count = len(names)
    end = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, count, count, len(central), len(local), 0)
    return local + central + end


def _odd_names(data, rng):
    entries = _entries(data)
    k = rng.randrange(len(entries))
    entries[k] = rng.choice([*WORDS[:20], "../up.npy", "/tmp/up.npy", "n" * 60000]), entries[k][1]
    return _zipped(entries)


def _twice(data, rng):
    entries = _entries(data)
    return _zipped(entries + [rng.choice(entries)] * rng.choice([1, 3000]))


def _inside(data, rng):
    entries = _entries(data)
    k = rng.randrange(len(entries))
    name, content = entries[k]
    head, rest = content[:128], content[128:]
    if rng.random() < 0.5 or name.endswith(".pkl"):
        head, rest = content, b""
    change = mutate_text if rng.random() < 0.6 else mutate_bytes
    entries[k] = name, change(head, rng) + rest
    return _zipped(entries)


def _packed_otherwise(data, rng):
    methods = [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    return _zipped(_entries(data), rng.choice(methods))


def _of_zeros(data, rng):
    """One entry expands far beyond what is declared, or honestly to hundreds of MiB."""
    name = rng.choice(_entries(data))[0].encode()
    size = rng.choice([64, 400, 3000]) * MIB
    declared = rng.choice([100, size, size // 2, 2**32 - 1])
    twins = rng.choice([0, 0, 2000])
    return zip_of_stream(name, deflated_zeros(size), declared=declared, twins=twins)


def _npy(array):
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=True)
    return out.getvalue()


def _odd_arrays(data, rng):
    entries = dict(_entries(data))
    name = rng.choice(list(entries))
    entries[name] = _npy(rng.choice(ODD_ARRAYS)(rng))
    return _zipped(entries.items())


def _numbers(rng, rows=300):
    array = np.linspace(0, 3, rows)
    array[rng.randrange(rows) :: rng.choice([1, 7, 1000])] = rng.choice(ODD_FLOATS)
    return array


ODD_ARRAYS = [
    _numbers,
    lambda rng: np.full((300, 3), rng.choice(ODD_FLOATS)),
    lambda rng: np.array([{"a": [1]}] * 300, dtype=object),
    lambda rng: np.array(["x", rng.choice(WORDS[:20])] * 150),
    lambda rng: np.arange(300).astype(rng.choice(["M8[ns]", "m8[s]", "c16", "?", ">f8", "f2"])),
    lambda rng: np.zeros(300, [("a", "f8"), ("b", "V0")]),
    lambda rng: np.zeros((300, 0)),
    lambda rng: np.zeros(()),
    lambda rng: np.zeros((300, 2, 2)),
    lambda rng: np.zeros((300, 5000)),
    lambda rng: np.zeros((2000, 4000), "i1"),
    lambda rng: np.arange(300, dtype="u8") + np.uint64(2**64 - 400),
    lambda rng: np.arange(300)[::-1].copy(),
    lambda rng: np.full(300, rng.choice([2**62, -(2**63), 2**31])),
]

_HEADERS = [
    "{'descr': '<f8', 'fortran_order': False, 'shape': (%s,)}",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (300, %s)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (%s, %s)}",
    "{'descr': '%s', 'fortran_order': False, 'shape': (300,)}",
    "{'descr': [('a', '<f8'), ('a', '%s')], 'fortran_order': False, 'shape': (300,)}",
    "%s",
]


def _lying_header(data, rng):
    """A header of an array says anything."""
    values = [*map(str, HUGE), "-1", "True", "None", "|O", "|V0", "|S0", "<U99999999", "<f16"]
    values += ["(" * 150, "[" * 3000, "-" * 5000 + "1", "9" * 5000, "{}", "\x1b[2J", "M8[Y]"]
    header = rng.choice(_HEADERS)
    text = (header.replace("%s", rng.choice(values)) + "\n").encode()
    entries = dict(_entries(data))
    name = rng.choice(list(entries))
    version = rng.choice([1, 2, 3, 4])
    size = struct.pack("<H" if version == 1 else "<I", len(text))
    entries[name] = b"\x93NUMPY" + bytes((version, 0)) + size + text + bytes(2400)
    return _zipped(entries.items())


def _tensors(pickle, numbers=300, names=("time", "q")):
    storages = [(f"run/data/{name}", np.linspace(0, 3, numbers).tobytes()) for name in names]
    return _zipped([*storages, ("run/data.pkl", pickle)])


def _lying_tensors(data, rng):
    shape, strides = ([rng.choice([*HUGE, 300, 3, -1]) for _ in range(2)] for _ in range(2))
    shapes = [(shape, strides), ((300,), strides), (shape, (1, 0)), ((300, 0), (1, 1)), ((), ())]
    entry = tensor("time", *rng.choice([(300, (300,), (1,), 10**9), (9, *rng.choice(shapes))]))
    return _tensors(b"\x80\x02}(Vtime\n" + entry + b"u.")


def _many_tensors(data, rng):
    """Thousands of names of one storage."""
    count, numbers = rng.choice([(3000, 300), (3000, 1_000_000), (20, 30_000_000)])
    entry = tensor("time", numbers, (numbers,), (1,))
    text = b"".join(b"Vt%d\n" % k + entry for k in range(count))
    pickle = b"\x80\x02}(" + text + b"u."
    if numbers == 300:
        return _tensors(pickle)
    return _tensors_of_zeros(numbers // 1_000_000 * 8, pickle)


@cache
def _tensors_of_zeros(mib, pickle):
    entries = [("run/data/time", bytes(mib * MIB)), ("run/data.pkl", pickle)]
    return _zipped(entries)


def _pickles(data, rng):
    """Dictionaries that hold each other, and themselves; programs; nothing."""
    doubled = b"}q\x00" + b"".join(
        b"}q%c(Va\nh%cVb\nh%cu" % (k + 1, k, k) for k in range(rng.choice([8, 40]))
    )
    nested = b"K\x01q\x00" + b"".join(
        b"h%ch%c\x86q%c" % (k, k, k + 1) for k in range(rng.choice([8, 60]))
    )
    last = nested[-1:]
    texts = [
        nested + b"}h" + last + b"K\x01s",
        nested + b"(Vstorage\nctorch\nFloatStorage\nh" + last + b"Vcpu\nK\x01tQ",
        nested + b"h" + last + b"\x93",
        doubled,
        b"}q\x00(Va\nh\x00u",
        b"}(Va\n" * 3000 + b"Nu" + b"u" * 2999,
        b"]" * 5000 + b"a" * 4999,
        b"(" * 100_000,
        b"cos\nsystem\n(Vtouch new\ntR",
        b"I" + b"9" * 6000 + b"\n",
        b"\x8a\xff" + bytes(255),
        b"V\x1b[2J\n",
        b"h\x07",
        b"",
    ]
    return _tensors(b"\x80\x02" + rng.choice(texts) + b".")


# -- Parquet -------------------------------------------------------------------------------


def _odd_column(rng, n):
    """Return a column of n cells of any type."""
    lists = [[0.1] * (k % 4) for k in range(n)]
    made = [
        lambda: pa.nulls(n),
        lambda: pa.array([rng.choice(WORDS[:25]) for _ in range(n)]),
        lambda: pa.array(lists),
        lambda: pa.array([None if k % 3 else [0.1, None] for k in range(n)]),
        lambda: pa.array([[[0.1]]] * n),
        lambda: pa.array([[]] * n, pa.list_(pa.float64())),
        lambda: pa.array([[0.5] * 5000] * n) if n <= 300 else pa.nulls(n),
        lambda: pa.array([["a", "b", "c"]] * n),
        lambda: pa.array(np.resize(ODD_FLOATS, n)),
        lambda: pa.array(np.resize(np.array([0, 2**64 - 1, 2**63], "u8"), n)),
        lambda: pa.array(np.full(n, rng.choice([-1, 2**62, -(2**63)]))),
        lambda: pa.array(np.arange(n), pa.timestamp(rng.choice(["s", "ms", "ns"]), tz="UTC")),
        lambda: pa.array(np.full(n, 2**62), pa.timestamp("s")),
        lambda: pa.array([{"x": 1.0, "y": [1]}] * n),
        lambda: pa.array([True] * n),
        lambda: pa.array([b"\xff\x00"] * n),
        lambda: pa.array([f"a{k % 2}" for k in range(n)]).dictionary_encode(),
        lambda: pa.array(np.arange(n)).cast(pa.decimal128(38, 0)),
        lambda: pa.array([[float("nan"), 1e308, float("inf")]] * n),
        lambda: pa.array(np.arange(n)[::-1].copy()),
    ]
    return rng.choice(made)()


def _remade(data, rng, change):
    table = change(parquet.read_table(io.BytesIO(data)), rng)
    out = io.BytesIO()
    options = {
        "row_group_size": rng.choice([1, 50, None]) if table.num_columns < 50 else None,
        "compression": rng.choice(["snappy", "zstd", "none"]),
    }
    parquet.write_table(table, out, **options)
    return out.getvalue()


def _changed_column(table, rng):
    k = rng.randrange(table.num_columns)
    return table.set_column(k, table.column_names[k], _odd_column(rng, table.num_rows))


def _changed_names(table, rng):
    names = list(table.column_names)
    k = rng.randrange(len(names))
    names[k] = rng.choice([*WORDS[:25], rng.choice(names), "frame_index[0]", "action[1]", "time"])
    return table.rename_columns(names)


def _changed_rows(table, rng):
    kind = rng.randrange(5)
    if kind == 0:
        return table.slice(0, rng.choice([0, 1]))
    if kind == 1:
        return table.take(np.arange(table.num_rows)[::-1].copy())
    if kind == 2:
        return pa.concat_tables([table] * 3)
    if kind == 3:
        return table.drop_columns([rng.choice(table.column_names)])
    column = pa.array(np.resize(ODD_FLOATS, table.num_rows))
    return pa.table([*table.columns, *[column] * 3000], names=_many_names(table, 3000))


def _many_names(table, count):
    return [*table.column_names, *(f"joint{k}_pos" for k in range(count))]


def _remake_parquet(change):
    return lambda data, rng: _remade(data, rng, change)


@cache
def constant_parquet(rows, names):
    """Return a table whose runs take no room: rows of zeros."""
    out = io.BytesIO()
    kind = pa.schema([(name, pa.float32()) for name in names])
    block = pa.table([np.zeros(1_000_000, np.float32)] * len(names), schema=kind)
    with parquet.ParquetWriter(out, kind, compression="zstd") as writer:
        for _ in range(rows // 1_000_000):
            writer.write_table(block)
    return out.getvalue()


@cache
def repeated_text(size, rows, *, plain):
    """Return a table whose column of texts is one text, in a dictionary."""
    out = io.BytesIO()
    note = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, "i4")), pa.array(["x" * size]))
    t = pa.array(np.arange(rows) / 100)
    table = pa.table({"time": t, "joint1_pos": t, "note": note})
    parquet.write_table(table, out, compression="zstd", store_schema=not plain)
    return out.getvalue()


@cache
def long_lists(length):
    """Return a table of three rows, of which the first has a list of zeros.

    It is written by another process, since cases are forked from this one with all its memory.
    """
    code = (
        "import sys, numpy as np, pyarrow as pa; from pyarrow import parquet; "
        "n = int(sys.argv[1]); "
        "lists = pa.ListArray.from_arrays(pa.array([0, n, n, n], pa.int32()), "
        "pa.array(np.zeros(n, 'f4'))); parquet.write_table(pa.table({'time': [0.0, 0.1, 0.2], "
        "'joint1_pos': lists}), sys.stdout.buffer, compression='zstd')"
    )
    return subprocess.run(
        [sys.executable, "-c", code, str(length)], check=True, capture_output=True
    ).stdout


def _repeated(data, rng):
    if rng.random() < 0.5:
        return long_lists(rng.choice([10**6, 10**8]))
    size, rows = rng.choice([(1 << 20, 20_000), (1 << 12, 20_000), (1 << 20, 60)])
    return repeated_text(size, rows, plain=rng.random() < 0.5)


def _constant(data, rng):
    return constant_parquet(rng.choice([1, 6]) * 1_000_000, ("time", "joint1_pos", "joint1_vel"))


# -- .mat ----------------------------------------------------------------------------------


def _odd_mat(data, rng):
    arrays = {k: v for k, v in loadmat(io.BytesIO(data)).items() if not k.startswith("__")}
    name = rng.choice([*arrays, "x" * 31])
    struct_ = {"a": {"b": np.ones(3)}}
    cells = np.array([np.ones(3), "x", struct_], dtype=object)
    odd = [cells, struct_, "text", rng.choice(WORDS[:20]), 3 + 4j]
    array = rng.choice(ODD_ARRAYS)(rng)
    plain = array.dtype.kind in "fiubc" and array.dtype.itemsize in {1, 4, 8, 16}
    arrays[name] = array if plain else rng.choice(odd)
    out = io.BytesIO()
    savemat(out, arrays, do_compression=rng.random() < 0.5)
    return out.getvalue()


def _repacked(data, rng):
    """Change numbers inside a compressed element, its checksum right; or have it expand."""
    parts, at = [data[:128]], 128
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        body = data[at + 8 : at + 8 + size]
        if kind == 15 and rng.random() < 0.5:
            inside = bytearray(zlib.decompress(body))
            place = 4 * rng.randrange(min(len(inside) // 4, 20))
            struct.pack_into("<I", inside, place, rng.choice(HUGE) & 0xFFFF_FFFF)
            packer = zlib.compressobj(9)
            body = packer.compress(bytes(inside)) + packer.flush(zlib.Z_SYNC_FLUSH)
            if rng.random() < 0.3:
                body += deflated_zeros(2000 * MIB)
            body += packer.flush()
        parts.append(struct.pack("<II", kind, len(body)) + body)
        at += 8 + size
    return b"".join(parts)


PACKED = {
    ".npz": one_of(
        _odd_names, _twice, _inside, _packed_otherwise, _of_zeros, _odd_arrays, _odd_arrays,
        _lying_header, _lying_header,
    ),
    ".pt": one_of(
        _odd_names, _twice, _inside, _inside, _packed_otherwise, _of_zeros, _lying_tensors,
        _many_tensors, _pickles, _pickles,
    ),
    ".parquet": one_of(
        *map(_remake_parquet, (_changed_column, _changed_column, _changed_names, _changed_rows)),
        *map(_remake_parquet, (_changed_column, _changed_column, _changed_names, _changed_rows)),
        _constant, _repeated,
    ),
    ".mat": one_of(_odd_mat, _repacked),
}  # fmt: skip
"""Suffix to a function that makes its file again from its bytes, with a fault."""
