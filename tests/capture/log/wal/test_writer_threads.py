"""What the threads of a write-ahead log do and when, on a clock of the test; what wakes them."""

import contextlib
import inspect
import os
import threading
from types import SimpleNamespace

import pytest

from support.processes import wait_for
from support.wal_messages import CHANNEL
from undulog.capture.common.errors import DataError, LogWriteError
from undulog.capture.log.wal import writer
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.segment import Segment
from undulog.capture.log.wal.writer import WriteAheadLog

PAGE = 4096
ROOM = PAGE - 2 * 64 - 40  # of one payload in a segment of a page


class Clock:
    """Time that waits let pass; what a wait is told to do comes from a script.

    Attributes:
        steps: Of each wait: how long it takes until it is woken, None to wait to its end.
        waits: How long each was to be at most.
    """

    def __init__(self, steps):
        self.now_s, self.steps, self.waits = 100.0, list(steps), []

    def monotonic(self):
        return self.now_s

    def wait(self, most_s):
        """Wait; return whether it was woken."""
        self.waits.append(most_s)
        step = self.steps.pop(0)
        self.now_s += most_s if step is None else step
        return step is not None


@pytest.fixture
def idle(tmp_path, monkeypatch):
    """Make a log whose threads don't run: a test runs what they would, with a clock."""
    folder, made = tmp_path / "w", []

    def make(clock, **options):
        jobs = {}

        def event():
            return SimpleNamespace(wait=clock.wait, set=bool, clear=bool)

        def thread(target, name, daemon):
            assert daemon
            jobs[name] = target
            return SimpleNamespace(start=bool, join=bool)

        threads = SimpleNamespace(Lock=threading.Lock, Event=event, Thread=thread)
        with monkeypatch.context() as patched:
            patched.setattr(writer, "threading", threads)
            made.append(WriteAheadLog(folder, **options))
        monkeypatch.setattr(writer, "time", clock)
        return made[-1], jobs[f"sync {folder}"], jobs[f"hold {folder}"]

    yield make
    for wal in made:
        wal._closed = False
        with contextlib.suppress(LogWriteError):
            wal.close()


def test_syncs_come_at_their_interval_whatever_wakes_the_thread_in_between(idle, monkeypatch):
    clock = Clock([1.0, 2.5, None, None, None, 0.25, None, None])
    wal, work, _ = idle(clock, segment_size=PAGE, sync_interval_s=4.0)
    synced = []

    def sync(**_):
        synced.append(clock.now_s)
        clock.now_s += 10.0 * (len(synced) == 3)  # a disk that takes longer than the interval
        wal._closed = len(synced) == 4

    monkeypatch.setattr(wal, "_sync", sync)
    work()
    assert clock.waits == [4.0, 3.0, 0.5, 4.0, 4.0, 4.0, 3.75, 4.0]
    assert synced == [104.0, 108.0, 112.0, 126.0]


def test_a_thread_that_is_late_waits_no_more(idle, monkeypatch):
    """Time passes between its look at the clock and the wait."""
    clock = Clock([None])
    wal, work, _ = idle(clock, segment_size=PAGE, sync_interval_s=4.0)
    looks = []

    def monotonic():
        looks.append(clock.now_s)
        clock.now_s += 5.0 * (len(looks) == 2)
        wal._closed = len(looks) == 3
        return looks[-1]

    monkeypatch.setattr(clock, "monotonic", monotonic)
    work()
    assert clock.waits == [0.0]


def test_pages_are_held_ahead_to_the_next_segment_a_tenth_of_a_second_apart(idle, monkeypatch):
    clock = Clock([None] * 4)
    wal, _, hold = idle(clock, segment_size=PAGE)
    held = []

    def holds(segment, ahead):
        held.append((segment.path.name, ahead))
        if len(held) == 1:
            return 0
        if len(held) == 4:
            raise OSError(22, os.strerror(22))  # an older kernel has no such call
        return 100 if segment.path.name == "000001.seg" else 0

    monkeypatch.setattr(Segment, "hold", holds)
    wal._ahead()
    hold()
    first, second = ("000001.seg", 2 << 20), ("000002.seg", 100)
    assert held == [first, first, second, first]
    assert clock.waits == [0.1] * 3
    assert wal.append(1, 0, 0, 0, b"") == 1


