"""Write-ahead logs that change while they are read, and folders that are not what they seem."""

import os
import struct
import subprocess
import sys

import pytest

from support.wal_messages import CHANNEL, check_messages, filled, message
from undulog.capture.common import errors
from undulog.capture.log.wal.format import WalLock, is_live
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.writer import WriteAheadLog

BUFFER = 8192  # of a file that is read


@pytest.fixture
def wal(tmp_path):
    with WriteAheadLog(tmp_path / "w", segment_size=1 << 16) as made:
        for channel in (1, 2, 3):
            made.define(CHANNEL.__class__(channel, f"/{channel}", "cdr", {}, 0))
        yield made


def append(wal, count):
    for _ in range(count):
        wal.append(*message(wal.position + 1))


def test_messages_that_come_while_a_segment_is_read_are_read(wal):
    """What the reader has buffered is old; what comes behind shows that there is more."""
    append(wal, 3)
    recovery = recover(wal.folder)
    first = [next(recovery) for _ in range(3)]
    append(wal, 100)
    assert wal._current.last == 103
    assert wal._current._at > 2 * BUFFER
    assert check_messages([*first, *recovery]) == list(range(1, 104))
    assert (recovery.missing, recovery.warnings) == (0, [])


def test_messages_that_come_to_a_segment_that_was_read_to_its_end_are_read(wal):
    append(wal, 3)
    wal._ahead()
    recovery = recover(wal.folder)
    first = [next(recovery) for _ in range(3)]
    real = recovery._messages
    append(wal, 12)
    assert wal._current._at < BUFFER - 1000
    wal._current._end = 0  # as if it were full
    wal._current.cut = False
    append(wal, 20)
    assert len(wal._sealed) == 1
    assert check_messages([*first, *real]) == list(range(1, 36))
    assert (recovery.missing, recovery.before, recovery.warnings) == (0, 0, [])


def test_a_segment_that_is_cut_while_it_is_read_ends_the_reading_of_it(tmp_path):
    folder = filled(tmp_path / "w", 150, segment_size=1 << 15)
    recovery = recover(folder)
    first = [next(recovery) for _ in range(2)]
    os.truncate(folder / "000001.seg", 4096)
    positions = check_messages([*first, *recovery])
    assert positions[0] == 1
    assert positions[-1] == 150
    assert recovery.missing == 150 - len(positions) > 10


@pytest.mark.parametrize("lost", [2, 3])
def test_a_segment_that_can_not_be_read_to_its_end_hides_no_other(tmp_path, lost):
    folder = filled(tmp_path / "w", 60)
    path = folder / f"00000{lost}.seg"
    whole = [item.position for item in recover(folder)]
    recovery = recover(folder)
    first = [next(recovery)]
    path.unlink()
    path.mkdir()
    positions = [item.position for item in (*first, *recovery)]
    assert set(positions) < set(whole)
    assert (positions[0], positions[-1]) == (1, 60)
    assert recovery.warnings == [
        f"{path.name} can't be read to its end: Is a directory",
        f"{60 - len(positions)} messages are missing between those found",
    ]


def test_a_segment_that_is_shorter_than_its_header_says_is_told(tmp_path):
    folder = filled(tmp_path / "w", 20, segment_size=1 << 15)
    os.truncate(folder / "000001.seg", (1 << 15) - 1)
    recovery = recover(folder)
    assert check_messages(list(recovery)) == list(range(1, 21))
    assert recovery.warnings == ["000001.seg is cut short: 32767 of 32768 bytes"]


def test_a_segment_that_ends_within_a_record_has_those_before(tmp_path):
    folder = filled(tmp_path / "w", 20, segment_size=1 << 15)
    raw = (folder / "000001.seg").read_bytes()
    at, places = 64, []
    while (head := struct.unpack_from("<IIQ", raw, at))[2]:
        at = (at + 40 + head[1] + 7) & -8
        places.append(at)
    for end in (places[9], places[9] + 39, places[9] + 40, places[10] - 8):
        os.truncate(folder / "000001.seg", end)
        assert check_messages(list(recover(folder))) == list(range(1, 11))


