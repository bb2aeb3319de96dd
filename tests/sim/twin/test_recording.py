"""Recordings of the twin: to the contract, the same bytes again, and whole however they end."""

import dataclasses
import math
import os
import re
import signal

import numpy as np
import pytest

from support.processes import UNDULOG, start, undulog, wait_for
from undulog import sim
from undulog.capture import Session
from undulog.capture.common.errors import OutputExistsError
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.sim.physics.ledger import JOINT_TERMS, TERMS
from undulog.sim.physics.sensing import JointSample
from undulog.sim.twin.session_log import urdf

HUNDREDTH_NS = 10_000_000
POWERS = {
    "mechanical": "mechanical_net",
    "mechanical_plus": "mechanical_plus",
    "electrical": "electrical_net",
    "electrical_plus": "electrical_plus",
}


@pytest.fixture(scope="module")
def scenario():
    return dataclasses.replace(
        sim.load_scenario("weak-servo-pi3").changed(duration_s=0.6), settle_s=0.3
    )


@pytest.fixture(scope="module")
def recording(scenario, tmp_path_factory):
    return sim.record(scenario, tmp_path_factory.mktemp("record") / "run.mcap")


@pytest.fixture
def session(recording):
    with Session.open(recording.path) as opened:
        yield opened


@pytest.fixture(scope="module")
def run(scenario):
    """The twin's samples, and its sensors' joint samples with the time of arrival [s]."""
    with sim.Twin(scenario) as twin:
        samples = list(twin.samples())
        received = [(s.time_s, sample) for s in samples for sample in s.sensed]
        received += [(samples[-1].time_s, sample) for sample in twin.flush()]
    return samples, [(at, sample) for at, sample in received if isinstance(sample, JointSample)]


@pytest.fixture
def truth(run):
    return run[0]


def columns(session, topic, field="position"):
    return np.array(session.joints(topic, field).values).T


def test_the_session_explains_itself(session, scenario, recording):
    assert session.session_id == recording.session_id == scenario.session_id
    assert session.robot == sim.load_scenario("flat").robot  # the robot's file, as it is
    assert sim.parse_scenario(session.attachments["scenario.toml"].decode(), "x.toml") == scenario
    assert session.attachments["robot.urdf"].decode() == urdf(scenario.robot)
    facts = session.metadata["undulog"]
    assert (facts["settle_s"], facts["seed"], facts["clock.twin"]) == ("0.3", "1", "simulated")
    assert facts["joint_sampling"].startswith("all joints at the stamp")
    assert (session.verdict, session.warnings) == ("good", [])


def test_the_channels_are_those_of_the_contract(session):
    assert {topic: channel.metadata.get("unit") for topic, channel in session.channels.items()} == {
        "/joint_commands": "rad",
        "/joint_states": "rad",
        "/joint_sample_offset": "s",
        "/joint_current": "A",
        "/joint_voltage": "V",
        **{f"/joint_power/{name}": "W" for name in POWERS},
        "/gait": "rad, omega in rad/s",
        "/gait/mode": None,
        "/energy_ledger": "J",
        "/odom": None,
        "/tf": None,
        "/robot_description": None,
        "/rosout": None,
        **{f"/ir/{i + 1:02d}": "m" for i in range(15)},
        "/sonar": "m",
        "/imu": None,
        "/compass": "T",
    }
    counts = {topic: channel.count for topic, channel in session.channels.items()}
    expected = {"/joint_states": 61, "/gait": 61, "/odom": 61, "/tf": 13}  # /tf: 20 Hz
    assert counts == counts | expected | {"/imu": 60, "/sonar": 12, "/compass": 12}
    assert {counts[f"/ir/{i + 1:02d}"] for i in range(15)} <= {15, 16}  # every 38 ms


def test_powers_of_a_period_are_what_the_ledger_books_in_it(session, truth, scenario):
    middles = scenario.epoch_ns + HUNDREDTH_NS * np.arange(60) + HUNDREDTH_NS // 2
    for name, term in POWERS.items():
        power = session.joints(f"/joint_power/{name}")
        assert power.names == scenario.robot.joint_names
        assert all(np.array_equal(t, middles) for t in power.t_ns)
        row = JOINT_TERMS.index(term)
        booked = np.diff([sample.joint_energy[row] for sample in truth], axis=0)
        rounded = 0.5 * 2.0**-24 * 0.01
        np.testing.assert_allclose(np.array(power.values).T * 0.01, booked, rtol=0, atol=rounded)


