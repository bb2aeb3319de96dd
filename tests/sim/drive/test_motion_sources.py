"""Motions by name: what a session, a plan or a scenario gives, and what is refused."""

import dataclasses
import math
import shutil

import numpy as np
import pytest

from support.twin_chains import chain
from undulog import sim
from undulog.capture import SessionWriter
from undulog.capture.common.errors import (
    DataError,
    InputFileError,
    JointSetError,
    MissingChannelError,
    UsageError,
)
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Plane
from undulog.sim.drive.dry_run import nominal_world
from undulog.sim.drive.motion import find_motion
from undulog.sim.drive.plan import PlanGait
from undulog.sim.drive.recorded_commands import CommandReplay
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.twin.adaptive import build_gait

ROBOT = parse_robot(chain(3), "chain.toml", {})
EPOCH_NS = 1_700_000_000_000_000_000
TEXTS = {"plan.toml": b"# plan", "gait.toml": b"# gait", "other.toml": b"# other"}


def written(path, *, robot=ROBOT, names=ROBOT.joint_names, texts=(), plan=None, gait=(), **facts):
    """Write a session of commands, 0.1 rad and more, over 50 ms."""
    clock = {"twin": "simulated"}
    with SessionWriter(
        path, session_id="s7", epoch_ns=EPOCH_NS, robot=robot, clock=clock, metadata=facts
    ) as writer:
        records = {"other": {"run": "9"}} | ({"undulog.plan": plan} if plan is not None else {})
        writer.explain(dict(texts), records)
        channel = writer.joint_state("/joint_commands", names, unit="rad")
        for tick in range(6):
            channel.write(EPOCH_NS + tick * 10_000_000, np.full(len(names), 0.1 + 0.01 * tick))
        if gait:
            writer.joint_state("/gait", gait, unit="1").write(EPOCH_NS, np.full(len(gait), 0.5))
            writer.string("/gait/mode").write(EPOCH_NS + 20_000_000, "turn")
        writer.set_verdict("good")
    return str(path)


# -- commands of a session ----------------------------------------------------------------------


def test_a_session_gives_its_commands_and_what_explains_them(tmp_path):
    plan = {"plan": "kicks", "run": "3", "heading_rad": "0.25"}
    facts = {"settle_s": "0.02", "kernels": "numba", "driven": "gait"}
    word = written(tmp_path / "a.mcap", texts=TEXTS, plan=plan, gait=("A", "b"), **facts)
    motion = find_motion(word)
    assert (motion.kind, motion.name, motion.robot, motion.origin) == (
        "commands",
        "a.mcap",
        ROBOT,
        None,
    )
    assert (motion.duration_s, motion.planes, motion.settle_s) == (0.05, (), 0.02)
    assert motion.facts == {
        "driven": "commands", "driven.by": "a.mcap", "driven.session_id": "s7",
    }  # fmt: skip
    assert motion.attachments == {"plan.toml": b"# plan", "gait.toml": b"# gait"}
    assert motion.records == {"undulog.plan": plan}
    assert (motion.kernels, motion.joints) == (Kernels.NUMBA, ROBOT.joint_names)
    assert (motion.heading_rad, motion.run, motion.as_run) == (0.25, 3, True)
    assert motion.world() is None
    gait = motion.make(ROBOT, None)
    assert type(gait) is CommandReplay
    tick = gait.step(0.03, sim.Readings.nothing(ROBOT))
    np.testing.assert_allclose(tick.command, 0.13)
    assert (gait.names, tick.values.tolist(), tick.mode) == (("A", "b"), [0.5, 0.5], "turn")


def test_of_a_session_that_says_little_nothing_is_made_up(tmp_path):
    motion = find_motion(written(tmp_path / "a.mcap", plan={"plan": "kicks", "run": "3"}))
    assert (motion.attachments, motion.settle_s, motion.kernels) == ({}, None, Kernels.NUMPY)
    # Without a heading the runs of a plan differ by their commands.
    assert (motion.heading_rad, motion.run, motion.as_run) == (0.0, 0, False)
    bare = find_motion(written(tmp_path / "b.mcap"))
    assert (bare.records, bare.run) == ({}, 0)
    tick = bare.make(ROBOT, None).step(0.0, sim.Readings.nothing(ROBOT))
    assert (tick.mode, tick.values.size) == ("replay", 0)


def test_the_robot_of_commands_is_the_one_given_that_of_the_world_or_its_own(tmp_path):
    word = written(tmp_path / "a.mcap")
    other, tall = (dataclasses.replace(ROBOT, name=name) for name in ("other", "tall"))
    world = nominal_world(tall)
    assert find_motion(word).robot.name == "chain3"
    assert find_motion(word, world).robot.name == "tall"
    assert find_motion(word, world, robot=other).robot.name == "other"
    assert find_motion(word, robot=other).robot.name == "other"
    nobodys = written(tmp_path / "b.mcap", robot=None)
    assert find_motion(nobodys, world).robot.name == "tall"
    with pytest.raises(DataError) as refused:
        find_motion(nobodys)
    assert str(refused.value) == (
        f"{nobodys}: the session has no robot; name one by its world, e.g. twin:flat, or, on a "
        "bus, by --robot"
    )


