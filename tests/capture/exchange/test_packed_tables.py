"""Tables and arrays that pack or claim more than a recording has; each was found by an attack."""

import io
import json
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.io import savemat

from campaign.foreign import tensor
from campaign.packed import MIB, constant_parquet, deflated_zeros, zip_of_stream
from support.imported import open_tables
from support.read_back import decoded_of
from undulog.capture.common.errors import ImportFormatError
from undulog.capture.exchange.formats.lerobot.importing import import_lerobot
from undulog.capture.exchange.registry.registry import open_table
from undulog.capture.exchange.table_import import import_tables

T = np.arange(200) * 0.01


def of_bytes(path, data):
    path.write_bytes(data)
    return path


def npy(header, body=b""):
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


def zipped(entries, method=zipfile.ZIP_DEFLATED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return out.getvalue()


def tensors(pickle, **storages):
    files = {f"run/data/{key}": array.tobytes() for key, array in storages.items()}
    return zipped({"run/data.pkl": b"\x80\x02" + pickle + b".", **files})


def test_a_zip_expands_to_what_it_declares_and_no_further(tmp_path):
    stream = deflated_zeros(300 * MIB)
    for name, suffix in ((b"time.npy", "npz"), (b"run/data.pkl", "pt")):
        path = of_bytes(tmp_path / f"x.{suffix}", zip_of_stream(name, stream, declared=1000))
        tracemalloc.start()
        with pytest.raises(ImportFormatError, match=path.name):
            open_table(path)
        assert tracemalloc.get_traced_memory()[1] < 20 * MIB
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_of_another_method_is_refused(tmp_path, method):
    out = io.BytesIO()
    np.lib.format.write_array(out, T)
    path = of_bytes(tmp_path / "x.npz", zipped({"time.npy": out.getvalue()}, method))
    with pytest.raises(ImportFormatError, match="neither stored nor deflated"):
        open_table(path)


HEADERS = [
    b"{'descr': '<f8', 'shape': (" + b"[" * 3000,
    b"{'descr': [('a', '<f8'), ('a', '<f8')], 'fortran_order': False, 'shape': (3,)}\n",
    b"(" * 150,
    b"{}",
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (-5,)}\n",
]


@pytest.mark.parametrize("header", HEADERS, ids=range(len(HEADERS)))
def test_a_header_that_is_no_header(tmp_path, header):
    path = of_bytes(tmp_path / "x.npz", zipped({"time.npy": npy(header, bytes(100))}))
    with pytest.raises(ImportFormatError, match=r"x\.npz"):
        open_table(path)


def test_dictionaries_that_hold_each_other(tmp_path):
    doubled = b"}q\x00" + b"".join(b"}q%c(Va\nh%cVb\nh%cu" % (k + 1, k, k) for k in range(50))
    with pytest.raises(ImportFormatError, match="names"):
        open_table(of_bytes(tmp_path / "x.pt", tensors(doubled)))


def test_a_dictionary_in_itself(tmp_path):
    with pytest.raises(ImportFormatError, match="too long"):
        open_table(of_bytes(tmp_path / "x.pt", tensors(b"}q\x00(Va\nh\x00u")))


def test_a_pickle_of_many_marks_and_tuples(tmp_path):
    """Each tuple took a search from the bottom of the stack."""
    pickle = b"N" * 300_000 + b"(t" * 100_000
    with pytest.raises(ImportFormatError):
        open_table(of_bytes(tmp_path / "x.pt", tensors(pickle)))


def test_thousands_of_names_of_one_storage(tmp_path):
    entry = tensor("s", 200, (200,), (1,))
    pickle = b"}(" + b"".join(b"Vt%d\n" % k + entry for k in range(2000)) + b"u"
    path = of_bytes(tmp_path / "x.pt", tensors(pickle, s=T))
    table = open_table(path)
    assert len(table.columns) == 2000
    assert np.array_equal(table.sample()["t7"], T)


def test_a_table_of_constants_with_millions_of_rows(tmp_path):
    data = constant_parquet(5_000_000, ("time", "joint1_pos", "joint1_vel"))
    with pytest.raises(ImportFormatError, match="5000000 rows"):
        open_table(of_bytes(tmp_path / "x.parquet", data))


def test_columns_of_one_name(tmp_path):
    path = tmp_path / "x.parquet"
    parquet.write_table(pa.table([T, T, T], names=["time", "q", "q"]), path)
    with pytest.raises(ImportFormatError, match="2 columns 'q'"):
        open_table(path)


@pytest.mark.slow
def test_a_mat_element_that_expands(tmp_path):
    savemat(tmp_path / "x.mat", {"time": T, "q": T}, do_compression=True)
    data = (tmp_path / "x.mat").read_bytes()
    (size,) = struct.unpack_from("<I", data, 132)
    inside = zlib.decompress(data[136 : 136 + size])
    packer = zlib.compressobj()
    body = packer.compress(inside) + packer.flush(zlib.Z_SYNC_FLUSH) + deflated_zeros(600 * MIB)
    element = struct.pack("<II", 15, len(body)) + body
    path = of_bytes(tmp_path / "x.mat", data[:128] + element + data[136 + size :])
    with pytest.raises(ImportFormatError, match="expands to more than"):
        open_table(path)


