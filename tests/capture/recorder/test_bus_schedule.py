"""When a bus decodes and writes: limits of its time as properties, failures, serial lines."""

import random
from types import SimpleNamespace

import numpy as np
import pytest

from undulog.capture import Session, SessionWriter
from undulog.capture.bus.decoding import FrameTally
from undulog.capture.log.messages.frames import FD_FRAME_DTYPE, empty_fd_frames, empty_frames
from undulog.capture.recorder import bus_recorder
from undulog.capture.recorder.bus_recorder import BusRecorder
from undulog.capture.recorder.source_clock import SourceClock

EPOCH_NS, MS = 1_700_000_000_000_000_000, 1_000_000
NEVER_NS = 1 << 62


class Stage:
    """A bus whose decoding takes the time that the test says, and what it did, in order.

    Attributes:
        done: Kind, number and time of each slice ("slice", frames) and message ("message", number).
        fails: Whether decoding of some frames fails.
    """

    def __init__(self, path, monkeypatch, costs=lambda: 8 * MS, **options):
        self.path, self.now_ns, self.costs, self.done = path, EPOCH_NS, costs, []
        self.writer = SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS)
        self.bus = BusRecorder("b", self.writer, SourceClock(), None, directions=False, **options)
        self.bus._decoder = SimpleNamespace(decode=self._decode)
        self.bus._topics = SimpleNamespace(add=self._add, forget=int, finish=list)
        self.fails, self.batch_size, self.count = (lambda _: False), lambda: 0, 0
        clock = SimpleNamespace(thread_time_ns=lambda: self.now_ns)
        monkeypatch.setattr(bus_recorder, "time", clock)

    def now(self):
        return self.now_ns

    def _decode(self, frames):
        self.done.append(("slice", len(frames), self.now_ns))
        self.now_ns += self.costs()
        if self.fails(frames):
            raise ZeroDivisionError
        return frames, FrameTally()

    def _add(self, frames):
        first, self.count = self.count, self.count + self.batch_size()
        return [Message(self, number) for number in range(first, self.count)]

    def give(self, count, first=0, dtype=None):
        frames = np.zeros(count, dtype) if dtype is not None else empty_frames(count)
        frames["t_host_ns"] = frames["t_device_ns"] = EPOCH_NS + first + np.arange(count)
        self.bus.add(frames)
        self.bus.write_raw(self.now)

    def decode(self, until_ns=NEVER_NS, **options):
        """Decode; returns what was done."""
        self.done.clear()
        self.bus.decode(self.now, until_ns, **options)
        return list(self.done)


class Message:
    """A topic's messages of a slice, which takes 1 ms to write."""

    topic = "/t"

    def __init__(self, stage, number):
        self.stage, self.number = stage, number

    def __len__(self):
        return 1

    def write(self, log_ns):
        assert log_ns.tolist() == [self.stage.now_ns]
        self.stage.done.append(("message", self.number, self.stage.now_ns))
        self.stage.now_ns += MS


@pytest.fixture
def stage_of(tmp_path, monkeypatch):
    made = []

    def make(**options):
        made.append(Stage(tmp_path / "run.mcap", monkeypatch, **options))
        return made[0]

    yield make
    made[0].writer.close()


# -- time ------------------------------------------------------------------------------------------


