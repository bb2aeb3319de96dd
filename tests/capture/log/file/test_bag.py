"""Bags written by rosbags itself: each storage, split and compression reads as what was written."""

import sqlite3
from functools import partial

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from support.ros_bags import BY_FILE, BY_MESSAGE, EPOCH_NS, Filler, write_bag, write_split
from undulog.capture import Session
from undulog.capture.common.errors import NotALogError, UndulogError

pytestmark = pytest.mark.usefixtures("scratch")
TRUTH = np.random.default_rng(5).normal(size=(60, 2))
TIMES_NS = EPOCH_NS + 10_000_000 * np.arange(60)
MODES = pytest.mark.parametrize(
    "compression", [(), BY_FILE, BY_MESSAGE], ids=["plain", "files", "messages"]
)


def filled(bag, rows=slice(None)):
    """Write JointStates of two joints."""
    filler = Filler(bag)
    for t_ns, values in zip(TIMES_NS[rows].tolist(), TRUTH[rows], strict=True):
        filler.state(t_ns, 0.0, positions=values, names=["a", "b"])


def check(path):
    with Session.open(path) as session:
        series = session.joints("/joint_states")
        assert session.path == path
        np.testing.assert_array_equal(series.t_ns, np.stack([TIMES_NS, TIMES_NS]))
        np.testing.assert_array_equal(series.values, TRUTH.T)


@MODES
@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_bag_reads_as_what_was_written(storage, compression, tmp_path):
    check(write_bag(tmp_path / "bag", filled, storage=storage, compression=compression))


def test_a_bare_db3_reads_with_and_without_definitions(tmp_path):
    (path,) = write_bag(tmp_path / "bag", filled, storage=StoragePlugin.SQLITE3).glob("*.db3")
    check(path)
    with sqlite3.connect(path) as base:
        base.execute("DELETE FROM message_definitions")
    base.close()
    check(path)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_parts_are_read_as_one(storage, tmp_path):
    halves = [partial(filled, rows=slice(25)), partial(filled, rows=slice(25, None))]
    check(write_split(tmp_path / "bag", halves, storage=storage))


@pytest.mark.parametrize("damage", ["yaml", "db3", "cut", "gone"])
def test_a_damaged_bag_is_named_with_the_fix(damage, tmp_path):
    bag = write_bag(tmp_path / "bag", filled, storage=StoragePlugin.SQLITE3)
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


@pytest.mark.slow
@MODES
@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("cases", [3, pytest.param(10, marks=pytest.mark.nightly)])
def test_a_mutated_bag_reads_or_is_refused_in_words(storage, compression, cases, tmp_path):
    bag = write_bag(tmp_path / "bag", filled, storage=storage, compression=compression)
    draw = np.random.default_rng(11)
    whole = {path: path.read_bytes() for path in sorted(bag.iterdir())}
    for case in range(cases):
        path = list(whole)[case % len(whole)]
        data = bytearray(whole[path])
        for place in draw.integers(len(data), size=1 + case):
            data[place] = draw.integers(256)
        path.write_bytes(data)
        message = str(bag)
        try:
            with Session.open(bag) as session:
                session.joints("/joint_states")
        except UndulogError as error:
            message = str(error)
        assert str(bag) in message
        path.write_bytes(whole[path])
