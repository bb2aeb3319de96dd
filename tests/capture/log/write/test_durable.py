"""The recorder's sink: nothing accepted is lost, whatever the disk does."""

import itertools
import os
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from support import durable_child as recorder
from support.processes import python, wait_for
from support.read_back import messages_of, metadata_of, opcodes_so_far, read
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import DataError, LogWriteError, OutputExistsError
from undulog.capture.common.part_files import unfinished_path
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.mcap.batch import MessageBatch
from undulog.capture.log.mcap.chunk import BODY_AT
from undulog.capture.log.messages.definitions import ERROR, OK, DiagnosticStatus, schema_text
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.recorder.recording import TappedSink

EPOCH_NS = recorder.EPOCH_NS


def batch_of(channel_id, log_ns, publish_ns, sequence, payloads):
    """Messages of one size as a batch."""
    records = [np.frombuffer(bytes(BODY_AT) + payload, np.uint8) for payload in payloads]
    times = np.array(log_ns), np.array(publish_ns)
    return MessageBatch(channel_id, *times, sequence, np.array(records))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def record_some(path, sink):
    """A session of several kinds of channels, one of them opened late."""
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, sink=sink) as writer:
        writer.attach("scenario.toml", "application/toml", b"x = 1\n")
        states = writer.joint_state("/joint_states", ["a", "b"], unit="rad", velocity=True)
        for k in range(3000):
            if k == 1000:
                late = writer.string("/gait/mode")
            states.write(EPOCH_NS + k * 10**7, [k, -k], [0.5 * k, 0.0])
            if k >= 1000 and k % 100 == 0:
                late.write(EPOCH_NS + k * 10**7, f"mode {k}")
        writer.set_verdict("good")
        writer.note_at_end("undulog.clock", {"can0.drift_ppm": "1.5"})


# -- an ordinary recording -----------------------------------------------------------------------


def test_a_session_is_the_same_through_either_sink(tmp_path):
    record_some(tmp_path / "plain.mcap", None)
    record_some(tmp_path / "run.mcap", DurableSink(tmp_path / "run.mcap"))
    assert names(tmp_path) == ["plain.mcap", "run.mcap"]  # nothing else is left
    assert read(tmp_path / "run.mcap") == read(tmp_path / "plain.mcap")
    with Session(tmp_path / "run.mcap") as run, Session(tmp_path / "plain.mcap") as plain:
        assert run.metadata == plain.metadata
        assert run.metadata["undulog.clock"] == {"can0.drift_ppm": "1.5"}
        assert run.attachments == plain.attachments
        assert (run.verdict, run.warnings) == ("good", [])
        assert next(t.data for _, t in run.messages("/gait/mode")) == "mode 1000"
    assert len(messages_of(tmp_path / "run.mcap")) == 3020
    health = check_session(tmp_path / "run.mcap")
    assert health.file.damage == ()
    assert not [reason for reason in health.reasons if "/joint_commands" not in reason]
    assert np.isclose(health.duration_s, 29.99)


def test_listeners_get_what_was_accepted_and_nothing_else(tmp_path):
    offered = []
    listener = SimpleNamespace(
        define=id,
        offer=lambda *message: offered.append(message),
        offer_batch=lambda batch: offered.extend(batch.messages),
    )
    kept = recorder.open_sink(tmp_path / "run.mcap")
    sink = TappedSink(kept, [listener])
    for number in range(100):
        recorder.write(sink, number)
    with pytest.raises(DataError, match="out of range"):
        sink.write(1, -1, 0, 0, b"")
    sink.write_batch(batch_of(1, [1, 2], [3, 4], 2**32 - 1, [b"ab", b"cd"]))
    with pytest.raises(DataError, match="out of range"):
        sink.write_batch(batch_of(1, [-1, 2], [3, 4], 5, [b"ab", b"cd"]))
    sink.close(())
    one_by_one = [(c, t, p, s, data) for c, s, t, p, data in map(recorder.message, range(100))]
    assert offered == [*one_by_one, (1, 1, 3, 2**32 - 1, b"ab"), (1, 2, 4, 0, b"cd")]
    assert (kept.messages, kept.part) == (102, 1)
    assert kept.size == (tmp_path / "run.mcap").stat().st_size


def test_a_quiet_session_reaches_the_file_by_itself(tmp_path):
    path = tmp_path / "run.mcap"
    sink = recorder.open_sink(path, flush_interval_s=0.01)
    recorder.write(sink, 0)
    copy = tmp_path / "copy.mcap"  # without the write-ahead log

    def arrived():
        sink.tick()
        shutil.copy(unfinished_path(path), copy)
        return Opcode.CHUNK in opcodes_so_far(copy)

    wait_for(arrived, "the chunk in the file")
    with Session(copy) as session:
        assert session.channels["/a"].count == 1
    sink.close(())