@pytest.mark.parametrize("around", [4096, 3 * 4096, 7 * 4096])
def test_a_record_is_looked_for_everywhere_behind_damage(tmp_path, around):
    """Also where the pieces meet that are read at once."""
    for length in range(around - 40 - 48, around + 16, 8):
        folder = tmp_path / str(length)
        with WriteAheadLog(folder, segment_size=1 << 16) as wal:
            wal.define(CHANNEL)
            for payload in (b"\xff" * length, b"behind", b"last"):
                wal.append(1, 0, 0, 0, payload)
        raw = bytearray((folder / "000001.seg").read_bytes())
        raw[64] ^= 1
        (folder / "000001.seg").write_bytes(raw)
        recovery = recover(folder)
        assert [item.payload for item in recovery] == [b"behind", b"last"]
        assert recovery.before == 1
        assert recovery.warnings == [
            f"000001.seg: {40 + length} bytes are no whole records, the first at byte 64"
        ]


# -- folders and locks -----------------------------------------------------------------------------


def test_a_log_in_which_nothing_was_written_goes_only_when_that_is_released(tmp_path):
    for released in (False, True):
        wal = WriteAheadLog(tmp_path / "w", force=True)
        with pytest.raises(errors.DataError, match="can't release up to -1; the positions go up"):
            wal.release(-1)
        if released:
            wal.release(0)
        wal.close()
        assert (tmp_path / "w").exists() is not released


def test_a_link_to_a_folder_is_not_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "w").symlink_to(tmp_path / "real")
    with pytest.raises(errors.LogWriteError, match="w: is a symbolic link, which is not followed"):
        WriteAheadLog(tmp_path / "w")
    assert list((tmp_path / "real").iterdir()) == []


def test_a_segment_that_can_not_be_removed_is_an_error(tmp_path):
    (tmp_path / "w" / "000001.seg").mkdir(parents=True)
    for _ in range(2):  # the lock is released
        with pytest.raises(errors.LogWriteError, match="w: can't be created: Is a directory"):
            WriteAheadLog(tmp_path / "w", force=True)
    assert not is_live(tmp_path / "w")
    assert not (tmp_path / "w" / "recorder.lock").exists()


def test_a_lock_is_no_link_and_no_folder(tmp_path):
    (tmp_path / "recorder.lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(errors.LogWriteError, match="can't be written: Too many levels"):
        WalLock(tmp_path)
    (tmp_path / "recorder.lock").unlink()
    (tmp_path / "recorder.lock").mkdir()
    with pytest.raises(errors.LogWriteError, match="can't be written: Is a directory"):
        WalLock(tmp_path)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("number", "text"), [(37, "can't be locked: No locks"), (11, "another recorder is writing it")]
)
def test_a_folder_without_locks_is_an_error_and_never_live(tmp_path, monkeypatch, number, text):
    def fails(*_):
        raise OSError(number, os.strerror(number))

    lock = WalLock(tmp_path)
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    monkeypatch.setattr("fcntl.flock", fails)
    with pytest.raises(errors.LogWriteError, match=text):
        WalLock(tmp_path)
    assert is_live(tmp_path) is (number == 11)
    assert len(os.listdir("/proc/self/fd")) <= before  # noqa: PTH208
    lock.release()


def test_whoever_asks_whether_a_log_is_live_refuses_no_recorder(tmp_path):
    asks = f"""
from pathlib import Path
from undulog.capture.log.wal.format import is_live
folder = Path({str(tmp_path)!r})
print("asks", flush=True)
while not (folder / "enough").exists():
    is_live(folder)
"""
    command = [sys.executable, "-c", asks]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "asks\n"
        try:
            for _ in range(300):
                WalLock(tmp_path).release()
        finally:
            (tmp_path / "enough").touch()


def test_the_lock_of_a_recorder_that_has_just_ended_is_not_taken(tmp_path, monkeypatch):
    """Its file is gone when the lock is there: another recorder has begun with a new one."""
    import fcntl

    real = fcntl.flock

    def disturbed(number, operation):
        real(number, operation)
        (tmp_path / "recorder.lock").unlink()
        (tmp_path / "recorder.lock").touch()

    monkeypatch.setattr("fcntl.flock", disturbed)
    with pytest.raises(errors.LogWriteError, match="another recorder is writing it"):
        WalLock(tmp_path)
