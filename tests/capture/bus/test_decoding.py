"""Decoding of frames, against cantools on every kind of signal."""

import math

import cantools
import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from cantools.database.errors import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from support.bus_robots import bus_robot
from undulog.capture import load_robot
from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.bus.map_entry import BitField
from undulog.capture.common.errors import DataError
from undulog.capture.log.messages import frames as fr
from undulog.capture.robot.bus_map import UNITS


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def reference(signal, data):
    """Values as cantools decodes them, one message at a time."""
    message = Message(1, "m", data.shape[1], [signal], strict=True)
    return [float(message.decode(row.tobytes(), decode_choices=False)["s"]) for row in data]


def motorola(position):
    """The top bit of a signal that is so far from the top of byte 0, in the numbers of a DBC."""
    return 8 * (position // 8) + 7 - position % 8


def layouts():
    """Every place and length that a signal can have in eight bytes."""
    for length in range(1, 65):
        for position in range(65 - length):
            yield "little_endian", position, length
            yield "big_endian", motorola(position), length


@pytest.mark.slow
def test_integers_of_every_layout(rng):
    data = rng.integers(0, 256, (3, 8), dtype=np.uint8)
    data[0] = 255
    for byte_order, start, length in layouts():
        for signed in (False, True):
            signal = Signal("s", start, length, byte_order, signed)
            assert BitField.of(signal).values(data).tolist() == reference(signal, data), signal


@pytest.mark.slow
@settings(max_examples=400, deadline=None)
@given(
    position=st.integers(0, 511),
    length=st.integers(1, 64),
    byte_order=st.sampled_from(["little_endian", "big_endian"]),
    kind=st.sampled_from(["unsigned", "signed", "float"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_layout_in_the_64_bytes_of_can_fd(position, length, byte_order, kind, seed):
    if kind == "float":
        length = (16, 32, 64)[length % 3]
    position = min(position, 512 - length)
    start = motorola(position) if byte_order == "big_endian" else position
    conversion = BaseConversion.factory(scale=0.5, offset=-3, is_float=kind == "float")
    signal = Signal("s", start, length, byte_order, kind != "unsigned", conversion=conversion)
    data = np.random.default_rng(seed).integers(0, 256, (5, 64), dtype=np.uint8)
    data[0] = 255
    values, expected = BitField.of(signal).values(data), reference(signal, data)
    np.testing.assert_allclose(values, expected, rtol=1e-15, atol=0)


@pytest.mark.parametrize("length", [16, 32, 64])
@pytest.mark.parametrize("byte_order", ["little_endian", "big_endian"])
def test_floats_of_every_layout(byte_order, length, rng):
    data = rng.integers(0, 256, (20, 8), dtype=np.uint8)
    conversion = BaseConversion.factory(scale=0.5, offset=-3, is_float=True)
    for order, start, size in layouts():
        if (order, size) == (byte_order, length):
            signal = Signal("s", start, length, byte_order, True, conversion=conversion)
            values, expected = BitField.of(signal).values(data), reference(signal, data)
            np.testing.assert_array_equal(values, expected)


@given(
    data=st.binary(min_size=8, max_size=8),
    layout=st.sampled_from(list(layouts())),
    signed=st.booleans(),
    scale=st.floats(-1e6, 1e6).filter(lambda scale: scale != 0),
    offset=st.floats(-1e6, 1e6),
)
def test_scaled_integers(data, layout, signed, scale, offset):
    byte_order, start, length = layout
    conversion = BaseConversion.factory(scale=scale, offset=offset)
    signal = Signal("s", start, length, byte_order, signed, conversion=conversion)
    row = np.frombuffer(data, dtype=np.uint8).reshape(1, 8)
    expected = reference(signal, row)[0]
    # cantools counts in exact integers where scale and offset are whole, we in doubles.
    assert BitField.of(signal).values(row)[0] == pytest.approx(expected, rel=1e-15, abs=1e-9)


MULTIPLEXED = """VERSION ""

NS_ :
	SG_MUL_VAL_

BU_: a b

BO_ 2147484672 mux: 8 a
 SG_ outer M : 3|4@0+ (1,0) [0|0] "" b
 SG_ inner m1M : 8|8@1+ (1,0) [0|0] "" b
 SG_ one m2 : 16|16@1- (0.1,5) [0|0] "deg" b
 SG_ two m2 : 39|12@0+ (1,-40) [0|0] "deg/s" b
 SG_ three m0 : 8|32@1- (1,0) [0|0] "A" b
 SG_ always : 56|8@1+ (0.5,0) [0|0] "V" b

BO_ 5 plain: 4 a
 SG_ four : 0|32@1- (1,0) [0|0] "N m" b

SG_MUL_VAL_ 2147484672 inner outer 1-3;
SG_MUL_VAL_ 2147484672 one inner 2-2, 5-7;
SG_MUL_VAL_ 2147484672 two inner 2-9;
SG_MUL_VAL_ 2147484672 three outer 0-0, 4-15;
SIG_VALTYPE_ 5 four : 1;
"""

SIGNALS = [
    ("mux", "one", "rx", "position", "rad", ""),
    ("mux", "two", "rx", "velocity", "rad/s", "scale = 2.0\noffset = 1.0"),
    ("mux", "three", "rx", "current", "A", ""),
    ("mux", "always", "rx", "voltage", "V", ""),
    ("plain", "four", "rx", "effort", "N m", ""),
]


@pytest.fixture(scope="module")
def muxed():
    return bus_robot(MULTIPLEXED, SIGNALS)


def some_frames(count, id_flags, dlc=8, way=fr.DIR_RX):
    frames = fr.empty_frames(count)
    frames["t_host_ns"] = np.arange(count) * 1000 + 7
    frames["id_flags"], frames["dlc"], frames["dir"] = id_flags, dlc, way
    return frames


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_nested_multiplexing(muxed, seed):
    rng = np.random.default_rng(seed)
    frames = some_frames(200, 1024 | fr.EXTENDED_FLAG)
    frames["data"] = rng.integers(0, 256, (200, 8))
    frames["data"][:, 1] %= 11
    samples, tally = BusDecoder(muxed).decode(frames)
    database = cantools.database.load_string(MULTIPLEXED, "dbc")
    expected = {}
    for row, frame in enumerate(frames):
        try:
            decoded = database.decode_message("mux", frame["data"].tobytes())
        except DecodeError:  # a multiplexer value without signals; cantools then gives up on all
            decoded = {"always": frame["data"][7] * 0.5}
        for name, value in decoded.items():
            expected.setdefault(name, {})[row] = value
    by_name = {sample.signals[0].signal: sample for sample in samples}
    assert set(by_name) == set(expected) - {"outer", "inner"}
    for name, sample in by_name.items():
        values = sample.values if name != "two" else (sample.values - 1) / 2
        assert dict(zip(sample.rows.tolist(), values.tolist(), strict=True)) == expected[name]
        assert sample.t_ns.tolist() == [row * 1000 + 7 for row in expected[name]]
    assert (tally.frames, tally.decoded, tally.problems()) == (200, 200, [])


@pytest.mark.nightly
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_frames_of_many_joints_and_sensors_at_once(seed):
    robot = load_robot("snake25")
    database = cantools.database.load_string(dict(robot.databases)["snake25.dbc"], "dbc")
    way = {signal.message: signal.direction for signal in robot.bus.signals}
    rng = np.random.default_rng(seed)
    chosen = rng.choice(database.messages, 300)
    frames = some_frames(300, [message.frame_id for message in chosen])
    frames["dlc"] = [message.length for message in chosen]
    frames["dir"] = [fr.DIR_TX if way[message.name] == "tx" else fr.DIR_RX for message in chosen]
    frames["data"] = rng.integers(0, 256, (300, 8))
    expected = {}
    for row, (message, frame) in enumerate(zip(chosen, frames, strict=True)):
        data = frame["data"][: message.length].tobytes()
        values = message.decode(data, decode_choices=False)
        for entry in robot.bus.signals:
            if entry.message == message.name:
                raw = message.decode(data, decode_choices=False, scaling=False)[entry.signal]
                value = values[entry.signal] * entry.scale + entry.offset
                codes = {entry.unknown: math.nan, entry.out_of_range: math.inf}
                expected[row, entry] = codes.get(raw, value * UNITS[entry.unit].factor)
    samples, tally = BusDecoder(robot).decode(frames)
    signals = {
        (row, decoded.signals[k]): value
        for decoded in samples
        for row, k, value in zip(
            decoded.rows.tolist(), decoded.member.tolist(), decoded.values.tolist(), strict=True
        )
    }
    assert signals == pytest.approx(expected, rel=1e-12, abs=1e-12, nan_ok=True)
    assert (tally.decoded, tally.problems(), tally.notes()) == (300, [], [])


def test_a_float_signal_of_a_database(muxed):
    frames = some_frames(3, 5, dlc=4)
    frames["data"][:, :4] = np.array([1.5, -2.25, 3e8], dtype="<f4").view(np.uint8).reshape(3, 4)
    ((sample,), _) = BusDecoder(muxed).decode(frames)
    assert (sample.values.tolist(), sample.unit) == ([1.5, -2.25, 3e8], "N m")


def test_no_frame_goes_unaccounted_for(muxed):
    kinds = [
        some_frames(2, 5, dlc=4),  # decoded
        some_frames(3, 5, dlc=3),  # too short for its signal
        some_frames(4, 5, way=fr.DIR_TX),  # known, but nothing is mapped in that direction
        some_frames(5, 5 | fr.EXTENDED_FLAG),  # another identifier
        some_frames(6, 0x7FF),
        some_frames(7, 5 | fr.REMOTE_FLAG),
        some_frames(8, 0x80 | fr.ERROR_FLAG),
    ]
    frames = np.concatenate(kinds)
    samples, tally = BusDecoder(muxed).decode(frames)
    assert sum(len(sample.rows) for sample in samples) == 2
    assert tally.problems() == [
        "8 error frames",
        "3 values missing from frames too short for them: plain.four (3)",
    ]
    assert tally.notes() == [
        "7 remote frames, which carry no data",
        "11 frames with identifiers that are in no database: 7FF (6), 00000005 (5)",
        "4 frames of known identifiers with nothing that the map names: 005 (4)",
    ]
    shares = tally.decoded + tally.errors + tally.remote
    shares += tally.unknown.total() + tally.silent.total() + tally.short.total()
    assert shares == len(frames) == tally.frames


def test_a_frame_too_short_for_its_multiplexer_is_counted(muxed):
    samples, tally = BusDecoder(muxed).decode(some_frames(1, 1024 | fr.EXTENDED_FLAG, dlc=0))
    assert samples == ()
    assert set(tally.short) == {"mux.one", "mux.two", "mux.three", "mux.always"}


def test_the_direction_tells_a_request_from_its_reply():
    decoder = BusDecoder(load_robot("arcsnake-joint"))
    frames = some_frames(5, 0x14B)
    texts = (
        "A40076023FCCFFFF",  # command, 630 deg/s, -13249 * 0.01 deg
        "A417FEFF0000C7A1",  # its reply: 23 degC, -2 * 33/2048 A, 0 deg/s
        "9200000000000000",  # asks for the position: no position of 0
        "923ECCFFFFFFFFFF",  # its reply: -13250 * 0.01 deg
        "9C1721007E00F355",  # motor state: 126 deg/s
    )
    frames["data"] = [list(bytes.fromhex(text)) for text in texts]
    frames["dir"] = [fr.DIR_TX, fr.DIR_RX, fr.DIR_TX, fr.DIR_RX, fr.DIR_RX]
    samples, tally = decoder.decode(frames)
    by_quantity = {s.signals[0].quantity: (s.rows.tolist(), s.values.tolist()) for s in samples}
    assert by_quantity == {
        "command": ([0], pytest.approx([math.radians(-132.49)], rel=1e-15)),
        "position": ([3], pytest.approx([math.radians(-132.50)], rel=1e-15)),
        "velocity": ([1, 4], pytest.approx([0, math.radians(126)], rel=1e-15)),
        "current": ([1, 4], [-2 * 33 / 2048, 33 * 33 / 2048]),
        "temperature": ([1, 4], [23, 23]),
    }
    assert dict(tally.silent) == {"14B": 1}


def test_without_directions_shared_identifiers_are_not_guessed():
    frames = some_frames(2, 0x14B)
    samples, tally = BusDecoder(load_robot("arcsnake-joint"), directions=False).decode(frames)
    assert samples == ()
    cause = "they differ only in direction, which the log does not have"
    assert tally.problems() == [f"2 frames not decoded: {cause}: 14B (2)"]


def test_without_directions_an_identifier_of_one_direction_is_decoded():
    frames = some_frames(1, 0x101, dlc=2)
    frames["data"][:, :2] = [0xE8, 0x03]
    robot = load_robot("snake25")
    assert BusDecoder(robot).decode(frames)[0] == ()
    ((sample,), _) = BusDecoder(robot, directions=False).decode(frames)
    assert sample.values == pytest.approx(math.radians(10), rel=1e-15)


def test_a_robot_without_a_bus():
    with pytest.raises(DataError, match="snake13 has no bus map"):
        BusDecoder(load_robot("snake13"))
