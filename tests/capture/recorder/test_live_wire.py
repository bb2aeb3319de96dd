"""Datagrams of the live feed byte by byte, by the layout in the module's description."""

import random
import struct
import zlib

import pytest
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from undulog.capture.common.errors import DataError
from undulog.capture.log.wal.format import pack_definition
from undulog.capture.recorder.live_wire import (
    HEAD_SIZE,
    MAX_DATAGRAM,
    MAX_MESSAGE,
    RECORD_SIZE,
    DatagramHead,
    DatagramKind,
    LiveDefinitions,
    LiveMessage,
    pack_datagram,
    pack_description,
    pack_message,
    read_head,
    read_records,
)

HEAD, RECORD = "<4sBBHQQ", "<BBHIIQQQ"  # as they are described, the padding as a number
MIB = 1 << 20
MESSAGE = (7, 2**32 - 2, 11, 12, 13, b"data")
SCHEMA = Schema(3, b"float64 x", "ros2msg", "sensor_msgs/msg/JointState")


def record_of(kind, payload, channel=0, sequence=0, *times):
    """A record by the layout."""
    return struct.pack(RECORD, kind, 0, channel, sequence, len(payload), *(times or (0, 0, 0))) + (
        payload
    )


def datagram(*records):
    return pack_datagram(DatagramHead(DatagramKind.MESSAGES, len(records), 5, 6), records)


# -- the layout ------------------------------------------------------------------------------------


def test_sizes_are_those_of_the_layout():
    assert (HEAD_SIZE, RECORD_SIZE) == (struct.calcsize(HEAD), struct.calcsize(RECORD)) == (24, 36)
    assert (MAX_DATAGRAM, MAX_MESSAGE) == (65_536, 65_536 - 24 - 36)
    assert [(kind.name, int(kind)) for kind in DatagramKind] == [
        ("MESSAGES", 0), ("DEFINITIONS", 1), ("END", 2),
    ]  # fmt: skip


def test_a_datagram_has_the_bytes_of_the_layout():
    body = pack_definition(SCHEMA)[1]
    data = pack_datagram(
        DatagramHead(DatagramKind.DEFINITIONS, 513, 2**64 - 2, 2**63 + 1),
        [pack_message(MESSAGE), pack_description(SCHEMA)],
    )
    head = struct.pack(HEAD, b"ULIV", 1, 1, 513, 2**64 - 2, 2**63 + 1)
    message = record_of(Opcode.MESSAGE, b"data", 7, 2**32 - 2, 11, 12, 13)
    assert data[:24] == head
    assert data[24 : 24 + 40] == message
    assert data[64:100] == record_of(Opcode.SCHEMA, zlib.compress(body))[:36]
    assert zlib.decompress(data[100:]) == body
    assert read_head(data) == DatagramHead(DatagramKind.DEFINITIONS, 513, 2**64 - 2, 2**63 + 1)
    assert read_records(data) == [LiveMessage(*MESSAGE), SCHEMA]


def test_a_head_without_records_is_whole_and_any_less_is_none():
    head = pack_datagram(DatagramHead(DatagramKind.END, 0, 1, 2), [])
    assert (read_head(head).kind, read_records(head)) == (DatagramKind.END, [])
    for size in (23, 0):
        with pytest.raises(DataError, match=f"a datagram of {size} bytes is too short for the"):
            read_head(head[:size])


@pytest.mark.parametrize(("at", "value"), [(0, b"X"), (3, b"W"), (4, b"\0"), (4, b"\2"), (5, b"\3"),
                                           (5, b"\xff")])  # fmt: skip
def test_another_magic_version_or_kind_is_refused(at, value):
    head = pack_datagram(DatagramHead(DatagramKind.MESSAGES, 0, 1, 2), [])
    with pytest.raises(DataError, match="not of this version's live feed"):
        read_head(head[:at] + value + head[at + 1 :])


def test_a_datagram_is_read_whole_or_refused_wherever_it_is_cut():
    parts = [pack_message((1, 2, 3, 4, 5, payload)) for payload in (b"", b"x", b"yz")]
    whole = datagram(*parts)
    ends = [24, 60, 97, len(whole)]
    for size in range(24, len(whole) + 1):
        if size in ends:
            records = read_records(whole[:size])
            assert [record.payload for record in records] == [b"", b"x", b"yz"][: ends.index(size)]
        else:
            with pytest.raises(DataError, match="cut short"):
                read_records(whole[:size])


# -- definitions -----------------------------------------------------------------------------------


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_definition_has_16_mib_at_most(beyond):
    size = 16 * MIB + beyond - struct.calcsize("<HIII")
    body = struct.pack("<HIII", 1, 0, 0, size) + bytes(size)  # a schema without names
    data = datagram(record_of(Opcode.SCHEMA, zlib.compress(body, 1)))
    if beyond:
        with pytest.raises(DataError, match="too long or cut short"):
            read_records(data)
    else:
        assert len(read_records(data)[0].data) == size


