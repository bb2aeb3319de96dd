"""The recorder's files on a disk that forgets what wasn't synced."""

from operator import itemgetter

import pytest

from support import durable_child as recorder
from support.forgetting_disk import ForgettingDisk, Loss
from support.read_back import messages_of, read, rows_of

START = """
import os, signal, sys, time
from pathlib import Path
from support import durable_child as recorder
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.write import disk_thread
from undulog.capture.log.write.part_stream import PartStream
from undulog.capture.log.write.ring_sink import RingSink

def lose_power():
    os.kill(os.getpid(), signal.SIGKILL)

def stream():
    return PartStream(Path(sys.argv[1]), 1, force=False)

def opened(**options):
    # The write-ahead log's own syncs don't come before the end of the test.
    usual = {"segment_size": 1 << 16, "ballast": 0, "sync_interval_s": 3600.0}
    return recorder.open_sink(sys.argv[1], **usual | options)

def go_on(sink, count):
    for number in range(sink.messages, sink.messages + count):
        recorder.write(sink, number)

"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# -- a file that is written ----------------------------------------------------------------------


@pytest.mark.parametrize("syncs", [1, 2])
def test_a_part_file_has_what_was_synced(disk, syncs):
    program = """
part = stream()
for _ in range(int(sys.argv[2])):
    part.put(memoryview(bytes(range(256))))
    part.sync()
part.put(memoryview(b"more"))
lose_power()
"""
    disk.run(program, disk.root / "run.mcap", syncs)
    for loss in Loss:
        part = disk.after(loss) / "run.mcap.part"
        assert part.read_bytes()[: 256 * syncs] == bytes(range(256)) * syncs, loss


def test_a_file_that_was_published_has_its_name(disk):
    program = "part = stream(); part.put(memoryview(b'12')); part.sync(); part.publish()"
    disk.run(program, disk.root / "run.mcap", code=0)
    for loss in Loss:
        left = disk.after(loss)
        assert names(left) == ["run.mcap"]
        assert (left / "run.mcap").read_bytes() == b"12"


@pytest.mark.parametrize("then", ["publish", "sync"])
def test_a_rescue_file_has_what_the_deleted_file_had(disk, then):
    program = """
part = stream()
part.put(memoryview(bytes(range(256))))
part.sync()
part._unfinished.unlink()
part.rescue(0)
part.publish() if sys.argv[2] == "publish" else part.sync()
lose_power()
"""
    disk.run(program, disk.root / "run.mcap", then)
    for loss in Loss:
        (rescued,) = disk.after(loss).glob("run.rescued-*")
        assert rescued.suffix == (".mcap" if then == "publish" else ".part")
        assert rescued.read_bytes() == bytes(range(256)), loss


# -- a recording ---------------------------------------------------------------------------------


def test_what_the_write_ahead_log_let_go_of_is_in_the_file(disk):
    program = """
sink = opened(flush_interval_s=3600.0)
for _ in range(2):
    go_on(sink, 3000)
    for _ in range(2):
        sink._flush()
    while sink._wal._released < sink.messages:
        time.sleep(0.001)
    sink._wal._drop_released()
    go_on(sink, 20)
sink._wal._sync()
assert sink.unsynced == 0
print(*sorted(name for name in os.listdir(f"{sys.argv[1]}.wal") if name[0] == "0"), flush=True)
lose_power()
"""
    _, (left,) = disk.run(program, disk.root / "run.mcap")
    assert left.split()[0] > "000010.seg"
    for loss in Loss:
        messages, warnings = read(disk.after(loss) / "run.mcap")
        assert messages == recorder.truth(6040), loss
        assert "none is missing" in warnings[0]


def test_a_recording_that_has_ended_is_there_under_its_names(disk):
    program = """
sink = opened()
go_on(sink, 1000)
sink.split()
go_on(sink, 1000)
sink.close(())
lose_power()
"""
    disk.run(program, disk.root / "run.mcap")
    for loss in Loss:
        left = disk.after(loss)
        assert set(names(left)) - {"run.mcap.wal"} == {"run.mcap", "run_0002.mcap"}, loss
        rows = [*rows_of(left / "run.mcap"), *rows_of(left / "run_0002.mcap")]
        assert rows == recorder.truth(2000)
        # The write-ahead log may be back: each message is read once all the same.
        assert read(left / "run.mcap") == (recorder.truth(2000), [])


FAULTS = [{"fails": 1, "name": ".part"}, {"fails": 2, "name": ".part"}, {"room": 1000}]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_recording_whose_file_failed_is_in_the_write_ahead_log(disk, fault):
    """As the error at the end says."""
    program = """
disk_thread._PATIENCE_S = 0.01
sink = opened()
try:
    go_on(sink, 100_000)
except LogWriteError:
    print(sink.messages)
try:
    sink.close(())
except LogWriteError as error:
    print(error)
"""
    _, (accepted, error) = disk.run(program, disk.root / "run.mcap", code=0, **fault)
    reason = "No space left on device" if "room" in fault else "Input/output error"
    assert f"{reason}; all {accepted} messages are kept" in error
    for loss in Loss:
        messages, _ = read(disk.after(loss) / "run.mcap")
        assert messages == recorder.truth(int(accepted)), loss


@pytest.mark.slow
def test_a_recording_that_loses_its_power_has_what_counted_as_synced(tmp_path, programs):
    """At each of its syncs, those of a split and of its end too."""
    program = """
sink = opened(segment_size=1 << 15, split_size=1 << 16)
for _ in range(4):
    go_on(sink, 250)
    sink._wal._sync()
    print(sink.messages - sink.unsynced, flush=True)
sink.close(())
"""
    for number in range(1, 100):
        disk = ForgettingDisk(tmp_path / str(number), programs)
        code, printed = disk.run(program, disk.root / "run.mcap", code=None, ends=number)
        assert code in (0, -9)
        count = max(map(int, printed), default=0)
        for loss in Loss if count else ():
            messages, _ = read(disk.after(loss) / "run.mcap")
            messages.sort(key=itemgetter(2))
            assert messages[:count] == recorder.truth(count), (loss, number)
            # Of what came later there may be some, with gaps.
            times = [message[2] for message in messages]
            assert len(set(times)) == len(times)
            assert set(messages) <= set(recorder.truth(1000))
        if code == 0:
            break
    assert number > 15
    assert count == 1000


# -- a ring --------------------------------------------------------------------------------------


def test_a_mark_that_is_written_is_whole(disk):
    program = """
ring = RingSink(Path(sys.argv[1]), 10**12)
recorder.define(ring)
for number in range(100):
    recorder.write(ring, number)
ring.mark()
ring.close(())
print(ring.marks[0].path.name, flush=True)
lose_power()
"""
    _, (name,) = disk.run(program, disk.root / "run.mcap")
    for loss in Loss:
        left = disk.after(loss)
        assert names(left) == [name]
        assert len(messages_of(left / name)) == 100
