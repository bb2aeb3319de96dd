"""Encoding of frames, against cantools on every kind of signal and against our own decoder."""

import math
import struct

import cantools
import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from support.bus_robots import bus_robot
from undulog.capture import load_robot
from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.bus.map_entry import BitField
from undulog.capture.common.errors import DataError
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Direction, Quantity


@pytest.mark.slow
@settings(max_examples=400, deadline=None)
@given(
    position=st.integers(0, 63),
    length=st.integers(1, 64),
    size=st.integers(1, 8),
    layout=st.tuples(st.booleans(), st.sampled_from(["unsigned", "signed", "float"])),
    share=st.integers(0, 2**64),
)
def test_every_layout_as_cantools_packs_it(position, length, size, layout, share):
    little, kind = layout
    if kind == "float":
        length = (16, 32, 64)[length % 3]
    size = max(size, -(-length // 8))
    start = min(position, 8 * size - length)
    if not little:
        start = 8 * (start // 8) + 7 - start % 8
    conversion = BaseConversion.factory(is_float=kind == "float")
    order = "little_endian" if little else "big_endian"
    signal = Signal("s", start, length, order, kind != "unsigned", conversion=conversion)
    least = -(2 ** (length - 1)) if kind == "signed" else 0
    value = least + share * (2**length - 1) // 2**64
    if kind == "float":
        value = share * 1e-16
    message = Message(1, "m", size, [signal], strict=True)
    field = BitField.of(signal)
    bits = field.raw_bits(value) if abs(value) < 2**53 else value & (2**length - 1)
    assert field.placed(bits, size).to_bytes(size, "little") == message.encode({"s": value})


def test_values_beyond_the_field_become_its_ends():
    field = BitField(0, 8, signed=True, scale=0.5, offset=1.0)
    raw = [field.raw_bits(value) for value in (-1e9, 1e9, math.inf, -math.inf, 1.26, 1.24)]
    assert raw == [0x80, 0x7F, 0x7F, 0x80, 1, 0]
    assert field.raw_bits(50.0, field.raw_range(upper=11.0)) == 20
    assert field.raw_bits(-50.0, field.raw_range(lower=-9.0)) == (-20) & 0xFF
    assert BitField(0, 8, scale=-1.0).raw_bits(-1e9) == 0xFF  # a falling scale turns the ends round
    narrow = BitField(0, 16, is_float=True)
    assert narrow.raw_bits(1e9) == int.from_bytes(struct.pack("<e", math.inf), "little")


def decoded(robot, frames):
    """All values in frames: (target, quantity, axis) to value, by our own decoder."""
    samples, tally = BusDecoder(robot).decode(frames)
    assert tally.decoded == len(frames)
    return {
        (sample.signals[k].target, sample.signals[k].quantity, sample.signals[k].axis): value
        for sample in samples
        for k, value in zip(sample.member.tolist(), sample.values.tolist(), strict=True)
    }


@pytest.mark.parametrize("direction", list(Direction))
def test_a_robots_values_come_back_within_half_a_step(direction):
    robot = load_robot("snake25")
    encoder = BusEncoder(robot, direction)
    rng = np.random.default_rng(5)
    span = {Quantity.RANGE: (0.0, 1.5), Quantity.TEMPERATURE: (-20.0, 80.0)}
    step = {  # half of one bit, in SI, by the database
        **dict.fromkeys((Quantity.COMMAND, Quantity.POSITION), math.radians(0.005)),
        Quantity.VELOCITY: math.radians(0.05),
        **dict.fromkeys((Quantity.EFFORT, Quantity.CURRENT, Quantity.RANGE), 0.0005),
        Quantity.TEMPERATURE: 0.5,
    }
    keys = [key for key in sorted(encoder.values) if key[1] in step]
    values = {key: rng.uniform(*span.get(key[1], (-0.5, 0.5))) for key in keys}
    frames = encoder.encode(values, 7)
    assert set(frames["dir"]) == {DIR_TX if direction is Direction.TX else DIR_RX}
    assert set(frames["t_host_ns"]) == {7}
    readings = decoded(robot, frames)
    assert {key for key in readings if key[1] in step} == set(values)
    for key, value in values.items():
        assert readings[key] == pytest.approx(value, abs=1.0001 * step[key[1]]), key


def test_frames_are_those_that_cantools_packs():
    robot = load_robot("snake25")
    database = cantools.database.load_string(dict(robot.databases)["snake25.dbc"], "dbc")
    values = {
        ("joint03", Quantity.POSITION, ""): math.radians(-12.34),
        ("joint03", Quantity.EFFORT, ""): 0.251,
        ("joint03", Quantity.CURRENT, ""): -1.5,
        ("accelerometer", Quantity.ACCELERATION, "z"): 9.80665,
        ("joint04", Quantity.POSITION, ""): math.nan,
    }
    joint, acceleration = BusEncoder(robot, Direction.RX).encode(values)
    expected = {"position": -12.34, "velocity": 0, "torque": 251, "current": -1500}
    message = database.get_message_by_name("joint03_state")
    assert joint["id_flags"] == message.frame_id
    assert joint["data"].tobytes() == message.encode(expected | {"temperature": "unknown"})
    message = database.get_message_by_name("acceleration")
    size = int(acceleration["dlc"])
    expected = message.encode({"x": 0, "y": 0, "z": 1000})
    assert (size, acceleration["data"].tobytes()[:size]) == (message.length, expected)


def test_a_value_that_is_not_given_stays_as_it_was_sent():
    robot = load_robot("snake25")
    encoder = BusEncoder(robot, Direction.RX)
    position, velocity = (("joint01", q, "") for q in (Quantity.POSITION, Quantity.VELOCITY))
    encoder.encode({position: 0.1, velocity: 1.0})
    readings = decoded(robot, encoder.encode({velocity: 2.0}))
    assert readings[position] == pytest.approx(0.1, abs=1e-4)
    assert readings[velocity] == pytest.approx(2.0, abs=1e-3)
    for nothing in ({}, {("joint01", Quantity.COMMAND, ""): 1}):
        assert len(encoder.encode(nothing)) == 0


def test_what_is_out_of_range_or_unknown_has_numbers_of_its_own():
    robot = load_robot("snake25")
    (frame,) = BusEncoder(robot, Direction.RX).encode({("ir01", Quantity.RANGE, ""): math.inf})
    database = cantools.database.load_string(dict(robot.databases)["snake25.dbc"], "dbc")
    codes = database.decode_message("ranges_1", frame["data"].tobytes())
    unknown = dict.fromkeys(("ir02", "ir03", "ir04"), "unknown")
    assert codes == {"ir01": "nothing in range", **unknown}
    readings = decoded(robot, np.array([frame]))
    assert readings.pop(("ir01", Quantity.RANGE, "")) == math.inf
    assert all(map(math.isnan, readings.values()))


def test_without_such_a_number_nothing_in_range_is_the_greatest_distance():
    robot = load_robot("snake25")
    plain = robot.toml.replace(", unknown = 65534, out_of_range = 65535", "")
    robot = parse_robot(plain, source="plain.toml", databases=dict(robot.databases))
    frames = BusEncoder(robot, Direction.RX).encode({("ir01", Quantity.RANGE, ""): math.inf})
    assert decoded(robot, frames)["ir01", Quantity.RANGE, ""] == 65.535


def test_multiplexed_frames_are_those_that_cantools_packs():
    robot = load_robot("arcsnake-joint")
    (command,) = [s for s in robot.bus.signals if s.direction is Direction.TX]
    key = (command.target, command.quantity, command.axis)
    (frame,) = BusEncoder(robot, Direction.TX).encode({key: 0.2})
    database = cantools.database.load_string(dict(robot.databases)["rmd-x8-request.dbc"], "dbc")
    message = database.get_message_by_name(command.message)
    physical = (math.degrees(0.2) - command.offset) / command.scale
    fields = {"command": 164, "speed_limit": 0, command.signal: physical}
    assert frame["data"].tobytes() == message.encode(fields)
    # Replies: the position has a frame of its own, what the motor does another one.
    both = BusEncoder(robot, Direction.RX)
    values = dict.fromkeys(both.values, 0.1)
    assert [row["data"][0] for row in both.encode(values)] == [146, 156]
    assert set(decoded(robot, both.encode(values))) == both.values


def test_initial_values_fill_what_the_map_does_not_name():
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: c\n\nBO_ 5 m: 3 c\n'
        ' SG_ q : 0|8@1- (0.1,0) [0|0] "deg" c\n'
        ' SG_ mode : 15|8@0+ (1,0) [0|0] "" c\n'
        ' SG_ limit : 16|8@1+ (2,0) [0|0] "" c\n\n'
        'BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 100000;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'
        'BA_ "GenSigStartValue" SG_ 5 mode 7;\nBA_ "GenSigStartValue" SG_ 5 limit 21;\n'
    )
    robot = bus_robot(text, [("m", "q", "tx", "command", "deg", "")])
    (frame,) = BusEncoder(robot, Direction.TX).encode({("joint01", Quantity.COMMAND, ""): 0.0})
    assert frame["data"].tolist()[:3] == [0, 7, 21]  # start values are raw


def test_a_robot_without_a_bus_is_refused():
    with pytest.raises(DataError, match="snake13 has no bus map"):
        BusEncoder(load_robot("snake13"), Direction.TX)
