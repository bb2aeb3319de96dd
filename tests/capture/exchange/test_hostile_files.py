"""Small binary files that end a library by a signal, or take memory and time without bound.

Each goes through the command; the kernel reports what it took, its child process included.
"""

import io
import os
import random
import sqlite3
import struct
import zipfile
import zlib

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.io import savemat

from support.measured import CPU_S, PEAK_BYTES, refused, undulog_measured
from support.written_frames import log_messages
from undulog.capture import Session

pytestmark = pytest.mark.slow
T = np.arange(300) * 0.01
Q = np.sin(3 * T)
MIB = 1 << 20


def imported(path):
    return ("import", path.name, "-o", "new.mcap")


def bounded(path, *words):
    """Run a command that may also succeed; return its end."""
    done = undulog_measured(*words, cwd=path.parent)
    assert done.code in {0, 1}, done
    assert "Traceback" not in done.err
    assert (done.cpu_s < CPU_S, done.peak < PEAK_BYTES) == (True, True), done
    return done


# -- MATLAB --------------------------------------------------------------------------------


@pytest.mark.nightly
def test_every_type_that_an_element_of_a_mat_file_may_state(tmp_path):
    """With the type of its numbers 0, 2 or others, scipy is ended by SIGSEGV."""
    whole = io.BytesIO()
    savemat(whole, {"time": T, "joint1_pos": Q})
    data = bytearray(whole.getvalue())
    numbers = bytes(struct.pack("<II", 9, 8 * len(T)))  # miDOUBLE
    place = data.index(numbers)
    reported = set()
    for kind in (0, 8, 10, 11, 14, 15, 16, 255):
        data[place] = kind
        path = tmp_path / f"kind{kind}.mat"
        path.write_bytes(data)
        reported.add(refused(path, *imported(path)).partition(".mat: ")[2])
    assert any("was ended by SIGSEGV" in text for text in reported)


def test_a_mat_file_that_declares_more_than_it_is_worth(tmp_path):
    whole = io.BytesIO()
    savemat(whole, {"time": T, "joint1_pos": Q})
    data = bytearray(whole.getvalue())
    at = data.index(struct.pack("<II", 9, 8 * len(T)))
    struct.pack_into("<I", data, at + 4, 0x7FFF_FFF8)
    path = tmp_path / "long.mat"
    path.write_bytes(data)
    refused(path, *imported(path))


@pytest.mark.nightly
def test_a_compressed_element_that_expands(tmp_path):
    packed = zlib.compressobj(9)
    body = packed.compress(struct.pack("<II", 14, 3 << 30))
    body += b"".join(packed.compress(bytes(MIB)) for _ in range(1500)) + packed.flush()
    path = tmp_path / "bomb.mat"
    head = b"MATLAB 5.0 MAT-file".ljust(124, b" ") + b"\x00\x01IM"
    path.write_bytes(head + struct.pack("<II", 15, len(body)) + body)
    refused(path, *imported(path))


# -- PyTorch and NumPy ---------------------------------------------------------------------


def pickled(path, pickle):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", pickle)
        archive.writestr("a/data/0", T.tobytes())
    return path


def nested(depth):
    """A tuple that holds one tuple twice, and so on: 2^depth elements to whatever walks them."""
    steps = (b"h%ch%c\x86q%c" % (k, k, k + 1) for k in range(depth))
    return b"K\x01q\x00" + b"".join(steps)


ENDS = (
    b"}h%cK\x01s.",
    b"ctorch._utils\n_rebuild_tensor_v2\n(h%ch%cK\x00h%ctR.",
)
"""Walked by what looks up a dictionary, and by what makes a tensor."""
LIKE_THEM = (
    b"(X\x07\x00\x00\x00storageq\xf0ctorch\nFloatStorage\nh%cX\x03\x00\x00\x00cpuK\x01tQ.",
    b"(h%cctorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x01tQ.",
    b"h%ch\x00\x93.",
    b"h\x00h%c\x93.",
    b"h\x00h%cR.",
    b"}X\x01\x00\x00\x00ah%cs.",
    b"ctorch._utils\n_rebuild_parameter\n(h%ctR.",
)


@pytest.mark.parametrize(
    "end", [*ENDS, *(pytest.param(end, marks=pytest.mark.nightly) for end in LIKE_THEM)]
)
def test_a_tensor_file_of_nested_tuples(end, tmp_path):
    depth = 60
    pickle = b"\x80\x02" + nested(depth) + end.replace(b"%c", bytes([depth]))
    path = pickled(tmp_path / "nested.pt", pickle)
    assert path.stat().st_size < 2000
    refused(path, *imported(path))


def test_arrays_that_are_as_large_as_may_be(tmp_path):
    """Two to the 25 numbers are the most that a small file may have."""
    rows = (1 << 25) // 2
    path = tmp_path / "wide.npz"
    np.savez_compressed(path, time=np.zeros(rows), joint1_pos=np.zeros(rows))
    refused(path, *imported(path))


# -- Parquet -------------------------------------------------------------------------------


def repeated_text(path, *, plain):
    """Twenty thousand rows of one text of 1 MiB."""
    rows = 20_000
    t = pa.array(np.arange(rows) / 100.0)
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, "i4")), pa.array(["x" * MIB]))
    columns = {"time": t, "joint1_pos": pa.array(np.sin(np.arange(rows) / 50)), "note": text}
    parquet.write_table(pa.table(columns), path, compression="zstd", store_schema=not plain)
    return path