def test_the_disk_is_waited_for_by_another_thread(tmp_path, monkeypatch):
    threads = set()
    for name in ("fsync", "fdatasync", "write"):
        real = getattr(os, name)

        def noted(*arguments, real=real):
            threads.add(threading.get_ident())
            return real(*arguments)

        monkeypatch.setattr(os, name, noted)
    sink = recorder.open_sink(tmp_path / "run.mcap", split_size=1 << 17)
    for number in range(10_000):
        recorder.write(sink, number)
    assert sink.part > 1
    wait_for(lambda: sink.backlog == 0, "the disk's thread")
    assert threads
    assert threading.get_ident() not in threads
    sink.close(())


# -- what is there already -----------------------------------------------------------------------


def test_nothing_is_overwritten_unless_forced(tmp_path):
    path = tmp_path / "run.mcap"
    recorder.open_sink(path).close(())
    before = path.read_bytes()
    with pytest.raises(OutputExistsError, match=r"run\.mcap exists"):
        DurableSink(path)
    path.rename(tmp_path / "run_0002.mcap")
    with pytest.raises(OutputExistsError, match=r"run_0002\.mcap exists"):
        DurableSink(path)
    assert (tmp_path / "run_0002.mcap").read_bytes() == before
    assert names(tmp_path) == ["run_0002.mcap"]
    sink = recorder.open_sink(path, force=True)
    recorder.write(sink, 0)
    sink.split()
    recorder.write(sink, 1)
    sink.close(())
    assert read(path) == (recorder.truth(2), [])


def test_a_forced_recording_leaves_readers_of_the_old_file_alone(tmp_path):
    path = tmp_path / "run.mcap"
    record_some(path, DurableSink(path))
    with Session(path) as old:
        recorder.open_sink(path, force=True).close(())
        assert len(old.joints("/joint_states").t_ns[0]) >= 0  # a truncated map would be SIGBUS
        assert old.channels["/joint_states"].count == 3000


def test_a_file_has_one_recorder_and_the_log_of_a_dead_one_is_not_overwritten(tmp_path):
    path = tmp_path / "run.mcap"
    sink = recorder.open_sink(path)
    recorder.write(sink, 0)
    with pytest.raises(OutputExistsError):
        DurableSink(path)
    with pytest.raises(LogWriteError, match=r"run\.mcap\.wal: another recorder is writing it"):
        DurableSink(path, force=True)
    shutil.copytree(tmp_path / "run.mcap.wal", tmp_path / "left")
    sink.close(())
    assert read(path) == (recorder.truth(1), [])
    path.unlink()  # as if the recorder had died
    (tmp_path / "left").rename(tmp_path / "run.mcap.wal")
    with pytest.raises(OutputExistsError, match=r"run\.mcap\.wal exists"):
        DurableSink(path)
    assert not path.exists()


@pytest.mark.parametrize("options", [{"split_size": 0}, {"flush_interval_s": 0.0}, {"ballast": -1}])
def test_senseless_options_are_refused(tmp_path, options):
    with pytest.raises(DataError, match="positive"):
        DurableSink(tmp_path / "run.mcap", **options)
    assert names(tmp_path) == []


def test_a_closed_session_takes_nothing(tmp_path):
    sink = recorder.open_sink(tmp_path / "run.mcap")
    sink.close(())
    sink.close(())
    for use in (lambda: recorder.write(sink, 0), sink.split, sink.tick):
        with pytest.raises(LogWriteError, match="closed"):
            use()
    with pytest.raises(LogWriteError, match="closed"):
        sink.define(Channel(4, "/more", "cdr", {}, 1))


# -- the disk ------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(disk_of):
    """A file system of 4 MiB."""
    return disk_of("4m")


# In a child, for the failure to be feared is a SIGBUS.
FILL = """
import sys, time
from pathlib import Path
from undulog.capture.common.errors import LogWriteError

def take_the_rest():  # as somebody else would
    with open(sys.argv[2] + "/hog", "wb", buffering=0) as hog:
        try:
            while hog.write(bytes(512)):
                pass
        except OSError:
            pass

sys.path.insert(0, str(Path(sys.argv[1]).parent))
import durable_child
sink = durable_child.open_sink(
    sys.argv[2] + "/run.mcap",
    segment_size=1 << 16,
    ballast=int(sys.argv[3]),
    split_size=int(sys.argv[4]) or None,
)
number = 0
try:
    while True:
        durable_child.write(sink, number)
        number += 1
        if number == 1000 and sys.argv[5] == "early":
            take_the_rest()
except LogWriteError as error:
    print(number, sink.shortage is not None, error, sep="|")
if sys.argv[5] == "late":
    while sink.backlog and "can't be written" not in str(sink.shortage):
        time.sleep(0.01)
    take_the_rest()
try:
    sink.close(())
    print("finalised")
except LogWriteError as error:
    print(error)
"""


def fill(place, ballast, split_size=0, hog="never"):
    done = python(FILL, recorder.__file__, place, ballast, split_size, hog, code=0)
    report, end = done.stdout.splitlines()
    accepted, foreseen, error = report.split("|")
    assert foreseen == "True"
    assert "bytes are missing" in error or "No space left on device" in error
    return int(accepted), end


