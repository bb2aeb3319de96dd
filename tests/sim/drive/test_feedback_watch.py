"""What the gate watches: whether the bus is silent, joints lost or beyond a limit, who is there."""

import dataclasses

import numpy as np
import pytest

from undulog.capture import load_robot
from undulog.capture.log.messages.frames import (
    DIR_TX,
    ERROR_FLAG,
    REMOTE_FLAG,
    empty_frames,
)
from undulog.capture.sources.events import BUS_OFF
from undulog.sim.drive.feedback import BusCheck, Silence, Watch
from undulog.sim.drive.limits import gate_limits
from undulog.sim.drive.outcome import FaultKind, JointStatus

ROBOT = load_robot("snake25")
NAMES = ROBOT.joint_names
LIMITS = dataclasses.replace(
    gate_limits(ROBOT),
    voltage=np.full(25, 5.0),
    reply_timeout_s=0.25,
    fault_after_s=0.3,
    tracking_error=np.where(np.arange(25) == 4, 0.5, 0.35),
)
MARK = 0x14B


# -- silence ------------------------------------------------------------------------------------


def heard_at(*ticks):
    silence = Silence()
    for tick in range(max(ticks) + 1):
        silence.tick(tick, received=tick in ticks)
    return silence


def test_five_receptions_are_enough_to_measure_an_interval():
    assert not heard_at(20).measure()
    four = heard_at(2, 3, 5, 8)
    assert not four.measure()
    assert (four.interval, four.limit, four.ticks) == (None, 3, 0)
    five = heard_at(2, 3, 5, 8, 12)  # gaps of 1, 2, 3, 4; what is before the first is none
    assert five.measure()
    assert (five.interval, five.limit) == (3, 9)
    assert (heard_at(*range(9)).measure(), heard_at(0, 2, 4, 6, 8).measure()) == (True, True)


@pytest.mark.parametrize(("interval", "limit"), [(1, 3), (2, 6), (3, 9), (7, 21)])
def test_a_bus_is_silent_after_three_ticks_and_three_intervals(interval, limit):
    silence = heard_at(*range(0, 5 * interval, interval))
    last = 4 * interval
    for tick in range(last + 1, last + 50 * interval):
        silence.tick(tick, received=False)
    assert not silence.silent  # it isn't measured
    silence = heard_at(*range(0, 5 * interval, interval))
    assert silence.measure()
    assert (silence.interval, silence.limit) == (interval, limit)
    for tick in range(last + 1, last + limit + 5):
        silence.tick(tick, received=False)
        assert silence.ticks == tick - last
        assert silence.silent == (tick - last >= limit)
    silence.tick(last + limit + 5, received=True)
    assert (silence.ticks, silence.silent) == (0, False)
    assert silence.interval == interval


def test_ticks_that_did_not_take_place_or_expect_nothing_are_no_silence():
    silence = heard_at(0, 1, 2, 3, 4)
    assert silence.measure()
    silence.tick(40, received=False)  # the process was stopped
    assert (silence.ticks, silence.silent) == (36, False)
    silence.tick(41, received=False)
    assert not silence.silent
    silence.tick(42, received=False)
    assert (silence.ticks, silence.silent) == (38, True)
    silence.tick(43, received=True)
    for tick in range(44, 60):
        silence.tick(tick, received=False, expected=False)
    assert (silence.ticks, silence.silent) == (0, False)
    silence.tick(60, received=False)
    assert silence.ticks == 1
    silence.tick(61, received=True, expected=False)
    assert silence.ticks == 0


# -- limits -------------------------------------------------------------------------------------


def status(**changed):
    """All joints well, but for some values: quantity to {joint number: value}."""
    usual = {"angle": 0.0, "current": 0.1, "temperature": 30.0, "voltage": 6.0, "silence_s": 0.01}
    quantities = {name: np.full(25, value) for name, value in usual.items()}
    for name, values in changed.items():
        for joint, value in values.items():
            quantities[name][joint] = value
    return JointStatus(**quantities)


