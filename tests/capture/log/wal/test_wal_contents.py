"""What is read of a write-ahead log as a whole: its messages as a block, names, locks, headers."""

import itertools
import struct
import zlib

import numpy as np
import pytest
from mcap.records import Metadata

from support.wal_messages import CHANNEL, check_messages, filled, message
from undulog.capture.common.errors import LogError, LogWriteError
from undulog.capture.log.wal import format as layout
from undulog.capture.log.wal.format import SegmentHeader, WalLock, is_live
from undulog.capture.log.wal.reader import WalMessage, WalTail, beyond, read_wal, recover
from undulog.capture.log.wal.writer import WriteAheadLog, wal_folder

MESSAGES = [
    WalMessage(5, 2, 7, 300, 250, b"abc"),
    WalMessage(6, 1, 1, 100, 100, b""),
    WalMessage(7, 2, 8, 200, 190, b"defg"),
]


def test_messages_are_one_block_of_mcap_records():
    tail = WalTail(iter(MESSAGES))
    assert tail.counts == {2: 2, 1: 1}
    (block,) = tail.blocks
    assert (block.start_ns, block.end_ns) == (100, 300)
    assert tail.inflates(block, 1) is False
    data, start, stop = tail.payload(block)
    assert (start, stop) == (0, len(data))
    assert tail.payload_once(block)[0] is data
    assert (block.size, block.compression, block.crc) == (len(data), "", 0)
    at, places = 0, {1: [], 2: []}
    for item in MESSAGES:  # opcode 5, length, channel, sequence, log and publish time, payload
        head = struct.unpack_from("<BQHIQQ", data, at)
        assert head == (5, 22 + len(item.payload), item.channel_id, item.sequence, *item[3:5])
        places[item.channel_id].append(at)
        end = at + 9 + head[1]
        assert data[at + 31 : end] == item.payload
        at = end
    assert at == len(data)
    assert {key: tail.offsets(block, key).tolist() for key in (1, 2, 3)} == {**places, 3: []}
    assert tail.offsets(block, 3).dtype == np.int64
    assert [place.tolist() for place in tail.indexed(block, [2, 1])] == [places[2], places[1]]
    room = bytearray(len(data))
    tail.inflate_into(block, memoryview(room))
    assert room == data
    late = WalTail([WalMessage(1, 1, 1, (1 << 63) - 1, 0, b"")]).blocks[0]
    assert late.start_ns == late.end_ns == (1 << 63) - 1
    first = WalTail([WalMessage(1, 1, 1, 0, 0, b"")]).blocks[0]
    assert (first.start_ns, first.end_ns) == (0, 0)


def test_what_a_file_lacks_is_told_by_channel_sequence_and_time():
    in_file = {(2, 7, 300), (2, 8, 201), (1, 2, 100)}
    assert beyond(MESSAGES, in_file) == MESSAGES[1:]
    assert beyond(MESSAGES, ()) == MESSAGES


# -- contents -------------------------------------------------------------------------------------


def test_the_contents_of_a_log(tmp_path):
    first = tmp_path / "x.mcap"
    assert read_wal(first) is None
    filled(wal_folder(first), 100)
    wal = read_wal(first)
    assert wal.folder == wal_folder(first)
    assert check_messages(list(wal.messages)) == list(range(1, 101))
    assert (wal.accepted, wal.before, wal.live) == (100, 0, False)
    assert (wal.warnings, wal.damaged) == ((), False)
    assert wal.definitions
    (wal_folder(first) / "000001.seg").unlink()
    later = read_wal(first)
    assert later.before == later.messages[0].position - 1 > 0
    assert later.accepted == 100
    (wal_folder(first) / "000003.seg").unlink()
    gap = read_wal(first)
    assert gap.warnings == ()  # log and file together show what is missing
    segment = max(wal_folder(first).glob("0*.seg"))
    raw = bytearray(segment.read_bytes())
    raw[80] ^= 1
    segment.write_bytes(raw)
    assert read_wal(first).damaged
    raw[:64] = raw[-64:] = bytes(64)
    segment.write_bytes(raw)
    assert not read_wal(first).damaged  # a torn header: it has no messages
    assert read_wal(first).warnings == (f"{segment.name} has no readable header; left out",)


def test_a_log_without_segments_says_so_unless_it_is_written(tmp_path):
    folder = wal_folder(tmp_path / "x.mcap")
    folder.mkdir()
    wal = read_wal(tmp_path / "x.mcap")
    assert (wal.accepted, wal.before, wal.messages, wal.live) == (0, 0, (), False)
    assert "no segment of a write-ahead log" in wal.warnings[0]
    lock = WalLock(folder)
    assert is_live(folder)
    wal = read_wal(tmp_path / "x.mcap")
    assert (wal.live, wal.warnings) == (True, ())
    with pytest.raises(LogWriteError, match="another recorder is writing it"):
        WalLock(folder)
    assert lock.folder == folder
    moved = folder.rename(tmp_path / "moved.wal")
    assert lock.folder == moved
    lock.release()
    assert not is_live(moved)
    assert list(moved.iterdir()) == []
    (tmp_path / "y.mcap.wal").write_text("no folder")
    assert read_wal(tmp_path / "y.mcap") is None
    assert not is_live(tmp_path / "none")


