"""Reading with several threads: the same as with one, in order, bounded, and nothing left."""

import json
import sys
import threading
from contextlib import ExitStack

import numpy as np
import pytest
from mcap.writer import CompressionType

from support.foreign_logs import rewrite
from support.processes import once, python
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import WorkPiece, helpers
from undulog.capture.log.columns import blocks as arenas
from undulog.capture.log.columns.blocks import ahead
from undulog.capture.log.file.log_file import LogFile
from undulog.capture.log.write.durable_sink import DurableSink

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
NAMES = [f"joint{k:02d}" for k in range(1, 26)]
FIELDS = ["position", "velocity", "effort"]
TOPICS = ["/joint_states", "/joint_current"]
MIB = 1 << 20


def values_of(ticks):
    return np.random.default_rng(11).normal(size=(ticks, 25))


def write_session(path, ticks, sink=None):
    """Joints and the frames of a bus; the writer is left open where it has a sink."""
    writer = SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, sink=sink)
    options = {"unit": "1", "velocity": True, "effort": True}
    channels = [writer.joint_state(topic, NAMES, **options) for topic in TOPICS]
    note = writer.string("/gait/mode")
    for tick, values in enumerate(values_of(ticks)):
        t_ns = EPOCH_NS + tick * STEP_NS
        for channel in channels:
            channel.write(t_ns, values, -values, 2 * values)
        note.write(EPOCH_NS, f"{tick:06d}")
    if sink is None:
        writer.close()
    return writer


@pytest.fixture
def small_arenas(monkeypatch):
    """Buffers of a few chunks, so that a small file needs many of them."""
    monkeypatch.setattr(arenas, "ARENA_SIZE", 3 * MIB)


def helpers_alive():
    return [thread for thread in threading.enumerate() if thread.name.startswith("undulog-helper")]


def signals(path, threads, **window):
    """All signals, and what is warned of."""
    with Session(path, threads=threads) as session:
        columns = session.joint_columns(dict.fromkeys(TOPICS, FIELDS), **window)
        warnings = session.warnings
    assert not helpers_alive()
    return columns, warnings


def read(path, threads, **window):
    """All signals as one array of times and one of values, and what is warned of."""
    columns, warnings = signals(path, threads, **window)
    times = np.array([signals.t_ns for signals in columns.values()])
    return times, np.array([signals.values for signals in columns.values()]), warnings


def truth(ticks):
    """What :func:`read` should give."""
    values = values_of(ticks).T
    t_ns = EPOCH_NS + np.arange(ticks) * STEP_NS
    return np.broadcast_to(t_ns, (6, 25, ticks)), np.array([values, -values, 2 * values] * 2)


def check(path, threads, ticks, part=slice(None)):
    """All that was written is read, or the ticks of a part."""
    window = {}
    if part.start is not None:
        limits = (EPOCH_NS + tick * STEP_NS for tick in (part.start, part.stop))
        window = dict(zip(("start_ns", "stop_ns"), limits, strict=True))
    times, values, warnings = read(path, threads, **window)
    expected = truth(ticks)
    np.testing.assert_array_equal(times, expected[0][:, :, part])
    np.testing.assert_array_equal(values, expected[1][:, :, part])
    return warnings


@pytest.mark.parametrize("threads", [1, 2, 4, None])
@pytest.mark.usefixtures("small_arenas")
def test_what_is_read_is_what_was_written_with_any_number_of_threads(tmp_path, threads):
    write_session(tmp_path / "s.mcap", 10_000)
    assert not check(tmp_path / "s.mcap", threads, 10_000)
    check(tmp_path / "s.mcap", threads, 10_000, slice(4321, 7321))
    with pytest.raises(UsageError, match="threads=0: give 1 or more"):
        Session.open(tmp_path / "s.mcap", threads=0)