def test_joints_come_back_exactly(session, run, scenario):
    states = session.joints("/joint_states", "position")
    assert states.names == scenario.robot.joint_names
    expected = scenario.epoch_ns + HUNDREDTH_NS * np.arange(61)
    assert all(np.array_equal(t, expected) for t in states.t_ns)
    truth, sensed = run[0], [sample for _, sample in run[1]]
    for topic, field, values in (
        ("/joint_commands", "position", [sample.gait.command for sample in truth]),
        ("/joint_states", "position", [sample.step.body.angle for sample in truth]),
        ("/joint_states", "velocity", [sample.step.body.rate for sample in truth]),
        ("/joint_states", "effort", [sample.effort for sample in sensed]),
        ("/joint_current", "position", [sample.current for sample in sensed]),
        ("/joint_voltage", "position", [sample.voltage for sample in sensed]),
        ("/joint_sample_offset", "position", np.zeros((61, 25))),
    ):
        np.testing.assert_array_equal(columns(session, topic, field), values)


def test_a_sample_is_logged_when_it_arrives_two_ticks_after_its_stamp(session, run, scenario):
    arrivals = [round(at * 100) for at, _ in run[1]]
    assert arrivals == [min(cycle + 2, 60) for cycle in range(61)]
    logged = [log_ns for log_ns, _ in session.messages("/joint_states")]
    assert logged == [scenario.epoch_ns + HUNDREDTH_NS * tick for tick in arrivals]


def test_joints_in_turn_come_back_at_their_own_times(scenario, tmp_path):
    slot_s = 0.2e-3
    polled = dataclasses.replace(
        scenario, sensing=sim.SensorModels(sim.ServoPolling(slot_s=slot_s))
    )
    path = tmp_path / "turns.mcap"
    sim.record(polled, path)
    with Session.open(path) as session:
        assert session.metadata["undulog"]["joint_sampling"].startswith("each joint 0.0002 s after")
        states = session.joints("/joint_states", "position")
        offset_ns = np.rint(1e9 * slot_s * np.arange(25)).astype(int)
        for t_ns, offset in zip(states.t_ns, offset_ns, strict=True):
            expected = scenario.epoch_ns + HUNDREDTH_NS * np.arange(60) + offset
            np.testing.assert_array_equal(t_ns[:-1], expected)
            assert t_ns[-1] == scenario.epoch_ns + 60 * HUNDREDTH_NS


def test_gait_and_ledger_come_back_by_name(session, truth):
    gait = session.joints("/gait", "position")
    assert gait.names == tuple(f"horizontal.{n}" for n in ("A", "omega", "lag", "offset", "phase"))
    assert gait.signal("horizontal.lag").values[0] == pytest.approx(-np.pi / 3)
    assert gait.signal("horizontal.phase").values[-1] == pytest.approx(2 * np.pi * 0.5 * 0.6)
    ledger = session.joints("/energy_ledger", "position")
    assert ledger.names == TERMS
    assert [values[-1] for values in ledger.values] == truth[-1].energy.tolist()


def test_odometry_and_transforms_agree_with_the_kinematics(session, scenario):
    odometry = session.table("/odom")
    angles = columns(session, "/joint_states")
    last = odometry.iloc[-1]
    position = last[[f"pose.pose.position.{a}" for a in "xyz"]].to_numpy(dtype=float)
    quaternion = last[[f"pose.pose.orientation.{a}" for a in "xyzw"]].to_numpy(dtype=float)
    turn = rotation_from_quaternion(quaternion)
    centres, turns = link_poses(scenario.robot, position, turn, angles[-1])
    _, message = list(session.messages("/tf"))[-1]
    for i, frame in enumerate(message.transforms):
        assert frame.child_frame_id == scenario.robot.links[i].name
        # URDF has the frame of a rear link at the joint in front of it.
        origin = centres[i] + (turns[i][:, 0] * 0.03 if i else 0.0)
        at = frame.transform.translation
        assert (at.x, at.y, at.z) == pytest.approx(tuple(origin), abs=2.0**-14)


def test_odometry_twist_is_in_the_heads_frame(tmp_path, make_scenario, make_robot, opened):
    world = sim.World(velocity=(0.0, 0.5, 0.0), heading=np.pi / 2)
    path = tmp_path / "a.mcap"
    sim.record(make_scenario(make_robot(3), amplitude=0.0, duration_s=0.1, world=world), path)
    first = opened(path).table("/odom").iloc[0]
    assert first["twist.twist.linear.x"] == pytest.approx(0.5)
    assert first["twist.twist.linear.y"] == pytest.approx(0.0, abs=1e-15)


