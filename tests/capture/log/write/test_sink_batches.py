"""Batches through the recorder's sink: as single messages, in good and in bad times."""

import contextlib
import os
import random
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.records import Channel, Metadata

from support import durable_child as recorder
from support.read_back import messages_of, read
from undulog.capture.common.errors import LogWriteError
from undulog.capture.log.write import durable_sink
from undulog.capture.log.write.durable_sink import DurableSink


@pytest.fixture
def now(monkeypatch):
    """The time of the sinks, in a list that the test changes [s]."""
    now = [100.0]
    monkeypatch.setattr(durable_sink, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.fixture
def sink_of(tmp_path, now):
    """Opens sinks in folders of their own; closed at the end, in good order or not."""
    made = []

    def make(**options):
        folder = tmp_path / str(len(made))
        folder.mkdir()
        given = {"sync_interval_s": 3600.0, "ballast": 0} | options
        made.append(recorder.open_sink(folder / "run.mcap", **given))
        return made[-1]

    yield make
    for sink in made:
        with contextlib.suppress(LogWriteError):
            sink.close(())


def batch_of(*messages):
    times = np.array([log_ns for _, log_ns, *_ in messages], np.int64)
    return SimpleNamespace(log_ns=times, messages=list(messages))


def states_of(sinks):
    return [(sink.messages, sink.part, sink._part.size) for sink in sinks]


@pytest.mark.parametrize(
    "options",
    [{}, {"split_ns": 800}, {"split_size": 1 << 16}, {"segment_size": 1 << 13},
     {"split_ns": 900, "split_size": 1 << 15, "flush_interval_s": 4.0}],
)  # fmt: skip
def test_a_batch_is_as_its_messages_one_by_one(sink_of, now, options):
    """At each moment: messages, part and its bytes; and in the files."""
    single, many = sinks = sink_of(**options), sink_of(**options)
    rng, log_ns = random.Random(1), 1000
    for number in range(48):
        messages = []
        for k in range(rng.choice([0, 1, 1, 2, 5, 20])):
            log_ns += rng.choice([0, 1, 7, 30])
            messages.append((1 + k % 2, log_ns, log_ns - 3, number, rng.randbytes(900)))
        for message in messages:
            single.write(*message)
        many.write_batch(batch_of(*messages))
        first, second = states_of(sinks)
        assert first == second
        if number % 6 == 5:
            now[0] += rng.choice([1.0, 2.0, 5.0])
            for writer in sinks:
                writer.tick()
    names = []
    for sink in sinks:
        sink.close((Metadata("end", {}),))
        names.append([path.name for path in sink.files()])
    assert names[0] == names[1]
    assert (len(names[0]) > 1) == bool(options.keys() & {"split_ns", "split_size"})
    for first, second in zip(single.files(), many.files(), strict=True):
        rows, others = ([m.data for *_, m in messages_of(path)] for path in (first, second))
        assert rows == others


def test_an_empty_batch_is_nothing(sink_of):
    sink = sink_of()
    size = sink.size
    sink.write_batch(batch_of())
    assert (sink.messages, sink.size) == (0, size)


# -- refused ---------------------------------------------------------------------------------------


BATCH = batch_of((1, 5, 5, 0, b"ab"), (1, 6, 6, 1, b"cd"))


def test_a_closed_session_takes_no_batch(sink_of):
    sink = sink_of()
    sink.close(())
    for batch in (BATCH, batch_of((1, 5, 5, 0, b"ab"))):
        with pytest.raises(LogWriteError, match="the session is closed"):
            sink.write_batch(batch)
    assert sink.messages == 0


def test_after_a_refused_message_no_batch_is_taken(sink_of, monkeypatch):
    sink = sink_of(last_words=100)

    def full(*_):
        raise LogWriteError(sink.path, "no room")

    for name in ("append", "append_all"):
        monkeypatch.setattr(sink._wal, name, full)
    with pytest.raises(LogWriteError, match="no room"):
        sink.write(1, 4, 4, 0, b"x")
    monkeypatch.undo()
    with pytest.raises(LogWriteError, match="no room"):
        sink.write_batch(BATCH)
    assert (sink.messages, sink._wal.position) == (0, 0)


def test_of_a_batch_the_last_words_are_taken_one_by_one(sink_of):
    sink = sink_of(last_words=3)
    sink._disk._shortage = LogWriteError(sink.path, "the disk is full")
    with pytest.raises(LogWriteError, match="the disk is full"):
        sink.write_batch(BATCH)
    assert sink.messages == 1
    assert "full" in str(sink.shortage)
    sink._disk._shortage = None
    sink.close(())
    assert len(read(sink.path)[0]) == 1


@pytest.mark.parametrize("last_words", [0, 5])
def test_last_words_are_counted_in_bytes_of_messages(sink_of, last_words):
    sink = sink_of(last_words=last_words)
    sink._disk._shortage = LogWriteError(sink.path, "the disk is full")
    taken = 0
    for size in (0, 6, 2, 4, 3, 1, 0):
        with contextlib.suppress(LogWriteError):
            sink.write(1, 1, 1, 0, bytes(size))
            taken += 1
    assert sink.messages == taken == (2 if last_words == 0 else 4)
    sink._disk._shortage = None


# -- definitions and parts -------------------------------------------------------------------------


def test_definitions_of_each_part_are_all_so_far_and_count_as_bytes(sink_of):
    sink = sink_of()
    for number in range(3):
        size = sink.size
        sink.define(Channel(4 + number, f"/late{number}", "cdr", {}, 1))
        sink.write(4 + number, number, number, 0, b"x")
        assert (sink.split().name, sink.part) == (f"run_000{number + 2}.mcap", number + 2)
        assert sink.size > size
    with pytest.raises(LogWriteError, match="another recorder is writing"):
        DurableSink(sink.path, force=True)
    sink.close(())
    for path, count in zip(sink.files(), (1, 1, 1, 0), strict=True):
        assert len(messages_of(path)) == count
    assert sink.size == sum(path.stat().st_size for path in sink.files())


def test_a_session_that_is_closed_has_no_log_and_one_that_could_not_has(sink_of, monkeypatch):
    sink = sink_of()
    sink.write(1, 1, 1, 0, b"x")
    sink.close(())
    assert os.listdir(sink.path.parent) == ["run.mcap"]  # noqa: PTH208 - names alone
    other = sink_of()
    other.write(1, 1, 1, 0, b"x")
    real = other._wal.define

    def full(record):
        if record.name == "end":
            raise LogWriteError(other.path, "no room for the end")
        real(record)

    monkeypatch.setattr(other._wal, "define", full)
    other.close((Metadata("end", {"a": "1"}),))  # the file has it
    assert os.listdir(other.path.parent) == ["run.mcap"]  # noqa: PTH208
