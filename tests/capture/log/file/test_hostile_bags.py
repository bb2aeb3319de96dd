"""Databases and pipes in place of recordings: a sentence within bounds of memory, time and disk."""

import os
import socket
import sqlite3

import pytest

from support.measured import refused
from undulog.capture import Session
from undulog.capture.common.errors import LogError

MESSAGES = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER"
KIND = "sensor_msgs/msg/JointState"
START_NS = 1_700_000_000_000_000_000


def database(path, columns, *, script="", rows=3000):
    """A .db3 file with a table of messages of some columns, which are filled but for the data."""
    with sqlite3.connect(path) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
            "serialization_format TEXT, offered_qos_profiles TEXT); "
            f"CREATE TABLE messages({columns}); "
            f"INSERT INTO topics VALUES(1, '/joint_states', '{KIND}', 'cdr', '')"
        )
        times = [(START_NS + k * 1_000_000,) for k in range(rows)]
        base.executemany("INSERT INTO messages(topic_id, timestamp) VALUES(1, ?)", times)
        base.executescript(script)
    base.close()
    return path


COMPUTED = {
    "zeros": "data BLOB AS (zeroblob(1000000))",
    "stored": "data BLOB AS (zeroblob(100)) STORED",
    "doubled": "data AS (hex(zeroblob(100000000)))",
    "printed": "data AS (printf('%.*c', 900000000, 'x'))",
    "checked": "data BLOB CHECK (length(hex(zeroblob(5000000))) > 0)",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "verb",
    [
        ("log", "info"),
        *(pytest.param(v, marks=pytest.mark.nightly) for v in (("log", "check"), ("analyse",))),
    ],
)
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.nightly if n == "printed" else ()) for n in COMPUTED],
)
def test_messages_that_are_computed(verb, name, tmp_path):
    rows = 3000 if name == "zeros" else 2  # SQLite computes the others already as it writes them
    path = database(tmp_path / f"{name}.db3", f"{MESSAGES}, {COMPUTED[name]}", rows=rows)
    assert path.stat().st_size < 500_000
    assert "table messages has" in refused(path, *verb, path.name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "script",
    [
        "CREATE INDEX odd ON messages(hex(zeroblob(100000)))",
        "CREATE INDEX odd ON messages(timestamp) WHERE length(hex(zeroblob(100000))) > 0",
    ],
)
def test_an_index_that_is_computed(script, tmp_path):
    path = database(tmp_path / "x.db3", f"{MESSAGES}, data BLOB", script=script, rows=20)
    assert "an index that is computed" in refused(path, "log", "check", path.name)


@pytest.mark.slow
def test_large_messages_without_an_index_are_not_sorted_on_disk(tmp_path, monkeypatch):
    """The temporary files of SQLite would hold all of them: 60 MB here, without room for 8 MB."""
    script = "UPDATE messages SET data = zeroblob(1000000)"
    path = database(tmp_path / "x.db3", f"{MESSAGES}, data BLOB", script=script, rows=60)
    monkeypatch.setattr("undulog.capture.common.confined._FILE_SIZE", 70 << 20)
    monkeypatch.setattr("undulog.capture.common.confined._FILE_SIZE_A_BYTE", 0)
    monkeypatch.setattr("undulog.capture.common.confined._MEMORY_A_BYTE", 0)
    monkeypatch.setattr("undulog.capture.common.confined._MEMORY", 150 << 20)
    with Session(path) as session:
        assert session.channels["/joint_states"].count == 60


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag", ".blf", ""])
@pytest.mark.parametrize("verb", [("log", "info"), ("log", "check"), ("analyse",)])
def test_a_pipe_is_not_waited_for(suffix, verb, tmp_path, command):
    path = tmp_path / f"x{suffix}"
    os.mkfifo(path)
    reported = command(*verb, path, code=1).err
    assert reported == f"error: {path}: can't be opened: it is a named pipe, not a file\n"


def test_neither_are_sockets_and_devices(tmp_path):
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "x.mcap"))
        with pytest.raises(LogError, match="it is a socket, not a file"):
            Session(tmp_path / "x.mcap")
    with pytest.raises(LogError, match="it is a device, not a file"):
        Session("/dev/zero")


def test_a_pipe_in_a_folder_of_ros(tmp_path):
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths: [x.db3]\n  compression_mode: ''\n"
    )
    os.mkfifo(tmp_path / "x.db3")
    with pytest.raises(LogError, match=r"named pipe|not there|no such file"):
        Session(tmp_path)


def test_a_plain_database_is_read(tmp_path):
    """Columns whose names only look like a rule, indices of columns, texts that are no UTF-8."""
    path = database(
        tmp_path / "x.db3", f"{MESSAGES}, data BLOB, checksum INTEGER, generated TEXT",
        script="CREATE INDEX i ON messages(checksum DESC, timestamp); "
        "UPDATE messages SET data = x'00', generated = CAST(x'ff' AS TEXT)",
        rows=5,
    )  # fmt: skip
    with Session(path) as session:
        assert session.channels["/joint_states"].count == 5
