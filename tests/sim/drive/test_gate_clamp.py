"""The gate's last stage: whatever is wanted, no command is beyond position or rate."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from support.decoded_commands import ROBOT, on_the_bus
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import OnFault
from undulog.sim.drive.feedback import CurrentLimiter
from undulog.sim.drive.limits import Clamp, EndingRamp, Ramp, Spacing, gate_limits
from undulog.sim.drive.outcome import JointStatus

LIMITS = gate_limits(ROBOT)
PERIOD_S = 0.01
STEP = math.radians(0.01)  # of a command on the bus of snake25

anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
near = st.floats(-0.7, 0.7)
wishes = st.lists(arrays(np.float64, 25, elements=anything | near), min_size=1, max_size=20)


@settings(max_examples=60, deadline=None)
@given(wishes, arrays(np.float64, 25, elements=st.floats(-0.6, 0.6)))
def test_no_sequence_of_wishes_gives_a_command_beyond_a_limit_on_the_bus(orders, pose):
    clamp = Clamp(LIMITS, pose, PERIOD_S)
    before = clamp.last
    for wish in orders:
        command = clamp.apply(wish).command
        sent = on_the_bus(command)
        assert (sent >= np.radians(-30) - 1e-9).all()
        assert (sent <= np.radians(30) + 1e-9).all()
        assert (np.abs(command - before) <= 4.0 * PERIOD_S + 1e-12).all()
        assert (np.abs(sent - command) <= STEP / 2 + 1e-9).all()
        before = command


def test_what_is_within_the_limits_passes_bit_by_bit():
    clamp = Clamp(LIMITS, np.zeros(25), PERIOD_S)
    for k in range(200):
        wish = 0.4 * np.sin(np.pi * k * PERIOD_S + np.arange(25)) * min(k / 100, 1.0)
        np.testing.assert_array_equal(clamp.apply(wish).command, wish)
    assert clamp.cuts == {"by_position": 0, "by_rate": 0, "unconfirmed": 0, "not_finite": 0}


def test_cuts_are_reported_by_joint_and_reason():
    clamp = Clamp(LIMITS, np.zeros(25), PERIOD_S)
    wish = np.zeros(25)
    wish[[3, 4, 5]] = 1.0, 0.3, np.nan
    clamped = clamp.apply(wish)
    assert np.flatnonzero(clamped.by_position).tolist() == [3]
    assert np.flatnonzero(clamped.by_rate).tolist() == [3, 4]
    assert np.flatnonzero(clamped.not_finite).tolist() == [5]
    assert clamped.command[[3, 4, 5]].tolist() == [0.04, 0.04, 0.0]
    assert clamp.cuts == {"by_position": 1, "by_rate": 2, "unconfirmed": 0, "not_finite": 1}


def test_a_pose_that_is_not_known_is_no_start():
    with pytest.raises(ValueError, match="not known"):
        Clamp(LIMITS, np.full(25, np.nan), PERIOD_S)


@given(
    arrays(np.float64, 25, elements=near),
    arrays(np.float64, 25, elements=near),
    arrays(np.float64, 25, elements=st.floats(0.05, 5.0)),
)
def test_a_ramp_arrives_and_no_joint_is_faster_than_it_may(start, target, rate):
    ramp = Ramp(start, target, rate)
    np.testing.assert_array_equal(ramp.at(0.0), start if ramp.duration_s else ramp.at(0.0))
    np.testing.assert_allclose(ramp.at(ramp.duration_s), target, atol=1e-15)
    t = np.linspace(0.0, ramp.duration_s, 500)
    step = np.abs(np.diff(np.array([ramp.at(instant) for instant in t]), axis=0)).max(axis=0)
    rounding = np.spacing(np.maximum(np.abs(start), np.abs(target)))  # of the angles themselves
    assert (step <= rate * (1 + 1e-6) * t[1] + rounding).all()


@pytest.mark.parametrize("how", list(OnFault))
def test_an_ending_starts_where_the_joints_are(how):
    limits = dataclasses.replace(LIMITS, on_fault=how)
    last, angle = np.full(25, 0.2), np.full(25, 0.15)
    angle[6] = -0.3  # blocked: 0.5 rad from where it was sent
    angle[7] = np.nan
    unknown = np.full(25, np.nan)
    ending = EndingRamp(
        limits, last, JointStatus(angle, np.zeros(25), unknown, unknown, np.zeros(25))
    )
    begin = last.copy()
    begin[6] = -0.3
    np.testing.assert_array_equal(ending.at(0.0), begin)
    end = begin if how is OnFault.HOLD else np.zeros(25)
    np.testing.assert_allclose(ending.at(ending.duration_s), end, atol=1e-15)
    expected_s = 0.0 if how is OnFault.HOLD else 1.5 * 0.3 / 0.5
    assert ending.duration_s == pytest.approx(0.5 / 4.0 + expected_s + 0.2)


def test_a_servo_that_draws_too_much_is_pushed_less_until_it_does_not():
    yielding = CurrentLimiter(np.array([1.0, 1.0, np.nan]))
    wish, angle = np.array([0.3, 0.3, 0.3]), np.array([0.1, 0.1, np.nan])
    current = np.array([8.0 * 0.2, 0.5, 5.0])  # of a stiff servo: proportional to the distance
    pushed = []
    for _ in range(40):
        command = yielding.apply(wish, angle, current)
        current[0] = 8.0 * (command[0] - angle[0])
        pushed.append(current[0])
    assert max(pushed[3:]) <= 1.0 * 1.05  # it grows back until the limit is met again
    assert min(pushed[3:]) > 0.5
    assert command[1] == command[2] == 0.3  # untouched, bit by bit


@pytest.mark.parametrize(
    ("current", "share"), [(0.999, 1.0), (-0.999, 1.0), (1.001, 0.8), (-1.001, 0.8), (np.nan, 1.0)]
)
def test_a_servo_gives_way_from_its_limit_on(current, share):
    yielding = CurrentLimiter(np.array([1.0]))
    command = yielding.apply(np.array([0.3]), np.array([0.1]), np.array([current]))
    assert command[0] == pytest.approx(0.1 + share * 0.2, abs=1e-15)
    again = yielding.apply(np.array([0.3]), np.array([0.1]), np.array([0.5]))
    assert again[0] == pytest.approx(0.1 + min(share + 0.02, 1.0) * 0.2, abs=1e-15)


def test_no_rate_is_beyond_the_servos_own():
    joints = list(ROBOT.joints)
    joints[2] = dataclasses.replace(joints[2], max_velocity=0.3)
    limits = gate_limits(dataclasses.replace(ROBOT, joints=tuple(joints)))
    assert limits.rate[1:4].tolist() == [4.0, 0.3, 4.0]
    assert limits.ramp_rate[1:4].tolist() == [0.5, 0.3, 0.5]
    assert limits.facts()["temperature"] == "70.0"
    assert limits.facts()["rate"].startswith("[4.0, 4.0, 0.3, 4.0, ")


def test_limits_that_are_missing_are_named_with_an_example():
    bare = dataclasses.replace(ROBOT, safety=None)
    with pytest.raises(UsageError) as refused:
        gate_limits(bare)
    text = str(refused.value)
    assert text.startswith(
        "snake25 can't be armed: its description lacks max_rate, ramp_rate, max_tracking_error, "
        "reply_timeout_s, max_late_s, max_current, max_temperature in [safety]"
    )
    assert "\n[safety]\nmax_rate = 4.0" in text
    assert "min_voltage" not in text  # its bus doesn't tell voltages


times = st.lists(st.floats(0.0, 0.05), min_size=2, max_size=30)


@given(st.data(), times, st.integers(1, 4))
def test_frames_that_wait_for_their_times_are_never_too_fast(data, apart_s, count):
    """Whatever is wanted, however late a tick, wherever a burst is held up: a clock of our own."""
    now_ns = 10**18
    spacing = Spacing(LIMITS.rate, lambda: now_ns)
    clamp = Clamp(LIMITS, np.zeros(25), PERIOD_S)
    before = None
    for pause_s in apart_s:
        now_ns += round(pause_s * 1e9)
        command = clamp.apply(data.draw(arrays(np.float64, 25, elements=near))).command
        sent_ns = []
        for earliest_ns in spacing.earliest_ns(command, count).tolist():
            assert earliest_ns - now_ns <= 10_000_001  # no wait is longer than a period
            now_ns = max(now_ns, earliest_ns) + data.draw(st.integers(0, 3_000_000))
            sent_ns.append(now_ns)
        spacing.sent(command, np.array(sent_ns))
        if before is not None:
            for a_ns, b_ns in zip(before[1], sent_ns, strict=True):
                assert (np.abs(command - before[0]) <= 4.0 * (b_ns - a_ns) * 1e-9 + 1e-12).all()
        before = command, sent_ns
    assert spacing.longest_s <= PERIOD_S + 1e-9


def test_what_is_slow_enough_does_not_wait():
    now_ns = 10**18
    spacing = Spacing(LIMITS.rate, lambda: now_ns)
    for k in range(50):
        command = np.full(25, 0.03 * (k % 2))  # 3 rad/s
        assert (spacing.earliest_ns(command, 25) <= now_ns).all()
        spacing.sent(command, np.full(25, now_ns))
        now_ns += 8_000_000  # behind a late tick
    assert (spacing.waits, spacing.longest_s) == (0, 0.0)
