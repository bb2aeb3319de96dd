"""The write-ahead log on a disk that forgets what wasn't synced."""

import pytest

from support.forgetting_disk import Loss
from support.wal_messages import CHANNEL, check_messages
from undulog.capture.log.wal.reader import recover

START = """
import os, signal, sys
from mcap.records import Channel
from support.wal_messages import CHANNEL, message
from undulog.capture.log.wal.writer import WriteAheadLog

def opened(segment_size):
    # The thread's own syncs don't come before the end of the test.
    wal = WriteAheadLog(sys.argv[1], segment_size=segment_size, sync_interval_s=3600.0)
    wal.define(CHANNEL)
    return wal

def go_on(wal, count):
    for _ in range(count):
        wal.append(*message(wal.position + 1))

def lose_power():
    os.kill(os.getpid(), signal.SIGKILL)

"""


def check(disk, count):
    """The first messages of the log are there, and what explains them."""
    for loss in Loss:
        recovery = recover(disk.after(loss) / "w")
        positions = check_messages(list(recovery))
        assert positions[:count] == list(range(1, count + 1)), loss
        assert recovery.definitions == (CHANNEL,)


def test_a_log_that_is_kept_at_its_end_is_on_the_disk(disk):
    kept = "wal = opened(1 << 16); go_on(wal, 20); wal.close(); lose_power()"
    disk.run(kept, disk.root / "w")
    check(disk, 20)


def test_a_busy_log_that_is_kept_at_its_end_is_on_the_disk(disk):
    """Another sync would leave out the page that is being written."""
    kept = """
wal = opened(1 << 20)
go_on(wal, 10)
wal._sync()
go_on(wal, 1990)
wal.close()
lose_power()
"""
    disk.run(kept, disk.root / "w")
    check(disk, 2000)


@pytest.mark.parametrize("syncs", [1, 2])
def test_what_counts_as_synced_is_on_the_disk(disk, syncs):
    """The first sync of a segment, and one of few messages more."""
    steps = """
wal = opened(1 << 16)
for _ in range(int(sys.argv[2])):
    go_on(wal, 10)
    wal._sync()
print(wal.synced, flush=True)
go_on(wal, 10)
lose_power()
"""
    _, printed = disk.run(steps, disk.root / "w", syncs)
    assert printed == [str(10 * syncs)]
    check(disk, 10 * syncs)


def test_what_counts_as_synced_of_a_busy_log_is_on_the_disk(disk):
    """Only pages that are full are synced then."""
    busy = """
wal = opened(1 << 20)
go_on(wal, 10)
wal._sync()
for _ in range(2):
    before = wal.synced
    go_on(wal, 300)
    wal._sync()
    assert before < wal.synced < wal.position
print(wal.synced, flush=True)
lose_power()
"""
    _, (synced,) = disk.run(busy, disk.root / "w")
    assert int(synced) > 500
    check(disk, int(synced))


def test_segments_that_follow_are_on_the_disk_with_their_names(disk):
    """Full ones, and one that wasn't there at the sync before."""
    follow = """
wal = opened(1 << 14)
go_on(wal, 10)
wal._sync()
go_on(wal, 200)
assert len(wal._sealed) > 2
wal._sync()
print(wal.synced, flush=True)
lose_power()
"""
    assert disk.run(follow, disk.root / "w")[1] == ["210"]
    check(disk, 210)


def test_definitions_are_on_the_disk_with_the_messages_that_need_them(disk):
    late = """
wal = opened(1 << 16)
go_on(wal, 10)
wal._sync()
for key in range(2, 6):
    wal.define(Channel(key, f"/{key}", "cdr", {"large": "x" * 100_000}, 0))
wal.append(5, 1, 1, 1, b"")
wal._sync()
print(wal.synced, flush=True)
lose_power()
"""
    assert disk.run(late, disk.root / "w")[1] == ["11"]
    for loss in Loss:
        recovery = recover(disk.after(loss) / "w")
        assert [message.channel_id for message in recovery][-1] == 5
        assert [item.id for item in recovery.definitions] == [1, 2, 3, 4, 5]


def test_after_a_sync_that_fails_nothing_more_counts_as_synced(disk):
    """The next sync would succeed, but the kernel has dropped what the failed one had to write."""
    failing = """
wal = opened(1 << 16)
for _ in range(3):
    try:
        go_on(wal, 10)
    except Exception as error:
        print(error)
    wal._sync()
    print(wal.synced, flush=True)
lose_power()
"""
    _, printed = disk.run(failing, disk.root / "w", fails=2, name="/000001.seg")
    first, second, error, third = printed
    assert (first, second, third) == ("10", "10", "10")
    assert "000001.seg: can't be brought to the disk: Input/output error" in error
    check(disk, 10)