def test_events_tell_the_story(session):
    logs = [message.msg for _, message in session.messages("/rosout")]
    assert logs[0].startswith("start of weak-servo-pi3, seed 1: ")
    assert logs[1:] == ["settled: 0.3 s have passed", "end at 0.6 s"]


def test_clamps_limits_and_stiff_parts_come_once(tmp_path, make_scenario, make_robot, opened):
    stiff = sim.World(ground=sim.Ground(slip_speed=0.001))
    path = tmp_path / "a.mcap"
    scenario = make_scenario(
        make_robot(9, limit=0.1), amplitude=0.4, frequency_hz=2.0, ramp_s=0.0, world=stiff
    )
    sim.record(scenario, path)
    logs = [message.msg for _, message in opened(path).messages("/rosout") if message.level == 30]
    assert len(logs) == len(set(logs))
    assert "horizontal.A clamped to the joint limits" in logs
    assert any("passed its limits -0.1 to 0.1 rad" in text for text in logs)
    assert any("world.ground.slip_speed is too stiff" in text for text in logs)


def test_noise_comes_from_the_seed_and_touches_only_reports(tmp_path, scenario, truth):
    noisy = dataclasses.replace(scenario, noise=sim.Noise(position=0.01))
    angles_by_seed = {}
    for seed in (1, 2):
        path = tmp_path / f"{seed}.mcap"
        sim.record(noisy.changed(seed=seed), path)
        with Session.open(path) as session:
            angles_by_seed[seed] = columns(session, "/joint_states")
            velocity = columns(session, "/joint_states", "velocity")
            energy = columns(session, "/energy_ledger")
    angles = np.array([sample.step.body.angle for sample in truth])
    assert np.std(angles_by_seed[1] - angles) == pytest.approx(0.01, rel=0.05)
    assert (
        np.abs(
            np.corrcoef((angles_by_seed[1] - angles).ravel(), (angles_by_seed[2] - angles).ravel())[
                0, 1
            ]
        )
        < 0.1
    )
    np.testing.assert_array_equal(velocity, [sample.step.body.rate for sample in truth])
    np.testing.assert_array_equal(energy, [sample.energy for sample in truth])


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        # Another hash seed and another time zone must not matter either.
        env = os.environ | {"PYTHONHASHSEED": str(ord(name)), "TZ": f"XYZ{ord(name) % 10}"}
        words = ("-o", f"{name}.mcap", "--duration", "0.5", "--seed", "3")
        done = undulog("sim", "run", "flat", *words, cwd=tmp_path, env=env)
        assert (done.returncode, done.stderr) == (0, "")
    first, second = ((tmp_path / f"{name}.mcap").read_bytes() for name in "ab")
    assert len(first) > 10_000
    assert first == second


