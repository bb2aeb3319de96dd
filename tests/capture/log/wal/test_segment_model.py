"""Segments beside plain models: records put together or singly, and what a sync has reached."""

import os
import random
import struct
import zlib

import pytest

from undulog.capture.common.errors import DataError
from undulog.capture.log.wal import segment as segments
from undulog.capture.log.wal.format import MARK, MESSAGES, SegmentHeader, WalLock
from undulog.capture.log.wal.segment import Segment

PAGE = 4096
HEAD = 40  # bytes of a record without its payload


@pytest.fixture
def made(tmp_path):
    """Make segments, that end with the test."""
    opened = []

    def make(pages, salt=0xFEDCBA98):
        path = tmp_path / f"{len(opened)}.seg"
        header = SegmentHeader(MESSAGES, salt, 1, pages * PAGE, bytes(16))
        opened.append(Segment(path, header))
        return opened[-1]

    yield make
    for segment in opened:
        segment.close(remove=True)


def ends_of(sizes):
    """Where records of some sizes, heads included, end in a segment; padding included."""
    ends = [64]
    for size in sizes:
        ends.append((ends[-1] + size + 7) // 8 * 8)
    return ends


@pytest.mark.parametrize("count", [1, 2, 7])
def test_records_put_together_are_those_put_singly(made, count):
    together, singly = made(8), made(8)
    expected, number = b"", 1
    rng = random.Random(count)
    for length in range(18):
        some = [
            (number + k, rng.randrange(2**64), 7 * k, 2**32 - 1 - k, rng.randbytes(length))
            for k in range(count)
        ]
        assert together.put_all((number, 5, MARK), some)
        for key, (channel, log_ns, publish_ns, sequence, payload) in enumerate(some, number):
            fields = (key, 5, MARK, channel, sequence, log_ns, publish_ns)
            assert singly.put(fields, payload)
            body = struct.pack("<IQBBHIQQ", length, *fields) + payload
            record = struct.pack("<I", zlib.crc32(body, 0xFEDCBA98)) + body
            expected += record.ljust((len(record) + 7) // 8 * 8, b"\0")
        number += count
        assert together.last == singly.last == number - 1
    for segment in (together, singly):
        raw = segment.path.read_bytes()
        assert raw[64:-64].rstrip(b"\0") == expected.rstrip(b"\0")
        assert raw[64 : 64 + len(expected)] == expected


def test_records_of_which_one_has_a_number_out_of_range_are_none(made):
    segment = made(4)
    good, bad = (1, 1, 1, 1, b"x"), (1 << 16, 1, 1, 1, b"x")
    for some in ([bad], [good, bad], [good, good, bad]):
        assert not segment.put_all((1, 5, MARK), some)
    assert segment.last == 0
    assert not any(segment.path.read_bytes()[64:-64])
    with pytest.raises(DataError, match="channel_id=65536, sequence=1"):
        segment.put((1, 5, MARK, 1 << 16, 1, 1, 1), b"x")
    assert segment.put_all((1, 5, MARK), [good])


def reached(ends, synced_at, busy, *, whole):
    """What a sync reaches: the last record, and where it ends or the page that is written begins.

    The page is that of the last byte.
    """
    page = (ends[-1] - 8) // PAGE * PAGE
    if whole or not synced_at or page - synced_at < busy:
        return len(ends) - 1, ends[-1]
    return max(k for k, end in enumerate(ends) if end <= page), page


@pytest.mark.parametrize("busy", [0, 1, 2, 8])
@pytest.mark.parametrize("together", [False, True])
def test_syncs_reach_the_page_that_is_being_written(made, monkeypatch, busy, together):
    monkeypatch.setattr(segments, "_BUSY", busy * PAGE)
    rng, segment = random.Random(busy), made(300)
    sizes, synced_at, last = [], 0, 0
    for step in range(60):
        size, count = rng.choice([40, 48, 200, 1000, 5000]), rng.randint(1, 12)
        number, ends = len(sizes) + 1, ends_of([*sizes, *[size] * count])
        if any(end % PAGE == 0 for end in ends):
            continue  # see below
        if together:
            assert segment.put_all((number, 5, MARK), [(1, 0, 0, 0, bytes(size - HEAD))] * count)
        else:
            for k in range(count):
                assert segment.put((number + k, 5, MARK, 1, 0, 0, 0), bytes(size - HEAD))
        sizes += [size] * count
        whole = step % 7 == 6
        last, synced_at = reached(ends, synced_at, busy * PAGE, whole=whole)
        assert segment.sync(whole=whole) == last
        assert segment.synced
    assert last > 300


@pytest.mark.parametrize("together", [False, True])
def test_a_page_that_is_just_full_counts_as_being_written(made, monkeypatch, together):
    """Until a record goes beyond it; then that page is whole."""
    monkeypatch.setattr(segments, "_BUSY", 0)
    segment = made(8)

    def put(number, *sizes):
        for size in sizes:
            payload = bytes(size - HEAD)
            if together:
                assert segment.put_all((number, 5, MARK), [(1, 0, 0, 0, payload)])
            else:
                assert segment.put((number, 5, MARK, 1, 0, 0, 0), payload)
            number += 1

    put(1, 1000)
    assert segment.sync(whole=False) == 1
    put(2, PAGE - 64 - 1000 + 96, PAGE - 96 - 48, 48)  # the last one ends the second page
    assert segment.sync(whole=False) == 1
    assert segment.sync(whole=True) == 4
    put(5, 48)
    assert segment.sync(whole=False) == 4
    put(6, PAGE)
    assert segment.sync(whole=False) == 5


def test_files_have_the_rights_that_the_mask_leaves(made, tmp_path):
    before = os.umask(0)
    try:
        segment, lock = made(1), WalLock(tmp_path)
        space = segments.ReservedSpace(tmp_path, 100)
    finally:
        os.umask(before)
    paths = segment.path, tmp_path / "recorder.lock", space.path
    assert [path.stat().st_mode & 0o7777 for path in paths] == [0o666] * 3
    assert space.free()
    lock.release()


def test_files_of_a_log_are_not_left_to_other_programs(made, tmp_path):
    segment, lock = made(1), WalLock(tmp_path)
    open_files = {}
    for number in os.listdir("/proc/self/fd"):  # noqa: PTH208
        try:
            open_files[os.readlink(f"/proc/self/fd/{number}")] = int(number)  # noqa: PTH115
        except OSError:
            continue
    for path in (segment.path, tmp_path / "recorder.lock"):
        assert not os.get_inheritable(open_files[str(path)])
    lock.release()


def test_a_system_without_a_watch_of_memory_writes_segments_all_the_same(made, monkeypatch):
    def refuses(_):
        raise MemoryError

    monkeypatch.setattr(segments, "_WATCH", segments._Watch())
    monkeypatch.setattr(segments, "_HANDLER", refuses)
    segment = made(1)
    assert segment.put((1, 5, MARK, 1, 0, 0, 0), b"payload")
    assert b"payload" in segment.path.read_bytes()
    assert not segment.cut