@pytest.mark.parametrize("plain", [pytest.param(True, marks=pytest.mark.nightly), False])
def test_a_column_of_long_texts_is_left_out(plain, tmp_path):
    path = repeated_text(tmp_path / "note.parquet", plain=plain)
    assert path.stat().st_size < 300_000
    done = bounded(path, *imported(path))
    assert done.code == 0, done
    with Session(tmp_path / "new.mcap") as session:
        values = session.joints("/joint_states", "position").values
    np.testing.assert_array_equal(values[0], np.sin(np.arange(20_000) / 50))


def test_a_column_of_long_texts_that_is_chosen_is_refused(tmp_path):
    path = repeated_text(tmp_path / "note.parquet", plain=True)
    (tmp_path / "map.toml").write_text(
        '[time]\ncolumn = "note"\nunit = "s"\n[[columns]]\ncolumn = "joint1_pos"\njoint = "a"\n'
        'quantity = "position"\nunit = "rad"\n'
    )
    refused(path, *imported(path), "--columns", "map.toml")


def test_a_list_of_a_hundred_million_equal_numbers(tmp_path):
    many = 100_000_000
    offsets = pa.array([0, many, many, many], pa.int32())
    lists = pa.ListArray.from_arrays(offsets, pa.array(np.zeros(many, "f4")))
    path = tmp_path / "list.parquet"
    table = pa.table({"time": [0.0, 0.1, 0.2], "joint1_pos": lists})
    parquet.write_table(table, path, compression="zstd")
    assert path.stat().st_size < 500_000
    refused(path, *imported(path))


def test_twenty_thousand_columns(tmp_path):
    path = tmp_path / "columns.parquet"
    parquet.write_table(pa.table({f"c{k}": [0.0, 0.1] for k in range(20_000)}), path)
    assert "20000 columns; 4096 at most" in refused(path, *imported(path))


def test_names_that_act_on_a_terminal(tmp_path):
    path = tmp_path / "escape.parquet"
    parquet.write_table(pa.table({"time": T, "joint\x1b[31m\u202e\u200b": Q}), path)
    assert "joint\\x1b[31m\\u202e" in refused(path, *imported(path))


@pytest.mark.nightly
def test_damaged_metadata_of_a_parquet_file(tmp_path):
    """Thrift structures that no checksum guards: an uncaught exception ends the process."""
    whole = io.BytesIO()
    parquet.write_table(pa.table({"time": T, "joint1_pos": Q}), whole)
    data, rng = whole.getvalue(), random.Random(5)
    size = int.from_bytes(data[-8:-4], "little")
    for k in range(25):
        changed = bytearray(data)
        for _ in range(3):
            changed[len(data) - 8 - rng.randrange(1, size)] = rng.randrange(256)
        path = tmp_path / f"damaged{k}.parquet"
        path.write_bytes(changed)
        bounded(path, "import", path.name, "-o", f"out{k}.mcap")


# -- CAN logs ------------------------------------------------------------------------------


def some_messages():
    import can

    for k in range(200):
        yield can.Message(timestamp=1.7e9 + k * 1e-3, arbitration_id=k, data=bytes(8))


@pytest.mark.parametrize(
    "data",
    [
        "hex(zeroblob(100000000))",
        *(
            pytest.param(data, marks=pytest.mark.nightly)
            for data in ("zeroblob(1000000)", "printf('%.*c', 900000000, 'x')")
        ),
    ],
)
def test_frames_that_are_computed(data, tmp_path):
    path = log_messages(tmp_path / "trace.db", some_messages())
    with sqlite3.connect(path) as base:
        names = [row[1] for row in base.execute("PRAGMA table_info(messages)")]
        kept = ", ".join(name for name in names if name != "data")
        base.executescript(
            "DELETE FROM messages WHERE rowid > 3; "
            f"ALTER TABLE messages RENAME TO old; CREATE TABLE messages({kept}, data AS ({data}));"
            f"INSERT INTO messages({kept}) SELECT {kept} FROM old; DROP TABLE old; VACUUM;"
        )
    base.close()
    reported = refused(path, *imported(path), "-r", "arcsnake-joint")
    assert "computed columns" in reported


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["blf", "mf4", "db"])
def test_damaged_logs_of_frames(kind, tmp_path):
    if kind == "mf4":
        pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
    data = log_messages(tmp_path / f"trace.{kind}", some_messages()).read_bytes()
    rng = random.Random(7)
    for k in range(12):
        changed = bytearray(data)
        for _ in range(4):
            at = rng.randrange(len(changed) - 8)
            value = rng.choice([0, 1, 2**31 - 1, 2**63 - 1, 2**64 - 1, at])
            struct.pack_into("<Q", changed, at, value)
        path = tmp_path / f"damaged{k}.{kind}"
        path.write_bytes(changed)
        bounded(path, "import", path.name, "-o", f"out{k}.mcap", "-r", "arcsnake-joint")


# -- no files ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "suffix",
    [
        *("csv", "mat"),
        *(
            pytest.param(s, marks=pytest.mark.nightly)
            for s in ("parquet", "npz", "pt", "blf", "db", "log")
        ),
    ],
)
def test_a_pipe_is_not_waited_for(suffix, tmp_path):
    path = tmp_path / f"x.{suffix}"
    os.mkfifo(path)
    assert "it is a named pipe, not a file" in refused(path, *imported(path), "-r", "snake25")