def _schema(text):
    return struct.pack("<HI", 1, len(text)) + text + bytes(8)


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        (Opcode.SCHEMA, b"not compressed"),
        (Opcode.SCHEMA, zlib.compress(pack_definition(SCHEMA)[1])[:-1]),
        (Opcode.SCHEMA, zlib.compress(pack_definition(SCHEMA)[1][:1])),  # the record is cut
        (0x77, zlib.compress(b"")),
        (Opcode.SCHEMA, zlib.compress(_schema(b"\xff"))),  # not UTF-8
        (Opcode.ATTACHMENT, zlib.compress(bytes(16) + bytes(8) + b"\xff" * 8)),
    ],
)
def test_a_definition_that_can_not_be_read_is_refused(kind, payload):
    with pytest.raises(DataError, match="a definition of the live feed "):
        read_records(datagram(record_of(kind, payload)))


def kept(*records, period_ns=5):
    """Definitions that are kept as a feed keeps them."""
    definitions = LiveDefinitions(period_ns)
    for record in records:
        packed = definitions.pack(record)
        if packed is not None:
            definitions.keep(record, packed)
    return definitions


def sent(definitions):
    """The records of all groups, read."""
    return read_records(
        datagram(*(definition for group in definitions.groups(1 << 20) for definition in group))
    )


def test_of_files_and_facts_only_the_robot_s_and_undulog_s_are_sent():
    files = [Attachment(0, 0, name, "text", b"x") for name in
             ("robot.toml", "a.dbc", "scenario.toml", "a.dbc.txt", "my robot.toml")]  # fmt: skip
    facts = [Metadata(name, {"a": "1"}) for name in ("undulog", "undulog.clock", "")]
    definitions = kept(*files, *facts)
    assert [definition.name for definition in sent(definitions)] == [
        "robot.toml",
        "a.dbc",
        "undulog",
    ]
    assert [definitions.pack(file) is None for file in (*files, *facts)] == [
        False, False, True, True, True, False, True, True,
    ]  # fmt: skip


def test_a_definition_replaces_the_one_of_its_number_or_name_in_its_place():
    channels = [Channel(1, topic, "cdr", {}, 3) for topic in ("/old", "/new")]
    schemas = [Schema(1, b"", "ros2msg", name) for name in ("a", "b")]
    files = [Attachment(0, 0, "robot.toml", "text", data) for data in (b"1", b"2")]
    facts = [Metadata("undulog", {"a": value}) for value in "12"]
    pairs = [channels, schemas, files, facts]
    definitions = kept(*(definition for definition, _ in pairs), *(other for _, other in pairs))
    assert sent(definitions) == [other for _, other in pairs]


@pytest.mark.parametrize(
    ("type_name", "period_ns", "is_state"),
    [
        ("sensor_msgs/msg/JointState", 5, False),
        ("nav_msgs/msg/Odometry", 5, False),
        ("sensor_msgs/msg/Imu", 5, False),
        ("sensor_msgs/msg/Range", 5, False),
        ("sensor_msgs/msg/MagneticField", 5, False),
        ("tf2_msgs/msg/TFMessage", 5, False),
        ("sensor_msgs/msg/TimeReference", 5, False),
        ("std_msgs/msg/String", 0, True),
        ("rcl_interfaces/msg/Log", 0, False),
        ("diagnostic_msgs/msg/DiagnosticArray", 0, False),
    ],
)
def test_samples_have_a_period_and_texts_are_states(type_name, period_ns, is_state):
    schema, channel = Schema(9, b"", "ros2msg", type_name), Channel(4, "/x", "cdr", {}, 9)
    definitions = kept(schema, channel)
    assert definitions.periods == {4: period_ns}
    assert definitions.states == ({4: None} if is_state else {})
    assert kept(channel).periods == {4: 0}  # without its schema: events, which are all sent


def test_a_state_outlives_a_channel_that_is_defined_again_and_raw_frames_have_no_period():
    schema, channel = Schema(9, b"", "ros2msg", "std_msgs/msg/String"), Channel(4, "/x", "", {}, 9)
    definitions = kept(schema, channel)
    definitions.states[4] = (4, 1, 2, 3, 5, b"walk")
    definitions.keep(channel, b"")
    assert definitions.states == {4: (4, 1, 2, 3, 5, b"walk")}
    for topic in ("/can/can0", "/can_fd/can0"):
        raw = kept(schema, Channel(5, topic, "cdr", {}, 9))
        assert (raw.periods, raw.states) == ({}, {})
        assert len(sent(raw)) == 2


def grouped(sizes, size):
    """Sizes one after the other: a new group where the next would be too much."""
    groups = []
    for length in sizes:
        if groups and sum(groups[-1]) + length <= size:
            groups[-1].append(length)
        else:
            groups.append([length])
    return groups


def test_groups_have_all_definitions_then_the_states_that_fit_into_one():
    rng = random.Random(4)
    for _ in range(200):
        size = rng.randrange(40, 130)
        definitions, sizes = LiveDefinitions(0), []
        for number in range(rng.randrange(9)):
            sizes.append(rng.randrange(1, 140))
            definitions.keep(Schema(number, b"", "", ""), bytes(sizes[-1]))
        for number in range(rng.randrange(9)):
            payload = bytes(rng.randrange(0, 100))
            definitions.states[number] = rng.choice([None, (number, 0, 0, 0, 0, payload)])
            if definitions.states[number] is not None and 36 + len(payload) <= size:
                sizes.append(36 + len(payload))
        lengths = [[len(record) for record in group] for group in definitions.groups(size)]
        assert lengths == grouped(sizes, size)
