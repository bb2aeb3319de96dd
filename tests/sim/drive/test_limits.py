"""Limits of a drive: which are missing, what they are, and what follows from them, by hand."""

import dataclasses
import json
import tomllib

import numpy as np
import pytest

from undulog.capture import load_robot
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import OnFault, Safety
from undulog.sim.drive.limits import (
    Clamp,
    EndingRamp,
    GateLimits,
    Ramp,
    Spacing,
    gate_limits,
    missing_limits,
    safety_example,
    why_not_from,
)
from undulog.sim.drive.outcome import JointStatus

ROBOT = load_robot("snake25")
ALWAYS = ("max_rate", "ramp_rate", "max_tracking_error", "reply_timeout_s", "max_late_s")
MS = 1_000_000


def limits(**more):
    """Those of three joints."""
    values = {
        "joint_names": ("a", "b", "c"), "lower": np.full(3, -1.0), "upper": np.array([1.0, 0.5, 1]),
        "rate": np.array([4.0, 2.0, 1.0]), "ramp_rate": np.array([0.5, 0.25, 0.5]),
        "tracking_error": np.array([0.3, 0.2, 0.3]), "current": np.full(3, 1.5),
        "temperature": np.full(3, np.nan), "voltage": np.full(3, np.nan), "reply_timeout_s": 0.25,
        "late_s": 0.2, "fault_after_s": 0.3, "on_fault": OnFault.RAMP_DOWN,
    }  # fmt: skip
    return GateLimits(**(values | more))


def status(*angle):
    unknown = np.full(3, np.nan)
    return JointStatus(np.array(angle), unknown, unknown, unknown, np.zeros(3))


# -- what a description has ---------------------------------------------------------------------


def with_safety(safety, quantities=("position", "command", "velocity")):
    signals = [signal for signal in ROBOT.bus.signals if signal.quantity in quantities]
    bus = dataclasses.replace(ROBOT.bus, signals=tuple(signals))
    return dataclasses.replace(ROBOT, safety=safety, bus=bus)


def test_limits_of_what_the_bus_tells_are_needed_and_others_are_not():
    assert missing_limits(with_safety(None)) == ALWAYS
    some = ("position", "temperature", "current")
    assert missing_limits(with_safety(None, some)) == (*ALWAYS, "max_current", "max_temperature")
    assert missing_limits(dataclasses.replace(ROBOT, safety=None, bus=None)) == ALWAYS
    assert missing_limits(ROBOT) == ()
    given = dict.fromkeys(ALWAYS, 1.0)
    assert missing_limits(with_safety(Safety(**given))) == ()
    for name in ALWAYS:
        few = {key: value for key, value in given.items() if key != name}
        assert missing_limits(with_safety(Safety(**few))) == (name,)
    # All joints need it, not some.
    of = (("joint02", "max_rate", 1.0),)
    few = {key: value for key, value in given.items() if key != "max_rate"}
    assert missing_limits(with_safety(Safety(**few, of=of))) == ("max_rate",)
    commanded = [
        dataclasses.replace(signal, quantity="voltage") if signal.direction == "tx" else signal
        for signal in ROBOT.bus.signals
    ]
    bus = dataclasses.replace(ROBOT.bus, signals=tuple(commanded))
    assert "min_voltage" not in missing_limits(dataclasses.replace(ROBOT, bus=bus))


def test_an_example_is_a_table_that_can_be_read():
    table = tomllib.loads(safety_example((*ALWAYS, "min_voltage")))
    assert list(table["safety"]) == [*ALWAYS, "min_voltage"]
    assert all(value > 0.0 for value in table["safety"].values())
    assert safety_example(()) == "[safety]"


def test_the_limits_are_those_of_the_description():
    values = {name: 0.1 * (k + 1) for k, name in enumerate(ALWAYS)}
    values |= {"max_current": 2.0, "max_temperature": 55.0, "min_voltage": 6.5}
    safety = Safety(**values, fault_after_s=0.7, on_fault=OnFault.HOLD)
    of_robot = gate_limits(dataclasses.replace(ROBOT, safety=safety))
    for name, value in (
        ("rate", 0.1), ("ramp_rate", 0.1), ("tracking_error", 0.3), ("current", 2.0),
        ("temperature", 55.0), ("voltage", 6.5),
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(of_robot, name), np.full(25, value), err_msg=name)
    assert (of_robot.reply_timeout_s, of_robot.late_s) == (0.4, 0.5)
    assert (of_robot.fault_after_s, of_robot.on_fault) == (0.7, OnFault.HOLD)
    assert of_robot.joint_names == ROBOT.joint_names
    np.testing.assert_array_equal(of_robot.lower, [joint.lower for joint in ROBOT.joints])
    np.testing.assert_array_equal(of_robot.upper, [joint.upper for joint in ROBOT.joints])
    with pytest.raises(UsageError) as refused:
        gate_limits(dataclasses.replace(ROBOT, safety=dataclasses.replace(safety, max_late_s=None)))
    assert str(refused.value).startswith(
        "snake25 can't be armed: its description lacks max_late_s in [safety]; add what is right"
    )


