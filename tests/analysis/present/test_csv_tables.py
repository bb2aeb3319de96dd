"""Results as CSV: read by pandas and csv, held against the result itself."""

import csv
import dataclasses
import json

import numpy as np
import pandas as pd
import pytest

from support import built_results
from support.joint_runs import write_joints
from undulog.analysis import load
from undulog.analysis.parts.gait.result import Window
from undulog.analysis.present.data_frames import write_csv
from undulog.capture.common.errors import OutputExistsError, UsageError

NAMES = ("j1", "j2", "j3")


@pytest.fixture
def runs(tmp_path):
    for k in range(2):
        noise = np.random.default_rng(k).normal(0, 1e-3, (300, 3))
        phase = 2 * np.pi * np.arange(300)[:, None] / 50 - np.arange(3)
        angle = 0.38 * np.sin(phase - 0.2) + noise
        write_joints(tmp_path / "runs" / f"r{k}.mcap", NAMES, 0.4 * np.sin(phase), [angle])
    return tmp_path / "runs"


@pytest.fixture(autouse=True)
def folder(tmp_path):
    (tmp_path / "runs").mkdir()


def assert_rows_of(table, result):
    assert table["name"].tolist() == [joint["name"] for joint in result["joints"]]
    (window,) = result["gait"]["windows"]
    for row, joint in zip(table.to_dict("records"), result["joints"], strict=True):
        assert (row["start_s"], row["stop_s"]) == (window["start_s"], window["stop_s"])
        assert (row["session"], row["cycles"]) == (result["session"]["id"], window["cycles"])
        assert row["gain"] == joint["gain"]  # bit for bit
        assert [row["gain_low"], row["gain_high"]] == joint["gain_ci95"]
        assert [row["lag_low_rad"], row["lag_high_rad"]] == joint["lag_ci95"]
        assert np.isnan(row["energy_net_j"])


def test_a_row_for_each_joint_of_each_session(runs, tmp_path, command):
    results = json.loads(command("analyse", runs, "--csv", tmp_path / "x.csv", "--json").out)
    table = pd.read_csv(tmp_path / "x.csv")
    assert len(table) == 2 * len(NAMES)
    for result in results:
        assert_rows_of(table[table["path"] == result["session"]["path"]], result)


def test_of_one_session_a_file_or_a_folder(runs, tmp_path, command):
    line = ("analyse", runs / "r0.mcap", "-o", tmp_path / "r.json", "--force", "--csv")
    command(*line, tmp_path / "x.csv")
    command(*line, tmp_path / "all")
    result = load(tmp_path / "r.json")
    assert_rows_of(pd.read_csv(tmp_path / "x.csv"), json.loads((tmp_path / "r.json").read_text()))
    for name, frame in result.frames().items():
        table = pd.read_csv(tmp_path / "all" / f"{name}.csv")
        assert table.columns.tolist() == frame.columns.tolist()
        assert len(table) == len(frame)
        for column in frame.select_dtypes("float"):
            np.testing.assert_array_equal(table[column], frame[column])


def test_an_experiment_has_the_joints_of_all_its_sessions(runs, tmp_path, command):
    command("analyse", runs / "r0.mcap", runs / "r1.mcap", "--csv", tmp_path / "x.csv")
    assert pd.read_csv(tmp_path / "x.csv")["name"].tolist() == [*NAMES, *NAMES]


def test_a_spreadsheet_runs_nothing(tmp_path):
    snake = built_results.make_snake()
    names = ["=cmd()", "+1", "@x", "plain", 'a"b\r\n,c']
    joints = [
        dataclasses.replace(joint, name=name, flags=("-2+3",))
        for joint, name in zip(snake.joints, names, strict=False)
    ]
    result = dataclasses.replace(snake, joints=tuple(joints))
    write_csv([result], tmp_path / "x.csv")
    with (tmp_path / "x.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["name"] for row in rows] == ["'=cmd()", "'+1", "'@x", "plain", 'a"b\r\n,c']
    assert {row["flags"] for row in rows} == {"'-2+3"}


def test_groups_have_windows_of_their_own(tmp_path):
    snake = built_results.make_snake()
    gait = snake.gait
    windows = (Window(1.0, 3.0, 2.0), Window(4.0, 5.0, 1.0))
    groups = tuple(dataclasses.replace(group, windows=windows) for group in gait.groups)
    joints = tuple(
        dataclasses.replace(joint, group=0 if groups else None) for joint in snake.joints
    )
    gait = dataclasses.replace(gait, groups=groups, windows=windows)
    write_csv([dataclasses.replace(snake, gait=gait, joints=joints)], tmp_path / "x.csv")
    table = pd.read_csv(tmp_path / "x.csv")
    spans = table[["start_s", "stop_s", "cycles"]].drop_duplicates()
    assert spans.to_numpy().tolist() == [[1.0, 5.0, 3.0]]


def test_what_is_refused(runs, tmp_path, command):
    (tmp_path / "x.csv").write_text("mine")
    line = ("analyse", runs / "r0.mcap", "--csv")
    assert "exists already" in command(*line, tmp_path / "x.csv", code=2).err
    assert "end the name in .csv" in command(*line, tmp_path / "x.xlsx", code=2).err
    assert "doesn't exist" in command(*line, tmp_path / "no" / "all", code=2).err
    every = ("analyse", runs, "--csv", tmp_path / "all")
    assert "for the tables of one result" in command(*every, code=2).err
    command(*line, tmp_path / "x.csv", "--force")
    snake = built_results.make_snake()
    with pytest.raises(UsageError, match="tables of one result"):
        write_csv([snake, snake], tmp_path / "all")
    write_csv([snake], tmp_path / "all")
    with pytest.raises(OutputExistsError):
        write_csv([snake], tmp_path / "all")