def long_run(path):
    """A run of an hour that has begun to write."""
    process = start(*UNDULOG, "sim", "run", "flat", "-o", path, "--duration", "3600")
    part = path.with_name(f"{path.name}.part")
    wait_for(lambda: part.exists() and part.stat().st_size > 100_000, alive=[process])
    return process


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_no_session_under_its_name(tmp_path):
    process = long_run(tmp_path / "killed.mcap")
    process.kill()
    process.communicate()
    assert [path.name for path in tmp_path.iterdir()] == ["killed.mcap.part"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_run_leaves_a_whole_session(tmp_path, number):
    path = tmp_path / "killed.mcap"
    process = long_run(path)
    process.send_signal(number)
    out, complained = process.communicate()
    assert (process.returncode, complained) == (1, "")
    assert out.startswith("stopped at ")
    with Session.open(path) as session:
        assert (session.warnings, session.verdict) == ([], "degraded")
        states = session.joints("/joint_states", "position")
        logs = [message.msg for _, message in session.messages("/rosout")]
        assert len(states.values[0]) == session.channels["/energy_ledger"].count > 1
        assert logs[-1] == out.split(";")[0]
    assert f"stopped at {(len(states.values[0]) - 1) / 100:g} s of 3600 s" == logs[-1]


def test_a_stop_request_ends_between_two_samples(tmp_path, scenario):
    stop = StopRequest()

    def ask(sample):
        if sample.tick == 7:
            stop.signal = signal.SIGTERM

    outcome = sim.record(scenario, tmp_path / "a.mcap", stop=stop, on_sample=ask)
    assert (outcome.sample_count, outcome.duration_s, outcome.complete) == (8, 0.07, False)


PEG = '[[world.obstacles]]\nshape = "cylinder"\nposition = [0.0, 0.08]\nradius = 0.05\n'
BAD = {
    "ground": ("[world.ground]\nstiffness = 1e7", "world.ground.stiffness is too stiff for steps"),
    "obstacle": (
        f"{PEG}[world.obstacle_contact]\nstiffness = 1e8",
        "world.obstacle_contact.stiffness is too stiff for steps",
    ),
    "gear": ("[servo_of.joint03]\ngear_stiffness = 1e6", "servo.gear_stiffness is too stiff"),
    "rotor": ("[servo_of.joint03]\nrotor_inertia = 1e-8", "servo.rotor_inertia is too stiff"),
    "heavy": ("[link_of.link03]\nmass_factor = 1e4", "link03 is too heavy for world.ground"),
    "step": ("", "servo.gear_stiffness is too stiff for steps of 5 ms"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_failed_run_keeps_what_came_before_and_why(tmp_path, name, command):
    text, cause = BAD[name]
    rate = "physics_rate_hz = 200\n" if name == "step" else ""
    wave = "gait.horizontal = { amplitude = 0.4, frequency_hz = 1.0, lag = 1.0 }\n"
    head = 'description = "bad"\nrobot = "snake13"\nduration_s = 2.0\n'
    (tmp_path / "bad.toml").write_text(f"{head}{rate}gait.ramp_s = 0.5\n{wave}{text}\n")
    path = tmp_path / "a.mcap"
    error = command("sim", "run", tmp_path / "bad.toml", "-o", path, code=1).err
    complaint = error.strip().removeprefix("error: ")
    match = re.match(r"the twin failed at (\d+\.\d+) s: (.*)(link|joint)\d\d ", complaint)
    assert match
    assert f"likely cause: {cause}" in complaint
    if name in ("gear", "rotor"):
        assert "the servo of joint03 turns at" in complaint
    with Session.open(path) as session:
        assert (session.verdict, session.warnings) == ("bad", [])
        assert [message.msg for _, message in session.messages("/rosout")][-1] == complaint
        angles = columns(session, "/joint_states")
        times = columns(session, "/energy_ledger").shape[0]
    # All samples from before the failure, none from after it, and all of them sound.
    assert times == math.floor(float(match[1]) * 100 - 1e-6) + 1
    assert np.abs(angles).max(initial=0.0) < np.pi


@pytest.mark.slow
def test_a_full_disk_leaves_nothing_and_no_traceback(disk_of):
    disk = disk_of("400k")
    done = undulog("sim", "run", "flat", "-o", disk / "run.mcap", "--duration", "60", code=1)
    assert re.search(r"run\.mcap.*No space left", done.stderr)
    assert "Traceback" not in done.stderr
    assert list(disk.iterdir()) == []


def test_nothing_is_overwritten_unasked(tmp_path, scenario):
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        sim.record(scenario, path)
    assert path.read_text() == "mine"
    assert sim.record(scenario.changed(duration_s=0.05), path, force=True).complete


def test_the_command_line_reports(tmp_path, command, report_of):
    path = tmp_path / "a.mcap"
    words = ("sim", "run", "flat", "-o", path, "--duration", "0.2")
    report = report_of(*words)
    assert (report["complete"], report["samples"], report["settle_s"]) == (True, 21, 0.2)
    assert set(report["energy_j"]) == set(TERMS)
    assert "give --force" in command(*words, code=2).err
    assert command(*words, "--force").out.startswith(f"{path}: 0.2 s of flat\n")
    assert "did you mean flat?" in command("sim", "run", "flt", "-o", "b.mcap", code=2).err
    command("sim", "run", "flat", "-o", "b.mcap", "--duration", "0", code=2)
    assert "name it b.mcap" in command("sim", "run", "flat", "-o", "b.csv", code=2).err


@pytest.mark.slow
def test_the_command_line_lists_the_scenarios(command, report_of):
    text = command("sim", "list").out
    listed = report_of("sim", "list")
    assert {"flat", "weak-servo-pi3"} <= {entry["name"] for entry in listed}
    for entry in listed:
        assert entry["name"] in text
        assert entry["description"] in text
