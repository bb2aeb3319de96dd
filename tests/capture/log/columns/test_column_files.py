"""Columns in files: the same numbers, in memory only while they are looked at, and nothing left."""

import resource
from pathlib import Path

import numpy as np
import pytest

from support.written_topics import EPOCH_NS, write_topics
from undulog.capture import Session

NAMES = [f"joint{k:02d}" for k in range(1, 26)]
TICKS = 24_000
COLUMN_BYTES = TICKS * len(NAMES) * 8
WANTED = {"/joint_states": ["position", "velocity", "effort"]}


@pytest.fixture(scope="module")
def values():
    return np.random.default_rng(3).normal(size=(TICKS, len(NAMES)))


@pytest.fixture(scope="module")
def session_path(tmp_path_factory, values):
    topics = {"/joint_states": (NAMES, "rad", values, -values, 2 * values)}
    t_ns = EPOCH_NS + np.arange(TICKS) * 10_000_000
    return write_topics(tmp_path_factory.mktemp("columns") / "s.mcap", t_ns, topics)


def resident():
    """What of this process is in memory [byte]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def assert_true(columns, values):
    for field, factor in zip(WANTED["/joint_states"], (1, -1, 2), strict=True):
        signals = columns["/joint_states", field]
        assert signals.names == tuple(NAMES)
        assert np.array_equal(np.transpose(signals.values), factor * values)


def test_columns_in_files_leave_memory_and_come_back(session_path, values, tmp_path):
    with Session.open(session_path, column_folder=tmp_path) as session:
        columns = session.joint_columns(WANTED)
        assert list(tmp_path.iterdir()) == []  # the files have no names
        assert_true(columns, values)
        before = resident()
        session.forget()
        assert before - resident() > 0.8 * 3 * COLUMN_BYTES
    assert_true(columns, values)  # a closed session's columns stay, too


@pytest.mark.parametrize("disk", [None, "1m"])
def test_columns_in_memory_stay_as_those_without_room_on_the_disk(
    session_path, values, disk, request
):
    folder = None if disk is None else request.getfixturevalue("disk_of")(disk)
    with Session.open(session_path, column_folder=folder) as session:
        columns = session.joint_columns(WANTED)
        session.forget()
    assert_true(columns, values)


def test_columns_in_files_can_be_written_to(session_path, tmp_path):
    with Session.open(session_path, column_folder=tmp_path) as session:
        column = session.joint_columns(WANTED)["/joint_states", "effort"].values[0]
        again = session.joint_columns(WANTED)["/joint_states", "effort"].values[0]
    column[:] = 0.0  # own_times does so
    assert again.any()