def test_a_log_under_way_is_live(tmp_path):
    with WriteAheadLog(wal_folder(tmp_path / "x.mcap")) as wal:
        wal.define(CHANNEL)
        for position in range(1, 4):
            assert wal.append(*message(position)) == position == wal.position
        recovered = read_wal(tmp_path / "x.mcap")
        assert (recovered.live, recovered.accepted) == (True, 3)
        assert recovered.warnings == ("messages of channels that are not defined: 2, 3",)
        assert wal.place == wal.folder


@pytest.mark.parametrize("raw", [b"", bytes(4096)], ids=["created", "reserved"])
def test_a_segment_that_is_being_made_is_no_damage(tmp_path, raw):
    with WriteAheadLog(wal_folder(tmp_path / "x.mcap")) as wal:
        wal.define(CHANNEL)
        made = wal.folder / "000009.seg"
        made.write_bytes(raw)
        assert read_wal(tmp_path / "x.mcap").warnings == ()
        made.write_bytes(raw + b"x")
        assert read_wal(tmp_path / "x.mcap").warnings == (
            "000009.seg has no readable header; left out",
        )
        made.unlink()


@pytest.mark.parametrize("count", [9, 10])
def test_messages_of_one_size_are_accepted_together_or_not_at_all(tmp_path, count):
    folder = tmp_path / "w"
    same = [(1, 10 * k, 20 * k, k, bytes([k]) * 110) for k in range(1, 1 + count)]
    with WriteAheadLog(folder, segment_size=4096) as wal:
        wal.define(CHANNEL)
        assert wal.append_all(same)
        assert wal.position == count
        assert wal.append_all(same)
        assert not wal.append_all(same)  # 27 or 30 records of 152 bytes are more than a segment
        assert wal.position == 2 * count
        assert wal.append(*same[0]) == 2 * count + 1
    messages = list(recover(folder))
    expected = [*same, *same, same[0]]
    assert [
        (m.channel_id, m.log_time_ns, m.publish_time_ns, m.sequence, m.payload) for m in messages
    ] == expected
    assert [message.position for message in messages] == list(range(1, 2 * count + 2))


# -- layout ---------------------------------------------------------------------------------------


def test_headers_are_whole_or_none():
    header = SegmentHeader(1, 0xDEADBEEF, 12, 4096, bytes(range(16)))
    packed = header.pack()
    assert len(packed) == 64
    assert SegmentHeader.unpack(packed) == header
    assert SegmentHeader.unpack(packed[:-1]) is None
    assert SegmentHeader.unpack(packed + b"\0") is None
    for at in range(52):
        broken = bytearray(packed)
        broken[at] ^= 1
        assert SegmentHeader.unpack(bytes(broken)) is None, at
    other = b"\x89UWAL2\r\n" + packed[8:48]
    assert (
        SegmentHeader.unpack((other + struct.pack("<I", zlib.crc32(other))).ljust(64, b"\0"))
        is None
    )


def test_segments_have_their_names_and_come_in_order(tmp_path):
    assert layout.segment_name(layout.MESSAGES, 7) == "000007.seg"
    assert layout.segment_name(layout.DEFINITIONS, 1234567) == "def-1234567.seg"
    assert (layout.MESSAGES, layout.DEFINITIONS, layout.MARK) == (0, 1, 0xA5)
    for name in ("000010.seg", "000009.seg", "def-000001.seg", "x.seg", "00001.seg", "000001.segx"):
        (tmp_path / name).touch()
    segments = [
        (stream, number, path.name) for stream, number, path in layout.segment_files(tmp_path)
    ]
    assert segments == [(0, 9, "000009.seg"), (0, 10, "000010.seg"), (1, 1, "def-000001.seg")]


def test_definitions_are_the_bodies_of_their_mcap_records():
    kind, body = layout.pack_definition(Metadata("n", {"k": "v"}))
    assert kind == 0x0C
    assert body == b"\1\0\0\0n" + struct.pack("<I", 10) + b"\1\0\0\0k\1\0\0\0v"
    assert layout.unpack_definition(kind, body) == Metadata("n", {"k": "v"})
    assert {0: {5}, 1: {1, 3, 4, 9, 12}} == layout.STREAM_KINDS


def test_damage_is_counted_from_where_it_begins_to_the_next_whole_record(tmp_path):
    folder = filled(tmp_path / "w", 12, segment_size=1 << 16)
    segment = folder / "000001.seg"
    whole = segment.read_bytes()
    at, places = 64, []
    for _ in range(12):
        places.append(at)
        at = (at + 40 + struct.unpack_from("<I", whole, at + 4)[0] + 7) & -8
    for broken, last in itertools.product((0, 3, 7), (False, True)):
        raw = bytearray(whole)
        raw[places[broken] + 30] ^= 1
        if last:
            raw[places[11] + 30] ^= 1
        segment.write_bytes(raw)
        recovery = recover(folder)
        positions = [message.position for message in recovery]
        assert positions == [k for k in range(1, 13) if k - 1 != broken and not (last and k == 12)]
        lost = places[broken + 1] - places[broken]
        if last:
            lost += len(bytes(raw[places[11] : -64]).rstrip(b"\0"))
        expected = (
            f"000001.seg: {lost} bytes are no whole records, the first at byte {places[broken]}"
        )
        assert recovery.warnings[0] == expected


def test_a_folder_that_can_not_be_listed_is_an_error(tmp_path, monkeypatch):
    folder = filled(wal_folder(tmp_path / "x.mcap"), 3)

    def fails(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("undulog.capture.log.wal.reader.segment_files", fails)
    with pytest.raises(LogError, match="no write-ahead log can be read here: Permission denied"):
        read_wal(tmp_path / "x.mcap")
    assert folder.is_dir()
