"""The reader of a write-ahead log beside a plain one that tries every place."""

import os
import random
import shutil
import struct
import zlib

import pytest
from mcap.records import Metadata

from support.wal_messages import filled
from undulog.capture.log.wal import reader
from undulog.capture.log.wal.reader import read_wal, recover
from undulog.capture.log.wal.writer import wal_folder

SIZE = 3 * 4096
END = SIZE - 64
LOG = bytes(range(16))
KINDS = ({5}, {1, 3, 4, 9, 12})  # of messages, of definitions


def segment_of(records, *, number=1, stream=0, size=SIZE, salt=77):
    """Bytes of a segment, and where its records are: (position, kind, payload) of each."""
    head = struct.pack("<8sIIQQ16s", b"\x89UWAL1\r\n", stream, salt, number, size, LOG)
    head = (head + struct.pack("<I", zlib.crc32(head))).ljust(64, b"\0")
    raw, at, places = bytearray(size), 64, []
    raw[:64] = raw[-64:] = head
    for position, kind, payload in records:
        body = struct.pack("<IQBBHIQQ", len(payload), position, kind, 0xA5, 9, 1, 2, 3) + payload
        raw[at : at + 4 + len(body)] = struct.pack("<I", zlib.crc32(body, salt)) + body
        places.append(at)
        at = (at + 4 + len(body) + 7) // 8 * 8
    assert at <= size - 64
    return raw, places


def signed(raw, at):
    """Give the record at a place the CRC of its bytes."""
    (length,) = struct.unpack_from("<I", raw, at + 4)
    (salt,) = struct.unpack_from("<I", raw, 12)
    struct.pack_into("<I", raw, at, zlib.crc32(raw[at + 4 : at + 40 + length], salt))


def whole(raw, at, end, last):
    """Length and position of the record at a place; None if there is none."""
    if at + 40 > end:
        return None
    crc, length, position, kind, mark = struct.unpack_from("<IIQBB", raw, at)
    stream, salt = struct.unpack_from("<II", raw, 8)
    if mark != 0xA5 or kind not in KINDS[stream] or position <= last or at + 40 + length > end:
        return None
    fits = zlib.crc32(raw[at + 4 : at + 40 + length], salt) == crc
    return (length, position) if fits else None


def plain(raw, last):
    """Positions in a segment behind a last one, and what is told of its damage."""
    end, at, positions, damaged, first = min(len(raw), END), 64, [], 0, None
    while True:
        while record := whole(raw, at, end, last):
            at, last = (at + 40 + record[0] + 7) // 8 * 8, record[1]
            positions.append(last)
        following = next((k for k in range(at, end, 8) if whole(raw, k, end, last)), None)
        stop = at + len(raw[at:end].rstrip(b"\0")) if following is None else following
        first = at if first is None and stop > at else first
        damaged += stop - at
        if following is None:
            text = f"{damaged} bytes are no whole records, the first at byte {first}"
            return positions, [text] * (damaged > 0)
        at = following


def damaged(rng, raw, places):
    """Damage a segment in one of several ways."""
    first, second = sorted(rng.sample(range(len(places) - 1), 2))
    at, after = places[first], places[first + 1]
    other = places[second]
    way = rng.randrange(9)
    if way == 0:  # a bit
        raw[rng.randrange(64, END)] ^= 1 << rng.randrange(8)
    elif way == 1:  # a block that was never written
        raw[at : places[second + 1]] = bytes(places[second + 1] - at)
    elif way == 2:  # a record comes twice
        length = min(after - at, END - other)
        raw[other : other + length] = raw[at : at + length]
    elif way == 3:  # a number that was there, or is there later
        struct.pack_into(
            "<Q", raw, other + 8, rng.choice([first, first + 1, second + 1, second + 9])
        )
        signed(raw, other)
    elif way == 4:  # another kind or mark
        raw[at + rng.choice([16, 17])] = rng.choice([1, 4, 5, 0xA4, 0xA5, 0xA6])
        signed(raw, at)
    elif way == 5:  # a length that reaches somewhere
        struct.pack_into("<I", raw, at + 4, rng.choice([0, after - at, END - at - 40, 2**31]))
    elif way == 6:  # random bytes
        raw[at:other] = rng.randbytes(other - at)
    elif way == 7:  # cut short
        del raw[rng.randrange(at, SIZE) :]
    else:  # longer
        raw += b"more"
    return raw


def written(folder, segments):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for number, raw in enumerate(segments, start=1):
        (folder / f"{number:06d}.seg").write_bytes(raw)
    return folder


@pytest.mark.parametrize("run", range(3))
def test_of_damaged_segments_is_read_what_a_plain_reader_finds(tmp_path, run):
    rng = random.Random(run)
    for _ in range(30):
        position, segments, positions, warnings = 1, [], [], []
        for number in range(1, 4):
            sizes = [rng.choice([0, 1, 8, 60, 300, 1500]) for _ in range(rng.randint(3, 7))]
            records = [(k, 5, rng.randbytes(size)) for k, size in enumerate(sizes, start=position)]
            position += len(records)
            raw, places = segment_of(records, number=number)
            if rng.random() < 0.8:
                raw = damaged(rng, raw, places)
            segments.append(raw)
        recovery = recover(written(tmp_path / "w", segments))
        last = 0
        for number, raw in enumerate(segments, start=1):
            some, texts = plain(raw, last)
            positions += some
            last = positions[-1] if positions else 0
            if len(raw) < SIZE:
                warnings.append(f"{number:06d}.seg is cut short: {len(raw)} of {SIZE} bytes")
            warnings += [f"{number:06d}.seg: {text}" for text in texts]
        assert [message.position for message in recovery] == positions
        missing = last - positions[0] + 1 - len(positions) if positions else 0
        counts = len(positions), positions[0] - 1 if positions else 0, missing
        assert (recovery.returned, recovery.before, recovery.missing) == counts
        warnings += [f"{missing} messages are missing between those found"] * (missing > 0)
        warnings += ["messages of channels that are not defined: 9"] * (len(positions) > 0)
        assert sorted(recovery.warnings) == sorted(warnings)


