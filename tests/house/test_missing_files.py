"""A missing file is reported alike by every command: one line that names it, exit code 1."""

import hashlib
import re
import shlex

import pytest

import undulog
from support.linear_chain import CHAIN, WAVE, M, write_run
from undulog.capture import load_robot
from undulog.sim import load_scenario
from undulog.sim.twin.recording import record

pytestmark = pytest.mark.slow

# What isn't there is {no} with a suffix, what is there {run}; outputs go to {out}.
LINES = [
    "record --settings {no}.toml",
    "record can:virtual:bus --robot {no}.toml -o {out}.mcap",
    "record twin:{no}.toml -o {out}.mcap",
    "import {no}.log --robot snake25 -o {out}.mcap",
    "import {no}.csv --robot snake25 -o {out}.mcap --map t=time:s",
    "import {no}.mf4 --robot snake25 -o {out}.mcap",
    "import {csv} --columns {no}.toml --robot snake25 -o {out}.mcap",
    "import {csv} --robot {no}.toml -o {out}.mcap",
    "log info {no}.mcap",
    "log check {no}.mcap",
    "log recover {no}.mcap",
    "log cut {no}.mcap -o {out}.mcap",
    "log merge {run} {no}.mcap -o {out}.mcap",
    "log export {no}.mcap -o {out}.log",
    "log export {no}.mcap -o {out}.csv",
    "robot show {no}.toml",
    "robot check {no}.toml",
    "robot new -o {out}.toml --from {no}.mcap",
    "sim show {no}.toml",
    "sim run {no}.toml -o {out}.mcap",
    "sim fit {no}.mcap -o {out}.toml",
    "sim fit {run} --on twin:{no}.toml -o {out}.toml",
    "sim null {no}.toml -o {out}.json",
    "sim serve {no}.toml --socketcand 0",
    "drive {no}.mcap --on twin -o {out}.mcap",
    "drive {no}.toml --on twin -o {out}.mcap",
    "drive flat --on twin:{no}.toml -o {out}.mcap",
    "drive flat --on can:virtual:bus --robot {no}.toml",
    "analyse {no}.mcap",
    "analyse {run} {no}.mcap",
    "analyse {run} --null {no}.json",
    "predict {no}.mcap --eps 0.3",
    "predict {no}.json --eps 0.3",
    "compare {run} {no}.mcap",
    "plan compensate {no}.json --like {run} -o {out}",
    "plan lag-sweep --like {no}.mcap -o {out}",
    "plan multisine --like {no}.mcap -o {out}",
    "plan phase-kicks --like {no}.mcap -o {out}",
    "plan reversal --like {no}.mcap -o {out}",
    "report {no}.mcap -o {out}.html",
    "sweep {no}.toml -o {out}",
    "replay {no}.mcap --on twin -o {out}.mcap",
    "replay {run} --on twin:{no}.toml -o {out}.mcap",
    "replay {run} --on can:virtual:bus --robot {no}.toml",
    "view {no}.mcap --save {out}.rrd",
    "view {run} {no}.mcap --save {out}.rrd",
    "view {no}.mcap --clip {out}.gif",
    "view {run} --result {no}.json --save {out}.rrd",
]
WITHOUT_FILES = {"record status", "record mark", "record note", "record split", "record stop"}
WITHOUT_FILES |= {"record unit", "sim list", "robot list", "info"}
OF_SEVERAL = ("log info", "log check", "analyse", "report")
OF_FOLDERS = {"catalog"}  # tests/analysis/catalog


def suffix_of(line):
    """The suffix of the file that isn't there."""
    return re.search(r"\{no\}(\.\w+)", line)[1]


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    """A session and a CSV that can be read."""
    folder = tmp_path_factory.mktemp("there")
    record(load_scenario("flat").changed(duration_s=0.1), folder / "run.mcap")
    (folder / "a.csv").write_text("t,a\n0,1\n")
    return {"run": folder / "run.mcap", "csv": folder / "a.csv"}


