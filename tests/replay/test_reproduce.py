"""Experiments run again in the twin: bit by bit, and from when on a change matters."""

import json

import numpy as np
import pytest

import undulog as front
from support.twin_chains import chain, wave
from support.written_topics import write_topics
from undulog.capture import Session, SessionWriter
from undulog.replay.reproduce import compare_logs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A run of a robot whose file is gone by the time that it is run again."""
    folder = tmp_path_factory.mktemp("again")
    (folder / "chain.toml").write_text(chain(5, planes=["horizontal"]))
    run = {"duration_s": 3.5, "settle_s": 1.0, "physics_rate_hz": 4000, "gait": {"ramp_s": 0.5}}
    world = wave(**run, horizontal={"lag": 1.0}, noise={"position": 0.001})
    (folder / "wave.toml").write_text(world)
    assert front.run(["sim", "run", str(folder / "wave.toml"), "-o", str(folder / "run.mcap")]) == 0
    (folder / "chain.toml").unlink()
    return folder


def again(room, output, *words, source="run.mcap", code=0):
    command = ["replay", str(room / source), "--on", "twin", "-o", str(output), *words]
    assert front.run(command) == code
    return output


def test_in_its_own_world_a_run_is_the_same_to_the_last_bit(room, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    again(room, path, code=2)
    assert "--force" in capsys.readouterr().err
    assert path.read_text() == "mine"
    again(room, path, "--force")
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith(f"{path}: run.mcap again on the twin of chain5 in wave, 3.5 s")
    assert printed[1].startswith("The same to the last bit: all ")
    both = f"{room / 'run.mcap'} {path}"
    assert printed[2:] == [f"Next: undulog view {both}", f"      undulog compare {both}"]
    with Session.open(path) as session, Session.open(room / "run.mcap") as first:
        assert session.metadata["undulog"]["driven.session_id"] == first.session_id
        assert session.settle_s == first.settle_s == 1.0
        topics = [topic for topic in first.channels if topic != "/rosout"]
        messages = sum(first.channels[topic].count for topic in topics)
    again(room, tmp_path / "b.mcap", "--json")
    report = json.loads(capsys.readouterr().out)
    assert (report["exact"], report["differs_s"], report["one_sided"]) == (True, {}, [])
    assert f"all {messages} messages on {len(topics)} topics" in printed[1]


@pytest.mark.nightly
def test_what_was_changed_is_named_with_intervals(room, tmp_path, capsys, opened):
    change = "servo_of.joint02.stall_torque=0.1"
    path = again(room, tmp_path / "weak.mcap", "--set", change, "--json")
    report = json.loads(capsys.readouterr().out)
    assert not report["exact"]
    assert report["changes"] == {"servo_of.joint02.stall_torque": 0.1}
    changed = report["comparison"]["changed"]
    expected = {"name": "scenario.toml: servo_of.joint02.stall_torque", "a": None, "b": "0.1"}
    assert expected in changed
    differences = report["comparison"]["differences"]
    named = {
        (difference["place"], difference["quantity"]): difference["difference"]
        for difference in differences
    }
    low, high = named["joint02", "lag"]["ci95"]
    assert 0.0 < low < high  # a weak servo lags
    again(room, tmp_path / "weak.mcap", "--set", change, "--force")
    printed = capsys.readouterr().out
    assert "Differs: " in printed
    assert "/joint_commands" not in printed.partition("\n\n")[0]
    assert "B differs from A: joint02 most" in printed
    assert "servo_of.joint02" in opened(path).attachments["scenario.toml"].decode()


@pytest.fixture(scope="module")
def commands(room):
    """Sessions of commands alone: those of the run, and with one of them 1e-3 rad larger."""
    with Session.open(room / "run.mcap") as session:
        joints, robot = session.joints("/joint_commands"), session.robot
        world = session.attachments["scenario.toml"]
    values = np.array(joints.values).T
    altered = values.copy()
    altered[200, 3] += 1e-3
    facts = {"epoch_ns": int(joints.t_ns[0][0]), "robot": robot}
    facts["begin"] = lambda writer: writer.attach("scenario.toml", "application/toml", world)
    for name, rows in (("plain", values), ("altered", altered)):
        topics = {"/joint_commands": (joints.names, "rad", rows)}
        write_topics(room / f"{name}.mcap", joints.t_ns[0], topics, **facts)
    return room


@pytest.mark.nightly
def test_one_altered_command_changes_what_comes_after_it_alone(commands, tmp_path, capsys):
    plain = again(commands, tmp_path / "plain.mcap", source="plain.mcap")
    printed = capsys.readouterr().out
    assert "plain.mcap has commands and no response" in printed
    assert printed.endswith(f"\nNext: undulog view {commands / 'plain.mcap'} {plain}\n")
    comparison = compare_logs(
        plain, again(commands, tmp_path / "altered.mcap", source="altered.mcap")
    )
    assert comparison.differs_s["/joint_commands"] == pytest.approx(2.0)
    # The command acts from its tick on; states of that period arrive two ticks later.
    for topic in ("/odom", "/energy_ledger", "/joint_states"):
        assert 2.0 < comparison.differs_s[topic] <= 2.05, topic
    assert comparison.one_sided == ()
    run = compare_logs(commands / "run.mcap", plain)
    assert set(run.differs_s) == {"/gait/mode"}  # the commands are all that drives it
    assert run.one_sided == ("/gait",)


def test_a_message_that_only_one_has_is_a_difference(tmp_path):
    for name, count in (("one", 3), ("two", 4)):
        with SessionWriter(tmp_path / f"{name}.mcap", session_id="s", epoch_ns=10**18) as writer:
            channel = writer.string("/mode")
            for k in range(count):
                channel.write(10**18 + k * 10**9, "walk")
    comparison = compare_logs(tmp_path / "one.mcap", tmp_path / "two.mcap")
    assert (comparison.exact, comparison.differs_s, comparison.messages) == (
        False,
        {"/mode": 3.0},
        3,
    )


def test_a_run_too_short_to_compare_says_so(room, tmp_path, capsys):
    again(room, tmp_path / "a.mcap", "--duration", "0.5", "--set", "servo.stall_torque=0.3")
    assert "Not compared: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("servo.stall_torqe=1", "did you mean stall_torque"),
        ("duration_s.x=1", "duration_s.x: found a part of what is no table"),
        ("engine=mujco", "mujoco"),
        ("servo.stall_torque", "expected KEY=VALUE"),
        ("=3", "expected KEY=VALUE"),
    ],
)
def test_a_wrong_change_names_the_key(room, tmp_path, capsys, change, message):
    again(room, tmp_path / "a.mcap", "--set", change, code=2 if "KEY" in message else 1)
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--on cam:socketcan:can0 -o a.mcap", "expected twin, twin:SCENARIO or can:"),
        ("--on can:virtual:x -o a.mcap --set engine=mujoco", "on a bus the world is as it is"),
        ("--on can:virtual:x --arm", "name the session with -o"),
        ("--on twin -o a.mcap --arm", "are for a bus"),
        ("--on twin", "name the session with -o"),
        ("--on twin: -o a.mcap", "names no scenario"),
        ("--on twin:flatt -o a.mcap", "did you mean flat"),
        ("--on twin -o a.json", "name it"),
    ],
)
def test_wrong_usage_says_what_would_be_right(room, words, message, command):
    assert message in command("replay", room / "run.mcap", *words.split(), code=2).err
