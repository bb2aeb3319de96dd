"""The ``[controller]`` table: read strictly, written back whole, and built into a gait."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.twin_runs import SNAKE13, SNAKE25, check_keys, faults_of
from undulog.sim import Readings, load_scenario, parse_scenario
from undulog.sim.scenario.motion import (
    Calibration,
    Controller,
    ControllerKind,
    HeadSteering,
    Lookout,
    RandomTurns,
    SideShrinking,
    TailHaste,
    TargetHeading,
)
from undulog.sim.twin.adaptive import build_gait

TARGET = "[world.target]\nposition = [3.0, 1.0]\n"
BASE = SNAKE25 + TARGET


def parsed(text):
    return parse_scenario(BASE + text, "x.toml")


@pytest.mark.parametrize("kind", list(ControllerKind))
def test_each_kind_has_its_parts_and_no_others(kind):
    controller = parsed(f'[controller]\nkind = "{kind}"').controller
    sides = kind in (ControllerKind.CORRIDOR, ControllerKind.AVOIDANCE)
    assert (controller.side is not None) == sides
    assert (controller.tail is not None) == (kind is ControllerKind.AVOIDANCE)
    courses = {"random-walk": RandomTurns(), "target-following": TargetHeading()}
    assert controller.course == courses.get(kind)
    for part in ("side", "tail", "course"):
        if getattr(controller, part) is None:
            text = f'[controller]\nkind = "{kind}"\n[controller.{part}]\n'
            assert f"controller.{part}" in faults_of(BASE + text)


POSITIVE = st.floats(1e-3, 1e3)
SHARE = st.floats(0.0, 1.0).map(lambda share: 0.0 if share < 1e-12 else share)


def some(part):
    """Any value of a part whose fields may all be any share."""
    return st.builds(part, **{field.name: SHARE for field in dataclasses.fields(part)})


@st.composite
def controllers(draw):
    kind = draw(st.sampled_from(ControllerKind))
    sides = kind in (ControllerKind.CORRIDOR, ControllerKind.AVOIDANCE)
    shortest_s = draw(POSITIVE)
    turns = st.builds(
        RandomTurns, SHARE, st.just(shortest_s), st.floats(shortest_s, 2 * shortest_s)
    )
    courses = {
        ControllerKind.RANDOM_WALK: turns,
        ControllerKind.TARGET_FOLLOWING: some(TargetHeading),
    }
    return Controller(
        kind=kind,
        near_hold_s=draw(SHARE),
        calibration=draw(st.builds(Calibration, POSITIVE, SHARE, SHARE)),
        lookout=draw(st.builds(Lookout, POSITIVE, SHARE)),
        head=draw(some(HeadSteering)),
        side=draw(some(SideShrinking)) if sides else None,
        tail=draw(some(TailHaste)) if kind is ControllerKind.AVOIDANCE else None,
        course=draw(courses.get(kind, st.none())),
    )


@pytest.mark.nightly
@given(controllers())
@settings(max_examples=40, deadline=None)  # each draws the robot from its file
def test_what_is_written_reads_the_same(controller):
    scenario = dataclasses.replace(parsed(""), controller=controller)
    again = parse_scenario(scenario.toml(), "x.toml")
    assert (again, again.session_id) == (scenario, scenario.session_id)
    assert again.session_id != parsed("").session_id


def test_all_faults_are_listed_at_once():
    text = """
[controller]
kind = "random-walk"
near_hold = 1.0
head.k = -1.0
lookout.half_width_m = 0.0
course = { shortest_s = 3.0, longest_s = 2.0 }
"""
    faults = faults_of(BASE + text)
    keys = "near_hold head.k lookout.half_width_m course.longest_s"
    check_keys(faults, " ".join(f"controller.{key}" for key in keys.split()))
    assert "did you mean near_hold_s?" in faults["controller.near_hold"]
    assert "at least shortest_s = 3" in faults["controller.course.longest_s"]
    assert "random-walk" in faults_of(f'{BASE}[controller]\nkind = "random"')["controller.kind"]


def test_a_controller_needs_its_sensors_its_target_and_a_horizontal_gait():
    follow = '[controller]\nkind = "target-following"'
    assert "[world.target]" in faults_of(SNAKE25 + follow)["controller.kind"]
    vertical = BASE.replace("gait.horizontal", "gait.vertical")
    assert "horizontal" in faults_of(vertical + follow)["controller.kind"]
    shown = faults_of(f'{SNAKE13}{TARGET}[controller]\nkind = "avoidance"')["controller.kind"]
    assert all(part in shown for part in ("looks ahead", "looks sideways", "snake13"))


@pytest.mark.parametrize("gait", ["flat", "delay-blocks", "oscillators"])
@pytest.mark.parametrize("kind", list(ControllerKind))
def test_every_controller_wraps_every_generator(gait, kind):
    controlled = parsed(f'[controller]\nkind = "{kind}"')
    scenario = dataclasses.replace(controlled, gait=load_scenario(gait).gait)
    assert "steer.offset" not in build_gait(dataclasses.replace(scenario, controller=None)).names
    wrapped, two = build_gait(scenario), build_gait(scenario)
    nothing = Readings.nothing(scenario.robot)
    for k in range(5):
        tick = wrapped.step(k / 100, nothing)
        np.testing.assert_array_equal(tick.values, two.step(k / 100, nothing).values)
        assert len(tick.values) == len(wrapped.names)
    assert "steer.offset" in wrapped.names


def test_the_target_is_measured_from_magnetic_north():
    """North a quarter turn to the left of x: a target ahead lies to the right of north."""
    text = '[controller]\nkind = "target-following"\n[sensing.compass]\nnorth = 1.5707963267948966'
    gait = build_gait(parsed(text))
    still = np.zeros(25)
    # The head looks along x, so a quarter turn to the right of north.
    field = {"compass": np.array([0.0, 2e-5, math.nan])}
    for k in range(3):
        tick = gait.step(k / 100, Readings(still, still, {}, {}, field))
    values = dict(zip(gait.names, tick.values, strict=True))
    assert values["course.heading"] == pytest.approx(-math.pi / 2, abs=1e-3)
    assert values["course.bearing"] == pytest.approx(math.atan2(1.0, 3.0) - math.pi / 2)


def test_shipped_controllers_of_the_paper():
    kinds = {
        name: load_scenario(name).controller.kind
        for name in ("random-walk", "target-following", "corridor", "avoidance")
    }
    assert kinds == {name: name for name in kinds}
    follow, walk = load_scenario("target-following"), load_scenario("random-walk")
    assert (follow.world, follow.gait) == (walk.world, walk.gait)
    assert len(follow.world.obstacles) == 4 + 10
