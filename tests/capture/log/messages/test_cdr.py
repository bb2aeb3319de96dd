"""CDR layouts against two foreign implementations: rosbags and mcap-ros2-support."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from undulog.capture.common.errors import DataError
from undulog.capture.log.messages.cdr import encode, layout_of
from undulog.capture.log.messages.definitions import message_type, parse_message_type, schema_text

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = {"sec": 1_700_000_000, "nanosec": 123_456_789}
NAMES = ["joint01", "neck", "a-much-longer-joint-name"]
MESSAGES = {
    "sensor_msgs/msg/JointState": {
        "header": {"stamp": STAMP, "frame_id": "odd"},
        "name": NAMES,
        "position": [0.1, -0.2, 0.3],
        "velocity": [],
        "effort": [1.0, 2.0, 3.0],
    },
    "nav_msgs/msg/Odometry": {
        "header": {"stamp": STAMP, "frame_id": "world"},
        "child_frame_id": "link01",
        "pose": {"pose": {"position": {"x": 1.0}}, "covariance": np.arange(36.0)},
    },
    "sensor_msgs/msg/Range": {
        "header": {"stamp": STAMP, "frame_id": "ir01"},
        "radiation_type": 1,
        "min_range": 0.2,
        "range": 0.75,
    },
    "tf2_msgs/msg/TFMessage": {
        "transforms": [{"header": {"frame_id": "world"}, "child_frame_id": name} for name in NAMES]
    },
    "rcl_interfaces/msg/Log": {"stamp": STAMP, "level": 30, "name": "twin", "msg": "naïve — ok"},
    "std_msgs/msg/UInt8MultiArray": {
        "layout": {"dim": [{"label": "frame", "size": 2, "stride": 6}]},
        "data": np.arange(6, dtype=np.uint8),
    },
}


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_an_encoded_message_is_what_rosbags_encodes(name):
    ours = encode(message_type(name), MESSAGES[name])
    assert bytes(STORE.serialize_cdr(STORE.deserialize_cdr(ours, name), name)) == ours


def _expected(message, path):
    for part in path.replace("[", ".[").split("."):
        message = message[int(part[1:-1])] if part.startswith("[") else getattr(message, part)
    return message


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_every_leaf_lies_where_rosbags_finds_it(name):
    data = encode(message_type(name), MESSAGES[name])
    layout = layout_of(message_type(name), data)
    theirs = STORE.deserialize_cdr(data, name)
    for path, leaf in layout.leaves.items():
        values = np.frombuffer(data, leaf.dtype, leaf.count, leaf.offset)
        np.testing.assert_array_equal(values, np.atleast_1d(_expected(theirs, path)))
    for path, text in layout.strings.items():
        assert text == _expected(theirs, path)


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_our_definitions_have_the_fields_of_ros_2(name):
    theirs = STORE.generate_msgdef(name, ros_version=2)[0]
    assert parse_message_type(name, theirs) == parse_message_type(name, schema_text(name))


def test_a_message_that_is_too_short_is_refused():
    name = "sensor_msgs/msg/JointState"
    data = encode(message_type(name), MESSAGES[name])
    for size in range(4, len(data)):
        with pytest.raises(DataError, match="ends at byte"):
            layout_of(message_type(name), data[:size])


def test_a_huge_length_is_refused_at_once():
    kind = message_type("std_msgs/msg/UInt8MultiArray")
    data = bytearray(encode(kind, {}))
    data[4:8] = b"\xff\xff\xff\x7f"
    with pytest.raises(DataError, match="can't be right"):
        layout_of(kind, bytes(data))


def test_big_endian_is_refused_by_name():
    with pytest.raises(DataError, match="not little-endian CDR"):
        layout_of(message_type("std_msgs/msg/String"), b"\x00\x00\x00\x00" + bytes(8))


def test_an_unknown_field_lists_those_that_exist():
    with pytest.raises(DataError, match=r"no field 'postion'; it has header, name, position"):
        encode(message_type("sensor_msgs/msg/JointState"), {"postion": [1.0]})


def test_constants_defaults_bounds_and_nested_packages_parse():
    text = "uint8 A=1\nstring<=8 s 'x'\nfloat64[3] v\nint32[<=4] w\nOther o  # a comment\n"
    text += "=" * 80 + "\nMSG: mine/Other\nfloat32 x 1.5\n"
    kind = parse_message_type("mine/msg/Main", text)
    fields = [(f.name, f.length, f.is_array) for f in kind.fields]
    assert fields == [("s", 1, False), ("v", 3, True), ("w", None, True), ("o", 1, False)]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("Other o", "no definition of mine/Other"),
        ("float64", "cannot read the line 'float64'"),
        ("Main m", "mine/Main contains itself"),
    ],
)
def test_a_bad_schema_is_refused_with_what_is_wrong(text, complaint):
    with pytest.raises(DataError, match=complaint):
        parse_message_type("mine/msg/Main", text)
