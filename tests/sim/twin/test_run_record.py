"""What a twin ran, in its session: kept by every edit, and the same facts as of its scenario."""

import dataclasses
import json

import pytest

import undulog
from support.twin_runs import SNAKE13
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.robot.run import RUN_RECORD
from undulog.sim import parse_scenario
from undulog.sim.twin.recording import record

SCENARIO = f"""
name = "changed"
settle_s = 2.0
gait.ramp_s = 1.0
{SNAKE13.replace("2.0", "7.0").replace("hz = 0.5", "hz = 1.0")}
[world]
heading = 0.4
[world.ground]
mu_tangential = 0.1
mu_normal = 0.6
[[world.obstacles]]
shape = "cylinder"
position = [3.0, 0.0]
radius = 0.1
[servo]
stall_torque = 0.9
[servo_of.joint03]
stall_torque = 0.2
[link_of.link05]
mass_factor = 1.5
"""


def ran(path, scenario, *, stated=True):
    """The session of a scenario; without the record, as it was written before there was one."""
    note = SessionWriter.note
    with pytest.MonkeyPatch.context() as patch:
        if not stated:
            patch.setattr(
                SessionWriter,
                "note",
                lambda self, name, facts: None if name == RUN_RECORD else note(self, name, facts),
            )
        record(scenario, path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    scenario = parse_scenario(SCENARIO, "changed.toml")
    for name, stated in (("new", True), ("old", False)):
        (folder / name).mkdir()
        ran(folder / name / "run.mcap", scenario, stated=stated)
        world = dataclasses.replace(scenario.world, ground=None, gravity=(0.0, 0.0, 0.0))
        free = dataclasses.replace(scenario, world=world)
        ran(folder / name / "free.mcap", free, stated=stated)
    return folder


def test_the_record_states_what_the_scenario_made_of_the_robot(folder):
    robot = parse_scenario(SCENARIO, "changed.toml").robot
    described = load_robot("snake13")
    with Session.open(folder / "new" / "run.mcap") as session:
        facts = session.metadata[RUN_RECORD]
        assert facts["contact_law"] == "ellipse"
        assert (facts["engine"], facts["kernels"]) == ("bullet", "numpy")
        assert json.loads(facts["servo.joint03"])["stall_torque_n_m"] == 0.2
        assert json.loads(facts["mass_factor"]) == {"link05": 1.5}
        assert session.robot.joints == described.joints
        assert session.robot_as_run.joints == robot.joints
        assert session.robot_as_run.links == robot.links
        assert session.run.start_heading_rad == 0.4
        assert session.run.drag_ratio == pytest.approx(6.0)
        assert session.run.physics_rate_hz == 1000
        assert session.run.contact
    with Session.open(folder / "new" / "free.mcap") as session:
        assert session.run.contact  # an obstacle
        assert session.run.drag_ratio is None
        assert "contact_law" not in session.metadata[RUN_RECORD]


@pytest.mark.parametrize("file", ["run.mcap", "free.mcap"])
def test_a_session_without_the_record_gives_the_same_facts(folder, file):
    with (
        Session.open(folder / "new" / file) as new,
        Session.open(folder / "old" / file) as old,
    ):
        assert RUN_RECORD not in old.metadata
        assert new.run == dataclasses.replace(old.run, servo_of=new.run.servo_of)
        assert new.robot_as_run == old.robot_as_run
        assert not old.warnings


def printed(folder, capsys, monkeypatch, *words):
    monkeypatch.chdir(folder)
    assert undulog.run([*words, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    result["provenance"].pop("inputs")  # the files differ
    return result


@pytest.mark.parametrize(
    "words",
    [("analyse", "run.mcap"), ("analyse", "free.mcap"), ("compare", "run.mcap", "free.mcap")],
)
def test_a_session_without_the_record_gives_the_same_numbers(folder, capsys, monkeypatch, words):
    new = printed(folder / "new", capsys, monkeypatch, *words)
    assert new == printed(folder / "old", capsys, monkeypatch, *words)


def test_every_edit_keeps_the_record(folder, tmp_path, capsys):
    run = folder / "new" / "run.mcap"
    halves = [str(tmp_path / name) for name in ("a.mcap", "b.mcap")]
    merged, recovered, broken = (tmp_path / name for name in ("m.mcap", "r.mcap", "x.mcap"))
    broken.write_bytes(run.read_bytes()[:-5000])
    for words in (
        ["cut", str(run), "--stop", "3", "-o", halves[0]],
        ["cut", str(run), "--start", "3", "-o", halves[1]],
        ["merge", *halves, "-o", str(merged)],
        ["recover", str(broken), "-o", str(recovered)],
    ):
        assert undulog.run(["log", *words]) == 0, words
    with Session.open(run) as session:
        told = session.run
        assert told is not None
    for path in (*halves, merged, recovered):
        with Session.open(path) as session:
            assert session.run == told
    capsys.readouterr()
    assert undulog.run(["log", "info", str(merged), "--json"]) == 0
    assert "servo.joint12" in json.loads(capsys.readouterr().out)["metadata"][RUN_RECORD]


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("physics_rate_hz", "0"),
        ("contact", "perhaps"),
        ("mass_factor", "[]"),
        ("servo.joint01", '{"stall_torque_n_m": 0.0}'),
        ("servo.joint01", '{"stall_torque_n_m": -Infinity}'),
        ("servo.joint01", "[" * 100_000),
        ("start_heading_rad", None),
    ],
)
def test_a_record_that_cant_be_used_is_reported_and_the_scenario_read(folder, tmp_path, key, text):
    with Session.open(folder / "new" / "run.mcap") as session:
        facts = {**session.metadata[RUN_RECORD], key: text}
        scenario, robot, told = session.attachments["scenario.toml"], session.robot, session.run
    path = tmp_path / "odd.mcap"
    with SessionWriter(path, session_id="odd", epoch_ns=10**18, robot=robot) as writer:
        writer.note(RUN_RECORD, {name: value for name, value in facts.items() if value is not None})
        writer.attach("scenario.toml", "application/toml", scenario)
        writer.string("/gait/mode").write(10**18, "walk")
    with Session.open(path) as session:
        assert session.run.drag_ratio == told.drag_ratio
        assert any(f"{RUN_RECORD} can't be used" in warning for warning in session.warnings)


def test_a_session_of_no_twin_has_no_such_facts(tmp_path):
    robot = load_robot("snake13")
    with SessionWriter(
        tmp_path / "real.mcap", session_id="s", epoch_ns=10**18, robot=robot
    ) as writer:
        writer.string("/gait/mode").write(10**18, "walk")
    with Session.open(tmp_path / "real.mcap") as session:
        assert session.run is None
        assert session.robot_as_run == session.robot
