"""The ring: a mark holds exactly the last seconds, whole, and nothing is ever overwritten."""

import functools
import json
import random
import shutil
import threading
import tracemalloc
from operator import itemgetter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Metadata, Schema

from support.processes import python, wait_for
from support.read_back import messages_of, metadata_of
from undulog.capture import Session
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.write.mcap_sink import McapSink
from undulog.capture.log.write.ring_sink import (
    MARK_RECORD,
    MAX_WAITING,
    MESSAGE_OVERHEAD,
    RingSink,
    RingStorage,
)
from undulog.capture.log.write.writer import SessionWriter

EPOCH_NS = 1_700_000_000_000_000_000
MS = 1_000_000
SECOND = 1000 * MS
PATIENCE_S = 60.0
TOPICS = ["/a", "/b", "/gait/mode", "/tf_static"]


def written(ring):
    """The marks, once every one is written."""
    wait_for(lambda: not ring.waiting, "the marks")
    return ring.take_marks()


def read(path):
    """All messages of a file by a foreign reader: channel by channel, as each was written."""
    rows = messages_of(path, log_time_order=False)
    messages = [(c.id, m.log_time, m.publish_time, m.sequence, bytes(m.data)) for _, c, m in rows]
    return by_channel(messages)


def by_channel(messages):
    """Messages in the order of the channels, those of one in the order they have."""
    return sorted(messages, key=itemgetter(0))


def marked(ring, text=""):
    """The last mark of a ring, which is closed."""
    path = ring.mark(text)
    ring.close(())
    return path


def put(ring, *messages):
    """Write messages of channel 1: log time after the epoch [ns] and payload."""
    for sequence, (t_ns, payload) in enumerate(messages):
        ring.write(1, EPOCH_NS + t_ns, EPOCH_NS, sequence, payload)


@pytest.fixture
def ring(tmp_path):
    return defined(RingSink(tmp_path / "run.mcap", SECOND))


def defined(ring):
    """Two ordinary channels, a latched one and static transforms."""
    ring.define(Schema(id=1, data=b"x", encoding="ros2msg", name="sensor_msgs/msg/JointState"))
    ring.define(Schema(id=2, data=b"string data", encoding="ros2msg", name="std_msgs/msg/String"))
    facts = ({"unit": "rad"}, {}, {}, {})
    for key, (topic, metadata, kind) in enumerate(zip(TOPICS, facts, (1, 1, 2, 1), strict=True), 1):
        ring.define(Channel(key, topic, "cdr", metadata, kind))
    return ring


STEP = st.tuples(st.integers(1, 2), st.integers(0, 400), st.binary(max_size=40))


@given(st.lists(STEP, max_size=60), st.integers(1, 2000), st.sets(st.integers(0, 59), max_size=3))
@settings(deadline=None, max_examples=60)
def test_a_mark_has_the_last_seconds_bit_for_bit(tmp_path_factory, steps, window_ms, marks):
    folder = tmp_path_factory.mktemp("ring")
    ring = defined(RingSink(folder / "run.mcap", window_ms * MS))
    sent, expected, t_ns = [], {}, EPOCH_NS
    for k, (channel, step_ms, payload) in enumerate(steps):
        t_ns += step_ms * MS
        sent.append((channel, t_ns, t_ns - k, k, payload))
        ring.write(*sent[-1])
        if k in marks:
            expected[ring.mark()] = [m for m in sent if m[1] >= t_ns - window_ms * MS]
    ring.close(())
    assert [mark.path for mark in ring.marks] == list(expected)
    for mark in ring.marks:
        truth = expected[mark.path]
        assert (mark.error, mark.messages) == (None, len(truth))
        assert read(mark.path) == by_channel(truth)
        assert (mark.start_ns, mark.stop_ns) == (truth[0][1], truth[-1][1])
    shutil.rmtree(folder)


