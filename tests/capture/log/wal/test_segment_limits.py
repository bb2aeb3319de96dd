"""Segments to the byte: what just fits, which pages are held and synced, and reserved space."""

import errno
import os
import signal
from types import SimpleNamespace

import pytest

from support.processes import python
from support.wal_messages import CHANNEL
from undulog.capture.common.errors import DataError, LogWriteError
from undulog.capture.log.wal import segment as segments
from undulog.capture.log.wal.format import MARK, MAX_PAYLOAD, MESSAGES, SegmentHeader
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.segment import ReservedSpace, Segment, free_bytes, require_space
from undulog.capture.log.wal.writer import WriteAheadLog

PAGE = 4096
HEADERS, HEAD = 2 * 64, 40


def header(size):
    return SegmentHeader(MESSAGES, 7, 1, size, bytes(16))


@pytest.fixture
def segment(tmp_path):
    made = Segment(tmp_path / "000001.seg", header(64 * PAGE))
    yield made
    made.close(remove=True)


def put(segment, first, *sizes):
    """Put records of some sizes, head and payload."""
    for number, size in enumerate(sizes, first):
        assert segment.put((number, 5, MARK, 1, 0, 0, 0), bytes(size - HEAD))


def sizes_of(folder):
    return [path.stat().st_size for path in sorted(folder.glob("0*.seg"))]


# -- what fits -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("beyond", "count"), [(0, 1), (1, 2)])
def test_a_segment_is_filled_to_the_byte(tmp_path, beyond, count):
    with WriteAheadLog(tmp_path / "w", segment_size=PAGE) as wal:
        wal.define(CHANNEL)
        wal.append(1, 0, 0, 0, bytes(1000))
        wal.append(1, 0, 0, 0, bytes(PAGE - HEADERS - 2 * HEAD - 1000 + beyond))
        assert len(wal._sealed) + 1 == count
    assert len(list(recover(tmp_path / "w"))) == 2


@pytest.mark.parametrize("extra", [0, 1])
def test_messages_of_one_size_fill_a_segment_to_the_byte(tmp_path, extra):
    count = (PAGE - HEADERS) // 128
    messages = [(1, 0, 0, 0, bytes(128 - HEAD))] * (count + extra)
    with WriteAheadLog(tmp_path / "w", segment_size=PAGE) as wal:
        wal.define(CHANNEL)
        assert wal.append_all(messages) is not bool(extra)
        assert wal.position == (0 if extra else count)
    assert len(list(recover(tmp_path / "w"))) == (0 if extra else count)


@pytest.mark.parametrize("length", [100_000, 100_001, 100_007])
def test_a_segment_for_a_long_message_has_its_size_and_two_headers(tmp_path, length):
    with WriteAheadLog(tmp_path / "w", segment_size=PAGE) as wal:
        wal.define(CHANNEL)
        wal.append(1, 0, 0, 0, bytes(length))
    assert (HEADERS + HEAD + length + 7) // 8 * 8 in sizes_of(tmp_path / "w")


def test_segments_have_16_mib_and_those_of_definitions_256_kib_or_more(tmp_path):
    with WriteAheadLog(tmp_path / "w") as wal:
        assert sizes_of(tmp_path / "w")[0] == 16 << 20
        assert (tmp_path / "w" / "def-000001.seg").stat().st_size == 1 << 18
        wal.release(0)
    with WriteAheadLog(tmp_path / "w", segment_size=PAGE + 1) as wal:
        assert sizes_of(tmp_path / "w")[0] == PAGE + 8
        wal.release(0)
    with pytest.raises(DataError, match="got 4095 bytes"):
        WriteAheadLog(tmp_path / "w", segment_size=PAGE - 1)
    with pytest.raises(DataError, match=r"got 4096 bytes, -1\.0 s"):
        WriteAheadLog(tmp_path / "w", segment_size=PAGE, sync_interval_s=-1.0)


def test_a_message_of_more_than_256_mib_is_refused(tmp_path):
    assert MAX_PAYLOAD == 1 << 28
    with WriteAheadLog(tmp_path / "w", segment_size=PAGE) as wal:
        with pytest.raises(DataError, match="a record of 268435457 bytes; at most 268435456 are"):
            wal.append(1, 0, 0, 0, bytes((1 << 28) + 1))
        wal.release(0)


# -- pages -----------------------------------------------------------------------------------------


def test_the_pages_ahead_are_held_to_the_end_of_the_segment(segment):
    assert [segment.hold(count * PAGE) for count in (2, 64, 65)] == [0, 0, PAGE]
    put(segment, 1, 3 * PAGE)
    assert [segment.hold(count * PAGE) for count in (61, 62, 70)] == [0, PAGE, 9 * PAGE]


def test_a_page_that_can_not_be_held_is_an_error(tmp_path):
    made = Segment(tmp_path / "000001.seg", header(4 * PAGE))
    os.truncate(made.path, PAGE)
    with pytest.raises(OSError, match="Bad address") as caught:
        made.hold(4 * PAGE)
    assert caught.value.errno == errno.EFAULT
    made.close(remove=True)


@pytest.mark.parametrize(("pages", "left_out"), [(7, 0), (8, 1)])
def test_a_busy_segment_is_that_of_8_pages_between_two_syncs(segment, pages, left_out):
    put(segment, 1, PAGE - 64)
    assert segment.sync(whole=False) == 1
    assert segment.synced
    put(segment, 2, *[1024] * (4 * pages + 1))
    assert segment.sync(whole=False) == 2 + 4 * pages - left_out
    assert segment.sync(whole=True) == 2 + 4 * pages
    assert segment.last == 2 + 4 * pages


