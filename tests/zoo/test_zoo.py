"""The zoo itself: bags that others can read, faults that are what they claim to be."""

import numpy as np
import pytest

from support.paths import DOCS
from support.read_back import decoded_of
from zoo.bags import write_bag
from zoo.faults import FAULTS, plant
from zoo.page import lines
from zoo.robot import Channels, draw, record
from zoo.run import DETECTION, RIGHT, SOUND, failures, robot_for, run_all, seed_of

SEED = 20250131
"""Of the fast test; printed with what fails."""


@pytest.mark.nightly
@pytest.mark.parametrize("per_servo", [False, True])
def test_bags_are_read_back_by_another_reader(tmp_path, per_servo):
    channels = Channels("true", effort=True, second=True)
    robots = (draw(seed, small=True, channels=channels) for seed in range(100))
    robot = next(robot for robot in robots if robot.per_servo is per_servo)
    log = record(robot, (), 7)
    seen = {}
    for topic, log_ns, state in decoded_of(write_bag(log, tmp_path / "bag.mcap")):
        stamp = state.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == log_ns
        for k, name in enumerate(state.name):
            columns = seen.setdefault((topic, name), ([], [], []))
            columns[0].append(state.position[k])
            columns[1].extend(state.velocity[k : k + 1])
            columns[2].extend(state.effort[k : k + 1])
    for j, name in enumerate(robot.names):
        np.testing.assert_array_equal(seen["/joint_commands", name][0], robot.sent()[:, j])
        states = seen["/joint_states", name]
        for column, values in zip(states, (log.position, log.velocity, log.effort), strict=True):
            np.testing.assert_array_equal(column, values[:, j])
        np.testing.assert_array_equal(seen["/joint_states_second", name][0], log.second[:, j])


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_touches_no_joint_but_those_it_names(name):
    """Same seed of noise: what differs from the healthy log is what was planted."""
    for seed in range(3):
        robot = robot_for(FAULTS[name], seed, small=True)
        changes, truth = plant(FAULTS[name], robot, seed_of(name, seed))
        healthy, faulty = (record(robot, planted, 1).position for planted in ((), changes))
        differs = ~(np.isclose(healthy, faulty, rtol=0, atol=1e-12)).all(axis=0)
        assert np.flatnonzero(differs).tolist() == sorted(joint.joint for joint in truth.joints)
        for joint in truth.joints:
            assert joint.names <= joint.allowed
            assert joint.names or joint.stands_out
            assert joint.since_s is None or 0 < joint.since_s < robot.duration_s


def test_a_healthy_robot_answers_as_drawn():
    """Gain and lag of each joint by least squares, by the seed's own numbers."""
    robots = (draw(seed, small=True) for seed in range(100))
    robot = next(robot for robot in robots if robot.start_s == 0 and robot.scatter[0] > 0)
    log = record(robot, (), 3)
    for j in range(robot.m):
        angle = robot.omega * robot.t_s[:, j] + robot.phase[j]
        waves = [f(k * angle) for k in (1, 2) for f in (np.sin, np.cos)]
        model = np.stack([*waves, np.ones(angle.size)], axis=1)
        (sine, cosine, *_, bias), *_ = np.linalg.lstsq(model, log.position[:, j])
        response = complex(sine, cosine) / robot.amplitude[j]
        half, offset = robot.half(j)
        assert abs(abs(response) / robot.gain[j] - 1) < half
        assert abs(-np.angle(response) - robot.lag[j]) < half
        assert abs(bias - robot.bias[j] - robot.zero[j]) < offset


def test_the_manual_lists_the_kinds_of_every_fault():
    page = (DOCS / "explanation/faults.md").read_text()
    assert "\n".join(lines()) in page, "renew it: python -m zoo.page"


def verdict(cases):
    """What fails, as the message of a failure; empty if enough is right."""
    right = np.mean([all(judged.right for judged in case.judged.values()) for case in cases])
    sound = np.mean([any(judged.sound for judged in case.judged.values()) for case in cases])
    print(f"fault zoo, seed {SEED}: {right:.0%} right, {sound:.0%} name a sound joint")
    if right >= RIGHT and sound <= SOUND:
        return ""
    return "\n".join(failures(cases))


@pytest.mark.nightly
@pytest.mark.parametrize("first", range(4))
def test_joints_that_do_not_follow_are_detected(first):
    """A seed a fault, on arrays; every fourth fault at a time."""
    faults = list(FAULTS)[first::4]
    wrong = verdict(list(run_all(faults, [SEED], small=True, outputs=(DETECTION,))))
    assert not wrong, wrong


@pytest.mark.built("tables")
@pytest.mark.slow
def test_every_output_is_right_about_every_fault():
    """A seed a fault, through bags; `make zoo` takes a hundred."""
    wrong = verdict(list(run_all(list(FAULTS), [SEED], small=True)))
    assert not wrong, wrong