def test_what_was_in_force_before_the_window_is_carried_to_its_start(ring):
    now_ns = EPOCH_NS + 5 * SECOND
    for channel, t_ns, sequence, payload in [
        (3, EPOCH_NS + 1, 0, b"stand"),
        (4, EPOCH_NS + 2, 0, b"left"),
        (4, EPOCH_NS + 3, 1, b"right"),
        (4, EPOCH_NS + 4, 2, b"left"),
        (3, EPOCH_NS + 5, 1, b"walk"),
        (1, EPOCH_NS + 6, 0, b"old"),
        (1, now_ns, 1, b"new"),
        (3, now_ns + 9, 2, b"avoid"),
    ]:
        ring.write(channel, t_ns, t_ns, sequence, payload)
    path = marked(ring, "slipped")
    assert read(path) == [
        (1, now_ns, now_ns, 1, b"new"),
        (3, now_ns, EPOCH_NS + 5, 1, b"walk"),
        (3, now_ns + 9, now_ns + 9, 2, b"avoid"),
        (4, now_ns, EPOCH_NS + 3, 1, b"right"),
        (4, now_ns, EPOCH_NS + 4, 2, b"left"),
    ]
    facts = metadata_of(path)[MARK_RECORD]
    assert (facts["number"], facts["text"], facts["ring_s"]) == ("1", "slipped", "1.0")
    assert facts["stop_ns"] == str(now_ns + 9)
    assert json.loads(facts["carried"]) == {"/gait/mode": EPOCH_NS + 5, "/tf_static": EPOCH_NS + 4}


def test_every_mark_explains_itself_and_opens_as_a_session(tmp_path):
    """Through the session writer and reader: three marks of one robot, each complete."""
    ring = RingSink(tmp_path / "run.mcap", 2 * SECOND)
    facts = {"session_id": "s", "epoch_ns": EPOCH_NS, "metadata": {"place": "x"}}
    writer = SessionWriter(tmp_path / "run.mcap", sink=ring, **facts)
    writer.attach("scenario.toml", "application/toml", b"a = 1")
    states = writer.joint_state("/joint_states", ["j1", "j2"], unit="rad")
    writer.string("/gait/mode").write(EPOCH_NS, "walk")
    for k in range(1000):
        states.write(EPOCH_NS + k * 10 * MS, [k, -k])
        if k in (300, 600):
            ring.mark()
    writer.log().write(EPOCH_NS + 9990 * MS, "info", "test", "late channel")
    ring.mark()
    writer.set_verdict("good")
    writer.close()
    assert not (tmp_path / "run.mcap").exists()
    for number, last in enumerate([300, 600, 999], 1):
        path = tmp_path / f"run_mark{number:04d}.mcap"
        with Session(path) as session:
            assert session.session_id == "s"
            assert session.metadata["undulog"]["place"] == "x"
            assert session.attachments["scenario.toml"] == b"a = 1"
            assert session.warnings == []
            expected = np.arange(last - 200, last + 1.0)
            states = session.joints("/joint_states").values
            np.testing.assert_array_equal(states, [expected, -expected])
            assert [m.data for _, m in session.messages("/gait/mode")] == ["walk"]
    with Session(path) as session:
        assert [m.msg for _, m in session.messages("/rosout")] == ["late channel"]


def test_nothing_is_overwritten_and_numbers_go_on(tmp_path):
    (tmp_path / "run_mark0007.mcap").write_bytes(b"precious")
    (tmp_path / "run_mark12.mcap").write_bytes(b"no mark of ours")
    (tmp_path / "other_mark0099.mcap").write_bytes(b"another's")
    ring = defined(RingSink(tmp_path / "run.mcap", SECOND))
    put(ring, (0, b"x"))
    (tmp_path / "run_mark0008.mcap").write_bytes(b"came later")
    assert [ring.mark().name for _ in range(2)] == ["run_mark0009.mcap", "run_mark0010.mcap"]
    ring.close(())
    assert (tmp_path / "run_mark0007.mcap").read_bytes() == b"precious"
    assert (tmp_path / "run_mark0008.mcap").read_bytes() == b"came later"


@pytest.mark.parametrize("name", ["run_mark0001.mcap", "run_mark0001.mcap.part"])
def test_a_file_that_comes_in_between_is_not_overwritten_either(name, tmp_path):
    def late(path):
        (tmp_path / name).write_bytes(b"precious")
        return McapSink(path)

    ring = defined(RingSink(tmp_path / "run.mcap", SECOND, open_file=late))
    ring.write(1, EPOCH_NS, EPOCH_NS, 0, b"x")
    ring.mark()
    (mark,) = written(ring)
    assert "exists" in str(mark.error)
    assert (tmp_path / name).read_bytes() == b"precious"
    ring.close(())


