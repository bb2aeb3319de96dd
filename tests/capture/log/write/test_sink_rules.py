"""The recorder's sink: when a chunk is written, when a part begins, and its reasons in words."""

import contextlib
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.records import Metadata

from support import durable_child as recorder
from support.processes import wait_for
from support.read_back import metadata_of, read
from undulog.capture.common.errors import DataError, LogWriteError, OutputExistsError
from undulog.capture.log.write import durable_sink
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.log.write.part_stream import FileDeletedError, NameTakenError

NS = 1_000_000_000


@pytest.fixture
def now(monkeypatch):
    """The time of the sink, in a list that the test changes [s]."""
    now = [100.0]
    monkeypatch.setattr(durable_sink, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@contextlib.contextmanager
def closing(path, **options):
    """A sink that is closed at the end, in good order or not."""
    sink = recorder.open_sink(path, sync_interval_s=3600.0, **options)
    try:
        yield sink
    finally:
        with contextlib.suppress(LogWriteError):
            sink.close(())


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# -- chunks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "half_s"), [({}, 5.0), ({"flush_interval_s": 3.0}, 1.5)])
@pytest.mark.parametrize("asked", ["tick", "write"])
def test_a_message_waits_for_its_chunk_between_half_and_all_of_the_interval(
    tmp_path, now, options, half_s, asked
):
    """At the first half the chunks begun before the last look are written: there are none yet."""
    with closing(tmp_path / "run.mcap", **options) as sink:
        numbers = iter(range(100))

        def look():
            recorder.write(sink, next(numbers)) if asked == "write" else sink.tick()
            return sink.size

        begin = sink.size
        recorder.write(sink, next(numbers))
        now[0] += half_s - 0.001
        assert look() == begin
        now[0] += 0.001
        assert look() == begin
        now[0] += half_s - 0.001
        assert look() == begin
        now[0] += 0.001
        written = look()
        assert written > begin
        now[0] += half_s - 0.001
        assert look() == written


def test_messages_of_a_batch_are_flushed_when_due(tmp_path, now):
    with closing(tmp_path / "run.mcap") as sink:
        begin = sink.size
        batch = SimpleNamespace(
            log_ns=np.array([7, 8]), messages=[(1, 7, 7, 0, b"ab"), (1, 8, 8, 1, b"cd")]
        )
        for wait_s, grows in ((5.0, False), (4.999, False), (0.001, True), (4.999, False)):
            now[0] += wait_s
            before = sink.size
            sink.write_batch(batch)
            assert (sink.size > before) is grows
        assert (sink.messages, begin < sink.size) == (8, True)


def test_a_full_chunk_is_written_at_once(tmp_path, now):
    with closing(tmp_path / "run.mcap") as sink:
        begin, size, chunk = sink.size, 1000, 1 << 19
        for number in range(chunk // size + 2):
            if number <= chunk // (size + 64):
                assert sink.size == begin
            sink.write(1, number, number, number, os.urandom(size))
        assert sink.size > begin + chunk - 2 * size


# -- parts -----------------------------------------------------------------------------------------


def test_a_part_begins_with_the_first_message_behind_a_boundary(tmp_path, now):
    """Boundaries are counted from the first message, also over long silences."""
    with closing(tmp_path / "run.mcap", split_ns=10 * NS) as sink:
        parts = []
        for time_s in (7, 16.9, 17, 26.9, 27, 58, 66.9, 67):
            sink.write(1, round(time_s * NS), 0, 0, b"x")
            parts.append(sink.part)
    assert parts == [1, 1, 2, 2, 3, 4, 4, 5]


def test_a_batch_that_passes_a_boundary_is_divided_there(tmp_path, now):
    with closing(tmp_path / "run.mcap", split_ns=10) as sink:
        for times, part in (([1, 5], 1), ([9, 10], 1), ([10, 11, 12], 2)):
            messages = [(1, t, t, 0, b"ab") for t in times]
            sink.write_batch(SimpleNamespace(log_ns=np.array(times), messages=messages))
            assert sink.part == part
    assert len(read(tmp_path / "run.mcap")[0]) == 7


def test_a_part_has_at_least_the_size_that_is_asked_for(tmp_path, now):
    with closing(tmp_path / "run.mcap", split_size=3 << 19) as sink:
        for number in range(2600):
            size, part = sink._part.size, sink.part
            sink.write(1, number, number, number, os.urandom(1000))
            if sink.part > part:
                assert size + (1 << 19) + 10_000 > 3 << 19
                assert size < 3 << 19
        assert sink.part == 2


def test_parts_name_each_other(tmp_path, now):
    path = tmp_path / "run.mcap"
    with closing(path) as sink:
        assert sink.split() == path == sink.part_path  # it has no message yet
        for number in range(3):
            recorder.write(sink, number)
            assert sink.split() == tmp_path / f"run_{number + 2:04d}.mcap" == sink.part_path
        assert sink.split() == sink.part_path
        recorder.write(sink, 3)
        files = sink.files()
    assert [file.name for file in files] == ["run.mcap", *(f"run_000{k}.mcap" for k in (2, 3, 4))]
    records = [metadata_of(file)["undulog.part"] for file in files]
    assert records[0] == {"part": "1", "next": "run_0002.mcap"}
    for k, record in enumerate(records[1:], 2):
        assert len(record.pop("previous_sha256")) == 64
        last = {"parts": "4"} if k == 4 else {"next": f"run_000{k + 1}.mcap"}
        assert record == {"part": str(k), "previous": files[k - 2].name, **last}


@pytest.mark.parametrize("by", ["size", "time"])
def test_a_part_that_can_not_begin_is_reported_once_and_the_former_goes_on(tmp_path, now, by):
    path = tmp_path / "run.mcap"
    options = {"split_ns": 10} if by == "time" else {"split_size": 1}
    with closing(path, **options) as sink:
        (tmp_path / "run_0002.mcap").write_text("precious")
        numbers = iter(range(10_000))

        def pass_boundary():
            if by == "time":
                k = next(numbers)
                sink.write(1, k * 10, 0, 0, b"x")
                return
            for _ in range(600):
                k = next(numbers)
                sink.write(1, k, 0, 0, os.urandom(1000))

        pass_boundary()
        pass_boundary()
        (event,) = sink.tick()
        fault = f"{tmp_path / 'run_0002.mcap'} exists already"
        assert event[0] == "error"
        assert event[1].startswith(f"the next part could not be begun, this one goes on: {fault}")
        assert sink.tick() == []
        pass_boundary()
        assert (sink.tick(), sink.part) == ([], 1)
        assert isinstance(sink.split_trouble, OutputExistsError)
        (tmp_path / "run_0002.mcap").unlink()
        pass_boundary()
        assert (sink.split_trouble, sink.part, sink.tick()) == (None, 2, [])


def test_a_part_that_the_log_can_not_note_is_not_begun(tmp_path, now, monkeypatch):
    with closing(tmp_path / "run.mcap") as sink:
        recorder.write(sink, 0)

        def full(_):
            raise LogWriteError(tmp_path, "full")

        monkeypatch.setattr(sink._wal, "define", full)
        with pytest.raises(LogWriteError, match="full"):
            sink.split()
        monkeypatch.undo()
        assert sink.part == 1
        assert not list(tmp_path.glob("run_0002*"))


def test_the_log_is_released_up_to_what_the_file_has(tmp_path, now):
    """Over the parts: positions are counted from the first one."""
    with closing(tmp_path / "run.mcap") as sink:
        for number in range(40):
            if number == 20:
                sink.split()
            recorder.write(sink, number)
            if number in (9, 29):
                now[0] += 5.0
                sink.tick()
        wait_for(lambda: sink._wal._released == 20, "the end of the first part")
        now[0] += 5.0
        sink.tick()
        wait_for(lambda: sink._wal._released == 40, "all, which are in one chunk")


# -- troubles --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [{"split_size": 0}, {"split_ns": 0}, {"flush_interval_s": 0}, {"ballast": -1},
     {"last_words": -1}],
)  # fmt: skip
def test_senseless_sizes_are_refused_and_the_smallest_is_taken(tmp_path, options):
    with pytest.raises(DataError, match="sizes and times of a recording are positive"):
        DurableSink(tmp_path / "run.mcap", **options)
    least = {key: value + (1 if key != "flush_interval_s" else 1e-3)
             for key, value in options.items()}  # fmt: skip
    DurableSink(tmp_path / "run.mcap", **least).close(())


