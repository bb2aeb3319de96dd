"""Driving the twin in process: gaits, plans, recorded commands, and the end on request."""

import dataclasses
import signal
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import undulog as front
from support.processes import UNDULOG, start, wait_for
from support.written_sessions import write_commands
from undulog import sim
from undulog.capture import Session
from undulog.capture.common.errors import DataError
from undulog.sim.drive.recorded_commands import CommandReplay, RecordedCommands

TOPICS = ("/joint_commands", "/joint_current", "/joint_voltage", "/gait", "/energy_ledger")
COLUMNS = (
    *(("/joint_states", field) for field in ("position", "velocity", "effort")),
    *((topic, "position") for topic in TOPICS),
)


def column_bytes(path):
    """All joint columns of a session with their times, as bytes."""
    with Session.open(path) as session:
        tables = [session.joints(topic, field) for topic, field in COLUMNS]
    return [
        (table.names, t_ns.tobytes(), values.tobytes())
        for table in tables
        for t_ns, values in zip(table.t_ns, table.values, strict=True)
    ]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A run of the twin by itself."""
    path = tmp_path_factory.mktemp("drive") / "plain.mcap"
    assert front.run(["sim", "run", "weak-servo-pi3", "-o", str(path), "--duration", "0.6"]) == 0
    return path


def test_driving_a_scenarios_gait_is_running_the_scenario(plain, tmp_path, report_of):
    path = tmp_path / "driven.mcap"
    words = ("drive", "weak-servo-pi3", "--on", "twin", "--duration", "0.6")
    report = report_of(*words, "-o", path)
    assert (report["kind"], report["on"]) == ("gait", "twin:weak-servo-pi3")
    assert (report["complete"], report["ticks"], report["duration_s"]) == (True, 61, 0.6)
    assert column_bytes(path) == column_bytes(plain)
    with Session.open(path) as session, Session.open(plain) as original:
        assert set(session.channels) == set(original.channels)
        assert session.session_id == report["session_id"] != original.session_id
        assert (session.metadata["undulog"]["driven"], session.verdict) == ("gait", "good")
        assert session.warnings == []


def test_recorded_commands_drive_the_same_run_bit_by_bit(plain, tmp_path, command):
    path = tmp_path / "again.mcap"
    words = ("drive", plain, "--on", "twin", "-o", path)
    assert f"{path}: drove plain.mcap for 0.6 s" in command(*words).out
    assert column_bytes(path) == column_bytes(plain)
    with Session.open(path) as session, Session.open(plain) as original:
        facts = session.metadata["undulog"]
        assert (facts["driven"], facts["driven.session_id"]) == ("commands", original.session_id)
        assert [m.data for _, m in session.messages("/gait/mode")] == ["walk"]
    first = path.read_bytes()
    command(*words, "--force")
    assert path.read_bytes() == first


def everything(path):
    """All messages of a session but events, by topic: times and bytes."""
    by_topic = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            by_topic[channel.topic].append((message.log_time, message.publish_time, message.data))
    del by_topic["/rosout"]
    return by_topic


# Among its logged values, target following has some that are not known yet.
MARKS = {
    "target-following": (),
    **dict.fromkeys(("corridor", "oscillators-feedback", "twist"), pytest.mark.slow),
}
"""The others, each a motion like one of these, are for the night."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=MARKS.get(name, pytest.mark.nightly))
        for name in sim.scenario_names()
    ],
)
def test_what_a_shipped_scenario_commanded_drives_it_again_bit_by_bit(name, tmp_path, command):
    path, again = tmp_path / "run.mcap", tmp_path / "again.mcap"
    command("sim", "run", name, "-o", path, "--duration", "0.5")
    command("drive", path, "--on", "twin", "-o", again)
    assert everything(again) == everything(path)


PLAN = """
description = "Faster, with a bend."
scenario = "flat"
[[segments]]
duration_s = 0.3
[[segments]]
duration_s = 0.4
transition_s = 0.2
mode = "turn"
horizontal = { offset = 0.1, frequency_hz = 1.0 }
"""