def test_before_the_first_sync_nothing_is_synced(segment):
    assert not segment.synced
    put(segment, 1, *[1024] * 100)
    assert segment.sync(whole=False) == 100  # the first one is of all: also of the headers
    assert segment.synced


def test_a_cut_within_a_page_that_is_not_full_is_survived(tmp_path):
    """The last page of the mapping is longer than the file."""
    made = Segment(tmp_path / "000001.seg", header(2 * PAGE + 800))
    put(made, 1, 1000)
    os.truncate(made.path, 0)
    put(made, 2, 1000)
    assert made.cut
    assert not made.put((3, 5, MARK, 1, 0, 0, 0), b"")
    made.close(remove=True)


SENT = """
import os, signal, sys
from undulog.capture.log.wal.writer import WriteAheadLog
wal = WriteAheadLog(sys.argv[1])
os.kill(os.getpid(), signal.SIGBUS)
print("goes on")
"""


def test_a_signal_that_no_cut_file_raised_ends_the_process(tmp_path):
    assert python(SENT, tmp_path / "w", code=-signal.SIGBUS).stdout == ""


def test_a_segment_that_ends_leaves_no_file_open(tmp_path):
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    for remove in (False, True):
        path = tmp_path / f"{remove}.seg"
        made = Segment(path, header(PAGE))
        put(made, 1, 1000)
        made.close(remove=remove)
        assert path.exists() is not remove
        assert not made.put((2, 5, MARK, 1, 0, 0, 0), b"")
    assert len(os.listdir("/proc/self/fd")) <= before  # noqa: PTH208


@pytest.mark.parametrize("at", range(2))
def test_definitions_that_are_cut_short_end_the_log(tmp_path, at):
    """The segment that is being written, the first one or a later one."""
    wal = WriteAheadLog(tmp_path / "w", segment_size=PAGE)
    long = CHANNEL.__class__(2, "/long", "cdr", {"text": "x" * 200_000}, 0)
    for _ in range(at + 1):
        wal.define(long)
    assert len(wal._definitions) == at + 1
    os.truncate(wal._definitions[-1].path, PAGE)
    wal.define(CHANNEL.__class__(3, "/short", "cdr", {"text": "x" * 50_000}, 0))
    for _ in range(2):
        with pytest.raises(LogWriteError, match=rf"def-00000{at + 1}\.seg: was cut short"):
            wal.define(CHANNEL)
    with pytest.raises(LogWriteError, match="was cut short"):
        wal.append(1, 0, 0, 0, b"")
    with pytest.raises(LogWriteError):
        wal.close()


# -- space -----------------------------------------------------------------------------------------


def test_space_is_that_of_ordinary_users(tmp_path, monkeypatch):
    asked = []

    def statvfs(path):
        asked.append(path)
        return SimpleNamespace(f_bavail=3, f_bfree=9, f_frsize=512, f_bsize=4096)

    monkeypatch.setattr(os, "statvfs", statvfs)
    assert free_bytes(tmp_path / "not" / "yet" / "x.mcap") == 1536
    assert asked == [tmp_path]
    require_space(tmp_path, 1536)
    with pytest.raises(LogWriteError) as caught:
        require_space(tmp_path, 1540)
    assert str(caught.value) == (
        f"{tmp_path}: needs 1540 bytes and the disk has 1536 free: 4 bytes are missing; free some "
        "space or write elsewhere"
    )


@pytest.mark.parametrize(
    ("code", "free", "why"),
    [
        (errno.ENOSPC, 4095, "needs 4096 bytes and the disk has 4095 free: 1 bytes are missing; "),
        (errno.ENOSPC, 4096, "4096 bytes can't be reserved: No space left on device"),
        (errno.EFBIG, 1, "4096 bytes can't be reserved: File too large"),
        (errno.ENOSPC, None, "4096 bytes can't be reserved: No space left on device"),
    ],
)
def test_a_segment_that_can_not_be_reserved_leaves_no_file(tmp_path, monkeypatch, code, free, why):
    def refuses(*_):
        raise OSError(code, os.strerror(code))

    def free_of(path):
        return refuses() if free is None else free

    monkeypatch.setattr(os, "posix_fallocate", refuses)
    monkeypatch.setattr(segments, "free_bytes", free_of)
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    with pytest.raises(LogWriteError) as caught:
        Segment(tmp_path / "000001.seg", header(PAGE))
    assert str(caught.value).startswith(f"{tmp_path / '000001.seg'}: {why}")
    assert list(tmp_path.iterdir()) == []
    assert len(os.listdir("/proc/self/fd")) <= before  # noqa: PTH208


def test_reserved_space_is_a_file_that_is_freed_once(tmp_path):
    path = tmp_path / "ballast"
    path.write_text("of an earlier recorder")
    space = ReservedSpace(tmp_path, 12_345)
    assert (space.path, path.stat().st_size) == (path, 12_345)
    assert path.stat().st_blocks * 512 >= 12_345
    assert [space.free(), path.exists(), space.free()] == [True, False, False]
    assert [ReservedSpace(tmp_path, 0).free(), path.exists()] == [False, False]


def test_space_that_can_not_be_reserved_leaves_no_file(tmp_path, monkeypatch):
    with pytest.raises(LogWriteError, match=r"ballast: needs \d+ bytes"):
        ReservedSpace(tmp_path, 1 << 60)

    def refuses(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", refuses)
    with pytest.raises(LogWriteError, match="ballast: 7 bytes can't be reserved: No space left"):
        ReservedSpace(tmp_path, 7)
    assert list(tmp_path.iterdir()) == []
