"""`undulog analyse` of LeRobot data sets: table, files, list of episodes; all versions alike."""

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from support.paths import SHARED
from zoo.data_sets import OFFSET, draw, write

G1 = SHARED / "g1_lerobot_v21"
CASES = SHARED.parent / "cases"


@pytest.fixture(scope="module")
def planted():
    """Return a data set with a joint that rests 5 degrees off in an episode."""
    return draw(3, OFFSET, most=20)


def test_the_table_the_list_and_the_files(planted, tmp_path, command):
    folder, fault = write(tmp_path / "set", planted), planted.fault
    table, result = tmp_path / "episodes.csv", tmp_path / "result.json"
    shown = command("analyse", folder, "--csv", table, "-o", result).out
    count = len(planted.actions)
    assert shown.startswith(f"set: {count} episodes of {planted.robot.joints} joints")
    assert f'--operation.episode_indices "[{fault.episode}]"' in shown
    assert "a rate that is wrong in all episodes can't be seen" in shown
    facts = json.loads(result.read_text())
    assert facts == json.loads(command("analyse", folder, "--json").out)
    assert facts["leave_out"] == [fault.episode]
    (row,) = pd.read_csv(table).to_dict("records")
    (listed,) = facts["faults"]
    assert (row["episode"], row["kind"], row["joint"]) == (
        fault.episode, "offset", f"joint_{fault.joint}",
    )  # fmt: skip
    assert row["size"] == pytest.approx(listed["size"]) == pytest.approx(fault.size, rel=0.05)
    assert row["size_low"] < row["size"] < row["size_high"]
    assert "exists already" in command("analyse", folder, "--csv", table, code=2).err


def test_all_versions_give_the_same(planted, tmp_path, command):
    results = []
    for version in ("v2.0", "v2.1", "v3.0"):
        folder = write(tmp_path / version / "set", planted, version)
        results.append(command("analyse", folder, "--json").out)
    assert len(set(results)) == 1


def test_what_is_for_sessions_is_refused(planted, tmp_path, command):
    folder = write(tmp_path / "set", planted)
    assert "give one folder" in command("analyse", folder, folder, code=2).err
    for options in (["--start", 2], ["--each"], ["--robot", "so101"]):
        assert "is a LeRobot data set" in command("analyse", folder, *options, code=2).err


def test_damaged_data_sets_are_named(planted, tmp_path, command):
    folder = write(tmp_path / "set", planted)
    info = folder / "meta" / "info.json"
    facts = json.loads(info.read_text())
    features = {"action": facts["features"]["action"]}
    info.write_text(json.dumps(facts | {"features": features}))
    assert "has no observation.state" in command("analyse", folder, code=1).err
    facts["features"]["action"]["shape"] = [3]
    info.write_text(json.dumps(facts))
    assert "share no name" in command("analyse", folder, code=1).err


def test_joints_are_paired_by_name(planted, tmp_path, command):
    folder = write(tmp_path / "set", planted)
    expected = command("analyse", folder, "--json").out
    info = folder / "meta" / "info.json"
    facts = json.loads(info.read_text())
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    frames = pd.read_parquet(path)
    frames["action"] = [row[::-1].copy() for row in frames["action"]]
    frames.to_parquet(path)
    names = facts["features"]["action"]["names"]
    facts["features"]["action"] = facts["features"]["action"] | {"names": names[::-1]}
    info.write_text(json.dumps(facts))
    assert command("analyse", folder, "--json").out == expected


@pytest.mark.skipif(not CASES.exists(), reason=f"no cases at {CASES}")
@pytest.mark.parametrize(
    ("script", "count"), [("35_lerobot_v20.py", 1), ("52_lerobot_v3_files.py", 3)]
)
def test_files_of_others(script, count, tmp_path, command):
    subprocess.run([sys.executable, CASES / script, tmp_path / "set"], check=True)
    facts = json.loads(command("analyse", tmp_path / "set", "--json").out)
    assert (facts["episodes"], facts["unit"], facts["faults"]) == (count, "deg", [])
    assert f"{count} episodes are too few" in facts["limits"][1]


@pytest.mark.skipif(not G1.exists(), reason=f"the G1 data are not at {G1}")
def test_three_real_episodes_are_too_few(command):
    shown = command("analyse", G1).out
    assert "3 episodes of 26 joints" in shown
    assert "not decided: 3 episodes are too few" in shown


def test_an_import_points_at_the_table(planted, tmp_path, command):
    small = planted.actions[:2], planted.states[:2]
    planted = type(planted)(planted.robot, *small, None)
    folder = write(tmp_path / "set", planted)
    assert f"undulog analyse {folder}" in command("import", folder, "-o", tmp_path / "out").out


def test_states_that_are_no_answer_are_not_judged(planted, tmp_path, command):
    """Actions that are poses of a hand, say, aren't followed by the joints of the same places."""
    rng = np.random.default_rng(5)
    actions = [np.cumsum(rng.normal(size=a.shape), axis=0).astype("f4") for a in planted.actions]
    folder = write(tmp_path / "set", type(planted)(planted.robot, actions, planted.states, None))
    facts = json.loads(command("analyse", folder, "--json").out)
    assert any("their states don't follow the actions" in limit for limit in facts["limits"])
    assert {fault["kind"] for fault in facts["faults"]} <= {"offset"}
