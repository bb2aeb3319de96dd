"""Which format a file is taken for: files of foreign libraries, and files that are of none."""

import bz2
import gzip
import json
import lzma
import pickle
import re
import sqlite3
import tarfile
import zipfile

import can
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from PIL import Image
from pyarrow import feather, parquet
from scipy.io import savemat, wavfile

from campaign.foreign import write_tensors
from support.paths import ROOT
from support.written_frames import log_messages
from undulog.capture import Session
from undulog.capture.common.errors import ImportFormatError
from undulog.capture.exchange.frame_reader import FrameReader
from undulog.capture.exchange.registry.registry import FORMATS, format_of
from undulog.capture.exchange.table_format import TableReader

T = np.arange(100) * 0.01
MESSAGES = [
    can.Message(timestamp=1.7e9 + 0.01 * k, arbitration_id=k, data=bytes(k % 9)) for k in range(50)
]
TABLE = pd.DataFrame({"time": T, "joint1_pos": np.sin(T)})


def write_bag(path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3):
        pass


FOREIGN = {
    **{
        suffix: lambda path: log_messages(path, MESSAGES)
        for suffix in ("asc", "blf", "trc", "db", "log")
    },
    "mf4": lambda path: log_messages(path, MESSAGES),
    "can.csv": lambda path: log_messages(path, MESSAGES),
    "table.csv": lambda path: TABLE.to_csv(path, index=False),
    "tsv": lambda path: TABLE.to_csv(path, index=False, sep="\t"),
    "txt": lambda path: np.savetxt(path, TABLE.to_numpy()),
    "parquet": lambda path: parquet.write_table(pa.Table.from_pandas(TABLE), path),
    "npz": lambda path: np.savez(path, time=T, q=T),
    "mat": lambda path: savemat(path, {"time": T, "q": T}),
    "pt": lambda path: write_tensors(path, {"time": T, "dof_pos": np.sin(T)}),
}
NAMES = {
    "log": "candump",
    "db": "can_db",
    "can.csv": "can_csv",
    **dict.fromkeys(["table.csv", "tsv", "txt"], "csv"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_file_of_a_foreign_library_is_found_by_suffix_and_by_content(kind, tmp_path):
    path = tmp_path / f"run.{kind}"
    FOREIGN[kind](path)
    name = NAMES.get(kind, kind)
    assert format_of(path)[0].name == name
    for other in ("run.dat", "run", "run.xyz"):
        renamed = path.rename(tmp_path / other)
        assert format_of(renamed)[0].name == name
        path = renamed


@pytest.mark.parametrize("kind", FOREIGN)
def test_no_other_format_fits_a_file_as_well(kind, tmp_path):
    path = tmp_path / f"run.{kind}"
    FOREIGN[kind](path)
    head = path.read_bytes()[: 1 << 16]
    fits = {form.name: form.sniff(head, path.with_suffix("")) for form in FORMATS}
    name = NAMES.get(kind, kind)
    assert fits[name] >= 0.5
    assert {other for other, fit in fits.items() if fit >= fits[name]} == {name}


@pytest.mark.parametrize("suffix", ["log", "asc", "trc", "csv", "blf"])
def test_a_trace_that_is_compressed(suffix, tmp_path):
    path = log_messages(tmp_path / f"run.{suffix}", MESSAGES)
    packed = tmp_path / f"{path.name}.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert format_of(packed)[0].name == format_of(path)[0].name


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_file_of_another_suffix_is_imported_alike(kind, tmp_path, command):
    path = tmp_path / f"run.{kind}"
    FOREIGN[kind](path)
    copies = [tmp_path / "own.mcap", tmp_path / "other.mcap"]
    robot = ["-r", "arcsnake-joint"] if isinstance(format_of(path)[1], FrameReader) else []
    command("import", path, "-o", copies[0], *robot)
    command("import", path.rename(tmp_path / "run.dat"), "-o", copies[1], *robot)
    counts = [counts_of(session) for session in copies]
    assert counts[0] == counts[1]
    assert sum(counts[0].values())


def counts_of(session):
    with Session.open(session) as opened:
        return {topic: channel.count for topic, channel in opened.channels.items()}


def test_what_a_file_of_its_suffix_shows_late_does_not_matter(tmp_path):
    """Names of entries behind 64 KiB of numbers, a schema behind other tables."""
    with zipfile.ZipFile(tmp_path / "x.pt", "w") as archive:
        archive.writestr("run/data/0", bytes(1 << 17))
        archive.writestr("run/data.pkl", b"}.")
    with sqlite3.connect(tmp_path / "x.db") as base:
        for k in range(400):
            columns = ", ".join(f"column{k:03d}_{n:04d} REAL" for n in range(30))
            base.execute(f"CREATE TABLE a{k} ({columns})")
    base.close()
    log_messages(tmp_path / "x.db", MESSAGES)
    assert b"arbitration_id" not in (tmp_path / "x.db").read_bytes()[: 1 << 16]
    assert [format_of(tmp_path / name)[0].name for name in ("x.pt", "x.db")] == ["pt", "can_db"]


def test_folders(tmp_path):
    (tmp_path / "set/meta").mkdir(parents=True)
    (tmp_path / "set/meta/info.json").write_text("{}")
    write_bag(tmp_path / "bag")
    (tmp_path / "tables").mkdir()
    names = [format_of(tmp_path / name)[0].name for name in ("set", "bag", "tables")]
    assert names == ["lerobot", "rosbag2", "folder"]
    (database,) = (tmp_path / "bag").glob("*.db3")
    with pytest.raises(ImportFormatError, match="looks like an SQLite database"):
        format_of(database.rename(tmp_path / "x.sqlite"))  # what opens bags goes by the suffix


def write_zip(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.bin", b"content")


def write_tar(path):
    with tarfile.open(path, "w") as archive:
        archive.add(__file__, "a.py")


def write_database(path):
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE readings (t REAL, value REAL)")
    base.close()


def picture(path):
    Image.new("RGB", (8, 8)).save(path)


def text(content):
    return lambda path: path.write_text(content)


def data(content):
    return lambda path: path.write_bytes(content)


UNKNOWN = {
    "x.json": (text(json.dumps({"t": [0, 1]})), "looks like JSON"),
    "x.yaml": (text("robot: snake\nrate: 100\nlinks: 13\n"), "looks like YAML"),
    "x.xml": (text("<?xml version='1.0'?>\n<log/>\n"), "looks like XML or HTML"),
    "x.md": (text("Notes of a test\n\nThe snake was slow.\n"), "looks like text (its first line"),
    "x.zip": (write_zip, "looks like a zip"),
    "x.tar": (write_tar, "looks like a tar archive"),
    "x.gz": (
        data(gzip.compress(b"\0\1\2" * 99)),
        "is compressed by gzip; inside it looks like bin",
    ),
    "x.csv.gz": (data(gzip.compress(b"t,a\n0,1\n1,2\n")), "inside it looks like a table of text"),
    "x.bin.bz2": (data(bz2.compress(b"a" * 99)), "looks like bzip2"),
    "x.xz": (data(lzma.compress(b"a" * 99)), "looks like xz"),
    "x.h5": (data(b"\x89HDF\r\n\x1a\n" + bytes(500)), "looks like HDF5"),
    "x.npy": (lambda path: np.save(path, T), "looks like one NumPy array (.npy)"),
    "x.pkl": (data(pickle.dumps({"a": 1})), "looks like a Python pickle"),
    "x.sqlite": (write_database, "looks like an SQLite database"),
    "x.png": (picture, "looks like a PNG image"),
    "x.jpg": (picture, "looks like a JPEG image"),
    "x.tiff": (picture, "looks like a TIFF image"),
    "x.wav": (lambda path: wavfile.write(path, 8000, np.zeros(9, np.int16)), "like WAVE audio"),
    "x.feather": (
        lambda path: feather.write_feather(TABLE, path, compression="uncompressed"),
        "looks like an Arrow file",
    ),
    "x.ulg": (data(b"ULog\x01\x12\x35\x01" + bytes(90)), "looks like a ULog of PX4"),
    "x.pcap": (data(b"\xd4\xc3\xb2\xa1" + bytes(90)), "looks like a capture of packets"),
    "x.raw": (data(bytes(range(128, 256))), "looks like binary data (it begins with 80 81"),
    "x.empty": (data(b""), "is empty"),
    "x.csv": (picture, "looks like a PNG image"),
    "y.csv": (lambda path: path.write_bytes(b"PK\x03\x04" + b"xl/" * 9), "an Excel workbook"),
    "x.log": (data(b"\x89HDF\r\n\x1a\n" + bytes(500)), "looks like HDF5"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_file_is_refused_by_what_it_looks_like(name, tmp_path):
    write, sentence = UNKNOWN[name]
    path = tmp_path / name
    if name == "x.csv":
        write(tmp_path / "x.png")
        (tmp_path / "x.png").rename(path)
    else:
        write(path)
    with pytest.raises(ImportFormatError) as caught:
        format_of(path)
    message = str(caught.value).removeprefix(f"{path}: ")
    assert f"it {sentence}" in message or sentence in message
    kind, _, advice = message.partition("export it as one of ")
    assert ".blf" in advice
    assert not re.search(r"\b(CAN|frames?|candump|joint|bag of ROS|LeRobot)\b", kind)


@pytest.mark.parametrize("verb", ["import", "log info", "log check"])
def test_commands_name_what_a_file_looks_like(verb, tmp_path, command):
    path = tmp_path / "x.json"
    path.write_text("[1, 2]\n")
    output = ["-o", tmp_path / "y.mcap"] if verb == "import" else []
    assert "it looks like JSON" in command(*verb.split(), path, *output, code=1).err


def test_a_text_in_a_log_is_not_taken_for_can_frames(tmp_path, command):
    path = tmp_path / "x.log"
    path.write_text("2024-05-01 12:00:00 INFO started\nand ended\n")
    refused = command("import", path, "-o", tmp_path / "y.mcap", code=1).err
    assert "is not a candump log; its first line is '2024-05-01 12:00:00 INFO started'" in refused
    assert "holds CAN frames" not in refused


def test_the_manual_lists_every_format():
    page = (ROOT / "docs/reference/formats.md").read_text()
    rows = re.findall(r"^\| `([\w-]+)` \| (.*?) \| (.*?) \| (.*?) \| (.*?) \|$", page, re.MULTILINE)
    assert [name for name, *_ in rows] == [form.name for form in FORMATS]
    for form, (_, suffixes, holds, read, written) in zip(FORMATS, rows, strict=True):
        assert tuple(re.findall(r"`(\.\w+)`", suffixes)) == form.suffixes
        assert read.startswith("yes") == (form.read is not None)
        assert (".gz" in read) == form.packed
        by_name = f"`--to {form.name}`"
        assert written == ("no" if not form.write else "yes" if form.write.by_suffix else by_name)
        kinds = {FrameReader: "CAN frames", TableReader: "table"}
        assert kinds.get(type(form.read), holds) == holds
