"""The write-ahead log against slow, failing and full disks."""

import os
import re
import resource

import pytest

from support.processes import python, wait_for
from support.wal_messages import MESSAGE, check_messages, message
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.segment import free_bytes, require_space
from undulog.capture.log.wal.writer import WriteAheadLog

# -- the disk --------------------------------------------------------------------------------


def test_a_failing_disk_is_reported_by_the_next_append_and_by_close(tmp_path, monkeypatch):
    wal = WriteAheadLog(tmp_path / "w", sync_interval_s=0.01)
    wal.append(*message(1))

    def broken(file):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    monkeypatch.setattr(os, "fdatasync", broken)
    accepted = 1

    def append_one():
        nonlocal accepted
        accepted = wal.append(*message(accepted + 1))

    with pytest.raises(LogWriteError, match=r"seg: can't be brought to the disk: Input/output"):
        wait_for(append_one, "a sync")
    with pytest.raises(LogWriteError, match="Input/output error"):
        wal.close()
    monkeypatch.undo()
    assert check_messages(list(recover(tmp_path / "w"))) == list(range(1, accepted + 1))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dead_background_thread_is_reported_by_the_next_append(tmp_path, monkeypatch):
    def broken(self):
        raise RuntimeError("unforeseen")

    monkeypatch.setattr(WriteAheadLog, "_drop_released", broken)
    wal = WriteAheadLog(tmp_path / "w")
    wait_for(lambda: not wal._thread.is_alive(), "its end")
    with pytest.raises(LogWriteError, match=r"can't be looked after: RuntimeError\('unforeseen'\)"):
        wal.append(*message(1))
    monkeypatch.undo()
    wal.release(0)
    wal.close()


def test_room_is_asked_for_beforehand(tmp_path):
    assert free_bytes(tmp_path / "not" / "yet.mcap") > 0
    require_space(tmp_path, 1)
    with pytest.raises(LogWriteError, match=r"needs \d+ bytes .* bytes are missing"):
        require_space(tmp_path / "x.mcap", 1 << 60)


@pytest.fixture
def small_disk(disk_of):
    """A file system of 1 MiB."""
    return disk_of("1m")


# In a child, for the failure to be feared is a SIGBUS.
FILL = f"""{MESSAGE}
import sys
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.wal.writer import WriteAheadLog

wal = WriteAheadLog(sys.argv[1], segment_size=1 << 16)
accepted = 0
try:
    while True:
        accepted = wal.append(*message(accepted + 1))
except LogWriteError as error:
    print(accepted, wal.shortage is not None, error, sep="|")
try:
    wal.append(*message(accepted + 1))
except LogWriteError:
    print("again")
if sys.argv[2] == "release":
    wal.release(accepted - 10)
    for _ in range(100):
        accepted = wal.append(*message(accepted + 1))
wal.close()
print(accepted)
"""


@pytest.mark.parametrize("then", ["close", "release"])
def test_a_full_disk_is_an_error_that_loses_nothing(small_disk, then):
    report, again, last = python(FILL, small_disk / "w", then, code=0).stdout.splitlines()
    accepted, foreseen, error = report.split("|")
    assert (foreseen, again) == ("True", "again")
    shortage = r"needs 65536 bytes and the disk has \d+ free: \d+ bytes are missing"
    assert re.search(rf"w/\d{{6}}\.seg: {shortage}", error)
    recovery = recover(small_disk / "w")
    positions = check_messages(list(recovery))
    assert recovery.missing == 0
    assert positions[-1] == int(last) == int(accepted) + (100 if then == "release" else 0)
    if then == "close":
        assert positions[0] == 1
        assert int(accepted) > 1500  # the disk was used, all but the last segments


def test_a_disk_full_from_the_start_is_reported_and_left_as_it_was(small_disk):
    with pytest.raises(LogWriteError, match=r"000001\.seg: needs 2097152 bytes"):
        WriteAheadLog(small_disk / "w", segment_size=2 << 20)
    assert list(small_disk.iterdir()) == []


def test_a_limit_on_file_size_is_an_error_not_a_signal(tmp_path):
    limit = 1 << 15  # above any page, below the segment

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = python(FILL, tmp_path / "w", "close", preexec_fn=limited, code=1)
    assert "LogWriteError" in done.stderr
    assert "can't be reserved: File too large" in done.stderr
    assert not (tmp_path / "w").exists()
