"""The ring against a plain list, its marks one by one, and what its storage tells of them."""

import json
import random
import threading
from types import SimpleNamespace

import pytest
from mcap.records import Channel, Schema

from support.processes import wait_for
from support.read_back import messages_of, metadata_of
from undulog.capture.common.errors import DataError, LogWriteError
from undulog.capture.log.write import ring_sink
from undulog.capture.log.write.mcap_sink import McapSink
from undulog.capture.log.write.ring_sink import (
    MARK_RECORD,
    MAX_BYTES,
    MAX_WAITING,
    MESSAGE_OVERHEAD,
    RingSink,
    RingStorage,
)

EPOCH_NS, NS = 1_700_000_000_000_000_000, 1_000_000_000
LATCHED, STATIC = 3, 4


def defined(ring):
    """Two ordinary channels, a latched one and static transforms."""
    ring.define(Schema(1, b"x", "ros2msg", "sensor_msgs/msg/Imu"))
    ring.define(Schema(2, b"string data", "ros2msg", "std_msgs/msg/String"))
    for key, (topic, kind) in enumerate((("/a", 1), ("/b", 1), ("/mode", 2), ("/tf_static", 1)), 1):
        ring.define(Channel(key, topic, "cdr", {}, kind))
    return ring


class Model:
    """A plain list of what a ring holds."""

    def __init__(self, duration_ns, max_bytes):
        self.duration_ns, self.max_bytes = duration_ns, max_bytes
        self.held, self.state, self.accepted, self.dropped, self.newest_ns = [], {}, 0, 0, 0

    @property
    def size(self):
        return sum(len(message[4]) + MESSAGE_OVERHEAD for message in self.held)

    def write(self, *message):
        self.held.append(message)
        self.accepted += 1
        self.newest_ns = max(self.newest_ns, message[1])
        while self.held[0][1] < self.newest_ns - self.duration_ns:
            self.drop()
        while self.size > self.max_bytes and len(self.held) > 1:
            self.drop()
            self.dropped += 1

    def drop(self):
        message = self.held.pop(0)
        if message[0] in {LATCHED, STATIC}:
            self.state[message[0], message[4] if message[0] == STATIC else b""] = message

    def mark(self):
        """The messages of a mark: what was in force at its start, and what is held."""
        start_ns = self.held[0][1] if self.held else self.newest_ns
        carried = sorted(self.state.values(), key=lambda message: message[1])
        return [(c, start_ns, *rest) for c, _, *rest in carried] + self.held


@pytest.mark.parametrize("seed", range(3))
def test_a_ring_holds_what_a_plain_list_does(tmp_path, seed):
    rng = random.Random(seed)
    model = Model(rng.choice([5, 50]) * NS, 40 * (MESSAGE_OVERHEAD + 20))
    ring = RingSink(tmp_path / "run.mcap", model.duration_ns, max_bytes=model.max_bytes)
    defined(ring)
    now_ns, marked = EPOCH_NS, {}
    for number in range(600):
        now_ns += rng.choice([0, 1, NS // 10, NS, -NS, 3 * NS]) if rng.random() < 0.5 else 0
        size = rng.choice([0, 1, 20, 40, 3000]) if rng.random() < 0.9 else 20_000
        channel = rng.choice([1, 2, LATCHED, STATIC])
        payload = bytes([rng.randrange(3)]) * size
        for target in (ring, model):
            target.write(channel, now_ns, now_ns - number, number, payload)
        state = (ring.messages, ring.size, ring.accepted, ring.dropped, ring.span_ns)
        span_ns = model.newest_ns - model.held[0][1]
        assert state == (len(model.held), model.size, number + 1, model.dropped, span_ns)
        if number % 199 == 150:
            marked[ring.mark(f"{number}")] = (model.mark(), model.newest_ns, model.dropped)
    ring.close(())
    assert len(marked) == 3
    for path, (messages, newest_ns, dropped) in marked.items():
        read = [(c.id, m.log_time, m.publish_time, m.sequence, bytes(m.data)) for _, c, m in
                messages_of(path, log_time_order=False)]  # fmt: skip
        assert sorted(read) == sorted(messages)
        facts = metadata_of(path)[MARK_RECORD]
        assert (facts["stop_ns"], facts["dropped"]) == (str(newest_ns), str(dropped))
        assert facts["ring_s"] == repr(model.duration_ns / 1e9)
    for mark, (messages, *_) in zip(ring.marks, marked.values(), strict=True):
        held = [t_ns for _, t_ns, *_ in messages]
        assert (mark.messages, mark.error) == (len(messages), None)
        assert (mark.start_ns, mark.stop_ns) == (min(held), max(held))


def test_a_ring_holds_512_mib_by_default_and_four_marks_may_wait(tmp_path):
    assert (MAX_BYTES, MAX_WAITING) == (512 << 20, 4)
    ring = RingSink(tmp_path / "run.mcap", NS)
    big = bytes(MAX_BYTES // 4 - MESSAGE_OVERHEAD)  # the same bytes each time
    for number in range(4):
        ring.write(1, EPOCH_NS, EPOCH_NS, number, big)
    assert (ring.messages, ring.size, ring.dropped) == (4, MAX_BYTES, 0)
    ring.write(1, EPOCH_NS, EPOCH_NS, 4, b"")
    assert (ring.messages, ring.dropped) == (4, 1)
    ring.close(())
    assert (ring.messages, ring.size, ring.span_ns) == (0, 0, 0)


def test_the_recorder_s_thread_is_let_go_on_after_each_64_messages(tmp_path, monkeypatch):
    slept = []
    monkeypatch.setattr(ring_sink, "time", SimpleNamespace(sleep=slept.append))
    ring = defined(RingSink(tmp_path / "run.mcap", NS))
    for number in range(64 * 3 + 1):
        ring.write(1, EPOCH_NS, EPOCH_NS, number, b"x")
    ring.mark()
    ring.close(())
    assert slept == [0] * 4  # none is a wait


def test_marks_are_taken_once_each_and_in_order(tmp_path):
    gate = threading.Event()

    def slow(path):
        gate.wait()
        return McapSink(path)

    ring = defined(RingSink(tmp_path / "run.mcap", NS, open_file=slow))
    paths = [ring.mark() for _ in range(3)]
    assert (ring.waiting, ring.take_marks(), ring.marks) == (3, (), ())
    gate.set()
    wait_for(lambda: not ring.waiting, "the marks")
    assert [mark.path for mark in ring.take_marks()] == paths
    assert ring.take_marks() == ()
    paths.append(ring.mark())
    wait_for(lambda: not ring.waiting, "the mark")
    assert [mark.path for mark in ring.take_marks()] == paths[3:]
    ring.close(())
    assert [mark.path for mark in ring.marks] == paths
    facts = metadata_of(paths[0])[MARK_RECORD]
    assert (facts["number"], facts["stop_ns"], facts["carried"]) == ("1", "0", "{}")


@pytest.mark.parametrize("broken", ["define", "write", "close"])
@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(28, "No space left on device"), "can't be written: No space left on device"),
        (DataError("odd"), "odd"),
    ],
)
def test_a_mark_that_fails_anywhere_has_its_reason(tmp_path, broken, error, text):
    def fails(*_):
        raise error

    def opened(path):
        sink = McapSink(path)
        setattr(sink, broken, fails)
        return sink

    ring = defined(RingSink(tmp_path / "run.mcap", NS, open_file=opened))
    ring.write(1, EPOCH_NS, EPOCH_NS, 0, b"x")
    path = ring.mark()
    with pytest.raises(LogWriteError) as caught:
        ring.close(())
    (mark,) = ring.marks
    assert (str(mark.error), mark.messages) == (f"{path}: {text}", 1)
    assert caught.value is mark.error
    assert not path.exists()


