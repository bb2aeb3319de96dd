"""What a twin ran, in its session: kept by every edit, and the same facts as of its scenario."""

import dataclasses
import json

import pytest

from support.twin_runs import SNAKE13
from support.written_sessions import write_commands
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.robot.run import RUN_RECORD
from undulog.sim import parse_scenario, record

pytestmark = pytest.mark.nightly

SCENARIO = f"""
name = "changed"
settle_s = 2.0
gait.ramp_s = 1.0
{SNAKE13.replace("2.0", "5.0").replace("hz = 0.5", "hz = 1.0")}
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

    def without(self, name, facts):
        return None if name == RUN_RECORD else note(self, name, facts)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SessionWriter, "note", note if stated else without)
        record(scenario, path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    scenario = parse_scenario(SCENARIO, "changed.toml")
    for name, stated in (("new", True), ("old", False)):
        (folder / name).mkdir()
        ran(folder / name / "run.mcap", scenario, stated=stated)
        world = dataclasses.replace(scenario.world, ground=None, gravity=(0.0, 0.0, 0.0))
        ran(folder / name / "free.mcap", dataclasses.replace(scenario, world=world), stated=stated)
    return folder


def test_the_record_states_what_the_scenario_made_of_the_robot(folder):
    robot = parse_scenario(SCENARIO, "changed.toml").robot
    described = load_robot("snake13")
    with Session.open(folder / "new" / "run.mcap") as session:
        facts, ran = session.metadata[RUN_RECORD], session.run
        made = facts["contact_law"], facts["engine"], facts["kernels"]
        assert made == ("ellipse", "bullet", "numpy")
        assert json.loads(facts["servo.joint03"])["stall_torque_n_m"] == 0.2
        assert json.loads(facts["mass_factor"]) == {"link05": 1.5}
        assert session.robot.joints == described.joints
        assert session.robot_as_run.joints == robot.joints
        assert session.robot_as_run.links == robot.links
        assert (ran.start_heading_rad, ran.physics_rate_hz, ran.contact) == (0.4, 1000, True)
        assert ran.drag_ratio == pytest.approx(6.0)
    with Session.open(folder / "new" / "free.mcap") as session:
        assert session.run.contact  # an obstacle
        assert session.run.drag_ratio is None
        assert "contact_law" not in session.metadata[RUN_RECORD]


@pytest.mark.parametrize("file", ["run.mcap", "free.mcap"])
def test_a_session_without_the_record_gives_the_same_facts(folder, file, opened):
    new, old = (opened(folder / name / file) for name in ("new", "old"))
    assert RUN_RECORD not in old.metadata
    assert new.run == dataclasses.replace(old.run, servo_of=new.run.servo_of)
    assert new.robot_as_run == old.robot_as_run
    assert not old.warnings


@pytest.mark.parametrize(
    "words",
    [("analyse", "run.mcap"), ("analyse", "free.mcap"), ("compare", "run.mcap", "free.mcap")],
)
def test_a_session_without_the_record_gives_the_same_numbers(folder, report_of, monkeypatch, words):
    results = []
    for name in ("new", "old"):
        monkeypatch.chdir(folder / name)
        results.append(report_of(*words))
        results[-1]["provenance"].pop("inputs")  # the files differ
    assert results[0] == results[1]


def test_every_edit_keeps_the_record(folder, tmp_path, command, report_of, opened):
    run = folder / "new" / "run.mcap"
    names = ("a.mcap", "b.mcap", "m.mcap", "r.mcap", "x.mcap")
    *halves, merged, recovered, broken = (tmp_path / name for name in names)
    broken.write_bytes(run.read_bytes()[:-5000])
    command("log", "cut", run, "--stop", "3", "-o", halves[0])
    command("log", "cut", run, "--start", "3", "-o", halves[1])
    command("log", "merge", *halves, "-o", merged)
    command("log", "recover", broken, "-o", recovered)
    facts = opened(run).run
    assert facts is not None
    for path in (*halves, merged, recovered):
        assert opened(path).run == facts
    assert "servo.joint12" in report_of("log", "info", merged)["metadata"][RUN_RECORD]


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
        scenario, robot, run = session.attachments["scenario.toml"], session.robot, session.run
    path = tmp_path / "odd.mcap"
    with SessionWriter(path, session_id="odd", epoch_ns=10**18, robot=robot) as writer:
        writer.note(RUN_RECORD, {name: value for name, value in facts.items() if value is not None})
        writer.attach("scenario.toml", "application/toml", scenario)
        writer.string("/gait/mode").write(10**18, "walk")
    with Session.open(path) as session:
        assert session.run.drag_ratio == run.drag_ratio
        assert any(f"{RUN_RECORD} can't be used" in warning for warning in session.warnings)


def test_a_session_of_no_twin_has_no_such_facts(tmp_path, opened):
    path = write_commands(tmp_path / "a.mcap", ["joint01"], [[0.0]], robot=load_robot("snake13"))
    session = opened(path)
    assert (session.run, session.robot_as_run) == (None, session.robot)