def test_nothing_is_begun_after_the_time_and_all_that_may_be_before_it(stage_of):
    rng = random.Random(3)
    stage = stage_of(costs=lambda: rng.choice([0, 1, 3, 5, 6, 7, 11, 12, 13, 30]) * MS)
    numbers = [rng.randrange(4) for _ in range(5000)]
    stage.batch_size, produced = iter(numbers).__next__, iter(numbers)
    bus, took_ns, size, left, waiting = stage.bus, 0, 256, 0, 0
    next_message = 0
    for _ in range(400):
        if rng.random() < 0.5:
            count = rng.choice([1, 200, 255, 256, 257, 511, 512, 513, 900, 1024, 3000])
            stage.give(count)
            left += count
        until_ns, rest = stage.now_ns + rng.randrange(-2, 25) * MS, rng.random() < 0.4
        done = stage.decode(until_ns, rest=rest)
        ends = [*(at_ns for *_, at_ns in done[1:]), stage.now_ns]
        for k, (kind, number, at_ns) in enumerate(done):
            assert at_ns < until_ns
            if kind == "message":
                assert number == next_message  # in order
                next_message += 1
                waiting -= 1
                continue
            assert waiting == 0  # those of the slice before come first
            assert k == 0 or at_ns + took_ns < until_ns
            assert number == min(size, left)
            assert rest or left >= size
            left -= number
            took_ns = ends[k] - at_ns
            size = max(size // 2, 256) if took_ns > 12 * MS else size
            size = min(size * 2, 1024) if took_ns < 6 * MS else size
            waiting = next(produced)
        assert (bus.backlog, bus.behind) == (left, waiting > 0 or left >= size)
        over = stage.now_ns + (took_ns if done else 0) >= until_ns
        if waiting:
            assert stage.now_ns >= until_ns
        else:
            assert over or not left or (not rest and left < size)


def test_what_waits_makes_a_bus_behind_from_a_whole_slice_on(stage_of):
    stage = stage_of()
    assert not stage.bus.behind
    stage.give(255)
    assert not stage.bus.behind
    stage.give(1)
    assert stage.bus.behind


# -- failures --------------------------------------------------------------------------------------


def bad_at(*places):
    return lambda frames: bool(np.isin(frames["t_host_ns"] - np.uint64(EPOCH_NS), places).any())


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 64, 65, 200, 256])
def test_a_failed_slice_is_tried_again_in_eighths_until_single_frames(stage_of, count):
    """Against a plain recursion; the frames come in their order."""
    stage, bad = stage_of(), count // 3
    stage.fails = bad_at(bad)

    def tried(first, number):
        sizes, here = [number], first <= bad < first + number
        piece = (number + 7) // 8
        if here and number > 1:
            for start in range(first, first + number, piece):
                sizes += tried(start, min(piece, first + number - start))
        return sizes

    stage.give(count)
    assert [number for _, number, _ in stage.decode()] == tried(0, count)
    text = "decoding failed with ZeroDivisionError() and goes on; 1 frames are kept raw only"
    assert (stage.bus.take_faults(), stage.bus.behind) == ([text], False)


@pytest.mark.parametrize("run", [8, 15, 16])
def test_after_16_single_failures_in_a_row_the_pieces_are_given_up(stage_of, run):
    """Pieces of 4 frames are left of the failed eighth, and the 7 other eighths."""
    stage = stage_of()
    stage.fails = bad_at(*range(run))
    stage.give(256)
    sizes = [number for _, number, _ in stage.decode()]
    (fault,) = stage.bus.take_faults()
    if run < 16:
        assert f"; {run} frames are kept raw only" in fault
        assert sizes[-7:] == [32] * 7
    else:
        assert f"; {16 + 16 + 7 * 32} frames are kept raw only" in fault
        assert sizes[-1] == 1
    stage.fails = bad_at(*range(1000, 1015))  # and the count begins anew
    stage.give(256, first=1000)
    stage.decode()
    assert "; 15 frames are kept raw only" in stage.bus.take_faults()[0]


def test_failures_with_successes_in_between_are_not_in_a_row(stage_of):
    stage = stage_of()
    stage.fails = bad_at(*range(0, 40, 2))
    stage.give(256)
    stage.decode()
    assert "; 20 frames are kept raw only" in stage.bus.take_faults()[0]


# -- serial lines and CAN FD -----------------------------------------------------------------------


@pytest.mark.parametrize("serial", [False, True])
def test_packets_of_a_line_are_decoded_in_its_order_and_frames_in_that_of_time(stage_of, serial):
    stage, seen = stage_of(serial=serial), []
    stage.fails = lambda frames: seen.append(frames["t_device_ns"].tolist())
    for t_ns in (30, 10, 20):
        frames = np.zeros(1, FD_FRAME_DTYPE)
        frames["t_host_ns"], frames["t_device_ns"] = EPOCH_NS, EPOCH_NS + t_ns
        stage.bus.add(frames)
    stage.bus.write_raw(stage.now)
    assert stage.bus.backlog == 3
    stage.bus.finish(stage.now)
    order = [30, 10, 20] if serial else [10, 20, 30]
    assert seen == [[EPOCH_NS + t_ns for t_ns in order]]
    stage.writer.close()
    with Session(stage.path) as session:
        topics = {topic for topic, channel in session.channels.items() if channel.count}
    assert topics == {"/serial/b" if serial else "/can_fd/b"}


def test_frames_of_both_kinds_have_their_channels_and_4096_a_message(stage_of):
    stage = stage_of()
    for count in (4096, 1):
        stage.bus.add(empty_frames(count))
        stage.bus.add(empty_fd_frames(count + 4096))
    stage.bus.write_raw(stage.now)
    assert stage.bus.backlog == 2 * 4097 + 2 * 4096
    stage.bus.keep(empty_frames(4097), stage.now)
    stage.bus.keep(empty_frames(0), stage.now)
    assert stage.bus.backlog == 2 * 4097 + 2 * 4096
    stage.writer.close()
    with Session(stage.path) as session:
        counts = {topic: channel.count for topic, channel in session.channels.items()}
        assert len(session.frames("/can/b")) == 2 * 4097
    assert counts == {"/can/b": 2 + 2, "/can_fd/b": 4}
