"""Plans for chains without contact: their commands read back, and how long they settle."""

import dataclasses
import json

import numpy as np
import pytest

import undulog
from undulog.analysis.plan.designs import tones
from undulog.analysis.plan.gait_base import slowest_mode, transverse_mass
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.robot.model import Plane

ROBOT = load_robot("snake25")
YAW = ROBOT.joint_indices(Plane.HORIZONTAL)[:4]
EPOCH_NS = 1_735_689_600_000_000_000


@pytest.fixture(scope="module")
def like(tmp_path_factory):
    path = tmp_path_factory.mktemp("like") / "like.mcap"
    names = ROBOT.joint_names
    with SessionWriter(path, session_id="like", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        commands = writer.joint_state("/joint_commands", names, unit="rad")
        for k in range(300):
            asked = np.zeros(25)
            asked[YAW] = 0.3 * np.cos(2 * np.pi * 0.5 * k / 50 - np.arange(4))
            commands.write(EPOCH_NS + k * 20_000_000, asked)
    return path


def planned(capsys, *words):
    capsys.readouterr()
    assert undulog.run(["plan", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def phasors(path, frequency_hz, seconds, settle_s):
    """Demodulated over whole periods, by a plain sum; shape (tones, joints)."""
    with Session.open(path) as session:
        signals = session.joints("/joint_commands")
        values = np.stack([signals.signal(name).values for name in ROBOT.joint_names])
        t = (signals.signal(ROBOT.joint_names[0]).t_ns - session.start_ns) * 1e-9
        plan = dict(session.metadata["undulog.plan"])
    inside = (t >= settle_s - 1e-9) & (t < settle_s + seconds - 1e-9)
    turn = np.exp(-2j * np.pi * np.atleast_1d(frequency_hz)[:, None] * t[inside])
    return 2 * turn @ values[:, inside].T / np.count_nonzero(inside), plan


def test_a_lag_sweep_is_a_dft(like, tmp_path, capsys):
    told = planned(capsys, "lag-sweep", "--like", like, "-o", tmp_path / "s", "--amplitude", 0.03)
    assert len(told["files"]) == 4
    found = [phasors(file, 0.5, 10.0, told["settle_s"]) for file in told["files"]]
    C = np.stack([one[0][0, YAW] for one in found], axis=1)
    np.testing.assert_allclose(np.abs(C), 0.03, rtol=1e-6)
    assert np.linalg.cond(C) == pytest.approx(1.0, abs=1e-6)
    for one, plan in found:
        step = one[0, YAW][1:] / one[0, YAW][:-1]
        np.testing.assert_allclose(step, np.exp(1j * float(plan["lag_rad"])), atol=1e-5)
    assert sorted(plan["run"] for _, plan in found) == ["0", "1", "2", "3"]


def test_settling_is_told_by_the_slowest_body_mode(like, tmp_path, capsys):
    told = planned(capsys, "lag-sweep", "--like", like, "-o", tmp_path / "s")
    _, plan = phasors(told["files"][0], 0.5, 10.0, 0.0)
    tau_s = float(plan["mode_tau_s"])
    assert tau_s == pytest.approx(1.845, rel=1e-3)
    assert told["settle_s"] == float(plan["settle_s"]) >= 5 * tau_s
    assert (plan["measure_s"], plan["amplitude_rad"]) == ("10", "0.02")


def test_every_tone_of_a_multisine_is_a_dft(like, tmp_path, capsys):
    told = planned(capsys, "multisine", "--like", like, "-o", tmp_path / "m", "--measure", 12)
    omega = tones(2 * np.pi * 0.5, 3)
    found = [phasors(file, omega / (2 * np.pi), 20.0, told["settle_s"]) for file in told["files"]]
    assert omega[0] == 2 * np.pi * 0.5
    assert found[0][1]["measure_s"] == "20"  # two whole periods
    for tone in range(3):
        C = np.stack([one[0][tone, YAW] for one in found], axis=1)
        np.testing.assert_allclose(np.abs(C), 0.02 * (omega[0] / omega[tone]) ** 2, rtol=1e-6)
        assert np.linalg.cond(C) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_no_tone_is_another_plus_gait_frequencies(count):
    gait = 2 * np.pi * 0.7
    chosen = tones(gait, count)
    for i, one in enumerate(chosen):
        for sign in (1, -1):
            apart = (chosen - sign * one) / gait
            off = np.abs(apart - np.round(apart))
            off[i] = 1.0
            assert off.min() > 0.5 / (2 * count - 1)


def weak(stall_torque):
    return dataclasses.replace(
        ROBOT,
        joints=tuple(
            dataclasses.replace(
                joint, servo=dataclasses.replace(joint.servo, stall_torque=stall_torque)
            )
            for joint in ROBOT.joints
        ),
    )


def test_the_weak_chain_rings_for_seconds():
    mode = slowest_mode(weak(0.25), ["joint01"])
    # Measured on a prototype that shares nothing with this code: 0.551 Hz, 3.8 %, 7.5 s.
    assert mode.frequency_hz == pytest.approx(0.551, abs=2e-3)
    assert mode.damping == pytest.approx(0.038, abs=1e-3)
    assert mode.time_constant_s == pytest.approx(7.5, abs=0.05)


def test_two_rods_have_their_textbook_inertia():
    """Two free uniform rods on one hinge: bending by q takes m l^2/24 q''^2/2 (thin rods)."""
    link = dataclasses.replace(
        ROBOT.links[0], length=0.3, mass=0.2, inertia=(0.0, 0.0, 0.2 * 0.3**2 / 12)
    )
    robot = dataclasses.replace(ROBOT, links=(link, link), joints=ROBOT.joints[:1])
    inertia = transverse_mass(robot, Plane.HORIZONTAL)
    # Mirror symmetry: each rod turns by q/2, its centre moves q l/8 against the hinge's q l/8.
    np.testing.assert_allclose(inertia, [[0.2 * 0.3**2 / 24]], rtol=1e-12)


def test_what_is_refused(like, tmp_path, capsys):
    words = ["plan", "lag-sweep", "--like", str(like), "-o", str(tmp_path / "x")]
    assert undulog.run([*words, "--amplitude", "0.2"]) == 2
    assert "would saturate" in capsys.readouterr().err
    assert undulog.run([*words, "--amplitude", "0.6"]) == 2
    assert undulog.run([*words, "--amplitude", "0"]) == 2
    assert undulog.run(["plan", "multisine", *words[2:], "--tones", "1"]) == 2
    assert not (tmp_path / "x").exists()
    assert undulog.run([*words, "--settle", "2"]) == 0
    assert "Warning: it needs 12 s to settle; 2 s is less" in capsys.readouterr().out
