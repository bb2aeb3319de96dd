"""Plans against the closed form of their transitions, and their files."""

import math
from pathlib import Path

import numpy as np
import pytest

from support.paths import DOCS
from support.twin_runs import check_keys
from undulog.capture.common.errors import PlanError
from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, Serpentine, SerpentineGait, load_scenario
from undulog.sim.drive.plan import Plan, PlanGait, PlanSegment, is_plan, parse_plan

H, V = Plane.HORIZONTAL, Plane.VERTICAL
SLOW = PlaneGait(0.2, 0.5, 0.6)


@pytest.fixture
def make_plan(make_scenario):
    def build(*segments, start=None, ramp_s=0.0):
        start = start or {H: SLOW}
        return Plan("test", "a test", make_scenario(), start, ramp_s, segments)

    return build


def ran(gait, robot, seconds):
    """What a gait says at every tick: times, commands, values by name, modes."""
    times = np.arange(round(seconds * 100) + 1) / 100
    ticks = [gait.step(t, Readings.nothing(robot)) for t in times]
    values = dict(zip(gait.names, np.array([tick.values for tick in ticks]).T, strict=True))
    return times, np.array([tick.command for tick in ticks]), values, [tick.mode for tick in ticks]


def test_a_plan_that_changes_nothing_is_the_gait_itself(make_plan, make_robot):
    robot = make_robot()
    planes = {H: SLOW, V: PlaneGait(0.1, 0.7, 0.3, offset=0.05, phase=1.0)}
    same = PlanSegment(1.0, {**planes}), PlanSegment(2.0, {**planes})
    plan = PlanGait(make_plan(*same, start=planes, ramp_s=2.0), robot)
    _, planned, _, _ = ran(plan, robot, 3.5)
    _, expected, _, _ = ran(SerpentineGait(Serpentine(planes, 2.0), robot), robot, 3.5)
    np.testing.assert_array_equal(planned, expected)


def test_values_follow_the_smooth_step(make_plan, make_robot):
    robot = make_robot()
    after = PlaneGait(0.4, 1.5, 0.2, wave="tail-to-head", offset=0.1)
    plan = make_plan(PlanSegment(1.0, {H: SLOW}), PlanSegment(3.0, {H: after}, 2.0, "turn"))
    times, _, values, modes = ran(PlanGait(plan, robot), robot, 5.0)
    x = np.clip((times - 1.0) / 2.0, 0.0, 1.0)
    share = 3 * x**2 - 2 * x**3
    changes = {"A": (0.2, 0.4), "omega": (np.pi, 3 * np.pi), "lag": (-0.6, 0.2)}
    for name, (before, then) in {**changes, "offset": (0.0, 0.1)}.items():
        expected = before + (then - before) * share
        np.testing.assert_allclose(values[f"horizontal.{name}"], expected, atol=1e-12)
    assert modes == ["walk"] * 100 + ["turn"] * 401


def test_the_phase_is_the_integral_of_omega_and_never_jumps(make_plan, make_robot):
    robot = make_robot()
    plan = make_plan(
        PlanSegment(1.0, {H: SLOW}), PlanSegment(3.0, {H: PlaneGait(0.2, 1.5, 0.6)}, 2.0)
    )
    times, _, values, _ = ran(PlanGait(plan, robot), robot, 4.0)
    phase = values["horizontal.phase"]
    # Integral of S is x^3 - x^4 / 2. Held from tick to tick, omega is the left Riemann sum: with
    # S(x) + S(1 - x) = 1 that falls short of the integral by half a tick of the change in all.
    x = np.clip((times - 1.0) / 2.0, 0.0, 1.0)
    closed = np.pi * times + 2 * np.pi * (2.0 * (x**3 - x**4 / 2) + np.maximum(times - 3.0, 0.0))
    short = 2 * np.pi * 0.005
    assert phase[-1] == pytest.approx(closed[-1] - short, abs=1e-9)
    assert np.abs(phase - closed).max() <= short * (1 + 1e-9)
    assert np.diff(phase).max() <= 3 * np.pi * 0.01 + 1e-12


def test_commands_are_as_smooth_as_the_gaits_on_both_sides(make_plan, make_robot):
    robot = make_robot(planar=True)
    far = PlaneGait(0.4, 1.0, 1.2, wave="tail-to-head", offset=0.1)
    plan = make_plan(PlanSegment(2.0, {H: SLOW}), PlanSegment(4.0, {H: far}, 3.0))
    _, command, _, _ = ran(PlanGait(plan, robot), robot, 6.0)
    # |dq/dt| <= A' + Y' + A (omega + (m - 1) lag'), with S' <= 3 / (2 T).
    steepest = 1.5 / 3.0
    bound = steepest * (0.2 + 0.1) + 0.4 * (2 * np.pi + 24 * steepest * 1.8)
    assert np.abs(np.diff(command, axis=0)).max() <= bound * 0.01