def test_a_failed_mark_is_reported_once_and_the_ring_goes_on(tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    ring = defined(RingSink(folder / "run.mcap", SECOND))
    ring.write(1, EPOCH_NS, EPOCH_NS, 0, b"x")
    folder.rmdir()
    ring.mark()
    (mark,) = written(ring)
    assert isinstance(mark.error, LogWriteError)
    assert ring.take_marks() == ()
    folder.mkdir()
    ring.mark()
    (mark,) = written(ring)
    assert mark.error is None
    assert len(read(mark.path)) == 1
    ring.close(())


def test_close_raises_a_failure_that_nobody_has_seen(tmp_path):
    ring = defined(RingSink(tmp_path / "none" / "run.mcap", SECOND))
    put(ring, (0, b"x"))
    with pytest.raises(LogWriteError, match=r"run_mark0001\.mcap"):
        marked(ring)
    ring.close(())


def test_a_full_disk_is_reported_and_what_fits_stays(disk_of):
    ring = defined(RingSink(disk_of("256k") / "run.mcap", SECOND))
    noise = random.Random(1).randbytes(1000)
    for k in range(1000):
        ring.write(1, EPOCH_NS, EPOCH_NS, k, noise + random.Random(k).randbytes(1000))
    ring.mark()
    (mark,) = written(ring)
    assert "No space left" in str(mark.error)
    assert not mark.path.exists()  # what fits is in the part file
    with Session(mark.path) as session:
        assert 0 < session.channels["/a"].count < 1000
        assert any("run_mark0001.mcap.part has not got" in text for text in session.warnings)
    ring.close(())
    with pytest.raises(LogWriteError, match="closed"):
        put(ring, (0, b"x"))


def test_marks_wait_their_turn_and_too_many_are_refused(tmp_path):
    gate = threading.Event()

    def slow(path):
        assert gate.wait(PATIENCE_S)
        return McapSink(path)

    ring = defined(RingSink(tmp_path / "run.mcap", SECOND, open_file=slow))
    paths = []
    for k in range(MAX_WAITING):
        ring.write(1, EPOCH_NS + k, EPOCH_NS, k, b"x")
        paths.append(ring.mark())
    with pytest.raises(LogWriteError, match="wait to be written already"):
        ring.mark()
    ring.write(1, EPOCH_NS + 9, EPOCH_NS, 9, b"goes on")
    gate.set()
    ring.close(())
    assert [len(read(path)) for path in paths] == [1, 2, 3, 4]


@pytest.mark.slow
def test_memory_is_bounded_and_what_went_early_is_counted(tmp_path):
    bound = 8 << 20
    ring = defined(RingSink(tmp_path / "run.mcap", 3600 * SECOND, max_bytes=bound))
    make = functools.partial(random.Random(2).randbytes, 100)
    tracemalloc.start()
    try:
        for k in range(60_000):
            ring.write(1 + k % 2, EPOCH_NS + k * MS, EPOCH_NS + k * MS + 1, k, make())
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ring.size <= bound
    assert 0.8 * bound < held < 1.05 * bound
    assert ring.messages == bound // (100 + MESSAGE_OVERHEAD)
    assert ring.dropped == 60_000 - ring.messages
    assert ring.accepted == 60_000
    assert ring.span_ns == (ring.messages - 1) * MS
    path = marked(ring)
    assert sorted(m[3] for m in read(path)) == list(range(ring.dropped, 60_000))
    assert metadata_of(path)[MARK_RECORD]["dropped"] == str(ring.dropped)


def test_a_message_larger_than_the_bound_is_kept_alone(tmp_path):
    ring = defined(RingSink(tmp_path / "run.mcap", SECOND, max_bytes=1000))
    put(ring, (0, b"x"), (0, b"x" * 5000))
    assert (ring.messages, ring.dropped) == (1, 1)
    ring.close(())


def test_an_empty_ring_makes_an_empty_session(ring):
    assert read(marked(ring)) == []
    (mark,) = ring.marks
    assert (mark.messages, mark.start_ns, mark.stop_ns, mark.error) == (0, None, None, None)
    with pytest.raises(LogWriteError, match="closed"):
        ring.mark()


def test_a_log_time_that_goes_back_empties_nothing(ring):
    put(ring, (0, b"a"), (-10 * SECOND, b"b"), (1, b"c"))
    assert sorted(m[4] for m in read(marked(ring))) == [b"a", b"b", b"c"]


def test_a_process_that_ends_without_a_close_still_writes_its_mark(tmp_path):
    """An error that nobody caught must not cost the mark, nor hang the process."""
    code = (
        "from pathlib import Path\n"
        "from mcap.records import Channel\n"
        "from undulog.capture.log.write.ring_sink import RingSink\n"
        f"ring = RingSink(Path({str(tmp_path)!r}) / 'run.mcap', 10**9)\n"
        "ring.define(Channel(1, '/a', 'cdr', {}, 0))\n"
        "for k in range(50_000):\n"
        "    ring.write(1, 10**18, 10**18, k, b'x')\n"
        "ring.mark()\n"
        "raise SystemExit('gone wrong')\n"
    )
    assert "gone wrong" in python(code, timeout=PATIENCE_S).stderr
    assert len(read(tmp_path / "run_mark0001.mcap")) == 50_000


def test_definitions_of_every_kind_come_back(ring):
    ring.define(Metadata("undulog", {"session_id": "s"}))
    ring.define(Attachment(1, 2, "robot.toml", "application/toml", b"data"))
    path = marked(ring)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        channels = reader.get_summary().channels
        (attachment,) = reader.iter_attachments()
    assert [channel.topic for channel in channels.values()] == TOPICS
    assert channels[1].metadata == {"unit": "rad"}
    assert (attachment.name, attachment.data) == ("robot.toml", b"data")
    assert metadata_of(path)["undulog"] == {"session_id": "s"}


def test_a_recording_kept_in_a_ring_reports_its_marks(tmp_path):
    folder = tmp_path / "out"
    with pytest.raises(LogWriteError, match="doesn't exist"):
        RingStorage(folder / "run.mcap", 1.5)
    folder.mkdir()
    storage = RingStorage(folder / "run.mcap", 1.5)
    ring = defined(storage.sink)
    for k in range(4):
        ring.write(1, EPOCH_NS + k * SECOND, EPOCH_NS, k, b"x")
    path = folder / "run_mark0001.mcap"
    assert storage.mark("slipped") == {"file": str(path), "messages": 2, "seconds": 1.0}
    wait_for(lambda: not ring.waiting, "the marks")
    ((level, text),) = storage.tick()
    assert storage.size == path.stat().st_size
    assert level == "info"
    assert "run_mark0001.mcap is written: 2 messages" in text
    shutil.rmtree(folder)
    storage.mark("")
    wait_for(lambda: not ring.waiting, "the marks")
    (level, text), gone = storage.tick()
    assert gone == ("error", f"the folder {folder} is gone: no mark can be written")
    assert level == "error"
    assert "run_mark0002.mcap" in text
    assert storage.files() == (path,)
    assert (storage.messages, storage.unsynced) == (4, 2)
    ring.close(())


# -- a recorder that is killed while it writes a mark ----------------------------------------------

KILLED = """
import os, signal, sys
from pathlib import Path
from undulog.capture.log.write import ring_sink
from undulog.capture.log.write.mcap_sink import McapSink
from undulog.capture.log.write.writer import SessionWriter

class Dying(McapSink):
    left = int(sys.argv[2])

    def write(self, *message):
        super().write(*message)
        Dying.left -= 1
        if not Dying.left:
            self._stream.flush()
            os.kill(os.getpid(), signal.SIGKILL)

path = Path(sys.argv[1])
ring = ring_sink.RingSink(path, 10**12, open_file=Dying)
writer = SessionWriter(path, session_id="s", epoch_ns=1, sink=ring)
texts = writer.string("/text")
for k in range(4000):
    texts.write(10**9 + k, f"{k} " + os.urandom(400).hex())
ring.mark()
ring.close(())
"""


def test_a_mark_that_a_kill_interrupts_has_no_final_name_and_is_recovered(tmp_path, command):
    died = python(KILLED, tmp_path / "run.mcap", 3500)
    assert died.returncode == -9, died
    name = "run_mark0001.mcap.part"
    assert [path.name for path in tmp_path.iterdir()] == [name]
    for place in (tmp_path, tmp_path / "run_mark0001.mcap", tmp_path / name):
        assert f"{name} has not got its final name" in command("log", "info", place).out
    ring = command("log", "info", tmp_path / "run.mcap", code=1).err
    assert f"is the name of a ring, which has only marks; name one: {name}" in ring
    shutil.copy(tmp_path / name, tmp_path / "other_mark0001.mcap.part")
    table = command("log", "info", tmp_path).out
    for part in (name, "other_mark0001.mcap.part"):
        assert f"{part} has not got its final name" in table
    command("log", "recover", tmp_path / "run_mark0001.mcap")
    messages = messages_of(tmp_path / "run_mark0001.recovered.mcap")
    assert [message.sequence for *_, message in messages] == list(range(len(messages)))
    assert 1000 < len(messages) <= 3500  # the chunks that were whole
    ring = RingSink(tmp_path / "run.mcap", SECOND)  # numbers go on after it
    assert marked(ring).name == "run_mark0002.mcap"
