"""Bags in the catalogue: of every kind, damaged, and distinguished by their content."""

import os
import shutil
import sqlite3

import numpy as np
import pandas as pd
import pytest
from rosbags.rosbag2 import StoragePlugin

from support.ros_bags import BY_FILE, BY_MESSAGE, Filler, filling, ticks, write_bag
from support.written_sessions import write_session
from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.sources import FOLDER
from undulog.capture import Session
from undulog.capture.common.errors import InputFileError

pytestmark = pytest.mark.slow

KINDS = {
    "one.bag": {},
    "plain": {},
    "messages": {"compression": BY_MESSAGE},
    "sql": {"storage": StoragePlugin.SQLITE3},
    "files": {"storage": StoragePlugin.SQLITE3, "compression": BY_FILE},
}
BAGS = ["alone.db3", *sorted(f"day/{name}" for name in KINDS)]


def _joints(writer, *tick):
    writer.controller(*tick)
    writer.state(*tick)


@pytest.fixture
def bags(tmp_path):
    """A bag of each kind, and folders of other tools with a metadata.yaml."""
    (tmp_path / "day").mkdir()
    for name, how in KINDS.items():
        write_bag(tmp_path / "day" / name, filling(_joints, 1.0), **how)
    shutil.copy(tmp_path / "day/sql/sql.db3", tmp_path / "alone.db3")
    for name in ("tool", "tool/deep"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metadata.yaml").write_text("# rosbag2_bagfile_information:\nname: x\n")
        write_session(tmp_path / name / "run.mcap")
    return tmp_path


SESSIONS = ["tool/deep/run.mcap", "tool/run.mcap"]


@pytest.mark.nightly
def test_bags_are_rows_with_the_facts_of_their_sessions(bags):
    catalog = Catalog(str(bags))
    report = catalog.scan()
    assert (report.sessions, report.damaged) == (8, 0)
    rows = catalog.find().set_index("path")
    assert rows.index.to_list() == BAGS + SESSIONS
    for path in BAGS:
        row = rows.loc[path]
        with Session.open(bags / path) as session:
            assert list(row.topics) == sorted(session.channels)
            assert row.messages == sum(channel.count for channel in session.channels.values())
            assert (row.start_ns, row.duration_s) == (session.start_ns, session.duration_s)
            assert row.session_id == session.session_id
        files = [bags / path] if "." in path else (bags / path).iterdir()
        assert row["size"] == sum(file.stat().st_size for file in files)


def test_bags_are_opened_again_only_when_a_file_of_theirs_has_changed(bags):
    catalog = Catalog(str(bags))
    catalog.scan()
    before = catalog.find()
    files = [path for path in bags.rglob("*") if path.is_file() and FOLDER not in path.parts]
    for path in files:  # an open file would show: the catalogue compares size and time
        facts = path.stat()
        path.write_bytes(b"?" * facts.st_size)
        os.utime(path, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    report = catalog.scan()
    assert (report.sessions, report.read, report.removed) == (8, 0, 0)
    pd.testing.assert_frame_equal(catalog.find(), before)
    os.utime(bags / "day/sql/sql.db3")
    report = catalog.scan()  # whose metadata.yaml is none now: a file without a folder
    assert (report.sessions, report.read, report.removed, report.damaged) == (8, 2, 1, 1)
    assert catalog.find("damage is not null").path.to_list() == ["day/sql/sql.db3"]


def test_a_bag_alone_and_damaged_ones(bags, opened):
    catalog = Catalog(str(bags / "day/plain"))
    catalog.scan()
    assert catalog.find().path.to_list() == ["."]
    assert catalog.find().session_id.to_list() == [opened(bags / "day/plain").session_id]
    (bags / "day/sql/sql.db3").unlink()
    for name in ("alone.db3", "day/one.bag"):
        os.truncate(bags / name, 3000)
    catalog = Catalog(str(bags))
    assert catalog.scan().damaged == 3
    reasons = catalog.find("damage is not null").set_index("path").damage
    assert reasons.index.to_list() == ["alone.db3", "day/one.bag", "day/sql"]
    assert all("reindex" in reason for reason in reasons)


@pytest.mark.parametrize("rounds", [1, pytest.param(15, marks=pytest.mark.nightly)])
def test_mutated_bags_are_rows_or_damaged_ones(rounds, bags):
    draw = np.random.default_rng(4)
    paths = [path for path in bags.rglob("*") if path.is_file() and "tool" not in path.parts]
    whole = {path: path.read_bytes() for path in paths}
    for _ in range(rounds):
        for path, content in whole.items():
            data = bytearray(content)
            for at in draw.integers(len(data), size=8):
                data[at] = draw.integers(256)
            path.write_bytes(data)
        catalog = Catalog(str(bags))
        assert catalog.scan().complete
        assert set(catalog.find().path) >= {"alone.db3", "day/one.bag", *SESSIONS}


def test_a_database_that_computes_its_times_is_damaged(tmp_path):
    with sqlite3.connect(tmp_path / "slow.db3") as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER,"
            " timestamp AS (length(hex(zeroblob(topic_id)))));"
            "INSERT INTO messages(topic_id) WITH RECURSIVE c(x) AS"
            " (SELECT 1 UNION ALL SELECT x + 1 FROM c LIMIT 9) SELECT x FROM c"
        )
    base.close()
    catalog = Catalog(str(tmp_path))
    assert catalog.scan().damaged == 1
    assert "computed" in catalog.find().damage[0]


def test_a_name_that_is_no_text_is_named(tmp_path):
    write_session(tmp_path / "run.mcap")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd/up").symlink_to(tmp_path)
    (tmp_path / os.fsdecode(b"odd/\xff.txt")).write_text("no log")
    assert Catalog(str(tmp_path)).scan().sessions == 1
    (tmp_path / os.fsdecode(b"odd/\xff.mcap")).write_text("no log")
    with pytest.raises(InputFileError, match="not UTF-8"):
        Catalog(str(tmp_path)).scan()


@pytest.mark.nightly
def test_analyses_of_bags_are_made_on_request(bags):
    catalog = Catalog(str(bags))
    catalog.scan()
    assert catalog.analyse(["day/one.bag", "day/messages"]) == {}
    rows = catalog.find("status = 'analysed'")
    assert rows.path.to_list() == ["day/messages", "day/one.bag"]


DIFFERENT = {"one.bag", "sql"}
"""ROS 1 and ROS 2; the others are MCAP."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in DIFFERENT else pytest.mark.nightly) for n in KINDS],
)
def test_the_id_of_a_bag_is_of_its_content(tmp_path, name, opened):
    """Same name, times, topics and sizes of all messages, and the same begin and end."""

    def fill(bag, day):
        first, then = Filler(bag), Filler(bag, seed=day)
        for number, tick in enumerate(ticks(20.0)):
            (then if 300 < number < 1700 else first).state(*tick)

    for day in range(2):
        (tmp_path / f"{day}").mkdir()
        write_bag(tmp_path / f"{day}" / name, lambda bag, day=day: fill(bag, day), **KINDS[name])
    copy = shutil.copytree if (tmp_path / "0" / name).is_dir() else shutil.copy
    (tmp_path / "copy").mkdir()
    copy(tmp_path / "0" / name, tmp_path / "copy" / f"other_{name}")
    catalog = Catalog(str(tmp_path))
    assert catalog.scan().damaged == 0
    first, second, copied = catalog.find().session_id
    assert first == copied != second
    for path, row in catalog.find().set_index("path").iterrows():
        assert opened(tmp_path / path).session_id == row.session_id
    assert catalog.analyse([f"1/{name}"]).keys() <= {f"1/{name}"}
    analysed = catalog.find("status = 'analysed'").path.to_list()
    assert analysed in ([], [f"1/{name}"])