@pytest.mark.usefixtures("small_arenas")
def test_damaged_chunks_cost_their_own_messages_with_any_number_of_threads(tmp_path):
    path = tmp_path / "s.mcap"
    write_session(path, 10_000)
    log_file = LogFile(path)
    ids = [key for key, channel in log_file.channels.items() if channel.topic in TOPICS]
    blocks = [block for block in log_file.blocks if not block.index_at.keys().isdisjoint(ids)]
    data = bytearray(path.read_bytes())
    log_file.close()
    assert len(blocks) > 12
    harmed = [blocks[k] for k in (0, 5, 6, -1)]
    for block in harmed:
        data[(block.start + block.stop) // 2] ^= 0x55
    path.write_bytes(data)
    columns, warnings = signals(path, 1)
    texts = [f"the chunk at byte {block.start} can't be decompressed" for block in harmed]
    assert all(any(text in warning for warning in warnings) for text in texts)
    assert ["; its messages are missing" in text for text in warnings] == [True] * len(harmed)
    expected = dict(zip(columns, truth(10_000)[1], strict=True))
    for key, series in columns.items():
        ticks = (series.t_ns[0] - EPOCH_NS) // STEP_NS
        assert 5000 < len(ticks) < 10_000
        np.testing.assert_array_equal(np.array(series.values), expected[key][:, ticks])
    for threads in (2, 4):
        again, complaints = signals(path, threads)
        assert complaints == warnings
        for key, series in columns.items():
            np.testing.assert_array_equal(np.array(again[key].t_ns), np.array(series.t_ns))
            np.testing.assert_array_equal(np.array(again[key].values), np.array(series.values))


@pytest.mark.parametrize("threads", [1, 4])
@pytest.mark.parametrize("kind", [CompressionType.LZ4, CompressionType.NONE])
def test_chunks_that_are_not_zstd_are_read_as_well(tmp_path, kind, threads):
    write_session(tmp_path / "ours.mcap", 2000)
    options = {"compression": kind, "chunk_size": 1 << 18}
    rewrite(tmp_path / "ours.mcap", tmp_path / "s.mcap", **options)
    check(tmp_path / "s.mcap", threads, 2000)


@pytest.mark.parametrize("threads", [1, 4])
def test_what_only_the_write_ahead_log_has_comes_last(tmp_path, threads):
    path = tmp_path / "s.mcap"
    writer = write_session(path, 1500, DurableSink(path))
    try:
        with Session(path, threads=threads) as session:
            assert any("write-ahead log" in text for text in session.warnings)
            modes = session.table("/gait/mode")  # all have the same stamp: as they lie in the file
        check(path, threads, 1500)
    finally:
        writer.close()
    assert modes["data"].tolist() == [f"{tick:06d}" for tick in range(1500)]


@pytest.mark.usefixtures("small_arenas")
def test_no_thread_outlives_a_reader_that_gives_up(tmp_path):
    write_session(tmp_path / "s.mcap", 10_000)
    log_file = LogFile(tmp_path / "s.mcap")
    batches = arenas.filled_arenas(log_file, list(log_file.channels), log_file.blocks, print, 4)
    next(batches)
    assert helpers_alive()
    batches.close()
    assert not helpers_alive()
    log_file.close()  # nobody looks at the file any more


def test_work_is_begun_so_far_ahead_and_no_further():
    begun = []
    for k, item in enumerate(ahead((begun.append(n) or n for n in range(20)), 3)):
        assert item == k
        assert begun == list(range(min(k + 4, 20)))
    assert list(ahead(iter(()), 3)) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_comes_where_the_result_is_asked_for(threads):
    with helpers(threads) as pool:
        pieces = [WorkPiece(lambda n=n: 12 // n, pool) for n in (1, 0, 3)]
        assert pieces[0].result() == 12
        with pytest.raises(ZeroDivisionError):
            pieces[1].result()
        assert pieces[2].result() == 4
    assert not helpers_alive()


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_each_piece_is_done_once_whoever_does_it(threads):
    done = []
    with helpers(threads) as pool:
        pieces = [WorkPiece(lambda n=n: done.append(n) or n, pool) for n in range(200)]
        for piece in reversed(pieces):
            piece.hurry()
        assert [piece.result() for piece in pieces] == list(range(200))
        assert [piece.result() for piece in pieces] == list(range(200))
    assert sorted(done) == list(range(200))


def test_who_needs_a_result_does_not_wait_for_helpers_that_are_busy():
    gate = threading.Event()
    with helpers(2) as pool:
        WorkPiece(gate.wait, pool)
        assert WorkPiece(threading.get_ident, pool).result() == threading.get_ident()
        gate.set()


def test_what_has_not_begun_is_left_undone_at_the_end():
    done, gate = [], threading.Event()
    with ExitStack() as endings, helpers(3) as pool:
        for n in range(50):
            WorkPiece(lambda n=n: (gate.wait(), done.append(n)), pool)
        waiting = pool._work_queue
        endings.enter_context(once(lambda: waiting.qsize() <= 1, gate.set, "the rest is cancelled"))
    assert len(done) < 50
    assert not helpers_alive()


MEASURE = """
import json, sys
from pathlib import Path
from undulog.capture import Session

def status(key):
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) * 1024

path, threads, wanted = Path(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3])

def read(stop_ns):
    with Session(path, threads=threads) as session:
        return session.joint_columns(wanted, stop_ns=stop_ns)

read(int(sys.argv[4]))  # what is imported late is imported now
Path("/proc/self/clear_refs").write_text("5")  # the high-water mark begins anew
before = status("VmRSS")
found = read(None)
arrays = {a.ctypes.data: a.nbytes for s in found.values() for a in (*s.t_ns, *s.values)}
print(status("VmHWM") - before - sum(arrays.values()) - path.stat().st_size)
"""


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("threads", [pytest.param(1, marks=pytest.mark.nightly), 4])
def test_beyond_the_arrays_and_the_file_a_reader_needs_little(tmp_path, threads):
    path = tmp_path / "s.mcap"
    write_session(path, 150_000)  # some 200 MB of arrays
    selection = json.dumps(dict.fromkeys(TOPICS, FIELDS))
    done = python(MEASURE, path, threads, selection, EPOCH_NS + 10**9)
    assert int(done.stdout) <= 64 * MIB, done.stderr
