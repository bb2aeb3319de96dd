"""The thread that writes parts: what it does about a disk that refuses, and what it releases."""

import contextlib
import errno
import hashlib
import os
import threading
from types import SimpleNamespace

import pytest
from mcap.records import Metadata

from support.read_back import metadata_of
from support.wal_messages import message
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.mcap.writer import McapWriter
from undulog.capture.log.wal.segment import ReservedSpace
from undulog.capture.log.wal.writer import WriteAheadLog
from undulog.capture.log.write import disk_thread
from undulog.capture.log.write.disk_thread import DiskThread
from undulog.capture.log.write.part_stream import PartStream


class Refusing(PartStream):
    """A part whose disk refuses some writes.

    Attributes:
        refusals: Errors of the next writes.
        most: Bytes that a write takes.
        syncs: Bytes that had been written at each sync.
    """

    def __init__(self, path, number=1):
        super().__init__(path, number, force=False)
        self.refusals, self.most, self.syncs, self.taken = [], 1 << 40, [], 0
        self.changed = threading.Condition()

    def put(self, data):
        if self.refusals:
            raise self.refusals.pop(0)
        taken = super().put(data[: self.most])
        self.taken += taken
        return taken

    def sync(self):
        with self.changed:
            self.syncs.append(self.taken)
            self.changed.notify()
        super().sync()


@pytest.fixture
def stage(tmp_path):
    """A write-ahead log of 20 messages, a reserve of space, the disk's thread and a part."""
    wal = WriteAheadLog(tmp_path / "run.mcap.wal")
    for position in range(1, 21):
        wal.append(*message(position))
    ballast = ReservedSpace(wal.folder, 4096)
    disk = DiskThread(wal, ballast)
    part = Refusing(tmp_path / "run.mcap")
    yield SimpleNamespace(wal=wal, ballast=ballast, disk=disk, part=part, path=tmp_path)
    disk.close()
    part.close()
    ballast.free()
    wal.release(20)
    with contextlib.suppress(LogWriteError):
        wal.close()


@pytest.fixture
def waits(monkeypatch):
    """The waits of the thread, whose time passes by them alone."""
    waits = []

    def sleep(seconds):
        waits.append(seconds)

    clock = SimpleNamespace(monotonic=lambda: 1000.0 + sum(waits), sleep=sleep)
    monkeypatch.setattr(disk_thread, "time", clock)
    return waits


def write(stage, data, covered=0):
    stage.part.write(data)
    stage.disk.write(stage.part, covered)


def ended(stage, size):
    """End the thread after the sync of some bytes: before its end it syncs only whole parts."""
    part = stage.part
    with part.changed:
        part.changed.wait_for(lambda: part.syncs and part.syncs[-1] == size)
    stage.disk.close()


def finish(stage, part, covered=0):
    """Finish a part of one metadata record."""
    writer = McapWriter(part, 1 << 19, lambda _: 0)
    writer.start(profile="", library="")
    stage.disk.finish(part, writer, (Metadata("last", {"number": str(part.number)}),), covered)


def no_space(count, code=errno.ENOSPC):
    return [OSError(code, os.strerror(code)) for _ in range(count)]


def test_bytes_are_counted_when_they_are_given_and_when_they_are_written(stage):
    stage.part.most = 3
    write(stage, b"0123456789", covered=12)
    write(stage, b"abc", covered=10)
    assert stage.disk.bytes_given == 13
    ended(stage, 13)
    assert (stage.disk.backlog, stage.disk.bytes_given) == (0, 13)
    assert (stage.disk.failure, stage.disk.trouble, stage.disk.misplaced) == (None, None, "")
    assert stage.part.place.read_bytes() == b"0123456789abc"
    assert stage.part.syncs[-1] == 13
    assert stage.wal._released == 12


def test_parts_are_finished_in_order_and_the_next_has_the_hash_of_the_last(stage):
    paths = [stage.path / f"run{number}.mcap" for number in (1, 2, 3)]
    for number, path in enumerate(paths, 1):
        finish(stage, Refusing(path, number), covered=5 * number)
    stage.disk.close()
    assert stage.disk.placed == dict(enumerate(paths, 1))
    assert stage.disk.rescued == {}
    assert stage.disk.bytes_given == sum(path.stat().st_size for path in paths)
    assert (stage.disk.backlog, stage.disk.failure, stage.wal._released) == (0, None, 15)
    for number, path in enumerate(paths, 1):
        records = metadata_of(path)
        assert records["last"] == {"number": str(number)}
        if number > 1:
            former = hashlib.sha256(paths[number - 2].read_bytes()).hexdigest()
            assert records["undulog.part"] == {"previous_sha256": former}


