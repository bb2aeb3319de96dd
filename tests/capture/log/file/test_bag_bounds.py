"""Bags that expand, repeat or never end are refused with the file and the fix."""

import bz2
import re
import sqlite3
import struct

import lz4.frame
import pytest
from hostile_logs import zeros
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from support.ros_bags import BY_FILE, BY_MESSAGE, Filler, filling, write_bag
from undulog.capture import Session
from undulog.capture.common.errors import NotALogError

pytestmark = pytest.mark.usefixtures("scratch")
MIB = 1 << 20
BOMB = zeros(200 * MIB)


fill = filling(Filler.state, 0.3)


def refused(path, match):
    with pytest.raises(NotALogError, match=match) as caught:
        Session.open(path).close()
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_compressed_file_that_expands_too_far_is_refused(storage, tmp_path):
    bag = write_bag(tmp_path / "bag", fill, storage=storage, compression=BY_FILE)
    (path,) = bag.glob("*.zstd")
    path.write_bytes(BOMB)
    refused(bag, "expands to more than 64 MiB.*decompress it first")


@pytest.mark.parametrize("stated", [True, False])
def test_a_compressed_message_that_expands_too_far_is_refused(stated, tmp_path):
    def bomb(bag):
        fill(bag)
        bag.writer.compression_mode = CompressionMode.NONE  # written as it is
        bag.writer.write(bag.ways["/joint_states"], 2 * 10**18, zeros(200 * MIB, stated=stated))
        bag.writer.compression_mode = CompressionMode.MESSAGE

    refused(
        write_bag(tmp_path / "bag", bomb, compression=BY_MESSAGE),
        "expands to more than 64 MiB.*decompress it first",
    )


@pytest.mark.parametrize("kind", ["bz2", "lz4"])
def test_a_chunk_of_ros1_that_expands_beyond_its_size_is_refused(kind, tmp_path):
    bag = write_bag(tmp_path / "x.bag", fill, compression=(_ROS1[kind],))
    data = bag.read_bytes()
    at = data.index(b"size=") - 4  # a chunk's header ends with its size
    size = struct.unpack_from("<I", data, at + 9)[0]
    pack = bz2.compress if kind == "bz2" else lz4.frame.compress
    content = data.index(pack(b"")[:3], at)
    (length,) = struct.unpack_from("<I", data, content - 4)
    expand = bz2.decompress if kind == "bz2" else lz4.frame.decompress
    inside = expand(data[content : content + length])
    assert len(inside) == size
    packed = pack(inside + bytes(MIB))
    shift = len(packed) - length
    bag.write_bytes(
        _moved(data[: content - 4], shift)
        + struct.pack("<I", len(packed))
        + packed
        + data[content + length :]
    )
    refused(bag, "expands (beyond|to).*rosbag reindex")


_ROS1 = {"bz2": Writer1.CompressionFormat.BZ2, "lz4": Writer1.CompressionFormat.LZ4}


def _moved(head, shift):
    at = head.index(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", head, at)
    return head[:at] + struct.pack("<Q", index + shift) + head[at + 8 :]


def test_a_chunk_of_ros1_is_read_once(tmp_path):
    """Its index lists it 1000 times."""
    bag = write_bag(tmp_path / "x.bag", fill)
    data = bytearray(bag.read_bytes())
    at = data.index(b"chunk_count=") + 12
    data[at : at + 4] = struct.pack("<I", 1000)
    place = data.index(b"chunk_pos=")
    begin = max(data.rfind(struct.pack("<I", size), 0, place) for size in range(80, 140))
    bag.write_bytes(data + data[begin:] * 999)
    refused(bag, "two chunks are at byte|index looks damaged")


def test_metadata_of_merges_is_read_as_text(tmp_path):
    """Merges of merges would double with each of 60 lines."""
    bag = write_bag(tmp_path / "bag", fill, storage=StoragePlugin.SQLITE3)
    path = bag / "metadata.yaml"
    lines = [
        "m0: &m0 {a: 1}",
        *(f"m{k}: &m{k} {{<<: [*m{k - 1}, *m{k - 1}]}}" for k in range(1, 60)),
    ]
    path.write_text("\n".join(lines) + "\n" + path.read_text())
    with Session.open(bag) as session:
        assert len(session.joints("/joint_states").t_ns[0]) == 30


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda text: text + "#" * 2 * MIB, "more than 1 MiB"),
        (lambda text: text + "[" * 20_000, "no YAML"),
        (lambda text: re.sub(r"(- bag.db3\n)", r"\1  - bag.db3\n", text), "names a file twice"),
        (lambda text: text.replace("- bag.db3", "- /etc/hostname"), "hostname, which is not there"),
        (lambda text: text.replace("- bag.db3", "- ../bag/gone.db3"), "gone.db3, which is not"),
        (lambda _: "rosbag2_bagfile_information: 1", "lists no files"),
        (lambda _: "a: 1", "no metadata.yaml of rosbag2"),
        (lambda text: text.replace("compression_mode: ''", "compression_mode: x"), "compression x"),
    ],
)
def test_metadata_that_is_wrong_is_refused(change, match, tmp_path):
    bag = write_bag(tmp_path / "bag", fill, storage=StoragePlugin.SQLITE3)
    path = bag / "metadata.yaml"
    path.write_text(change(path.read_text()))
    refused(bag, match)


_ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x id, "
_MESSAGES = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "match"),
    [
        (
            f"CREATE VIEW messages AS {_ENDLESS} 1 topic_id, x timestamp, x'00' data FROM c",
            "has no table messages",
        ),
        (
            (
                f"CREATE TABLE messages({_MESSAGES}, data AS (zeroblob(900000000)));"
                "INSERT INTO messages VALUES (1, 1, 5)"
            ),
            "computed columns.*ros2 bag reindex",
        ),
        (
            (
                f"CREATE TABLE messages({_MESSAGES}, data AS (zeroblob(1000000)));"
                f"INSERT INTO messages {_ENDLESS} 1, x FROM c LIMIT 1000"
            ),
            "computed columns",
        ),
    ],
)
def test_a_database_that_computes_its_rows_is_refused(script, match, tmp_path):
    (path,) = write_bag(tmp_path / "bag", fill, storage=StoragePlugin.SQLITE3).glob("*.db3")
    with sqlite3.connect(path) as base:
        base.executescript(f"DROP TABLE messages; {script}")
    base.close()
    refused(path, match)


def test_a_definition_that_never_ends_is_not_read(tmp_path):
    (path,) = write_bag(tmp_path / "bag", fill, storage=StoragePlugin.SQLITE3).glob("*.db3")
    view = (
        f"CREATE VIEW message_definitions AS {_ENDLESS} 'a' topic_type, 'ros2msg' encoding, "
        "'b' encoded_message_definition FROM c"
    )
    with sqlite3.connect(path) as base:
        base.executescript(f"DROP TABLE message_definitions; {view}")
    base.close()
    with Session.open(path) as session:
        assert len(session.joints("/joint_states").t_ns[0]) == 30