def test_a_file_that_is_cut_short_is_noticed_where_its_pages_are_held(idle):
    clock = Clock([None])
    wal, _, hold = idle(clock, segment_size=PAGE)
    os.truncate(wal.folder / "000001.seg", 0)
    hold()
    assert clock.waits == [0.1]
    with pytest.raises(LogWriteError, match=r"000001\.seg: was cut short by another program"):
        wal.append(1, 0, 0, 0, b"")
    assert not wal.append_all([(1, 0, 0, 0, b"")])
    assert wal.position == 0


def test_without_a_next_segment_no_page_of_it_is_held(idle, monkeypatch):
    clock = Clock([None, 0.0])
    _, _, hold = idle(clock, segment_size=PAGE)
    monkeypatch.setattr(Segment, "hold", lambda *_: 100)
    hold()
    assert clock.waits == [0.1, 0.1]


def test_what_a_log_starts_with(tmp_path):
    options = inspect.signature(WriteAheadLog).parameters
    assert (options["segment_size"].default, options["sync_interval_s"].default) == (16 << 20, 1.0)
    with WriteAheadLog(tmp_path / "w") as wal:
        assert (wal.position, wal.synced, wal.shortage) == (0, 0, None)
        names = {f"sync {wal.folder}", f"hold {wal.folder}"}
        running = {thread.name: thread.daemon for thread in threading.enumerate()}
        assert [running[name] for name in names] == [True, True]
        wal.release(0)
    assert names.isdisjoint(thread.name for thread in threading.enumerate())


# -- segments --------------------------------------------------------------------------------------


def filled(folder, segments):
    """A log of so many segments of one message each, that syncs by itself no more."""
    wal = WriteAheadLog(folder, segment_size=PAGE, sync_interval_s=3600.0)
    wal.define(CHANNEL)
    for number in range(1, segments + 1):
        assert wal.append(1, number, 0, number, bytes(ROOM)) == number
        wait_for(lambda: wal._spare is not None, "the next segment")
    return wal


def names(folder):
    return sorted(path.name for path in folder.glob("0*.seg"))


def test_a_message_that_fills_the_next_segment_to_the_byte_goes_there(tmp_path):
    with filled(tmp_path / "w", 3):
        assert names(tmp_path / "w") == [f"00000{number}.seg" for number in range(1, 5)]
    assert len(list(recover(tmp_path / "w"))) == 3


@pytest.mark.parametrize("position", range(1, 4))
def test_segments_are_removed_as_soon_as_their_last_message_is_released(tmp_path, position):
    with filled(tmp_path / "w", 4) as wal:
        wait_for(lambda: not wal._wake.is_set(), "the thread's pause")
        wal.release(position)
        kept = [f"00000{number}.seg" for number in range(position + 1, 6)]
        wait_for(lambda: names(wal.folder) == kept, "the release")
        wal.release(position - 1)  # one that was released already changes nothing
        assert names(wal.folder) == kept
    assert [message.position for message in recover(tmp_path / "w")] == [*range(position + 1, 5)]


def test_a_message_that_is_refused_after_a_full_segment_leaves_what_is_synced(tmp_path):
    wal = filled(tmp_path / "w", 3)
    with pytest.raises(DataError, match="out of range"):
        wal.append(1 << 16, 0, 0, 0, b"")
    assert names(wal.folder)[-1] >= "000004.seg"
    wal._sync()
    assert (wal.position, wal.synced) == (3, 3)
    wal.release(3)
    wal.close()
    assert not wal.folder.exists()


def test_the_longest_message_is_accepted_and_none_beyond(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "MAX_PAYLOAD", 10_000)
    with WriteAheadLog(tmp_path / "w", segment_size=PAGE) as wal:
        wal.define(CHANNEL)
        assert wal.append(1, 0, 0, 0, bytes(10_000)) == 1
        with pytest.raises(DataError, match="a record of 10001 bytes; at most 10000 are kept"):
            wal.append(1, 0, 0, 0, bytes(10_001))
        with pytest.raises(DataError, match="at most 10000 are kept"):
            wal.define(CHANNEL.__class__(2, "/" + "x" * 10_000, "cdr", {}, 0))
    assert [len(message.payload) for message in recover(tmp_path / "w")] == [10_000]
