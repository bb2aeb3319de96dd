"""Bags written by rosbags itself: each storage, split and compression reads as what was written."""

import shutil
import sqlite3

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from undulog.capture import Session
from undulog.capture.common.errors import NotALogError, UndulogError

pytestmark = pytest.mark.usefixtures("scratch")
EPOCH_NS = 1_700_000_000_000_000_000
KIND = "sensor_msgs/msg/JointState"
STORE = get_typestore(Stores.ROS2_HUMBLE)
TRUTH = np.random.default_rng(5).normal(size=(60, 2))
TIMES_NS = EPOCH_NS + 10_000_000 * np.arange(60)
MODES = [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE]


def write(folder, storage, mode=CompressionMode.NONE, rows=slice(None)):
    """Write JointStates of two joints."""
    types, none = STORE.types, np.zeros(0)
    writer = Writer(folder, version=9, storage_plugin=storage)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        way = writer.add_connection("/joint_states", KIND, typestore=STORE)
        for t_ns, values in zip(TIMES_NS[rows].tolist(), TRUTH[rows], strict=True):
            stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            message = types[KIND](
                header=header, name=["a", "b"], position=values, velocity=none, effort=none
            )
            writer.write(way, t_ns, STORE.serialize_cdr(message, KIND))
    return folder


def check(path):
    with Session.open(path) as session:
        found = session.joints("/joint_states")
        assert session.path == path
        np.testing.assert_array_equal(found.t_ns, np.stack([TIMES_NS, TIMES_NS]))
        np.testing.assert_array_equal(found.values, TRUTH.T)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_bag_reads_as_what_was_written(storage, mode, tmp_path):
    check(write(tmp_path / "bag", storage, mode))


def test_a_bare_db3_reads_with_and_without_definitions(tmp_path):
    (path,) = write(tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3")
    check(path)
    with sqlite3.connect(path) as base:
        base.execute("DELETE FROM message_definitions")
    base.close()
    check(path)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_parts_are_read_as_one(storage, tmp_path):
    first = write(tmp_path / "one", storage, rows=slice(0, 25))
    second = write(tmp_path / "two", storage, rows=slice(25, None))
    suffix = ".mcap" if storage is StoragePlugin.MCAP else ".db3"
    shutil.copy(second / f"two{suffix}", first / f"two{suffix}")
    stated = (first / "metadata.yaml").read_text()
    entry = next(line for line in stated.splitlines() if line.strip() == f"- one{suffix}")
    more = entry + "\n" + entry.replace("one", "two")
    (first / "metadata.yaml").write_text(stated.replace(entry, more, 1))
    check(first)


@pytest.mark.parametrize("damage", ["yaml", "db3", "cut", "gone"])
def test_a_damaged_bag_is_named_with_the_fix(damage, tmp_path):
    bag = write(tmp_path / "bag", StoragePlugin.SQLITE3)
    data = bag / "bag.db3"
    match damage:
        case "yaml":
            (bag / "metadata.yaml").write_text("a: [")
        case "db3":
            data.write_bytes(b"no database")
        case "cut":
            data.write_bytes(data.read_bytes()[:5000])
        case _:
            data.unlink()
    with pytest.raises(NotALogError, match="ros2 bag reindex"):
        Session.open(bag)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_mutated_bag_reads_or_is_refused_in_words(storage, mode, tmp_path):
    bag, draw = write(tmp_path / "bag", storage, mode), np.random.default_rng(11)
    whole = {path: path.read_bytes() for path in sorted(bag.iterdir())}
    for case in range(10):
        path = list(whole)[case % len(whole)]
        data = bytearray(whole[path])
        for place in draw.integers(len(data), size=1 + case):
            data[place] = draw.integers(256)
        path.write_bytes(data)
        said = str(bag)
        try:
            with Session.open(bag) as session:
                session.joints("/joint_states")
        except UndulogError as error:
            said = str(error)
        assert str(bag) in said
        path.write_bytes(whole[path])
