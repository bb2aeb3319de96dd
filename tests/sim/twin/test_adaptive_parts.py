"""The controllers' parts and the gait under them, on readings made up in closed form."""

import dataclasses
import math

import numpy as np
import pytest

from undulog.capture.robot.description import load_robot
from undulog.capture.robot.model import Plane, Robot, Sensor, SensorKind
from undulog.sim import PlaneGait, Readings, Serpentine
from undulog.sim.gait.contract import WALK
from undulog.sim.scenario.motion import (
    Controller,
    ControllerKind,
    HeadSteering,
    RandomTurns,
    SideShrinking,
    TailHaste,
    TargetHeading,
    generator,
)
from undulog.sim.scenario.motion import Lookout as LookoutParameters
from undulog.sim.scenario.sensors import layout
from undulog.sim.twin.adaptive import (
    AVOID,
    HASTEN,
    SHRINK,
    TURN,
    AdaptiveGait,
    RandomHeadingPolicy,
    StraightOn,
    TargetHeadingPolicy,
)
from undulog.sim.twin.filters import Pose, SlipOdometry
from undulog.sim.twin.reactions import ControlInput, Distances, ObstacleMonitor

SNAKE = load_robot("snake25")
WAVE = Serpentine({Plane.HORIZONTAL: PlaneGait(0.3, 0.5, math.pi / 6)}, ramp_s=0.0)
STILL = np.zeros(25)
ROLES = layout(SNAKE)
CURVES = [lambda x: 0.15 * np.sin(4.5 * x), lambda x: 0.1 * np.sin(3 * x + x**2 / 2)]


def controlled(controller, course=None, robot=SNAKE):
    return AdaptiveGait(
        generator(WAVE, robot, per_joint=True), controller, course or StraightOn(), robot
    )


def driven(gait, seconds, ranges):
    """Ticks of a robot that stands still and reads the same distances, with a little dither.

    The dither (10 nm) is there since an unchanged value is no new measurement.
    """
    ticks = []
    for k in range(round(100 * seconds)):
        read = {name: value + 1e-8 * (k % 2) for name, value in ranges.items()}
        ticks.append(gait.step(k / 100, Readings(STILL, STILL, read)))
    table = np.array([tick.values for tick in ticks])
    return {name: table[:, i] for i, name in enumerate(gait.names)}, ticks


def test_every_sensor_of_the_shipped_robot_has_its_role():
    roles = layout(SNAKE)
    assert (roles.head, roles.tail) == (("ir01", "ir02", "ir03", "sonar"), ("ir14", "ir15"))
    beside = {side.name: (np.flatnonzero(side.beside) + 1).tolist() for side in roles.sides}
    # Every fourth link has a pair; the joints go to the nearest, two links and a half at most.
    for k, pair in enumerate(zip(range(4, 14, 2), range(5, 15, 2), strict=True)):
        for number in pair:
            assert beside[f"ir{number:02d}"] == [4 * k + i for i in (3, 4, 5, 6)]
    assert (roles.fold_m["ir01"], roles.fold_m["sonar"]) == (0.2, 0.0)


def test_roles_follow_from_the_description_of_any_robot(make_robot):
    def ir(number, link, yaw, x=0.0):
        name = f"ir{number:02d}"
        return Sensor(name, SensorKind.IR, link, (x, 0.0, 0.0), (0.0, 0.0, yaw), 0.2, 1.5)

    robot = dataclasses.replace(
        make_robot(8, planar=True),
        sensors=(
            ir(1, "link01", 0.1),
            ir(2, "link01", math.pi),  # looks back from the head: no role
            ir(3, "link01", 1.4),  # sideways, on the head
            ir(4, "link06", 1.7, x=0.02),
            ir(5, "link04", -1.5),  # the only one of its side
            ir(6, "link05", 0.0),  # ahead from the middle: no role
            ir(7, "link08", 3.0),
        ),
    )
    roles = layout(robot)
    assert (roles.head, roles.tail) == (("ir01",), ("ir07",))
    beside = {side.name: (np.flatnonzero(side.beside) + 1).tolist() for side in roles.sides}
    # Noses at 0: ir03 at 0.03 m, ir04 at 0.31 m, half their gap 0.14 m; joint i at 0.06 i m.
    assert beside == {"ir03": [1, 2], "ir04": [3, 4, 5, 6, 7], "ir05": [1, 2, 3, 4, 5, 6, 7]}


