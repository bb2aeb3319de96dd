"""Plans: the commands that are written, read back as the experiment they are for."""

import dataclasses
import subprocess

import numpy as np
import pytest

from support.joint_runs import turns, write_joints
from undulog.analysis.experiment.kick_runs import KickKind, missing_kicks, sort_kicks
from undulog.analysis.plan.designs import reversal, slowest_mode, tones, transverse_mass
from undulog.capture import Session, load_robot
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Plane

pytestmark = pytest.mark.slow

ROBOT = load_robot("snake25")
YAW = ROBOT.joint_indices(Plane.HORIZONTAL)[:4]
BASE = 0.3 * np.exp(-1j * np.pi / 3 * np.arange(4) + 0.7j)


def write_gait(path, amplitude=BASE, overtone=0.0, robot=ROBOT):
    turn = turns(0.8, 300)
    asked = np.tile(np.linspace(-0.1, 0.1, 25), (300, 1))
    asked[:, YAW] += np.real(amplitude * (turn + overtone * turn**2))
    return write_joints(path, ROBOT.joint_names, asked, [asked], robot=robot)


def phasors(path, start_s, seconds=5.0, frequency_hz=0.8):
    """Demodulated over whole cycles, by a plain sum, shape (tones, joints); mean angles; plan."""
    with Session.open(path) as session:
        signals = session.joints("/joint_commands")
        columns = [signals.signal(name) for name in ROBOT.joint_names]
        plan = dict(session.metadata["undulog.plan"])
        t = (columns[0].t_ns - session.start_ns) * 1e-9
    inside = (t >= start_s - 1e-9) & (t < start_s + seconds - 1e-9)
    values = np.stack([column.values for column in columns])[:, inside]
    turn = np.exp(-2j * np.pi * np.atleast_1d(frequency_hz)[:, None] * t[inside])
    return 2 * turn @ values.T / turn.shape[1], values.mean(axis=1), plan


@pytest.fixture(scope="module")
def like(tmp_path_factory):
    return write_gait(tmp_path_factory.mktemp("like") / "like.mcap")


@pytest.mark.nightly
def test_kicks_read_back_as_kicks(like, tmp_path, report_of):
    words = ("--like", like, "-o", tmp_path / "kicks", "--settle", 3, "--measure", 5)
    files = report_of("plan", "phase-kicks", *words)["files"]
    assert len(files) == 4 * 4 + 6 + 3
    measured = [phasors(file, 3.0) for file in files]
    command = np.stack([run[0][0, YAW] for run in measured])
    runs = sort_kicks(command)
    assert (len(runs.base), len(runs.kicks), len(runs.patterns)) == (6, 16, 3)
    for kind in KickKind:
        assert missing_kicks(list(runs.kicks.values()), kind, "abcd") == ()
    np.testing.assert_allclose(np.abs(command[runs.base[0]]), 0.3, rtol=1e-5)
    for k, kick in runs.kicks.items():
        assert abs(abs(kick.size) - 0.05) < 1e-5
        plan = measured[k][2]
        assert (plan["plan"], plan["kind"]) == ("phase-kicks", kick.kind.value)
        assert plan["joint"] == ROBOT.joint_names[YAW[kick.joint]]
        assert float(plan["sign"]) * kick.size > 0
        assert plan["run"] == str(k)
    assert len({run[2]["plan_id"] for run in measured}) == 1
    for _, offset, _ in measured:
        np.testing.assert_allclose(offset, np.linspace(-0.1, 0.1, 25), atol=1e-5)


def test_names_of_joints_lead_out_of_no_folder(tmp_path, report_of, opened):
    names = ["../up", "/etc/x", "nul\0", "l" * 300]
    asked = np.real(BASE * turns(0.8, 300))
    like = write_joints(tmp_path / "like.mcap", names, asked, [asked])
    folder = tmp_path / "deep" / "kicks"
    words = ("--like", like, "-o", folder, "--settle", 3, "--measure", 5)
    files = report_of("plan", "phase-kicks", *words)["files"]
    assert len(set(files)) == len(list(folder.iterdir())) == 4 * 4 + 6 + 3
    kicked = {opened(file).metadata["undulog.plan"].get("joint") for file in files}
    assert set(names) <= kicked