def look(at_s, watch=None, command=None, **changed):
    watch = watch or Watch(LIMITS)
    return watch.look(at_s, status(**changed), np.zeros(25) if command is None else command)


@pytest.mark.parametrize(
    ("silent", "subject", "joint"),
    [
        ([6], "joint07 is", "joint07"),
        ([0, 24], "joint01, joint25 are", ""),
        ([1, 2, 3, 4], "joint02, joint03, joint04, joint05 are", ""),
        (range(25), "the robot is", ""),
    ],
)
def test_joints_that_are_silent_for_too_long_are_lost(silent, subject, joint):
    silence_s = {k: 0.2501 + 0.01 * k for k in silent}
    fault = look(7.0, silence_s=silence_s)
    assert fault.kind is FaultKind.LOST
    assert (fault.text, fault.joint) == (f"{subject} lost: no angle for more than 0.25 s", joint)
    longest = max(silence_s.values())
    assert (fault.value, fault.limit) == (longest, 0.25)
    assert fault.since_s == pytest.approx(7.0 - longest)
    assert look(7.0, silence_s=dict.fromkeys(silent, 0.25)) is None


def test_many_lost_joints_are_named_in_part():
    fault = look(0.0, silence_s=dict.fromkeys(range(1, 25), 1.0))
    assert fault.text.startswith("joint02, joint03, joint04, joint05 ")
    assert "joint06" not in fault.text
    assert " are lost: " in fault.text


@pytest.mark.parametrize(
    ("kind", "quantity", "values", "text"),
    [
        ("current", "current", (1.5, -1.7), "current 1.7 A, more than 1.4 A"),
        ("temperature", "temperature", (70.1, 99.0), "temperature 99 degC, more than 70 degC"),
        ("voltage", "voltage", (4.9, 3.5), "voltage 3.5 V, less than 5 V"),
        ("tracking", "angle", (0.36, -0.4), "tracking error 0.4 rad, more than 0.35 rad"),
    ],
)
def test_an_excess_is_a_fault_when_it_has_lasted_and_names_the_worst_joint(
    kind, quantity, values, text
):
    watch, given = Watch(LIMITS), {quantity: dict(zip((2, 9), values, strict=True))}
    for at_s in (5.0, 5.1, 5.29):
        assert look(at_s, watch, **given) is None
    fault = look(5.3, watch, **given)
    assert (fault.kind, fault.joint) == (FaultKind(kind), "joint10")
    assert fault.text == f"joint10: {text} for 0.3 s"
    assert (fault.value, fault.since_s) == (abs(values[1]), 5.0)
    assert fault.limit == {"current": 1.4, "temperature": 70.0, "voltage": 5.0}.get(kind, 0.35)
    assert look(5.4, watch) is None  # over: it counts from the next one on
    assert look(5.5, watch, **given) is None
    assert look(5.7, watch, **given) is None
    assert look(5.8, watch, **given).since_s == 5.5


def test_each_joint_and_each_quantity_lasts_by_itself():
    watch = Watch(LIMITS)
    assert look(0.0, watch, current={3: 1.5}) is None
    assert look(0.2, watch, current={3: 1.5, 8: 9.0}, temperature={5: 80.0}) is None
    fault = look(0.31, watch, current={3: 1.5, 8: 9.0}, temperature={5: 80.0})
    assert (fault.joint, fault.since_s) == ("joint04", 0.0)  # the worse one has not lasted
    fault = look(0.5, watch, temperature={5: 80.0})
    assert (fault.kind, fault.joint) == (FaultKind.TEMPERATURE, "joint06")
    assert "for 0.3 s" in fault.text