def test_distances_bear_what_sensors_may_tell():
    distances = Distances({"ir01": 0.2, "ir02": 0.2, "sonar": 0.0}, 1.0)
    distances.step(0.0, {"ir01": math.nan, "sonar": -math.inf})
    assert distances.nearest(["ir01", "ir02"]) == math.inf
    assert (distances.nearest(["sonar"]), distances.nearest([])) == (0.0, math.inf)
    distances.step(0.1, {"ir01": 0.2})
    distances.step(0.2, {"ir01": 0.6})  # no obstacle moves so fast: it came too near
    assert distances.nearest(["ir01"]) == 0.2


@pytest.mark.parametrize("d", [0.25, 0.5, 0.75, 0.95])
def test_the_head_bends_by_the_papers_law_and_the_body_follows(d):
    """f(d) = sgn f0 exp(-k d), held until it has reached the tail."""
    gait = controlled(Controller(ControllerKind.CORRIDOR, head=HeadSteering(f0=0.2, k=2.0)))
    values, ticks = driven(gait, 3.5, {"sonar": d})
    law = values["steer.side"][-1] * 0.2 * math.exp(-2.0 * d)
    assert values["steer.offset"][-1] == pytest.approx(law, rel=1e-3)
    # The bend travels down the wave, a lag a joint: it has passed the fourth joint long ago.
    joints = SNAKE.joint_indices(Plane.HORIZONTAL)
    commands = np.array([tick.command for tick in ticks[-200:]])[:, joints]
    middle = (commands.max(axis=0) + commands.min(axis=0)) / 2
    np.testing.assert_allclose(middle[:4], law, atol=5e-3)
    assert ticks[-1].mode == AVOID


def seen(heading, ranges, place=(0.0, 0.0), time_s=0.0, lookout=None):
    """What is in the way of a robot that goes along x while its head looks elsewhere."""
    parameters = LookoutParameters(half_width_m=0.3, memory_s=2.0)
    lookout = lookout or ObstacleMonitor(parameters, ROLES, SNAKE)
    pose, readings = Pose(np.array(place), heading, 0.0), Readings(STILL, STILL, ranges)
    return lookout.step(ControlInput(time_s, 0.01, 0.0, pose, readings)), lookout


def test_a_swinging_head_sees_what_is_in_the_way_and_on_which_side():
    """The head looks 45 degrees to the left; the sensor on its right then looks along the way."""
    way, _ = seen(math.pi / 4, {"ir03": 0.6})
    x = 0.02 * math.cos(math.pi / 4) + 0.025 * math.sin(math.pi / 4) + 0.6
    y = 0.02 * math.sin(math.pi / 4) - 0.025 * math.cos(math.pi / 4)
    assert way.nearest == way.right == pytest.approx(math.hypot(x, y) - 0.03)
    assert way.left == math.inf
    assert seen(math.pi / 4, {"ir01": 0.6})[0].nearest == math.inf  # beside the way
    assert seen(0.3, {"ir01": 0.6})[0].left < 0.6
    assert seen(0.3, {"ir01": math.inf, "ir02": math.nan})[0].nearest == math.inf
    assert seen(0.0, {"sonar": -math.inf})[0].nearest == 0.0  # too near to tell


def test_an_echo_is_kept_in_its_place_for_one_swing():
    first, lookout = seen(0.0, {"ir01": 0.8})
    assert first.nearest == pytest.approx(0.8)
    later, _ = seen(0.7, {"ir01": 1.4}, (0.5, 0.0), 1.0, lookout)
    assert later.nearest == pytest.approx(0.3)
    gone, _ = seen(0.7, {"ir01": 1.4}, (0.5, 0.0), 2.1, lookout)
    assert gone.nearest == math.inf