def test_a_reversal_alternates(like, tmp_path, report_of):
    words = ("--like", like, "-o", tmp_path / "both", "--runs", 2, "--settle", 2, "--measure", 5)
    files = report_of("plan", "reversal", *words)["files"]
    assert len(files) == 4
    step = np.angle(
        [phasor[1] / phasor[0] for phasor in [phasors(file, 2.0)[0][0, YAW] for file in files]]
    )
    np.testing.assert_allclose(step, np.array([-1, 1, -1, 1]) * np.pi / 3, atol=1e-5)
    plans = [phasors(file, 2.0)[2] for file in files]
    assert [float(plan["heading_rad"]) for plan in plans] == pytest.approx([0, np.pi, np.pi, 0])
    assert [file.rpartition("-")[2] for file in files] == [f"{h}.mcap" for h in (0, 180, 180, 0)]


@pytest.mark.parametrize("count", [2, 6, 8])
def test_half_of_each_direction_is_turned_and_drift_cancels(count):
    runs = reversal(BASE, count)
    way = np.array([1 if run.facts["kind"] == "as-recorded" else -1 for run in runs])
    turn = np.array([1 if run.label.endswith("-0") else -1 for run in runs])
    place = np.arange(len(runs)) - (len(runs) - 1) / 2
    assert [(way == 1).sum(), (turn == 1).sum()] == [count, count]
    # Each way at each heading as often: the three contrasts are orthogonal.
    assert way @ turn == 0
    if count % 4 == 0:  # pairs of blocks: a drift that is linear in time is in no contrast
        assert place @ way == place @ turn == 0
    # The robot is turned every second run at most.
    assert (np.diff(turn) != 0).sum() <= count


def test_what_is_refused(like, tmp_path, command):
    folder = tmp_path / "kicks"
    words = ("plan", "phase-kicks", "-o", folder, "--like")
    command(*words, like, "--runs", "0", code=2)
    high = write_gait(tmp_path / "high.mcap", amplitude=BASE * 1.65)
    assert "its limits are" in command(*words, high, code=2).err
    odd = write_gait(tmp_path / "odd.mcap", overtone=0.1)
    assert "is no sine" in command(*words, odd, code=2).err
    assert not folder.exists()
    short = (like, "--settle", "1", "--measure", "1")
    assert command(*words, *short).out.startswith(f"{folder}: phase-kicks, 25 runs of 2 s")
    assert "exists" in command(*words, *short, code=2).err


def test_a_folder_that_can_not_be_written_is_an_error(like, tmp_path, disk_of, command):
    words = ("plan", "phase-kicks", "--like", like, "--settle", "1", "--measure", "1", "-o")
    (tmp_path / "file").write_text("")
    disk = disk_of("1m")
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    for folder in (tmp_path / "file", tmp_path / "file" / "below", disk, disk / "below"):
        complaint = command(*words, folder, code=1).err
        assert complaint.startswith(f"error: {folder}")
        assert "can't be written" in complaint or "no folder for the plan" in complaint


def test_a_full_disk_ends_a_plan(like, disk_of, command):
    disk = disk_of("200k")
    assert "No space left" in command("plan", "phase-kicks", "--like", like, "-o", disk, code=1).err
    assert not list(disk.glob("*.part"))


def test_a_lag_sweep_is_a_dft(like, tmp_path, report_of):
    words = ("--like", like, "-o", tmp_path / "s", "--amplitude", 0.03)
    plan = report_of("plan", "lag-sweep", *words)
    assert len(plan["files"]) == 4
    runs = [phasors(file, plan["settle_s"], 10.0, 0.8) for file in plan["files"]]
    C = np.stack([run[0][0, YAW] for run in runs], axis=1)
    np.testing.assert_allclose(np.abs(C), 0.03, rtol=1e-6)
    assert np.linalg.cond(C) == pytest.approx(1.0, abs=1e-6)
    for values, _, plan in runs:
        step = values[0, YAW][1:] / values[0, YAW][:-1]
        np.testing.assert_allclose(step, np.exp(1j * float(plan["lag_rad"])), atol=1e-5)
    assert sorted(plan["run"] for _, _, plan in runs) == ["0", "1", "2", "3"]


def test_settling_follows_from_the_slowest_body_mode(like, tmp_path, report_of):
    report = report_of("plan", "lag-sweep", "--like", like, "-o", tmp_path / "s")
    plan = phasors(report["files"][0], 0.0)[2]
    tau_s = float(plan["mode_tau_s"])
    assert tau_s == pytest.approx(1.845, rel=1e-3)
    assert report["settle_s"] == float(plan["settle_s"]) >= 5 * tau_s
    assert (plan["measure_s"], plan["amplitude_rad"]) == ("10", "0.02")