def test_facts_have_one_number_where_all_joints_have_the_same():
    facts = limits().facts()
    assert (facts["current"], facts["lower"], facts["temperature"]) == ("1.5", "-1.0", "nan")
    assert json.loads(facts["upper"]) == [1.0, 0.5, 1.0]
    assert json.loads(facts["tracking_error"]) == [0.3, 0.2, 0.3]
    assert (facts["late_s"], facts["on_fault"]) == ("0.2", "ramp-down")
    assert "joint_names" not in facts
    assert len(facts) == 12


# -- when a command may be sent -----------------------------------------------------------------


def test_a_command_waits_for_the_joint_that_needs_longest():
    now_ns = 1000 * MS
    spacing = Spacing(np.array([4.0, 2.0]), lambda: now_ns)
    assert spacing.earliest_ns(np.array([9.0, 9.0]), 3).tolist() == [0, 0, 0]
    spacing.sent(np.array([0.0, 0.1]), np.array([1000, 1001, 1003]) * MS)
    # 0.02 rad at 2 rad/s are 10 ms, 0.03 rad at 4 rad/s are 7.5 ms.
    earliest_ns = spacing.earliest_ns(np.array([-0.03, 0.08]), 3)
    assert earliest_ns.tolist() == pytest.approx(np.array([1010, 1011, 1013]) * MS, abs=1)
    assert (spacing.waits, spacing.longest_s) == (1, pytest.approx(0.013))
    now_ns = 1006 * MS
    earliest_ns = spacing.earliest_ns(np.array([0.0, 0.11]), 2)  # other frames: after all of those
    assert earliest_ns.tolist() == pytest.approx([1008 * MS] * 2, abs=1)
    assert (spacing.waits, spacing.longest_s) == (2, pytest.approx(0.013))
    now_ns = 1013 * MS + 1
    assert spacing.earliest_ns(np.array([-0.03, 0.08]), 3).max() <= now_ns
    assert spacing.waits == 2
    assert spacing.earliest_ns(np.array([0.0, 0.1]), 3).tolist() == [
        1000 * MS,
        1001 * MS,
        1003 * MS,
    ]
    spacing.sent(np.array([0.0, 0.1]), np.array([2000]) * MS)
    assert spacing.earliest_ns(np.array([0.0, 0.5]), 1).tolist() == pytest.approx(
        [2200 * MS], abs=1
    )
    assert (spacing.waits, spacing.longest_s) == (3, pytest.approx(1.187, abs=1e-6))


# -- ways ---------------------------------------------------------------------------------------


def test_a_clamp_measures_its_steps_from_the_command_before():
    clamp = Clamp(limits(), np.array([0.0, 0.6, -2.0]), 0.01)
    np.testing.assert_array_equal(clamp.last, [0.0, 0.5, -1.0])  # the pose, within its limits
    least, most = np.full(3, -0.01), np.full(3, 0.02)
    clamped = clamp.apply(np.array([1.5, -9.0, -1.0]), (least, most))
    # The step is 0.04, 0.02, 0.01 rad; a bound is no tighter than the last command.
    np.testing.assert_allclose(clamped.command, [0.02, 0.48, -1.0])
    assert clamped.by_position.tolist() == [True, True, False]
    assert clamped.by_rate.tolist() == [True, True, False]
    assert clamped.unconfirmed.tolist() == [True, False, False]
    assert not clamped.not_finite.any()
    clamped.command[:] = 7.0
    np.testing.assert_allclose(clamp.last, [0.02, 0.48, -1.0])
    clamped = clamp.apply(np.array([np.inf, np.nan, -np.inf]))
    np.testing.assert_allclose(clamped.command, [0.02, 0.48, -1.0])
    assert clamped.not_finite.all()
    assert not (clamped.by_position | clamped.by_rate | clamped.unconfirmed).any()
    assert clamp.cuts == {"by_position": 2, "by_rate": 2, "unconfirmed": 1, "not_finite": 3}
    tiny = clamp.apply(np.array([0.02 + 4e-2 + 9e-13, 0.48, -1.0 - 9e-13]))  # its last bits
    assert not (tiny.by_position | tiny.by_rate | tiny.unconfirmed).any()
    more = clamp.apply(np.array([0.06, 0.5 + 2e-12, -1.0 - 2e-12]))
    assert more.by_position.tolist() == [False, True, True]