def test_a_record_without_payload_that_ends_a_segment_is_found_behind_damage(tmp_path):
    records = [(1, 5, bytes(SIZE - 128 - 2 * 40)), (2, 5, b"")]
    raw, (first, last) = segment_of(records)
    assert last + 40 == END
    raw[first + 4] ^= 1
    assert [message.position for message in recover(written(tmp_path / "w", [raw]))] == [2]


@pytest.mark.parametrize("length", [1 << 20, (1 << 20) + 1, (2 << 20) + 5, (2 << 20) - 1])
def test_a_payload_of_more_than_a_piece_is_whole_to_its_last_byte(tmp_path, length):
    payload = random.Random(length).randbytes(length)
    raw, (first, second) = segment_of([(1, 5, payload), (2, 5, b"end")], size=3 << 20)
    for at in (None, first + 40, first + 40 + length - 1, first + 40 + (1 << 20) - 1):
        broken = bytearray(raw)
        if at is not None:
            broken[at] ^= 0x80
        recovery = recover(written(tmp_path / "w", [broken]))
        assert [message.payload for message in recovery] == [payload, b"end"][at is not None :]
        damage = f"000001.seg: {second - first} bytes are no whole records, the first at byte 64"
        assert (damage in recovery.warnings) is (at is not None)


def test_a_payload_of_the_greatest_length_is_read_and_none_beyond(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "MAX_PAYLOAD", 500)
    raw, places = segment_of([(1, 5, bytes(499)), (2, 5, bytes(500)), (3, 5, bytes(501))])
    recovery = recover(written(tmp_path / "w", [raw]))
    assert [message.position for message in recovery] == [1, 2]
    assert recovery.warnings[0].endswith(f"the first at byte {places[2]}")


# -- definitions ----------------------------------------------------------------------------------


def test_a_definition_that_can_not_be_read_hides_no_other(tmp_path):
    """Its CRC fits, but the body ends early, is no UTF-8, or has a length beyond all memory."""
    name = b"\1\0\0\0n"
    good = name + struct.pack("<I", 10) + b"\1\0\0\0k\1\0\0\0v"
    bodies = [
        (4, b"\1\0\2"),
        (12, b"\1\0\0\0\xff" + bytes(4)),
        (12, good),
        (9, struct.pack("<QQI", 1, 2, 1) + name + name + struct.pack("<Q", 2**64 - 1)),
        (12, good),
    ]
    definitions, _ = segment_of(
        [(k, kind, body) for k, (kind, body) in enumerate(bodies, start=2)], stream=1
    )
    folder = written(tmp_path / "w", [segment_of([])[0]])
    (folder / "def-000001.seg").write_bytes(definitions)
    recovery = recover(folder)
    assert recovery.definitions == (Metadata("n", {"k": "v"}),) * 2
    missing, *unreadable = recovery.warnings
    assert missing == "1 definitions are missing"
    assert [text.partition(":")[0] for text in unreadable] == [
        f"definition {position} can't be read" for position in (2, 3, 5)
    ]
    assert list(recovery) == []


# -- a log that changes ----------------------------------------------------------------------------


def test_damage_is_told_from_where_it_is_also_of_a_segment_that_grows(tmp_path):
    """What was being written when it was looked at, and is whole now, is no damage."""
    records = [(k, 5, bytes([k]) * 1000) for k in range(1, 12)]
    raw, places = segment_of(records)
    folder = written(tmp_path / "w", [bytes(raw[: places[3] + 20]).ljust(SIZE, b"\0")])
    recovery = recover(folder)
    first = [next(recovery) for _ in range(3)]
    raw[places[9] + 100] ^= 1
    with (folder / "000001.seg").open("r+b") as file:  # the same file, as its recorder has it
        file.write(raw)
    positions = [message.position for message in (*first, *recovery)]
    assert positions == [1, 2, 3, 4, 5, 6, 7, 8, 9, 11]
    damage = f"000001.seg: 1040 bytes are no whole records, the first at byte {places[9]}"
    assert recovery.warnings[0] == damage


def test_a_record_that_was_read_half_written_is_read_again(tmp_path):
    """The reader's buffer has the next one, which came while the buffer was filled."""
    raw, places = segment_of([(k, 5, bytes([k]) * 500) for k in range(1, 5)], size=4096)
    torn = bytearray(raw)
    torn[places[1] : places[1] + 4] = bytes(4)  # a CRC is written last
    folder = written(tmp_path / "w", [torn])
    recovery = recover(folder)
    first = next(recovery)
    with (folder / "000001.seg").open("r+b") as file:
        file.write(raw)
    assert [first.position, *(message.position for message in recovery)] == [1, 2, 3, 4]
    assert recovery.warnings == ["messages of channels that are not defined: 9"]


def test_a_log_that_goes_while_it_is_listed_is_none(tmp_path, monkeypatch):
    folder = filled(wal_folder(tmp_path / "x.mcap"), 3)

    def gone(listed):
        shutil.rmtree(listed)
        return os.listdir(listed)  # noqa: PTH208

    monkeypatch.setattr(reader, "segment_files", gone)
    assert read_wal(tmp_path / "x.mcap") is None
    assert not folder.exists()
