"""Readings from the bus: frames that the shared encoder packs, decoded for a gait."""

import math

import numpy as np
import pytest

from support.bus_robots import bus_robot
from undulog.capture import load_robot
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.log.messages.frames import DIR_TX, empty_frames
from undulog.capture.robot.model import Direction, Quantity
from undulog.sim.drive.links import BusReadings

ROBOT = load_robot("snake25")
encode = BusEncoder(ROBOT, Direction.RX).encode


@pytest.fixture
def bus_readings():
    return BusReadings(ROBOT)


def joint(quantity, value, name="joint03"):
    return {(name, quantity, ""): value}


def test_nothing_is_known_before_the_first_frame(bus_readings):
    readings = bus_readings.readings(0.0)
    assert np.isnan(readings.angle).all()
    assert np.isnan(readings.velocity).all()
    assert readings.ranges == readings.acceleration == readings.magnetic_field == {}
    assert (bus_readings.status(3.0).silence_s == math.inf).all()


def test_each_sensor_has_its_newest_value(bus_readings):
    first = joint(Quantity.POSITION, 0.1) | joint(Quantity.VELOCITY, -1.0)
    first |= {("ir01", Quantity.RANGE, ""): 0.5, ("sonar", Quantity.RANGE, ""): 2.0}
    for axis, specific_force in (("x", 1.0), ("y", 2.0), ("z", 9.0)):
        first["accelerometer", Quantity.ACCELERATION, axis] = specific_force
    for axis, field in (("x", 2e-5), ("y", 1e-5)):
        first["compass", Quantity.MAGNETIC_FIELD, axis] = field
    bus_readings.add(encode(first), 1.0)
    bus_readings.add(encode(joint(Quantity.POSITION, 0.2)), 1.01)
    readings = bus_readings.readings(1.01)
    assert readings.angle[2] == pytest.approx(0.2, abs=1e-4)
    assert readings.velocity[2] == pytest.approx(-1.0, abs=1e-3)
    assert np.isnan(np.delete(readings.angle, 2)).all()
    assert readings.ranges == pytest.approx({"ir01": 0.5, "sonar": 2.0}, abs=6e-4)
    np.testing.assert_allclose(readings.acceleration["accelerometer"], [1, 2, 9], atol=5e-3)
    np.testing.assert_allclose(
        readings.magnetic_field["compass"], [2e-5, 1e-5, math.nan], atol=1e-8
    )
    silence_s = bus_readings.status(1.5).silence_s
    assert silence_s[2] == pytest.approx(0.49)
    assert (np.delete(silence_s, 2) == math.inf).all()
    assert bus_readings.tally.decoded == 6


def test_the_gate_gets_what_the_servos_report_of_themselves(bus_readings):
    values = joint(Quantity.POSITION, 0.1) | joint(Quantity.CURRENT, -1.2)
    bus_readings.add(encode(values | joint(Quantity.TEMPERATURE, 41.0)), 0.0)
    bus_readings.add(encode(joint(Quantity.POSITION, 0.2) | joint(Quantity.CURRENT, 0.7)), 0.01)
    status = bus_readings.status(0.02)
    assert status.angle[2] == pytest.approx(0.2, abs=1e-4)
    assert status.current[2] == pytest.approx(0.7, abs=1e-3)
    assert status.temperature[2] == 41.0  # the second frame says that it is not known
    assert np.isnan(status.voltage).all()  # not on this bus
    assert np.isnan(np.delete(status.current, 2)).all()
    assert np.isnan(bus_readings.status(0.6).current).all()


def test_nothing_in_range_is_infinitely_far_and_unknown_is_not_a_value(bus_readings):
    bus_readings.add(encode({("ir01", Quantity.RANGE, ""): 0.5}), 0.0)
    bus_readings.add(
        encode({("ir02", Quantity.RANGE, ""): math.inf}), 0.1
    )  # shares a frame with ir01
    assert bus_readings.readings(0.1).ranges == {"ir01": pytest.approx(0.5), "ir02": math.inf}


def test_what_has_not_come_for_long_is_unknown_again():
    readings = BusReadings(ROBOT, oldest_s=0.3)
    readings.add(encode(joint(Quantity.POSITION, 0.1) | {("ir01", Quantity.RANGE, ""): 0.5}), 0.0)
    readings.add(encode(joint(Quantity.POSITION, 0.3, "joint04")), 0.2)
    assert not math.isnan(readings.readings(0.3).angle[2])
    later = readings.readings(0.31)
    assert math.isnan(later.angle[2])
    assert (later.angle[3], later.ranges) == (pytest.approx(0.3, abs=1e-4), {})


def test_what_was_handed_out_does_not_change_later(bus_readings):
    values = {("accelerometer", Quantity.ACCELERATION, "x"): 1.0}
    bus_readings.add(encode(values | joint(Quantity.POSITION, 0.1)), 0.0)
    before = bus_readings.readings(0.0)
    bus_readings.add(encode(dict.fromkeys(values, 5.0) | joint(Quantity.POSITION, 0.4)), 0.01)
    assert before.angle[2] == pytest.approx(0.1, abs=1e-4)
    assert before.acceleration["accelerometer"][0] == pytest.approx(1.0, abs=5e-3)
    with pytest.raises(ValueError, match="read-only"):
        before.angle[2] = 0.0


def test_frames_of_others_are_counted_and_give_no_reading(bus_readings):
    frames = empty_frames(2)
    frames["id_flags"] = [0x101, 0x7FF]  # a command, and an unknown identifier
    frames["dlc"], frames["dir"] = 2, [0, DIR_TX]
    bus_readings.add(frames, 0.0)
    assert (bus_readings.status(1.0).silence_s == math.inf).all()
    assert (bus_readings.tally.frames, bus_readings.tally.decoded) == (2, 0)


FLOATS = """
VERSION ""
BU_: a b

BO_ 5 angle: 4 a
 SG_ radians : 0|32@1- (1,0) [0|0] "rad" b

SIG_VALTYPE_ 5 radians : 1;
"""


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_servo_at_infinity_has_not_replied(value):
    """A bus with floating-point numbers can have it."""
    readings = BusReadings(bus_robot(FLOATS, [("angle", "radians", "rx", "position", "rad", "")]))
    frames = empty_frames(1)
    frames["id_flags"], frames["dlc"] = 5, 4
    for angle, time_s in ((0.25, 1.0), (value, 1.1)):
        frames["data"][0, :4] = np.frombuffer(np.float32(angle).tobytes(), np.uint8)
        readings.add(frames, time_s)
    status = readings.status(1.1)
    assert status.angle.tolist() == [0.25]
    assert status.silence_s[0] == pytest.approx(0.1)
    assert readings.angles.tolist() == [1]