def test_a_plan_is_driven_and_kept_in_the_session(tmp_path, command, opened):
    plan, path = tmp_path / "bend.toml", tmp_path / "bend.mcap"
    plan.write_text(PLAN)
    shown = command("drive", plan, "--on", "twin", "-o", path).out.splitlines()
    assert shown[0] == f"{path}: drove bend for 0.7 s"
    assert shown[1].startswith("plan on the twin of snake25 in flat, 71 ticks")
    with Session.open(path) as session:
        assert session.attachments["plan.toml"].decode() == PLAN
        facts = session.metadata["undulog"]
        assert (facts["driven"], facts["driven.by"]) == ("plan", "bend")
        omega = session.joints("/gait").signal("horizontal.omega").values
        assert omega[[0, 29, 50, 70]] == pytest.approx([np.pi, np.pi, 2 * np.pi, 2 * np.pi])
        modes = [(t_ns - session.start_ns, m.data) for t_ns, m in session.messages("/gait/mode")]
        assert modes == [(0, "walk"), (300_000_000, "turn")]
    again = tmp_path / "again.mcap"
    command("drive", path, "--on", "twin", "-o", again)
    assert column_bytes(again) == column_bytes(path)
    # What the commands were made from:
    assert opened(again).attachments["plan.toml"].decode() == PLAN


@pytest.mark.slow
def test_several_motions_are_driven_into_a_folder(plain, tmp_path, command, report_of):
    """Each under its own name, the same as alone; a table says what came of each."""
    folder, alone = tmp_path / "driven", tmp_path / "alone.mcap"
    plan = tmp_path / "bend.toml"
    plan.write_text(PLAN)
    drive = ("drive", plain, plan, "--on", "twin", "-o", folder)
    report = report_of(*drive)
    assert [drive["driven"] for drive in report] == ["plain.mcap", "bend"]
    assert sorted(file.name for file in folder.iterdir()) == ["bend.mcap", "plain.mcap"]
    for what, output in ((plain, folder / "plain.mcap"), (plan, folder / "bend.mcap")):
        command("drive", what, "--on", "twin", "-o", alone, "--force")
        assert output.read_bytes() == alone.read_bytes()
    assert "plain.mcap exists already" in command(*drive, code=2).err
    (folder / "broken.mcap").write_bytes(b"no session")
    out = command("drive", folder, "--on", "twin", "-o", tmp_path / "again", code=1).out
    names = ["bend.mcap", "broken.mcap", "plain.mcap"]
    assert [Path(line.split()[0]).name for line in out.splitlines()[1:]] == names
    assert sorted(file.name for file in (tmp_path / "again").iterdir()) == [
        "bend.mcap",
        "plain.mcap",
    ]


def test_a_log_that_is_cut_short_is_driven_with_a_warning(plain, tmp_path, command):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(plain.read_bytes()[:-100])
    err = command("drive", cut, "--on", "twin", "-o", tmp_path / "again.mcap").err
    assert f"warning: {cut}: " in err
    assert "cut short" in err


def test_several_motions_never_share_a_session(plain, tmp_path, command):
    copy = tmp_path / "copy" / "plain.mcap"
    copy.parent.mkdir()
    copy.write_bytes(plain.read_bytes())
    drive = ("drive", plain, copy, "--on", "twin")
    assert "replace another session" in command(*drive, "-o", tmp_path / "a", code=2).err
    words = ("drive", copy, "flat", "--on", "twin", "-o", copy.parent, "--force")
    assert "replace another session" in command(*words, code=2).err
    assert copy.read_bytes() == plain.read_bytes()
    assert "name a folder for them" in command(*drive, code=2).err
    assert "name a folder for them" in command(*drive, "-o", tmp_path / "a.mcap", code=2).err