def test_what_is_at_its_limit_or_unknown_is_no_fault():
    watch, command = Watch(LIMITS), np.zeros(25)
    command[4] = 0.5
    at_limit = {"current": {1: 1.4, 2: np.nan}, "temperature": {1: 70.0, 2: np.nan}}
    at_limit |= {"voltage": {1: 5.0, 2: np.nan}, "angle": {1: 0.35, 2: np.nan}}
    for at_s in np.arange(0.0, 2.0, 0.1):
        assert look(at_s, watch, command, **at_limit) is None
    command[4] = 0.51
    assert look(2.0, watch, command) is None
    fault = look(2.3, watch, command)
    assert (fault.joint, fault.limit) == ("joint05", 0.5)


def test_of_several_faults_the_lost_joint_comes_first():
    watch = Watch(LIMITS)
    everything = {"current": {0: 9.0}, "temperature": {1: 99.0}, "voltage": {2: 1.0}}
    everything |= {"angle": {3: 1.0}}
    assert look(0.0, watch, **everything) is None
    for kind, name in (
        ("lost", "silence_s"), ("current", "current"), ("temperature", "temperature"),
        ("voltage", "voltage"), ("tracking", "angle"),
    ):  # fmt: skip
        shown = everything | ({"silence_s": {4: 2.0}} if kind == "lost" else {})
        assert look(1.0, watch, **shown).kind == kind
        everything.pop(name, None)
    assert look(1.0, watch) is None


# -- who is on the bus --------------------------------------------------------------------------


def frames_of(*identifiers, way=0):
    frames = empty_frames(len(identifiers))
    frames["id_flags"] = identifiers
    frames["dlc"], frames["dir"] = 8, way
    return frames


def test_another_robot_is_one_of_which_most_frames_are_not_known():
    check = BusCheck(ROBOT)
    assert check.another_robot() is None
    check.add(frames_of(0x201, 0x202, MARK, MARK))
    assert check.recognised == 2
    assert check.strange == {MARK: 2}
    assert check.another_robot() is None  # as many of one as of the other
    more = [MARK + k for k in range(7, 0, -1) for _ in range(k)]
    check.add(frames_of(*more, MARK, 0x203))
    assert (check.recognised, check.strange.total()) == (3, 31)
    listed = ", ".join(f"{MARK + k:03X}" for k in range(7, 3, -1))
    assert check.another_robot() == (
        "another robot is on this bus: of 34 frames received 3 are of snake25; others have the "
        f"identifiers {listed}, {MARK:03X}, {MARK + 3:03X}"
    )


def test_frames_that_are_no_data_of_others_are_not_counted():
    check = BusCheck(ROBOT)
    assert check.add(frames_of(0x101, MARK, way=DIR_TX)) is None  # an echo of our own
    assert check.add(frames_of(REMOTE_FLAG | 0x101, REMOTE_FLAG | MARK)) is None
    assert check.add(frames_of(ERROR_FLAG | 0x80)) is None
    assert (check.recognised, check.strange.total()) == (0, 0)
    fault = check.add(frames_of(0x201, ERROR_FLAG | BUS_OFF))
    assert fault.kind is FaultKind.BUS_OFF
    # The bit that tells bus-off in an error frame is part of usual identifiers.
    assert check.add(frames_of(0x200 | BUS_OFF)) is None


@pytest.mark.parametrize("others", [(0x119,), (0x108, 0x102), (MARK, 0x201, 0x101)])
def test_commands_of_another_controller_are_a_fault(others):
    fault = BusCheck(ROBOT).add(frames_of(*others))
    first = next(other for other in others if 0x101 <= other <= 0x119)
    assert fault.kind is FaultKind.STRANGER
    assert fault.text == (
        f"another controller commands snake25 on this bus: frame {first:03X} was received; end "
        "that controller first"
    )


def test_a_request_that_shares_its_identifier_with_a_reply_tells_nothing():
    check = BusCheck(load_robot("arcsnake-joint"))
    assert check.add(frames_of(MARK, MARK)) is None
    assert (check.recognised, check.another_robot()) == (2, None)