def test_a_ramp_is_as_long_as_its_slowest_joint_needs():
    ramp = Ramp(np.array([0.0, 1.0]), np.array([0.4, 0.5]), np.array([0.5, 0.25]))
    assert ramp.duration_s == pytest.approx(1.5 * 0.5 / 0.25)
    np.testing.assert_array_equal(ramp.at(0.0), [0.0, 1.0])
    np.testing.assert_allclose(ramp.at(0.75), [0.4 * 0.15625, 1.0 - 0.5 * 0.15625])  # S(1/4)
    np.testing.assert_allclose(ramp.at(1.5), [0.2, 0.75])
    for time_s in (3.0, 3.1, 1e9):
        np.testing.assert_allclose(ramp.at(time_s), [0.4, 0.5])
    still = Ramp(np.ones(2), np.ones(2), np.ones(2))
    assert still.duration_s == 0.0
    np.testing.assert_array_equal(still.at(0.0), [1.0, 1.0])


@pytest.mark.parametrize("how", list(OnFault))
def test_an_ending_is_from_where_the_joints_are_within_their_limits(how):
    last = np.array([0.4, 0.3, 0.8])
    # Farther than 0.3, 0.2, 0.3 rad from the command: the second, and the third beyond its limit.
    ending = EndingRamp(limits(on_fault=how), last, status(0.7, 0.09, 1.2))
    start = [0.4, 0.09, 1.0]
    np.testing.assert_allclose(ending.at(0.0), start)
    target = start if how is OnFault.HOLD else np.zeros(3)
    np.testing.assert_allclose(ending.at(100.0), target)
    down_s = 0.0 if how is OnFault.HOLD else 1.5 * 1.0 / 0.5
    assert ending.duration_s == pytest.approx(0.2 + down_s + 0.2)  # 0.2 rad back at 1 rad/s
    above = EndingRamp(
        limits(on_fault=how, lower=np.full(3, 0.1)), np.full(3, 0.2), status(*[0.2] * 3)
    )
    rest = 0.2 if how is OnFault.HOLD else 0.1  # straight is beyond a limit
    np.testing.assert_allclose(above.at(100.0), np.full(3, rest))
    assert above.duration_s == pytest.approx(
        0.2 + (0.0 if how is OnFault.HOLD else 1.5 * 0.1 / 0.25)
    )


def test_why_a_pose_is_none_to_start_from():
    assert why_not_from(np.array([0.0, 0.1, -0.2]), limits(), 2.0) is None
    assert why_not_from(np.array([1.29, 0.69, -1.29]), limits(), 2.0) is None  # a little beyond
    for angle, name, beyond in (
        ((1.31, 0.0, 0.0), "a is at 1.310 rad, 0.310", ""),
        ((0.0, 0.71, 0.0), "b is at 0.710 rad, 0.210", ""),
        ((1.31, 0.79, 0.0), "b is at 0.790 rad, 0.290", ""),  # by its own measure it is worse
        ((0.0, 0.0, -1.4), "c is at -1.400 rad, 0.400", ""),
    ):
        why = why_not_from(np.array(angle), limits(), 2.0)
        assert why == f"{name} rad beyond its limits; bring it back by hand{beyond}"
    end = "is the robot switched on, and does it report unasked?"
    assert why_not_from(np.array([np.nan, 0.0, np.nan]), limits(), 1.26) == (
        f"the pose is not known, a, c reported no angle within 1.3 s; {end}"
    )
    assert why_not_from(np.full(3, np.nan), limits(), 2.0) == (
        f"the pose is not known, all 3 joints reported no angle within 2 s; {end}"
    )
    angle = np.zeros(25)
    angle[:9] = np.nan
    why = why_not_from(angle, gate_limits(ROBOT), 2.0)
    assert "joint07, joint08 and 1 more reported no angle" in why