@pytest.mark.slow
def test_a_long_table_in_any_order(tmp_path):
    """Rows of three joints, shuffled, are the samples that they are in order."""
    rng = np.random.default_rng(1)
    rows = [(t, k, np.sin(t + k)) for t in range(20_000) for k in range(3)]
    rng.shuffle(rows)
    text = "\n".join(["t,joint,angle", *(f"{int(t)},{int(k)},{q:.9f}" for t, k, q in rows)])
    path = of_bytes(tmp_path / "x.csv", text.encode())
    import_tables(open_tables(path), tmp_path / "x.mcap", units={"time": "s"})
    messages = [message for *_, message in decoded_of(tmp_path / "x.mcap", ["/joint_states"])]
    in_order = np.argsort(messages[0].name)
    angles = np.array([message.position for message in messages])[:, in_order]
    expected = np.sin(np.arange(20_000)[:, None] + np.arange(3))
    assert angles == pytest.approx(expected, abs=1e-8)


def dataset(folder, width=2, **columns):
    """Write a data set of 20 frames with some other columns."""
    meta, data = folder / "set" / "meta", folder / "set" / "data" / "chunk-000"
    meta.mkdir(parents=True)
    data.mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [width], "names": None}
    (meta / "info.json").write_text(json.dumps({"fps": 30, "features": {"action": feature}}))
    frames = {"action": [[0.1] * width] * 20, "episode_index": [0] * 20, "frame_index": range(20)}
    table = pa.table({name: list(cells) for name, cells in (frames | columns).items()})
    parquet.write_table(table, data / "file-000.parquet")
    return folder / "set"


@pytest.mark.nightly
@pytest.mark.parametrize("column", ["episode_index", "frame_index"])
@pytest.mark.parametrize("cells", [[None, 1] * 10, ["a"] * 20, [[1]] * 20, [0.5] * 20])
def test_frames_numbered_by_what_is_no_number(tmp_path, column, cells):
    with pytest.raises(ImportFormatError, match=column):
        import_lerobot(dataset(tmp_path, **{column: cells}), tmp_path / "out")


def with_one(name, t=None, value=None):
    """A table of one joint in which one row has another time or value."""
    rows = [f"{k / 100},{k % 7}" for k in range(100)]
    rows[50] = f"{t or 0.5},{value or 1}"
    return [f"time,{name}", *rows]


BEYOND = (0, 1, 4294967296)  # as many joints were named
REFUSED = [
    *(
        (with_one("joint1_pos", t=t), "time")
        for t in ("1e999999999", "1e308", "-1e308", "nan", "inf", "1e18", "-5e9")
    ),
    *(
        (with_one("joint1_pos_deg", value=value), "joint1_pos_deg")
        for value in ("1e308", "inf", "-1e250")
    ),
    (
        ["time [s],joint1_pos", *(f"{k - 2e8:.2f},{k % 7}" for k in range(100))],
        "not all times are from 1970",
    ),
    (
        ["time,joint,angle", *(f"{k / 100},j{k % 3000},0.5" for k in range(60_000))],
        "seldom share a time",
    ),
    (
        ["time,joint,angle", *(f"{k},{j},0.5" for k in range(100) for j in BEYOND)],
        "number 4294967296",
    ),
]


@pytest.mark.parametrize(
    ("rows", "why"), REFUSED, ids=[f"{why}-{k}" for k, (_, why) in enumerate(REFUSED)]
)
def test_times_values_and_joints_that_no_log_holds(tmp_path, rows, why):
    path = of_bytes(tmp_path / "x.csv", "\n".join(rows).encode())
    with pytest.raises(ImportFormatError, match=why):
        import_tables(open_tables(path), tmp_path / "x.mcap")


UNEVEN = [[0.1], [0.1, 0.2, 0.3]] * 10, [[0.1, 0.2], None] * 10, [None, [0.1] * 4] * 10
ODD = ["a", "b"] * 10, [[[1.0]]] * 20, [{"x": 1.0}] * 20, [None] * 20, [[]] * 20


@pytest.mark.nightly
@pytest.mark.parametrize("cells", [*UNEVEN, *ODD])
def test_actions_that_are_no_numbers(tmp_path, cells):
    with pytest.raises(ImportFormatError, match="action"):
        import_lerobot(dataset(tmp_path, action=cells), tmp_path / "out")


def test_one_joint_has_no_vectors(tmp_path):
    """LeRobot writes a feature of one element as plain numbers."""
    cells = [k / 20 for k in range(20)]
    import_lerobot(dataset(tmp_path, width=1, action=cells), tmp_path / "x.mcap")
    messages = decoded_of(tmp_path / "x.mcap", ["/joint_commands"])
    assert [message.position for *_, message in messages] == [[cell] for cell in cells]