@pytest.mark.parametrize(("split_size", "hog"), [(0, "never"), (1 << 19, "never"), (0, "early")])
def test_a_full_disk_ends_in_a_file_with_all_that_was_accepted(small_disk, split_size, hog):
    accepted, end = fill(small_disk, 1 << 20, split_size, hog)
    assert end == "finalised"
    assert accepted > (900 if hog == "early" else 3000)
    assert not (small_disk / "run.mcap.wal").exists()
    assert read(small_disk / "run.mcap") == (recorder.truth(accepted), [])
    if split_size:
        assert (small_disk / "run_0002.mcap").exists()


@pytest.mark.slow
def test_a_disk_too_full_to_finalise_keeps_all_in_the_write_ahead_log(small_disk):
    accepted, end = fill(small_disk, 0, hog="late")
    messages, warnings = read(small_disk / "run.mcap")
    assert messages == recorder.truth(accepted)
    if end != "finalised":  # as it is when the segments went before the disk was filled
        assert f"all {accepted} messages are kept" in end
        assert f"undulog log recover {small_disk / 'run.mcap'}" in end
        assert any("none is missing" in text for text in warnings)


def test_a_disk_full_from_the_start_is_reported_and_left_as_it_was(small_disk):
    with pytest.raises(LogWriteError, match=r"ballast: needs 8388608 bytes .* are missing"):
        DurableSink(small_disk / "run.mcap", segment_size=1 << 16)
    assert names(small_disk) == []


def test_a_failing_disk_ends_the_recording_and_loses_nothing(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    sink = recorder.open_sink(path, sync_interval_s=60.0)
    real = os.write

    def broken(file, data):
        if Path(f"/proc/self/fd/{file}").readlink() == unfinished_path(path):
            raise OSError(5, "Input/output error")
        return real(file, data)

    monkeypatch.setattr(os, "write", broken)
    accepted = []

    def go_on():
        for number in itertools.count():
            recorder.write(sink, number)
            accepted.append(number)

    with pytest.raises(LogWriteError, match=r"run\.mcap: can't be written: Input/output error"):
        go_on()
    with pytest.raises(LogWriteError, match=f"all {len(accepted)} messages are kept"):
        sink.close(())
    monkeypatch.undo()
    assert not (tmp_path / "run.mcap.wal" / "ballast").exists()
    messages, warnings = read(path)
    assert messages == recorder.truth(len(accepted))
    assert any("none is missing" in text for text in warnings)


# -- channels of the recorder's own --------------------------------------------------------------


def test_clocks_and_diagnostics_are_standard_messages(tmp_path):
    statuses = [
        DiagnosticStatus(ERROR, "source can0", "lost 3 frames", "can:x", {"dropped": "3", "ü": ""}),
        DiagnosticStatus(OK, "recorder", "fine"),
    ]
    with SessionWriter(tmp_path / "x.mcap", session_id="s", epoch_ns=EPOCH_NS) as writer:
        clock = writer.time_reference("/clock/can0", source="can0")
        diagnostics = writer.diagnostics()
        for k in range(3):
            clock.write(EPOCH_NS + k, 5_000_000_007 + k, log_time_ns=EPOCH_NS + 10 + k)
            diagnostics.write(EPOCH_NS + k, statuses[: k + 1])
        with pytest.raises(DataError, match="32 bits"):
            clock.write(EPOCH_NS, 1 << 62)
    store = get_typestore(Stores.ROS2_JAZZY)
    messages = [
        (channel.topic, message.log_time, store.deserialize_cdr(message.data, schema.name))
        for schema, channel, message in messages_of(tmp_path / "x.mcap")
    ]
    clocks = [(t, m) for topic, t, m in messages if topic == "/clock/can0"]
    assert [t for t, _ in clocks] == [EPOCH_NS + 10 + k for k in range(3)]
    assert [(m.source, m.time_ref.sec, m.time_ref.nanosec) for _, m in clocks] == [
        ("can0", 5, 7 + k) for k in range(3)
    ]
    assert clocks[1][1].header.stamp.nanosec == EPOCH_NS % 10**9 + 1
    last = [m for topic, _, m in messages if topic == "/diagnostics"][-1]
    assert [
        (s.level, s.name, s.message, s.hardware_id, {v.key: v.value for v in s.values})
        for s in last.status
    ] == [
        (2, "source can0", "lost 3 frames", "can:x", {"dropped": "3", "ü": ""}),
        (0, "recorder", "fine", "", {}),
    ]


@pytest.mark.parametrize(
    "name", ["sensor_msgs/msg/TimeReference", "diagnostic_msgs/msg/DiagnosticArray"]
)
def test_the_schema_texts_are_those_of_ros(name):
    full = get_typestore(Stores.ROS2_JAZZY)
    types = get_types_from_msg(schema_text(name), name)
    assert {key: types[key][1] for key in types} == {key: full.fielddefs[key][1] for key in types}


def test_metadata_given_at_the_end_is_the_last(tmp_path):
    sink = recorder.open_sink(tmp_path / "run.mcap")
    recorder.write(sink, 0)
    sink.close((Metadata("undulog.health", {"verdict": "bad", "reasons": "[]"}),))
    assert list(metadata_of(tmp_path / "run.mcap")) == ["undulog", "undulog.health"]
