"""Recorded commands: held at the ticks, and their means over the steps between."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from support.twin_chains import chain
from undulog import sim
from undulog.capture.common.errors import DataError, JointSetError, MissingChannelError
from undulog.capture.log.read.sample_times import JointSignals
from undulog.capture.robot.description import parse_robot
from undulog.sim.drive.recorded_commands import CommandReplay, RecordedCommands

ROBOT = parse_robot(chain(3), "chain.toml", {})
START_NS, MS = 10**18, 1_000_000
NAN = math.nan
NOTHING = sim.Readings.nothing(ROBOT)


def signals(topic, **series):
    """Name to {time [ms]: value}."""
    times = tuple(
        START_NS + MS * np.array(list(column), dtype=np.int64) for column in series.values()
    )
    values = tuple(np.array(list(column.values()), dtype=float) for column in series.values())
    return JointSignals(topic, "position", "rad", tuple(series), times, values)


def replay(gait=None, modes=(), **series):
    recorded = RecordedCommands(signals("/joint_commands", **series), gait, modes)
    return CommandReplay(recorded, ROBOT)


def test_each_joint_holds_what_was_commanded_last():
    replayed = replay(joint02={4: 0.1, 20: NAN, 31: 0.3}, joint01={0: -0.1, 15: 0.2})
    assert replayed.duration_s == 0.04  # 31 ms, in whole control periods
    for at_s, first, second in (
        (0.0, -0.1, 0.1), (0.014, -0.1, 0.1), (0.015, 0.2, 0.1), (0.02, 0.2, 0.1),
        (0.0309, 0.2, 0.1), (0.031, 0.2, 0.3), (99.0, 0.2, 0.3),
    ):  # fmt: skip
        tick = replayed.step(at_s, NOTHING)
        assert tick.command.tolist() == [first, second, 0.0], at_s
        assert (tick.mode, tick.clamped, tick.values.size) == ("replay", (), 0)
    assert replayed.names == ()


@pytest.mark.parametrize(
    ("last_ms", "duration_s"),
    [(0, 0.01), (9, 0.01), (10, 0.01), (11, 0.02), (600, 0.6), (605, 0.61)],
)
def test_its_length_is_in_whole_control_periods(last_ms, duration_s):
    assert replay(joint01={0: 0.0, last_ms: 0.1}).duration_s == duration_s
    later = {5: 0.0, 5 + last_ms: 0.1}  # of any joint: from the first to the last one
    assert replay(joint01={5: 0.0}, joint03=later, joint02={}).duration_s == duration_s


def test_modes_and_values_are_those_of_the_time_and_may_be_unknown():
    gait = signals("/gait", A={0: 0.4, 20: NAN}, phase={10: 1.0, 30: 3.0}, none={})
    modes = ((START_NS + 10 * MS, "walk"), (START_NS + 30 * MS, "turn"))
    replayed = replay(gait, modes, joint01={0: 0.0})
    assert replayed.names == ("A", "phase", "none")
    ticks = [replayed.step(at_s, NOTHING) for at_s in (0.0, 0.01, 0.02, 0.03)]
    assert [tick.mode for tick in ticks] == ["replay", "walk", "walk", "turn"]
    values = [[0.4, 1.0, NAN], [0.4, 1.0, NAN], [NAN, 1.0, NAN], [NAN, 3.0, NAN]]
    np.testing.assert_array_equal([tick.values for tick in ticks], values)


def test_joints_without_a_command_rest_and_all_are_within_their_limits():
    joints = [dataclasses.replace(joint, lower=0.05, upper=0.3) for joint in ROBOT.joints]
    robot = dataclasses.replace(ROBOT, joints=tuple(joints))
    recorded = RecordedCommands(signals("/joint_commands", joint02={0: 0.9}, joint01={0: -0.9}))
    tick = CommandReplay(recorded, robot).step(0.0, NOTHING)
    assert tick.command.tolist() == [0.05, 0.3, 0.05]
    assert tick.clamped == ("joint01", "joint02")


def test_commands_of_joints_that_the_robot_lacks_are_named():
    with pytest.raises(JointSetError) as refused:
        replay(joint01={0: 0.0}, hip={0: 0.0}, knee={})
    assert str(refused.value) == (
        "/joint_commands has joints that chain3 lacks: hip, knee; it commands joint01, hip, knee; "
        "chain3 has joint01, joint02, joint03"
    )
    with pytest.raises(DataError, match="/joint_commands holds no command"):
        replay(joint01={0: NAN}, joint02={})


def test_commands_of_a_session_are_never_guessed():
    session = SimpleNamespace(channels={"/other": None, "/a": None}, path="a.mcap")
    with pytest.raises(MissingChannelError) as refused:
        RecordedCommands.read(session)
    assert "choose with --command-topic" in str(refused.value)
    assert str(refused.value).index("/a") < str(refused.value).index("/other")


def test_mean_commands_are_the_integral_of_those_held():
    """Against the sum of microseconds, of commands between steps, several in one step, and none."""
    given = replay(joint01={0: 0.1, 3: -0.1, 4: 0.2}, joint03={1: 0.3, 13: NAN, 20: -0.2})
    times_s = (np.arange(25_000) + 0.5) * 1e-6
    held = np.array([given.step(t, NOTHING).command for t in times_s[::10].tolist()])
    for rate_hz in (1000, 400, 200):
        count = round(0.025 * rate_hz)
        expected = held.reshape(count, -1, 3).mean(axis=1)
        np.testing.assert_allclose(given.mean_commands(count, rate_hz), expected, atol=1e-12)


@pytest.mark.parametrize("late_ns", [-400_000, -114, 114, 400_000])
def test_mean_commands_are_continuous_in_the_times_of_commands(late_ns):
    """A step's mean changes by its share of the jump; the sum over time by all of it."""
    t_ns = START_NS + 10 * MS * np.arange(4)
    values = np.array([0.0, 0.1, 0.3, 0.2])

    def means(stamps):
        signal = JointSignals(
            "/joint_commands", "position", "rad", ("joint02",), (stamps,), (values,)
        )
        return CommandReplay(RecordedCommands(signal), ROBOT).mean_commands(40, 1000)[:, 1]

    on_time, late = means(t_ns), means(t_ns + late_ns * (np.arange(4) > 0))
    np.testing.assert_array_equal(on_time, np.repeat(values, 10))
    share = abs(late_ns) / MS
    assert np.abs(late - on_time).max() == pytest.approx(0.2 * share)
    assert np.sum(late - on_time) == pytest.approx(-0.2 * late_ns / MS)


def test_joints_without_a_command_rest_on_average_too():
    joints = [dataclasses.replace(joint, lower=0.05, upper=0.3) for joint in ROBOT.joints]
    robot = dataclasses.replace(ROBOT, joints=tuple(joints))
    recorded = RecordedCommands(signals("/joint_commands", joint02={0: 0.9}, joint01={0: -0.9}))
    means = CommandReplay(recorded, robot).mean_commands(2, 1000)
    assert means.tolist() == [[0.05, 0.3, 0.05]] * 2