def test_a_mark_that_a_mistake_costs_is_missed_at_the_end(tmp_path):
    def mistaken(_):
        raise RuntimeError

    ring = defined(RingSink(tmp_path / "run.mcap", NS, open_file=mistaken))
    ring.mark()
    ring.mark()
    with pytest.raises(LogWriteError, match=r"run\.mcap: 2 marks are not written"):
        ring.close(())
    assert ring.marks == ()


# -- the storage -----------------------------------------------------------------------------------


@pytest.fixture
def storage(tmp_path):
    folder = tmp_path / "here"
    folder.mkdir()
    storage = RingStorage(folder / "run.mcap", 2.5)
    defined(storage.sink)
    yield storage
    storage.sink.close(())


def texts_of(storage):
    wait_for(lambda: not storage.sink.waiting, "the marks")
    return storage.tick()


def test_a_storage_tells_of_each_mark_once_and_adds_their_sizes(storage):
    assert (storage.part, storage.shortage, storage.must_end) == (None, None, "")
    assert (storage.size, storage.tick(), storage.files()) == (0, [], ())
    size = 0
    for number in (1, 2):
        for k in range(10):
            storage.sink.write(1, EPOCH_NS + k * 123_456_789, EPOCH_NS, k, b"x" * 100)
        reply = storage.mark("slipped")
        path = storage.part_path.with_name(f"run_mark000{number}.mcap")
        assert reply == {"file": str(path), "messages": 10 * number, "seconds": 1.111}
        ((level, text),) = texts_of(storage)
        size += path.stat().st_size
        assert (level, storage.size, storage.tick()) == ("info", size, [])
        assert text.startswith(f"{path.name} is written: {10 * number} messages, ")
        assert text.endswith((" B", " kB"))
        assert json.loads(metadata_of(path)[MARK_RECORD]["ring_s"]) == 2.5
    assert (storage.messages, storage.unsynced, len(storage.files())) == (20, 20, 2)


def test_a_folder_that_goes_is_told_once_and_again_after_it_was_back(storage):
    folder = storage.part_path.parent
    gone = ("error", f"the folder {folder} is gone: no mark can be written")
    for _ in range(2):
        folder.rename(folder.with_name("away"))
        assert [storage.tick() for _ in range(3)] == [[gone], [], []]
        folder.with_name("away").rename(folder)
        assert storage.tick() == []


def test_a_mark_that_was_moved_away_counts_nothing_and_a_failed_one_is_told(storage):
    path = storage.part_path.with_name("run_mark0001.mcap")
    storage.mark("")
    wait_for(lambda: not storage.sink.waiting, "the mark")
    path.unlink()
    assert storage.tick() == [("info", f"{path.name} is written: 0 messages, 0 B")]
    storage.part_path.with_name("run_mark0002.mcap.part").mkdir()
    storage.sink._open_file = lambda _: (_ for _ in ()).throw(DataError("odd"))
    third = storage.part_path.with_name("run_mark0003.mcap")
    storage.mark("")
    assert texts_of(storage) == [("error", f"a mark is not whole: {third}: odd")]
    assert (storage.size, storage.files()) == (0, (path,))


def test_a_ring_that_is_full_of_bytes_is_told_once(storage):
    storage.sink._max_bytes = 3 * (MESSAGE_OVERHEAD + 1)
    for number in range(9):
        storage.sink.write(1, EPOCH_NS + number * NS // 4, EPOCH_NS, number, b"x")
        expected = (
            [("warn", "the ring is full of bytes and holds only 0.5 s")] if number == 3 else []
        )
        assert storage.tick() == expected
