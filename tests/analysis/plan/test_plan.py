"""Plans: the commands that are written, read back as the experiment they are for."""

import json
import subprocess

import numpy as np
import pytest

import undulog
from undulog.analysis.experiment.kicks.runs import Kind, missing_kicks, sort_kicks
from undulog.analysis.plan.designs import reversal
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.robot.model import Plane

ROBOT = load_robot("snake25")
YAW = ROBOT.joint_indices(Plane.HORIZONTAL)[:4]
EPOCH_NS = 1_735_689_600_000_000_000
BASE = 0.3 * np.exp(-1j * np.pi / 3 * np.arange(4) + 0.7j)


def write_gait(path, amplitude=BASE, overtone=0.0):
    offset = np.linspace(-0.1, 0.1, 25)
    names = ROBOT.joint_names
    with SessionWriter(path, session_id="like", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        commands = writer.joint_state("/joint_commands", names, unit="rad")
        states = writer.joint_state("/joint_states", names, unit="rad")
        for k in range(300):
            asked = offset.copy()
            turn = np.exp(2j * np.pi * 0.8 * k / 50)
            asked[YAW] += np.real(amplitude * (turn + overtone * turn**2))
            commands.write(EPOCH_NS + k * 20_000_000, asked)
            states.write(EPOCH_NS + k * 20_000_000, asked)
    return path


def phasors(path, start_s):
    """Demodulated over whole cycles, by a plain sum."""
    with Session.open(path) as session:
        signals = session.joints("/joint_commands")
        columns = [signals.signal(name) for name in ROBOT.joint_names]
        plan = dict(session.metadata["undulog.plan"])
        started = session.start_ns
    t = (columns[0].t_ns - started) * 1e-9
    inside = (t >= start_s - 1e-9) & (t < start_s + 5.0 - 1e-9)  # four cycles of 0.8 Hz
    values = np.stack([one.values for one in columns])[:, inside]
    turn = np.exp(-2j * np.pi * 0.8 * t[inside])
    return 2 * (values @ turn) / turn.size, values.mean(axis=1), plan


@pytest.fixture(scope="module")
def like(tmp_path_factory):
    return write_gait(tmp_path_factory.mktemp("like") / "like.mcap")


def planned(capsys, *words):
    assert undulog.run(["plan", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["files"]


def test_kicks_read_back_as_kicks(like, tmp_path, capsys):
    words = ("--like", like, "-o", tmp_path / "kicks", "--settle", 3, "--measure", 5)
    files = planned(capsys, "phase-kicks", *words)
    assert len(files) == 4 * 4 + 6 + 3
    found = [phasors(file, 3.0) for file in files]
    command = np.stack([one[0][YAW] for one in found])
    runs = sort_kicks(command)
    assert (len(runs.base), len(runs.kicks), len(runs.patterns)) == (6, 16, 3)
    for kind in Kind:
        assert missing_kicks(list(runs.kicks.values()), kind, "abcd") == ()
    np.testing.assert_allclose(np.abs(command[runs.base[0]]), 0.3, rtol=1e-5)
    for k, kick in runs.kicks.items():
        assert abs(abs(kick.size) - 0.05) < 1e-5
        plan = found[k][2]
        assert (plan["plan"], plan["kind"]) == ("phase-kicks", kick.kind.value)
        assert plan["joint"] == ROBOT.joint_names[YAW[kick.joint]]
        assert float(plan["sign"]) * kick.size > 0
        assert plan["run"] == str(k)
    assert len({one[2]["plan_id"] for one in found}) == 1
    for _, offset, _ in found:
        np.testing.assert_allclose(offset, np.linspace(-0.1, 0.1, 25), atol=1e-5)


def test_names_of_joints_lead_out_of_no_folder(tmp_path, capsys):
    names = ["../up", "/etc/x", "nul\0", "l" * 300]
    with SessionWriter(tmp_path / "like.mcap", session_id="like", epoch_ns=EPOCH_NS) as writer:
        commands = writer.joint_state("/joint_commands", names, unit="rad")
        states = writer.joint_state("/joint_states", names, unit="rad")
        for k in range(300):
            asked = np.real(BASE * np.exp(2j * np.pi * 0.8 * k / 50))
            commands.write(EPOCH_NS + k * 20_000_000, asked)
            states.write(EPOCH_NS + k * 20_000_000, asked)
    folder = tmp_path / "deep" / "kicks"
    words = ("--like", tmp_path / "like.mcap", "-o", folder, "--settle", 3, "--measure", 5)
    files = planned(capsys, "phase-kicks", *words)
    assert len(set(files)) == len(list(folder.iterdir())) == 4 * 4 + 6 + 3
    kicked = set()
    for file in files:
        with Session.open(file) as session:
            kicked.add(session.metadata["undulog.plan"].get("joint"))
    assert set(names) <= kicked


def test_a_reversal_alternates(like, tmp_path, capsys):
    words = ("--like", like, "-o", tmp_path / "both", "--runs", 2, "--settle", 2, "--measure", 5)
    files = planned(capsys, "reversal", *words)
    assert len(files) == 4
    command = [phasors(file, 2.0)[0][YAW] for file in files]
    step = np.angle([one[1] / one[0] for one in command])
    np.testing.assert_allclose(step, np.array([-1, 1, -1, 1]) * np.pi / 3, atol=1e-5)
    plans = [phasors(file, 2.0)[2] for file in files]
    assert [float(one["heading_rad"]) for one in plans] == pytest.approx([0, np.pi, np.pi, 0])
    assert [file.rpartition("-")[2] for file in files] == [f"{h}.mcap" for h in (0, 180, 180, 0)]


@pytest.mark.parametrize("each", [2, 6, 8])
def test_half_of_each_direction_is_turned_and_drift_cancels(each):
    runs = reversal(BASE, each)
    way = np.array([1 if run.facts["kind"] == "as-recorded" else -1 for run in runs])
    turn = np.array([1 if run.label.endswith("-0") else -1 for run in runs])
    place = np.arange(len(runs)) - (len(runs) - 1) / 2
    assert [(way == 1).sum(), (turn == 1).sum()] == [each, each]
    # Each way at each heading as often: the three contrasts are orthogonal.
    assert way @ turn == 0
    if each % 4 == 0:  # pairs of blocks: a drift that is linear in time is in no contrast
        assert place @ way == place @ turn == 0
    # The robot is turned every second run at most.
    assert (np.diff(turn) != 0).sum() <= each


def test_what_is_refused(like, tmp_path, capsys):
    folder = tmp_path / "kicks"
    words = ["plan", "phase-kicks", "-o", str(folder), "--like"]
    assert undulog.run([*words, str(like), "--runs", "0"]) == 2
    high = write_gait(tmp_path / "high.mcap", amplitude=BASE * 1.65)
    assert undulog.run([*words, str(high)]) == 2
    assert "its limits are" in capsys.readouterr().err
    odd = write_gait(tmp_path / "odd.mcap", overtone=0.1)
    assert undulog.run([*words, str(odd)]) == 2
    assert "is no sine" in capsys.readouterr().err
    assert not folder.exists()
    short = [str(like), "--settle", "1", "--measure", "1"]
    assert undulog.run([*words, *short]) == 0
    assert capsys.readouterr().out.startswith(f"{folder}: phase-kicks, 25 runs of 2 s")
    assert undulog.run([*words, *short]) != 0
    assert "exists" in capsys.readouterr().err


def test_a_folder_that_can_not_be_written_is_an_error(like, tmp_path, disk_of, capsys):
    words = ["plan", "phase-kicks", "--like", str(like), "--settle", "1", "--measure", "1", "-o"]
    (tmp_path / "file").write_text("")
    disk = disk_of("1m")
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    for folder in (tmp_path / "file", tmp_path / "file" / "below", disk, disk / "below"):
        assert undulog.run([*words, str(folder)]) == 1
        complaint = capsys.readouterr().err
        assert complaint.startswith(f"error: {folder}")
        assert "can't be written" in complaint or "no folder for the plan" in complaint


def test_a_full_disk_ends_a_plan(like, disk_of, capsys):
    disk = disk_of("200k")
    assert undulog.run(["plan", "phase-kicks", "--like", str(like), "-o", str(disk)]) == 1
    assert "No space left" in capsys.readouterr().err
    assert not list(disk.glob("*.part"))
