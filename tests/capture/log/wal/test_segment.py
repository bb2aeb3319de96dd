"""Segments: what one refuses, which pages a sync writes, and files that others cut short."""

import contextlib
import os
import struct

import pytest

from support.wal_messages import CHANNEL, filled
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.wal import segment as segments
from undulog.capture.log.wal.format import MARK, MESSAGES, SegmentHeader
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.segment import Segment, require_space
from undulog.capture.log.wal.writer import WriteAheadLog

PAGE = 4096
RECORD = 40  # bytes of a record without its payload


@pytest.fixture
def segment(tmp_path):
    made = Segment(tmp_path / "000001.seg", SegmentHeader(MESSAGES, 7, 1, 64 * PAGE, bytes(16)))
    yield made
    made.close(remove=True)


def test_what_can_not_be_created_is_an_error_with_its_reason(tmp_path, monkeypatch):
    header = SegmentHeader(MESSAGES, 7, 1, PAGE, bytes(16))
    (tmp_path / "000001.seg").touch()
    with pytest.raises(LogWriteError, match=r"000001\.seg: can't be created: File exists"):
        Segment(tmp_path / "000001.seg", header)
    with pytest.raises(LogWriteError, match="space"):
        require_space(tmp_path, 1 << 60)
    require_space(tmp_path, 1)

    def fails(_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(segments, "free_bytes", fails)
    with pytest.raises(LogWriteError, match="can't read the free space: Input/output error"):
        require_space(tmp_path, 1)


def together(segment, first, count, size):
    """Put records of one size, payload and head, as one."""
    messages = [(1, 0, 0, 0, bytes(size - RECORD))] * count
    assert segment.put_all((first, 0, MARK), messages)


def singly(segment, first, count, size):
    """Put the same one by one."""
    for number in range(first, first + count):
        assert segment.put((number, 0, MARK, 1, 0, 0, 0), bytes(size - RECORD))


@pytest.mark.parametrize("put", [together, singly])
@pytest.mark.parametrize("size", [1000, 1024, 4096 + 8])
def test_a_sync_leaves_out_the_page_that_is_being_written(segment, put, size, monkeypatch):
    """Of many pages; the last record that it states lies wholly before that page."""
    monkeypatch.setattr(segments, "_BUSY", 0)
    put(segment, 1, 3, size)
    assert segment.sync() == 3
    put(segment, 4, 20, size)
    end = 64 + 23 * size
    page = end // PAGE * PAGE
    assert segment.sync(whole=False) == max(k for k in range(24) if 64 + k * size <= page)
    assert segment.sync() == 23
    assert segment.sync() == 23


@pytest.fixture
def logs(tmp_path):
    """Two logs, a message in each; a log that was cut can't be closed in good order."""
    made = [WriteAheadLog(tmp_path / name, segment_size=16 * PAGE) for name in "ab"]
    for wal in made:
        wal.define(CHANNEL)
        wal.append(1, 0, 0, 0, b"x")
    yield made
    for wal in made:
        with contextlib.suppress(LogWriteError):
            wal.close()


def fill(wal):
    """Append more than a segment has room for."""
    for _ in range(100):
        wal.append(1, 0, 0, 0, bytes(1000))


def test_a_log_that_is_cut_short_refuses_what_follows(logs):
    """Also after another log was closed: the watch of memory is one for all."""
    first, second = logs
    first.close()
    os.truncate(second.folder / "000001.seg", PAGE)
    with pytest.raises(LogWriteError, match=r"000001\.seg: was cut short by another program"):
        fill(second)
    first_page = (PAGE - 64 - 48) // 1040
    sizes = [len(message.payload) for message in recover(second.folder)]
    assert sizes == [1, *[1000] * first_page]


def test_a_segment_that_was_released_while_the_log_is_read_hides_no_later_one(tmp_path):
    folder = filled(tmp_path / "w", 100)
    numbers = sorted(path.name for path in folder.glob("0*.seg"))
    assert len(numbers) > 3
    recovery = recover(folder)
    (folder / numbers[0]).unlink()
    positions = [message.position for message in recovery]
    assert positions == list(range(positions[0], 101))
    assert positions[0] > 1


def test_definitions_that_are_missing_are_counted(tmp_path):
    folder = filled(tmp_path / "w", 3)
    path = folder / "def-000001.seg"
    raw, at = bytearray(path.read_bytes()), 64
    places = []
    for _ in range(3):  # CRC, length, number, kind, mark, channel, sequence, log and publish time
        length, number, kind, mark, *rest = struct.unpack_from("<IQBBHIQQ", raw, at + 4)
        assert (number, kind, mark, rest) == (len(places) + 1, 4, MARK, [0, 0, 0, 0])
        places.append(at)
        at = (at + RECORD + length + 7) & -8
    for place in places[:2]:
        raw[place + RECORD] ^= 1
    path.write_bytes(raw)
    recovery = recover(folder)
    assert "2 definitions are missing" in recovery.warnings
    assert len(list(recovery)) == 3