def test_a_gait_can_be_driven_in_another_world(tmp_path, command):
    path = tmp_path / "a.mcap"
    words = ["drive", "flat", "--on", "twin:weak-servo-pi3", "-o", str(path), "--duration", "0.1"]
    command(*words)
    with Session.open(path) as session:
        assert "stall_torque = 0.25" in session.attachments["scenario.toml"].decode()
        assert session.metadata["undulog"]["driven.by"] == "flat"
    vertical = ["drive", "snake13-vertical-pi3", "--on", "twin:flat", "--duration", "0.1"]
    command(*vertical, "-o", tmp_path / "b.mcap")
    words = ["drive", "flat", "--on", "twin:nowhere", "-o", str(tmp_path / "c.mcap")]
    assert "no scenario 'nowhere'" in command(*words, code=2).err


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGTERM, marks=pytest.mark.nightly), signal.SIGINT]
)
def test_asked_to_stop_it_comes_to_rest_first(tmp_path, number, request):
    path = tmp_path / "stopped.mcap"
    process = start(*UNDULOG, "drive", "flat", "--on", "twin", "-o", path, "--duration", "3600")
    request.addfinalizer(process.kill)
    unfinished = tmp_path / "stopped.mcap.part"
    wait_for(lambda: unfinished.exists() and unfinished.stat().st_size > 200_000, alive=[process])
    process.send_signal(number)
    shown, complained = process.communicate()
    assert (process.returncode, complained) == (0, "")
    assert shown.startswith("stopped at rest at ")
    with Session.open(path) as session:
        assert (session.verdict, session.warnings) == ("good", [])
        commands = np.array(session.joints("/joint_commands").values)
        modes = [(t_ns - session.start_ns, m.data) for t_ns, m in session.messages("/gait/mode")]
        notes = [message.msg for _, message in session.messages("/rosout")]
    assert notes[-1].endswith("of 3600 s: it was stopped")
    assert [mode for _, mode in modes] == ["walk", "stop"]
    assert not commands[:, -1].any()
    begun = modes[1][0] // 10_000_000
    assert commands.shape[1] - 1 - begun == 100  # within a second of robot's time
    # Smooth: no step is larger than that of the gait plus that of the fade, A (omega + S'max / T).
    assert np.abs(np.diff(commands[:, begun - 1 :])).max() <= 0.4 * (np.pi + 1.5) * 0.01


def written(path, rows, names=("joint01", "joint02")):
    """A session of commands: (time [ns], values) for each message."""
    times_ns, commands = zip(*rows, strict=True)
    write_commands(path, names, commands, times_ns=times_ns)
    with Session.open(path) as session:
        return RecordedCommands.read(session)


def test_each_joint_holds_its_newest_command(tmp_path, make_robot):
    robot = make_robot(4)
    rows = [
        (0, (np.nan, 0.1)),
        (4_000_000, (0.2, np.nan)),
        (20_000_000, (0.3, 9.0)),
        (25_000_000, (-0.1, np.nan)),
    ]
    replay = CommandReplay(written(tmp_path / "a.mcap", rows), robot)
    assert (replay.names, replay.duration_s) == ((), 0.03)
    ticks = [replay.step(k / 100, sim.Readings.nothing(robot)) for k in range(5)]
    limit = robot.joints[1].upper
    assert [tick.command.tolist() for tick in ticks] == [
        [0.2, 0.1, 0.0],  # a joint without a command yet has its first one
        [0.2, 0.1, 0.0],
        [0.3, limit, 0.0],
        [-0.1, limit, 0.0],
        [-0.1, limit, 0.0],
    ]
    assert [tick.clamped for tick in ticks] == [(), (), *3 * [("joint02",)]]
    assert {tick.mode for tick in ticks} == {"replay"}


def test_commands_without_a_gait_give_a_session_without_one(tmp_path, command):
    source = tmp_path / "given.mcap"
    written(source, [(0, (0.0, 0.0)), (50_000_000, (0.1, 0.0))])
    words = ("drive", source, "-o", tmp_path / "a.mcap", "--on")
    assert "name one by its world" in command(*words, "twin", code=1).err
    command(*words, "twin:flat")
    with Session.open(tmp_path / "a.mcap") as session:
        assert "/gait" not in session.channels
        given = session.joints("/joint_commands").signal("joint01").values.tolist()
        assert given == [*[0.0] * 5, 0.1]


def test_what_planned_commands_are_for_goes_on_to_the_run(tmp_path, command):
    plan, commands = {"plan": "phase-kicks", "run": "3"}, [(0.01 * k,) for k in range(11)]
    source, path = tmp_path / "planned.mcap", tmp_path / "run.mcap"
    write_commands(source, ["joint01"], commands, plan=plan, metadata={"settle_s": "0.04"})
    command("drive", source, "--on", "twin:flat", "-o", path)
    with Session.open(path) as session:
        assert (session.metadata["undulog.plan"], session.settle_s) == (plan, 0.04)
        assert "settled: 0.04 s have passed" in [m.msg for _, m in session.messages("/rosout")]