def test_a_busy_thread_syncs_after_more_than_32_mib(stage):
    begin, mib = threading.Event(), bytes(1 << 20)
    part, put = stage.part, stage.part.put

    def waiting(data):
        begin.wait()
        part.taken += len(data)
        return len(data)

    part.put = waiting
    for piece in [*[mib] * 32, b"x", *[mib] * 32, b"x", mib]:
        write(stage, piece)
    begin.set()
    ended(stage, (65 << 20) + 2)
    part.put = put
    assert part.syncs == [(32 << 20) + 1, (64 << 20) + 2, (65 << 20) + 2]


# -- a disk that refuses ---------------------------------------------------------------------------


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_costs_the_reserve_and_nothing_that_was_accepted(stage, waits, code):
    stage.part.refusals = no_space(1, code)
    write(stage, b"0123456789", covered=20)
    ended(stage, 10)
    assert stage.disk.failure is None
    assert str(stage.disk.trouble) == (
        f"{stage.path / 'run.mcap'}: {os.strerror(code)}: recording must end; free some space or "
        "write elsewhere"
    )
    assert not stage.ballast.free()  # it is already
    assert stage.part.place.read_bytes() == b"0123456789"
    assert (waits, stage.wal._released) == ([], 20)


def test_space_that_is_freed_late_is_waited_for(stage, waits):
    stage.part.refusals = no_space(15)
    write(stage, b"0123456789", covered=20)
    ended(stage, 10)
    assert stage.disk.failure is None
    assert stage.part.place.read_bytes() == b"0123456789"
    assert waits == [0.1] * 14


def test_after_two_seconds_nothing_more_is_written(stage, waits):
    stage.part.refusals = no_space(1000)
    write(stage, b"0123456789", covered=20)
    write(stage, b"abc", covered=20)
    stage.disk.close()
    text = f"{stage.path / 'run.mcap'}: can't be written: No space left on device"
    assert str(stage.disk.failure) == str(stage.disk.trouble) == text
    assert sum(waits) == pytest.approx(2.1, abs=0.11)
    assert stage.part.place.read_bytes() == b""
    assert (stage.disk.backlog, stage.wal._released) == (13, -1)


def test_a_disk_that_fails_ends_the_writing(stage):
    stage.part.refusals = no_space(1, errno.EIO)
    write(stage, b"0123456789", covered=20)
    write(stage, b"abc", covered=20)  # not a byte behind a gap
    stage.disk.close()
    assert "can't be written: Input/output error" in str(stage.disk.failure)
    assert stage.disk.no_rescue is None
    assert stage.part.place.read_bytes() == b""
    assert stage.ballast.free()


def test_a_disk_that_fails_at_the_end_leaves_the_part_unfinished(stage):
    stage.part.refusals = no_space(1, errno.EIO)
    finish(stage, stage.part, covered=20)
    stage.disk.close()
    assert "can't be written: Input/output error" in str(stage.disk.failure)
    assert (stage.disk.placed, stage.wal._released) == ({}, -1)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_mistake_of_ours_is_a_failure(stage):
    stage.part.refusals = [RuntimeError("unforeseen")]
    write(stage, b"x")
    stage.disk.close()
    text = f"{stage.path / 'run.mcap'}: can't be written: RuntimeError('unforeseen')"
    assert str(stage.disk.failure) == text


# -- a file that will be lost ----------------------------------------------------------------------


@pytest.mark.parametrize("finished", [False, True])
def test_a_deleted_file_goes_on_in_a_rescue_file(stage, finished):
    stage.part.place.unlink()
    if finished:
        finish(stage, stage.part, covered=20)
    else:
        write(stage, b"0123456789", covered=20)
        ended(stage, 10)
    stage.disk.close()
    deleted = "was deleted while it was being written"
    assert stage.disk.misplaced == f"{stage.path / 'run.mcap'}: {deleted}"
    assert (stage.disk.failure, stage.wal._released) == (None, 20)
    assert stage.part.rescued
    if finished:
        assert stage.disk.rescued == stage.disk.placed == {1: stage.part.path}
        assert metadata_of(stage.part.path)["last"] == {"number": "1"}
    else:
        assert stage.part.place.read_bytes() == b"0123456789"


def test_a_disk_that_became_read_only_is_left_for_a_rescue_file(stage):
    write(stage, b"abc", covered=10)
    stage.part.refusals = no_space(1, errno.EROFS)
    write(stage, b"0123456789", covered=20)
    ended(stage, 13)
    assert stage.disk.misplaced == f"{stage.path / 'run.mcap'}: Read-only file system"
    assert stage.part.rescued
    assert stage.part.place.read_bytes() == b"abc0123456789"


def test_without_room_for_a_rescue_file_the_reason_is_kept(stage, monkeypatch):
    monkeypatch.setattr("undulog.capture.log.write.part_stream.free_bytes", lambda _: 7)
    stage.part.place.unlink()
    write(stage, b"0123456789", covered=20)
    ended(stage, 10)
    assert "was deleted while it was being written" in str(stage.disk.failure)
    assert "has 7 bytes free" in str(stage.disk.no_rescue)
    assert (stage.disk.misplaced, stage.wal._released) == ("", -1)