def test_every_tone_of_a_multisine_is_a_dft(like, tmp_path, report_of):
    words = ("--like", like, "-o", tmp_path / "m", "--measure", 12)
    plan = report_of("plan", "multisine", *words)
    omega = tones(2 * np.pi * 0.8, 3)
    runs = [phasors(file, plan["settle_s"], 12.5, omega / (2 * np.pi)) for file in plan["files"]]
    assert omega[0] == 2 * np.pi * 0.8
    assert runs[0][2]["measure_s"] == "12.5"  # two whole periods
    for tone in range(3):
        C = np.stack([run[0][tone, YAW] for run in runs], axis=1)
        np.testing.assert_allclose(np.abs(C), 0.02 * (omega[0] / omega[tone]) ** 2, rtol=1e-6)
        assert np.linalg.cond(C) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_no_tone_is_another_plus_gait_frequencies(count):
    gait = 2 * np.pi * 0.7
    chosen = tones(gait, count)
    for i, tone in enumerate(chosen):
        for sign in (1, -1):
            apart = (chosen - sign * tone) / gait
            off = np.abs(apart - np.round(apart))
            off[i] = 1.0
            assert off.min() > 0.5 / (2 * count - 1)


def test_the_weak_chain_rings_for_seconds():
    servo = dataclasses.replace(ROBOT.joints[0].servo, stall_torque=0.25)
    joints = tuple(dataclasses.replace(joint, servo=servo) for joint in ROBOT.joints)
    mode = slowest_mode(dataclasses.replace(ROBOT, joints=joints), ["joint01"])
    # Measured on a prototype that shares nothing with this code: 0.551 Hz, 3.8 %, 7.5 s.
    assert mode.frequency_hz == pytest.approx(0.551, abs=2e-3)
    assert mode.damping == pytest.approx(0.038, abs=1e-3)
    assert mode.time_constant_s == pytest.approx(7.5, abs=0.05)


def test_two_rods_have_their_textbook_inertia():
    """Two free uniform rods on one hinge: bending by q takes m l^2/24 q''^2/2 (thin rods)."""
    rod = {"length": 0.3, "mass": 0.2, "inertia": (0.0, 0.0, 0.2 * 0.3**2 / 12)}
    link = dataclasses.replace(ROBOT.links[0], **rod)
    robot = dataclasses.replace(ROBOT, links=(link, link), joints=ROBOT.joints[:1])
    inertia = transverse_mass(robot, Plane.HORIZONTAL)
    # Mirror symmetry: each rod turns by q/2, its centre moves q l/8 against the hinge's q l/8.
    np.testing.assert_allclose(inertia, [[0.2 * 0.3**2 / 24]], rtol=1e-12)


def test_sweeps_that_are_refused(like, tmp_path, command):
    words = ["plan", "lag-sweep", "--like", str(like), "-o", str(tmp_path / "x")]
    assert "would saturate" in command(*words, "--amplitude", "0.2", code=2).err
    command(*words, "--amplitude", "0.6", code=2)
    command(*words, "--amplitude", "0", code=2)
    command("plan", "multisine", *words[2:], "--tones", "1", code=2)
    assert not (tmp_path / "x").exists()
    assert "Warning: it needs 12 s to settle; 2 s is less" in command(*words, "--settle", "2").out


LIMITS = [
    ("max_velocity = 10.0", "max_velocity = 0.05"),  # of the servo
    ("[safety]\nmax_rate = 4.0", "[safety]\nmax_rate = 0.05"),  # of driving
]


@pytest.mark.parametrize("plan", ["phase-kicks", "reversal", "lag-sweep", "multisine"])
@pytest.mark.parametrize("limit", LIMITS)
def test_commands_faster_than_a_joint_are_refused(plan, limit, tmp_path, command):
    slow = parse_robot(ROBOT.toml.replace(*limit), "slow.toml", dict(ROBOT.databases))
    path = write_gait(tmp_path / "a.mcap", robot=slow)
    error = command("plan", plan, "--like", path, "-o", tmp_path / "x", code=2).err
    assert f"would command {ROBOT.joint_names[YAW[0]]} at up to" in error
    assert "its limit is 0.05 rad/s" in error
    assert not (tmp_path / "x").exists()