KINDS = ["empty", "several", "rosbag2", "rosbag2 of sqlite3"]


def when(number):
    """Return the mark of a case: one of four is for every integration."""
    return () if number % len(KINDS) == 1 else pytest.mark.nightly


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        pytest.param(line, kind, marks=when(n + m))
        for n, line in enumerate(LINES)
        for m, kind in enumerate(KINDS)
    ],
)
def test_a_folder_that_is_no_session_is_named_with_the_fix(line, kind, there, tmp_path, capsys):
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in ("a.mcap", "b.mcap") if kind in ("several", "rosbag2") else ():
        (folder / name).write_bytes(there["run"].read_bytes())
    if kind.startswith("rosbag2"):
        (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    suffix = suffix_of(line)
    words = line.replace("{no}" + suffix, str(folder))
    several = kind == "several" and line.startswith(OF_SEVERAL)  # takes what is in the folder
    code = undulog.run(shlex.split(words.format_map({"out": tmp_path / "out", **there})))
    assert code in ((0, 1) if several else (1, 2))
    err = capsys.readouterr().err
    assert several or str(folder) in err
    if suffix == ".mcap" and not line.startswith("drive") and not several:
        fixes = {"empty": ["name a session's file"], "several": ["name one: a.mcap, b.mcap"]}
        fixes["rosbag2"] = ["undulog log merge", "ros2 bag reindex"]
        fixes["rosbag2 of sqlite3"] = ["ros2 bag convert", "ros2 bag reindex"]
        assert any(fix in err for fix in fixes[kind])


OF_ONE = [
    *("analyse {folder}", "report {folder} -o {out}.html", "compare {folder} {run}"),
    *("view {folder} --save {out}.rrd", "plan lag-sweep --like {folder} -o {out}"),
]


@pytest.fixture(scope="module")
def of_one(tmp_path_factory):
    """A folder with one session."""
    folder, robot = tmp_path_factory.mktemp("one"), load_robot("snake25")
    some = {"names": robot.joint_names[: 2 * M : 2], "robot": robot}
    write_run(folder / "run.mcap", WAVE, CHAIN @ WAVE, 1, 0.003, **some)
    return folder


@pytest.mark.parametrize("line", OF_ONE)
def test_a_folder_of_one_session_is_that_session(line, of_one, tmp_path, capsys):
    words = {"folder": of_one, "out": tmp_path / "out", "run": of_one / "run.mcap"}
    assert undulog.run(shlex.split(line.format_map(words))) == 0, capsys.readouterr().err


def test_every_verb_is_here():
    tried = {max((v for v in undulog.VERBS if line.startswith(v)), key=len) for line in LINES}
    assert tried == set(undulog.VERBS) - WITHOUT_FILES - OF_FOLDERS


@pytest.mark.parametrize("line", LINES)
def test_a_file_that_is_not_there_is_named_and_the_work_has_failed(line, there, tmp_path, command):
    words = {"no": tmp_path / "nowhere", "out": tmp_path / "out", **there}
    error = f"error: {tmp_path / 'nowhere'}{suffix_of(line)}: no such file\n"
    shown = command(*shlex.split(line.format_map(words)), code=1)
    assert shown.err == error
    assert not shown.out or line == "analyse {run} {no}.mcap"  # a table of those that are there
    assert not any(tmp_path.iterdir())


def test_a_file_that_vanishes_meanwhile_is_named(there, tmp_path, monkeypatch, command):
    path = tmp_path / "run.mcap"
    path.write_bytes(there["run"].read_bytes())
    digest = hashlib.sha256

    def vanish(*data):
        path.unlink(missing_ok=True)
        return digest(*data)

    monkeypatch.setattr("hashlib.sha256", vanish)
    assert command("analyse", path, code=1).err == f"error: {path}: No such file or directory\n"