def test_the_reserve_is_8_mb_and_goes_with_the_end(tmp_path):
    sink = DurableSink(tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap.wal" / "ballast").stat().st_size == 8 << 20
    assert (tmp_path / "run.mcap.wal" / "000001.seg").stat().st_size == 16 << 20
    sink.close(())
    assert names(tmp_path) == ["run.mcap"]


def test_last_words_are_taken_after_the_reserve_was_freed(tmp_path, now):
    with closing(tmp_path / "run.mcap", last_words=10) as sink:
        sink._disk._shortage = LogWriteError(tmp_path / "x", "the disk is full")
        sink.write(1, 1, 1, 0, b"1234567")
        with pytest.raises(LogWriteError) as caught:
            sink.write(1, 2, 2, 1, b"1234")
        assert str(caught.value) == f"{tmp_path / 'x'}: the disk is full"
        sink.write(1, 3, 3, 1, b"123")
        sink.write_batch(SimpleNamespace(log_ns=np.array([4]), messages=[(1, 4, 4, 2, b"")]))
        assert sink.messages == 3
        assert sink.shortage is sink._disk.trouble
        sink._disk._failure = LogWriteError(tmp_path / "x", "the disk fails")
        with pytest.raises(LogWriteError, match="the disk fails"):
            sink.write(1, 5, 5, 3, b"")
        sink._disk._failure = None


def test_after_a_message_was_refused_by_the_log_none_is_accepted(tmp_path, now, monkeypatch):
    with closing(tmp_path / "run.mcap", last_words=1000) as sink:
        recorder.write(sink, 0)
        monkeypatch.setattr(sink._wal, "append", refuse := refusing(tmp_path))
        with pytest.raises(LogWriteError, match="no room"):
            recorder.write(sink, 1)
        assert refuse.calls == [1]
        monkeypatch.undo()
        with pytest.raises(LogWriteError, match="no room"):
            recorder.write(sink, 1)
        assert "no room" in str(sink.shortage)
        sink.close(())
        assert read(tmp_path / "run.mcap") == (recorder.truth(1), [])


def refusing(folder):
    def refuse(*_):
        refuse.calls.append(1)
        raise LogWriteError(folder, "no room")

    refuse.calls = []
    return refuse


def test_what_was_deleted_or_moved_must_end_the_recording(tmp_path, now):
    path = tmp_path / "run.mcap"
    with closing(path) as sink:
        assert (sink.must_end, sink.misplaced, sink.rescued) == ("", "", ())
        moved = (tmp_path / "run.mcap.part").rename(tmp_path / "elsewhere")
        text = f"{path}: was moved to {moved} while it was being written"
        assert sink.misplaced == ""  # as far as it is known without looking
        assert (sink.must_end, sink.misplaced) == (text, text)
        moved.rename(tmp_path / "run.mcap.part")
        assert sink.must_end == text  # it stays so
    with closing(tmp_path / "b.mcap") as sink:
        shutil.rmtree(tmp_path / "b.mcap.wal")
        assert sink.must_end == f"{tmp_path / 'b.mcap.wal'}: was deleted while it was being written"
    closed = recorder.open_sink(tmp_path / "c.mcap")
    closed.close(())
    (tmp_path / "c.mcap").unlink()
    assert closed.must_end == ""


def test_a_deleted_recording_is_rescued_with_all_that_was_accepted(tmp_path, now):
    sink = recorder.open_sink(tmp_path / "run.mcap", sync_interval_s=3600.0)
    recorder.write(sink, 0)
    (tmp_path / "run.mcap.part").unlink()
    assert sink.must_end
    recorder.write(sink, 1)
    sink.close(())
    (path,) = sink.rescued
    assert sink.files() == (path,)
    assert path.name.startswith("run.rescued-")
    assert read(path)[0] == recorder.truth(2)
    assert names(tmp_path) == [path.name]


@pytest.mark.parametrize("left", [False, True])
def test_without_a_rescue_file_the_end_says_what_is_left(tmp_path, now, monkeypatch, left):
    monkeypatch.setattr("undulog.capture.log.write.part_stream.free_bytes", lambda _: 7)
    path = tmp_path / "run.mcap"
    sink = recorder.open_sink(path, sync_interval_s=3600.0)
    recorder.write(sink, 0)
    (tmp_path / "run.mcap.part").unlink()
    if not left:
        shutil.rmtree(tmp_path / "run.mcap.wal")
    with pytest.raises(FileDeletedError) as caught:
        sink.close(())
    first, no_rescue, last = str(caught.value).split("; ", 1)[0], "no rescue file of", "nothing"
    assert first == f"{path}: was deleted while it was being written"
    assert no_rescue in str(caught.value)
    if left:
        last = f"only what {tmp_path / 'run.mcap.wal'} still has"
    assert str(caught.value).endswith(f"; {last} is left")


def test_a_name_that_was_taken_is_said_at_the_end(tmp_path, now):
    sink = recorder.open_sink(tmp_path / "run.mcap", sync_interval_s=3600.0)
    recorder.write(sink, 0)
    (tmp_path / "run.mcap").write_text("precious")
    with pytest.raises(NameTakenError, match="the recording is in"):
        sink.close(())
    assert (tmp_path / "run.mcap").read_text() == "precious"


def test_a_message_that_was_interrupted_is_no_part_of_the_whole(tmp_path, now):
    sink = recorder.open_sink(tmp_path / "run.mcap", sync_interval_s=3600.0)
    recorder.write(sink, 0)
    sink._wal.append(1, 5, 5, 5, b"x")  # and not in the file, as after a Ctrl-C in between
    with pytest.raises(LogWriteError) as caught:
        sink.close((Metadata("end", {}),))
    assert str(caught.value) == (
        f"{tmp_path / 'run.mcap'}: the last message was interrupted; all 2 messages are kept, the "
        f"last of them in {tmp_path / 'run.mcap.wal'}: free some space, then "
        f"'undulog log recover {tmp_path / 'run.mcap'}'"
    )


def test_messages_that_are_not_synced_are_counted(tmp_path, now):
    with closing(tmp_path / "run.mcap") as sink:
        for number in range(5):
            recorder.write(sink, number)
        assert sink.unsynced == 5 - sink._wal.synced
        sink._wal._sync()
        assert sink.unsynced == 0