def test_nothing_in_range_leaves_the_wave_alone():
    gait = controlled(Controller(ControllerKind.AVOIDANCE, side=SideShrinking(), tail=TailHaste()))
    values, ticks = driven(gait, 3.0, dict.fromkeys(layout(SNAKE).fold_m, math.inf))
    plain = generator(WAVE, SNAKE)
    expected = np.array([plain.step(k / 100, Readings.nothing(SNAKE)).command for k in range(300)])
    np.testing.assert_array_equal([tick.command for tick in ticks], expected)
    assert {tick.mode for tick in ticks} == {WALK}
    assert (values["steer.distance"] == 1.0).all()


@pytest.mark.parametrize("d", [0.25, 0.4, 0.8])
def test_the_joints_beside_a_wall_swing_by_the_law_and_no_others(d):
    law = SideShrinking(smallest=0.3, k=3.0, filter_s=0.5)
    gait = controlled(Controller(ControllerKind.CORRIDOR, side=law))
    values, ticks = driven(gait, 6.0, {"ir08": d})
    factor = 1.0 - 0.7 * math.exp(-3.0 * d)
    commands = np.array([tick.command for tick in ticks[-200:]])
    swing = (commands.max(axis=0) - commands.min(axis=0)) / 2 / 0.3
    expected = np.zeros(25)
    expected[0::2] = 1.0
    expected[[10, 12]] = factor  # joints 11 and 13, beside link 13
    np.testing.assert_allclose(swing, expected, atol=2e-3)
    assert values["shrink.joint11"][-1] == pytest.approx(factor, abs=1e-4)
    assert "shrink.joint12" not in values
    assert ticks[-1].mode == (SHRINK if factor < 0.9 else WALK)


def test_a_wall_at_the_tail_hastens_within_bounds():
    gait = controlled(Controller(ControllerKind.AVOIDANCE, tail=TailHaste(gain=0.5, k=2.0)))
    values, ticks = driven(gait, 3.0, {"ir15": 0.3})
    law = 1.0 + 0.5 * math.exp(-0.6)
    assert values["haste.factor"][-1] == pytest.approx(law, abs=1e-4)
    assert values["horizontal.omega"][-1] == pytest.approx(law * math.pi, abs=1e-3)
    assert ticks[-1].mode == HASTEN


def test_modes_last_half_a_second():
    gait = controlled(Controller(ControllerKind.AVOIDANCE, tail=TailHaste()))
    random = np.random.default_rng(5)
    modes = [
        gait.step(k / 100, Readings(STILL, STILL, {"ir14": random.uniform(0.3, 0.5)})).mode
        for k in range(1000)
    ]
    changes = np.flatnonzero(np.array(modes[1:]) != np.array(modes[:-1]))
    assert len(changes) > 5
    assert np.diff(changes).min() >= 50


def test_the_random_walk_draws_from_its_own_stream():
    def offsets(seed):
        course = RandomHeadingPolicy(RandomTurns(0.15, 2.0, 6.0), seed)
        return np.array([course.step(moment(k / 100)) for k in range(20000)])

    walk = offsets(7)
    np.testing.assert_array_equal(walk, offsets(7))
    assert (walk != offsets(8)).any()
    held = np.diff(np.flatnonzero(np.diff(walk))) / 100
    assert held.min() > 2.0 - 0.02
    assert held.max() < 6.0 + 0.02
    assert np.abs(walk).max() <= 0.15
    drawn = walk[np.flatnonzero(np.diff(walk)) + 1]
    assert abs(drawn.mean()) < 3 * 0.15 / math.sqrt(3 * len(drawn))


def moment(time_s, place=(0.0, 0.0), heading=0.0, field=None):
    read = {} if field is None else {"compass": np.array(field)}
    pose = Pose(np.array(place), heading, heading)
    return ControlInput(time_s, 0.01, math.pi * time_s, pose, Readings(STILL, STILL, {}, {}, read))


def north_at(angle):
    """The field in the frame of a head that looks at an angle to the left of north."""
    return 2e-5 * math.cos(angle), -2e-5 * math.sin(angle), math.nan