def test_commands_that_the_robot_can_not_do_are_refused_with_their_file(tmp_path):
    word = written(tmp_path / "a.mcap", names=("joint01", "hip"))
    with pytest.raises(JointSetError) as refused:
        find_motion(word)
    assert str(refused.value).startswith(
        f"{word}: /joint_commands has joints that chain3 lacks: hip; it commands joint01, hip; "
    )
    empty = tmp_path / "b.mcap"
    with SessionWriter(empty, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        channel = writer.joint_state("/joint_commands", ROBOT.joint_names, unit="rad")
        channel.write(EPOCH_NS, np.full(3, math.nan))
        writer.set_verdict("good")
    with pytest.raises(DataError) as refused:
        find_motion(str(empty))
    assert str(refused.value) == f"{empty}: /joint_commands holds no command"
    assert not isinstance(refused.value, JointSetError)
    for plan in ({"heading_rad": "nan"}, {"heading_rad": "0", "run": "-1"}):
        word = written(tmp_path / "c.mcap", plan=plan)
        with pytest.raises(DataError, match=r"of its plan is '(nan|-1)'; expected a number"):
            find_motion(word)
        (tmp_path / "c.mcap").unlink()


def test_the_world_of_a_run_is_the_one_that_it_had_changed_as_asked(tmp_path):
    ran = dataclasses.replace(nominal_world(ROBOT), seed=5)
    texts = {"scenario.toml": ran.toml().encode()}
    word = written(tmp_path / "a.mcap", texts=texts)
    motion = find_motion(word)
    world = motion.world()
    assert (world.robot, world.seed, world.world) == (ROBOT, 5, ran.world)
    assert motion.attachments == {}
    sloping = find_motion(word, changes={"world.slope": 0.1, "seed": 8}).world()
    assert (sloping.seed, sloping.world.gravity[0]) == (8, pytest.approx(9.81 * math.sin(0.1)))


def test_parts_in_a_folder_are_a_session_and_damage_is_told(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "flat"  # as a scenario is named, which comes first
    folder.mkdir()
    written(folder / "flat_0.mcap")
    monkeypatch.chdir(tmp_path)
    assert find_motion("flat").kind == "gait"
    shutil.copytree(folder, tmp_path / "night")
    motion = find_motion("night")
    assert (motion.kind, motion.name, motion.duration_s) == ("commands", "night", 0.05)
    assert capsys.readouterr().err == ""
    whole = (folder / "flat_0.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[:-50])
    assert find_motion(str(cut)).kind == "commands"
    assert capsys.readouterr().err.startswith(f"warning: {cut}: ")


def test_commands_may_have_another_topic_which_has_to_be_named(tmp_path):
    path = tmp_path / "a.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        channel = writer.joint_state("/wishes", ROBOT.joint_names, unit="rad")
        channel.write(EPOCH_NS, np.full(3, 0.25))
        writer.set_verdict("good")
    with pytest.raises(MissingChannelError, match="choose with --command-topic"):
        find_motion(str(path))
    motion = find_motion(str(path), command_topic="/wishes")
    tick = motion.make(ROBOT, None).step(0.0, sim.Readings.nothing(ROBOT))
    assert tick.command.tolist() == [0.25] * 3


# -- plans and scenarios ------------------------------------------------------------------------

PLAN = """
description = "d"
scenario = "flat"
[gait.horizontal]
amplitude = 0.1
frequency_hz = 0.5
lag = 0.5
[gait.vertical]
amplitude = 0.2
frequency_hz = 0.5
lag = 0.5
[[segments]]
duration_s = 0.75
"""


def test_a_plan_gives_its_text_its_planes_and_its_scenario(tmp_path):
    path = tmp_path / "bend.toml"
    path.write_text(PLAN)
    motion, flat = find_motion(str(path)), sim.load_scenario("flat")
    assert (motion.kind, motion.name, motion.duration_s) == ("plan", "bend", 0.75)
    assert (motion.planes, motion.robot) == ((Plane.HORIZONTAL, Plane.VERTICAL), flat.robot)
    assert (motion.world(), motion.origin, motion.settle_s) == (flat, None, None)
    assert motion.facts == {"driven": "plan", "driven.by": "bend"}
    assert motion.attachments == {"plan.toml": PLAN.encode()}
    gait = motion.make(ROBOT, nominal_world(ROBOT))  # it does not look at the world
    assert type(gait) is PlanGait
    assert len(gait.step(0.0, sim.Readings.nothing(ROBOT)).command) == 3


def test_a_scenarios_gait_is_that_of_the_world_it_is_driven_in():
    motion, flat = find_motion("flat"), sim.load_scenario("flat")
    assert motion.planes == tuple(flat.gait.planes)
    world = motion.scenario(sim.load_scenario("weak-servo-pi3"), None)
    faster = dataclasses.replace(flat.gait, ramp_s=0.25)
    for there in (world, dataclasses.replace(world, gait=faster)):
        made, expected = motion.make(there.robot, there), build_gait(there)
        nothing = sim.Readings.nothing(there.robot)
        for time_s in (0.0, 0.3):
            np.testing.assert_array_equal(
                made.step(time_s, nothing).command, expected.step(time_s, nothing).command
            )
    short = motion.make(ROBOT, None)  # without a world: its own, of that robot
    gait = build_gait(dataclasses.replace(flat, robot=ROBOT))
    nothing = sim.Readings.nothing(ROBOT)
    for time_s in (0.0, 0.3):
        np.testing.assert_array_equal(
            short.step(time_s, nothing).command, gait.step(time_s, nothing).command
        )


def test_what_is_neither_a_name_nor_a_file_is_refused(tmp_path):
    with pytest.raises(UsageError, match="did you mean flat"):
        find_motion("flt")
    with pytest.raises(InputFileError, match="no such file"):
        find_motion(str(tmp_path / "none.toml"))
