"""Several logs in one command: what is found in folders and patterns, and the table."""

import shutil

import pytest
from rosbags.rosbag2 import StoragePlugin

from support.linear_chain import CHAIN, WAVE, write_run
from support.paths import ROOT
from support.ros_bags import BY_MESSAGE, filling, write_bag, write_split
from undulog.capture.commands.sessions import first_sentence, sessions_of

GOLDEN = ROOT / "tests/replay/golden/session.mcap"


@pytest.fixture
def folder(tmp_path):
    """Two sessions, one of them in a folder, a file that is none, and what is no session's."""
    (tmp_path / "sub").mkdir()
    (tmp_path / ".hidden").mkdir()
    for place in ("a.mcap", "sub/b.mcap", ".hidden/c.mcap"):
        shutil.copy(GOLDEN, tmp_path / place)
    (tmp_path / "bad.mcap").write_text("junk")
    (tmp_path / "notes.txt").write_text("none")
    return tmp_path


def test_a_folder_and_a_pattern_name_the_sessions_in_them(folder):
    every = [folder / "a.mcap", folder / "bad.mcap", folder / "sub/b.mcap"]
    assert sessions_of([folder]) == every
    assert sessions_of([folder / "**/*.mcap"]) == every
    assert sessions_of([folder / "[ab].mcap", folder]) == every
    assert sessions_of([folder / "none*.mcap"]) == [folder / "none*.mcap"]


def test_a_folder_of_one_session_stays_what_was_named(folder):
    assert sessions_of([folder / "sub"]) == [folder / "sub"]


def test_a_file_with_a_pattern_in_its_name_is_that_file(folder):
    odd = folder / "a[1].mcap"
    shutil.copy(GOLDEN, odd)
    assert sessions_of([odd]) == [odd]


def test_a_rosbag2_folder_is_one_session(folder):
    (folder / "sub/metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    shutil.copy(GOLDEN, folder / "sub/b_1.mcap")
    assert sessions_of([folder])[-1] == folder / "sub"


def joints(first=0.0, last=3.0):
    """A fill with a controller's joints from one time to another [s]."""
    return filling(lambda log, *tick: tick[1] >= first and log.controller(*tick), last)


@pytest.fixture
def bags(tmp_path):
    """A bag of each kind, in a folder of its own, and one of several files."""
    paths = [tmp_path / name for name in ("day/a.bag", "day/b", "day/c", "day/d.db3", "one/e.bag")]
    a, b, c, d, e = paths
    for folder in ("day", "one", "alone"):
        (tmp_path / folder).mkdir()
    for path in (a, e):
        write_bag(path, joints())
    write_split(b, [joints(last=1.5), joints(first=1.5)], storage=StoragePlugin.SQLITE3)
    write_bag(c, joints(), storage=StoragePlugin.MCAP, compression=BY_MESSAGE)
    shutil.copy(b / "b.db3", d)
    shutil.copytree(c, tmp_path / "alone/f")
    write_run(tmp_path / "day/g.mcap", WAVE, CHAIN @ WAVE, 1, 0.003)
    return tmp_path


def test_bags_in_folders_and_patterns_are_one_session_each(bags):
    day = [bags / "day" / name for name in ("a.bag", "d.db3", "g.mcap", "b", "c")]
    assert sessions_of([bags / "day"]) == day
    assert sessions_of([bags / "one"]) == [bags / "one/e.bag"]
    assert sessions_of([bags / "alone"]) == [bags / "alone/f"]
    assert sessions_of([bags / "day/b"]) == [bags / "day/b"]
    assert sessions_of([bags / "day/**/*.db3"]) == [bags / "day/b", bags / "day/d.db3"]
    assert sorted(sessions_of([bags / "day/**/*"])) == sorted(day)
    assert sorted(sessions_of([bags / "d*"])) == sorted(day)
    assert sessions_of([bags / "day/b/*"]) == [bags / "day/b"]
    assert sessions_of([bags / "day", bags / "day/b"]) == [*day, bags / "day/b"]
    single = bags / "day/b/b_1.db3"
    assert sessions_of([single]) == [single]


@pytest.mark.nightly
@pytest.mark.parametrize(
    "line",
    [("log", "info"), ("log", "check"), pytest.param(("analyse",), marks=pytest.mark.nightly)],
)
def test_commands_read_the_bags_of_a_folder(line, bags, report_of, command):
    rows = report_of(*line, bags / "day")
    assert len(rows) == 5
    assert not [row for row in rows if "error" in row]


@pytest.mark.nightly
def test_a_report_has_the_bags_of_a_folder(bags, tmp_path, report_of):
    report = report_of("report", bags / "day", "-o", tmp_path / "page.html")
    assert [len(answer["sentence"]) > 0 for answer in report["answers"]] == [True] * 5


@pytest.mark.parametrize("verb", ["info", "check"])
def test_one_bad_file_stops_nobody(verb, folder, command):
    lines = command("log", verb, folder, code=1).out.splitlines()
    assert lines[0].split()[:4] == ["session", "robot", "gait", "verdict"]
    good, bad, other = (line.split() for line in lines[1:])
    assert (good[0], good[1], good[3]) == ("a.mcap", "snake25", "good")
    assert (bad[0], bad[3]) == ("bad.mcap", "failed")
    assert "not an MCAP file" in lines[2]
    assert other[0] == "b.mcap"


def test_json_is_a_list_of_what_each_alone_gives(folder, report_of):
    good, bad, _ = report_of("log", "info", folder, code=1)
    assert good == report_of("log", "info", folder / "a.mcap")
    assert bad["path"] == str(folder / "bad.mcap")
    assert "not an MCAP file" in bad["error"]


def test_good_files_alone_end_well(folder, command):
    command("log", "info", folder / "a.mcap", folder / "sub/b.mcap")


def test_the_first_sentence_ends_at_a_full_stop_not_at_a_number():
    assert first_sentence("It is 1.5 m long. It moves.") == "It is 1.5 m long."
    assert first_sentence("one line\nanother") == "one line"