def planned_commands(path, **plan):
    commands = [(0.01 * k,) for k in range(3)]
    return write_commands(path, ("joint01",), commands, plan={"plan": "reversal", **plan})


def test_a_plan_turns_the_robot_and_gives_each_run_noise_of_its_own(tmp_path, command):
    source = planned_commands(tmp_path / "planned.mcap", run="3", heading_rad="3.141593")
    world = tmp_path / "sloping.toml"
    flat = sim.load_scenario("flat", {"world.slope": 0.02, "world.heading": 0.5})
    flat = dataclasses.replace(flat, world=dataclasses.replace(flat.world, velocity=(0.1, 0.2, 0)))
    world.write_text(flat.toml())
    path, again = tmp_path / "run.mcap", tmp_path / "again.mcap"
    command("drive", source, "--on", f"twin:{world}", "-o", path)
    # Driven again in the world of the run, which is turned already.
    command("drive", path, "--on", "twin", "-o", again)
    positions = []
    for output in (path, again):
        with Session.open(output) as session:
            ran = sim.parse_scenario(
                session.attachments["scenario.toml"].decode(), "s", session.robot
            )
            assert session.metadata["undulog.plan"]["heading_rad"] == "3.141593"
            pose = session.table("/odom").iloc[0]
            positions.append(session.joints("/joint_states").signal("joint01").values)
        assert ran.world.heading == pytest.approx(0.5 + np.pi, abs=1e-6)
        assert ran.world.velocity == pytest.approx((-0.1, -0.2, 0), abs=1e-6)
        assert (ran.world.gravity, ran.seed) == (flat.world.gravity, flat.seed + 3)
        yaw = 2 * np.arctan2(pose["pose.pose.orientation.z"], pose["pose.pose.orientation.w"])
        assert np.exp(1j * yaw) == pytest.approx(np.exp(1j * (0.5 + np.pi)), abs=1e-6)
    np.testing.assert_array_equal(*positions)


@pytest.mark.parametrize(("key", "value"), [("heading_rad", "north"), ("run", "-1")])
def test_a_senseless_plan_is_refused(tmp_path, command, key, value):
    source = planned_commands(tmp_path / "planned.mcap", **{"heading_rad": "0", key: value})
    path = tmp_path / "run.mcap"
    err = command("drive", source, "--on", "twin:flat", "-o", path, code=1).err
    assert f"{key} of its plan is '{value}'" in err
    assert not path.exists()


def test_a_slope_can_be_set(tmp_path, command, opened):
    path = tmp_path / "run.mcap"
    words = ["sim", "run", "weak-servo-pi3", "-o", str(path), "--duration", "0.02"]
    command(*words, "--set", "world.slope=0.1", "--set", "world.heading=1.5")
    text = opened(path).attachments["scenario.toml"].decode()
    # The run's scenario has its gravity written out; a slope takes its place.
    for changes, fall in (({}, 0.1), ({"world.slope": 0.2}, 0.2)):
        world = sim.parse_scenario(text, "s", changes=changes).world
        assert world.gravity == pytest.approx((9.81 * np.sin(fall), 0, -9.81 * np.cos(fall)))
        assert world.heading == 1.5
    command(*words, "--force", "--set", "world.slope", code=2)


@pytest.mark.parametrize("stated", ["soon", "-1", "inf", "nan"])
def test_a_senseless_settling_time_is_none(tmp_path, stated, opened):
    facts = {"settle_s": stated}
    path = write_commands(tmp_path / "a.mcap", ("joint01",), [(0.0,)], metadata=facts)
    assert opened(path).settle_s is None


def test_commands_of_another_robot_are_refused(tmp_path, make_robot):
    recorded = written(tmp_path / "a.mcap", [(0, (0.0, 0.0))], names=("joint01", "hip"))
    with pytest.raises(DataError, match="chain lacks: hip"):
        CommandReplay(recorded, make_robot(4))
    recorded = written(tmp_path / "b.mcap", [(0, (np.nan, np.nan))])
    with pytest.raises(DataError, match="no command"):
        CommandReplay(recorded, make_robot(4))