def test_a_jump_of_the_values_leaves_the_phase_alone(make_plan, make_robot):
    robot = make_robot()
    plan = make_plan(
        PlanSegment(1.0, {H: SLOW}), PlanSegment(1.0, {H: PlaneGait(0.2, 1.0, 0.6)}, 0.0)
    )
    _, command, values, _ = ran(PlanGait(plan, robot), robot, 2.0)
    assert values["horizontal.omega"][99:101].tolist() == [np.pi, 2 * np.pi]
    assert values["horizontal.phase"][100] == pytest.approx(np.pi)
    assert values["horizontal.phase"][200] == pytest.approx(3 * np.pi)
    assert np.abs(np.diff(command, axis=0)).max() <= 0.2 * 2 * np.pi * 0.01


PLAN = """
description = "Faster, then the other way."
scenario = "flat"

[gait]
ramp_s = 1.0
[gait.horizontal]
amplitude = 0.3
frequency_hz = 0.5
lag = 0.5

[[segments]]
duration_s = 6.0

[[segments]]
duration_s = 10.0
transition_s = 2.0
mode = "fast"
horizontal = { frequency_hz = 0.8, amplitude = 0.2 }

[[segments]]
duration_s = 0.5
horizontal = { wave = "tail-to-head", offset = 0.1 }
"""


def test_a_plan_file_says_what_changes():
    assert is_plan(PLAN)
    assert not is_plan('description = "a scenario"')
    assert not is_plan("segments = [")
    plan = parse_plan(PLAN, Path("turn.toml"))
    assert (plan.name, plan.duration_s, plan.ramp_s) == ("turn", 16.5, 1.0)
    assert plan.scenario == load_scenario("flat")
    first, second, third = plan.segments
    assert dict(first.planes) == dict(plan.start) == {H: PlaneGait(0.3, 0.5, 0.5)}
    assert (first.mode, second.mode, second.transition_s) == ("walk", "fast", 2.0)
    assert second.planes[H] == PlaneGait(0.2, 0.8, 0.5)
    assert third.planes[H] == PlaneGait(0.2, 0.8, 0.5, wave="tail-to-head", offset=0.1)
    assert third.transition_s == 0.5  # no longer than the segment


def test_without_a_gait_of_its_own_a_plan_starts_from_its_scenarios():
    plan = parse_plan(
        'description = "d"\nscenario = "flat"\n[[segments]]\nduration_s = 1\n', Path("p.toml")
    )
    flat = load_scenario("flat").gait
    assert (dict(plan.start), plan.ramp_s) == (flat.planes, flat.ramp_s)


def test_all_faults_of_a_plan_are_reported_at_once():
    text = """
scenario = "flt"
speed = 3
[[segments]]
duration_s = 1.0
transition_s = 2.0
mode = " "
horizontal = { amplitude = -0.1, wave = "sideways", phase = 1.0 }
vertical = { amplitude = 0.1 }
[[segments]]
horizontal = { frequency_hz = 30.0 }
[gait.horizontal]
amplitude = 0.3
frequency_hz = 0.5
lag = 0.5
"""
    with pytest.raises(PlanError) as caught:
        parse_plan(text, Path("bad.toml"))
    check_keys(
        (fault.key for fault in caught.value.faults),
        "description scenario speed segments[0].transition_s segments[0].mode segments[0].vertical "
        "segments[0].horizontal.amplitude segments[0].horizontal.wave "
        "segments[0].horizontal.phase segments[1].duration_s segments[1].horizontal.frequency_hz",
    )
    assert "bad.toml: 11 faults in this plan" in str(caught.value)
    assert "did you mean flat?" in str(caught.value)


DELAY_PLAN = """
description = "d"
scenario = "flat"
[gait]
kind = "delay-blocks"
horizontal = { amplitude = 0.1, frequency_hz = 1.0, delay_s = 0.1 }
[[segments]]
duration_s = 1.0
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segments = 3", "an array of tables"),
        ('description = "d"\nscenario = "flat"\nsegments = []', "at least one table"),
        ("[[segments]", "TOML 1.0"),
        (DELAY_PLAN, "a serpentine gait"),
    ],
)
def test_what_is_no_plan_says_why(text, message):
    with pytest.raises(PlanError, match=message):
        parse_plan(text, Path("p.toml"))


def test_a_lag_may_turn_round_through_zero(make_plan, make_robot):
    robot = make_robot()
    back = PlaneGait(0.2, 0.5, 0.6, wave="tail-to-head")
    plan = make_plan(PlanSegment(1.0, {H: SLOW}), PlanSegment(2.0, {H: back}, 2.0))
    _, _, values, _ = ran(PlanGait(plan, robot), robot, 3.0)
    assert values["horizontal.lag"][[0, 200, 300]] == pytest.approx([-0.6, 0.0, 0.6])
    assert math.isclose(values["horizontal.A"].min(), 0.2)


def test_the_manuals_plan_is_one():
    text = (DOCS / "how-to/driving.md").read_text().split("```toml\n")[1].split("```")[0]
    assert is_plan(text)
    plan = parse_plan(text, Path("turn.toml"))
    assert plan.duration_s == 26.0
    assert [segment.transition_s for segment in plan.segments] == [1.0, 2.0, 1.0]