@pytest.mark.parametrize("start", [0.0, 0.7, -2.5])
def test_the_course_points_to_the_target_from_wherever_the_robot_started_to_look(start):
    """Whatever way the head looked at first, and however far it has come since."""
    course = TargetHeadingPolicy(TargetHeading(gain=0.35, largest=0.2), (3.0, 1.0), 0.3, 0.4, SNAKE)
    assert course.step(moment(0.0)) == 0.0  # the compass has not measured anything yet
    course.step(moment(0.01, field=north_at(start)))
    turn = 0.2
    offset = course.step(moment(0.02, (0.5, 0.1), turn, north_at(start + turn)))
    x = 0.5 * math.cos(start) - 0.1 * math.sin(start)
    y = 0.5 * math.sin(start) + 0.1 * math.cos(start)
    bearing = math.atan2(1.0 - y, 3.0 - x)
    error = math.remainder(bearing - start - turn, 2 * math.pi)
    assert offset == pytest.approx(-np.clip(0.35 * error, -0.2, 0.2))
    np.testing.assert_allclose(course.values[1:], [bearing, x, y], atol=1e-9)


def test_a_target_that_no_turn_reaches_is_left_behind_first():
    course = TargetHeadingPolicy(TargetHeading(), (0.0, 0.5), 0.1, 0.5, SNAKE)
    course.step(moment(0.0, field=north_at(0.0)))
    assert course.step(moment(0.01, field=north_at(0.0))) == 0.0  # at the centre of the turn
    assert course.step(moment(0.02, (2.0, 0.0), field=north_at(0.0))) == -0.2


def test_the_course_turns_the_body():
    course = TargetHeadingPolicy(TargetHeading(), (0.0, -5.0), 0.3, 0.4, SNAKE)
    gait = controlled(Controller(ControllerKind.TARGET_FOLLOWING), course)
    field = {"compass": np.array(north_at(0.0))}
    ticks = [gait.step(k / 100, Readings(STILL, STILL, {}, {}, field)) for k in range(150)]
    values = dict(zip(gait.names, ticks[-1].values, strict=True))
    assert (values["steer.offset"], ticks[-1].mode) == (pytest.approx(0.2, abs=2e-3), TURN)


def gliding(robot: Robot, speed, curve, time_s):
    """Angles of a chain whose joints lie on a path that it follows, at one time."""
    arc = speed * time_s + 3.0 - 0.06 * np.arange(len(robot.links) + 1)
    x = np.linspace(0.0, 6.0, 60001)
    y = curve(x)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.array([np.interp(arc, length, x), np.interp(arc, length, y)])
    ahead = at[:, :-1] - at[:, 1:]
    heading = np.unwrap(np.arctan2(ahead[1], ahead[0]))
    return np.diff(heading), heading[0], (at[:, 0] + at[:, 1]) / 2


@pytest.mark.parametrize("curve", CURVES)
def test_odometry_of_a_chain_that_follows_its_path(make_robot, curve):
    """No link slips sideways there, but for the chords' deviation from the path, L^2."""
    robot = make_robot(14, planar=True)
    dt, speed = 0.01, 0.5
    before, heading, place = gliding(robot, speed, curve, -dt)
    after, turned, moved = gliding(robot, speed, curve, dt)
    angle, heading_now, _ = gliding(robot, speed, curve, 0.0)
    step = (moved - place) / (2 * dt)
    cos, sin = math.cos(heading_now), math.sin(heading_now)
    truth = [cos * step[0] + sin * step[1], cos * step[1] - sin * step[0]]
    truth.append((turned - heading) / (2 * dt))
    estimated = SlipOdometry(robot, 1e6).velocity(angle, (after - before) / (2 * dt))
    np.testing.assert_allclose(estimated, truth, atol=0.02 * speed)


def test_odometry_of_a_body_that_holds_its_shape(make_robot):
    robot = make_robot(14, planar=True)
    angle = np.full(13, 0.2)
    np.testing.assert_allclose(SlipOdometry(robot, 50.0).velocity(angle, np.zeros(13)), 0.0)
