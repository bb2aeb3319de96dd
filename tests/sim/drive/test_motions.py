"""Motions: the world that one is driven in, and the robots that it fits."""

import dataclasses

import pytest

from support.twin_chains import chain
from undulog import sim
from undulog.capture import load_robot
from undulog.capture.common.errors import DataError, JointSetError, UsageError
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Plane
from undulog.sim.drive.motion import (
    MotionSource,
    _kernels,
    _planned,
    find_motion,
)
from undulog.sim.scenario.scenario import Kernels

ROBOT = parse_robot(chain(3), "chain.toml", {})
LEVEL = tuple(dataclasses.replace(joint, plane=Plane.HORIZONTAL) for joint in ROBOT.joints)
LEVEL = dataclasses.replace(ROBOT, name="level", joints=LEVEL)


def source(**more):
    values = {
        "kind": "commands", "name": "wave.mcap", "robot": ROBOT, "world": lambda: None,
        "duration_s": 1.5, "planes": (), "make": lambda robot, world: (robot, world),
        "facts": {}, "attachments": {},
    }  # fmt: skip
    return MotionSource(**(values | more))


def test_a_robot_has_to_have_its_joints_and_planes():
    source().check_fits(ROBOT)
    source(joints=tuple(reversed(ROBOT.joint_names))).check_fits(ROBOT)  # in any order
    with pytest.raises(JointSetError) as refused:
        source(joints=("joint01", "hip")).check_fits(ROBOT)
    assert str(refused.value) == (
        "wave.mcap is of another joint set than chain3; nothing was sent\n"
        "  it commands 2 joints: joint01, hip\n"
        "  chain3 has 3: joint01, joint02, joint03"
    )
    with pytest.raises(JointSetError):
        source(joints=ROBOT.joint_names[:2]).check_fits(ROBOT)
    source(planes=(Plane.HORIZONTAL,)).check_fits(load_robot("snake25"))
    with pytest.raises(UsageError) as refused:
        source(planes=(Plane.HORIZONTAL, Plane.VERTICAL)).check_fits(LEVEL)
    assert str(refused.value) == (
        "wave.mcap moves vertical joints, and level has none; nothing was sent"
    )


def test_the_scenario_of_a_run_is_its_world_with_what_the_motion_says():
    flat = sim.load_scenario("flat")
    made = source(world=lambda: flat, settle_s=0.7).scenario(None, None)
    assert (made.duration_s, made.settle_s, made.seed) == (1.5, 0.7, flat.seed)
    assert made.world == flat.world
    assert source(world=lambda: flat).scenario(None, 2.5).duration_s == 2.5
    assert source().scenario(flat, 60.0).settle_s == flat.settle_s
    with pytest.raises(UsageError, match="mcap does not name the world it ran in; name one"):
        source().scenario(None, None)
    turning = source(world=lambda: flat, heading_rad=0.5, run=3)
    for world in (None, flat):
        made = turning.scenario(world, None)
        assert made.world.heading == pytest.approx(flat.world.heading + 0.5)
        assert made.seed == flat.seed + 3
    taken = dataclasses.replace(turning, as_run=True)  # its world has that already
    assert taken.scenario(None, None).seed == flat.seed
    assert taken.scenario(None, None).world == flat.world
    assert taken.scenario(flat, None).seed == flat.seed + 3


def test_a_gait_goes_with_its_controller_to_another_world():
    flat, weak = sim.load_scenario("flat"), sim.load_scenario("weak-servo-pi3")
    made = source(origin=weak).scenario(flat, None)
    assert (made.gait, made.controller) == (weak.gait, weak.controller)
    assert (made.robot, made.name) == (flat.robot, flat.name)
    with pytest.raises(UsageError) as refused:
        source(planes=(Plane.VERTICAL,)).scenario(dataclasses.replace(flat, robot=LEVEL), None)
    assert str(refused.value) == "wave.mcap moves vertical joints and level of flat has none"


def test_a_shipped_gait_is_found_with_its_scenario():
    motion, flat = find_motion("flat"), sim.load_scenario("flat")
    assert (motion.kind, motion.name, motion.origin, motion.world()) == ("gait", "flat", flat, flat)
    assert (motion.duration_s, motion.settle_s) == (flat.duration_s, flat.settle_s)
    assert motion.facts == {"driven": "gait", "driven.by": "flat"}
    assert motion.attachments == {"gait.toml": flat.toml().encode()}
    assert (motion.run, motion.heading_rad, motion.as_run, motion.joints) == (0, 0.0, False, None)
    assert motion.kernels is Kernels.NUMPY
    made = motion.make(flat.robot, None)
    assert len(made.step(0.0, sim.Readings.nothing(flat.robot)).command) == len(flat.robot.joints)


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [("0.5", float, 0.5), ("-0.5", float, -0.5), ("3", int, 3), ("0", int, 0)],
)
def test_a_number_of_a_plan_is_read(text, kind, value):
    meta = {"undulog.plan": {"number": text}}
    assert _planned(meta, "number", kind, "a.mcap") == value
    assert _planned({}, "number", kind, "a.mcap") == 0


@pytest.mark.parametrize(
    ("text", "kind"), [("x", float), ("nan", float), ("inf", float), ("-1", int), ("1.5", int)]
)
def test_a_number_of_a_plan_that_is_none_is_refused(text, kind):
    meta = {"undulog.plan": {"number": text}}
    with pytest.raises(DataError) as refused:
        _planned(meta, "number", kind, "a.mcap")
    assert str(refused.value) == f"a.mcap: number of its plan is {text!r}; expected a number"


def test_kernels_that_nobody_knows_are_the_usual_ones():
    assert [_kernels(name) for name in ("numpy", None, "other")] == [Kernels.NUMPY] * 3
    assert {_kernels(str(kind)) for kind in Kernels} == set(Kernels)
