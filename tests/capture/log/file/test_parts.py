"""Split sessions: parts that are read as one, and told when one is missing."""

import errno
import hashlib
import os
import shutil
from pathlib import Path

import pytest

from support import durable_child as recorder
from support.processes import wait_for
from support.read_back import messages_of, metadata_of, read, rows_of
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import LogError, LogWriteError, NotALogError, OutputExistsError
from undulog.capture.log.cut import cut_log
from undulog.capture.log.file.parts import later_parts, part_path, split_part_path
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.merge import merge_logs
from undulog.capture.log.write import part_stream
from undulog.capture.log.write.durable_sink import DurableSink

EPOCH_NS = recorder.EPOCH_NS


def split_session(path, count=900, parts=3, **options):
    """A finished session of that many parts, of the same number of messages each."""
    sink = recorder.open_sink(path, **options)
    for number in range(count):
        if number and number % (count // parts) == 0:
            sink.split()
        recorder.write(sink, number)
    sink.close(())
    return path


def part_record(path):
    return metadata_of(path).get("undulog.part", {})


# -- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["run.mcap", "a_b.mcap", "2024_0001.mcap", "x.y.mcap"])
def test_names_of_parts_go_there_and_back(tmp_path, first):
    path = tmp_path / first
    assert part_path(path, 1) == path
    for number in (2, 17, 9999, 12345):
        assert split_part_path(part_path(path, number)) == (path, number)
    for number in (12, 2, 100000):
        part_path(path, number).touch()
    assert later_parts(path) == [part_path(path, number) for number in (2, 12, 100000)]


def test_a_name_without_a_number_is_no_later_part():
    for name in ("run.mcap", "run_2.mcap", "run_0001.mcap", "run_0000.mcap", "_0002.mcap"):
        assert split_part_path(Path(name)) == (Path(name), 1)


# -- writing -------------------------------------------------------------------------------------


def test_each_part_explains_itself_and_names_its_neighbours(tmp_path):
    split_session(tmp_path / "run.mcap")
    names = ["run.mcap", "run_0002.mcap", "run_0003.mcap"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    digests = [hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() for name in names]
    previous = [{}] + [
        {"previous": name, "previous_sha256": digest}
        for name, digest in zip(names, digests, strict=True)
    ]
    assert [part_record(tmp_path / name) for name in names] == [
        {"part": "1", "next": "run_0002.mcap"},
        {"part": "2", "next": "run_0003.mcap", **previous[1]},
        {"part": "3", "parts": "3", **previous[2]},
    ]
    assert [metadata_of(tmp_path / n)["undulog"]["session_id"] for n in names] == ["killed"] * 3
    for part, name in enumerate(names):  # by a foreign reader, one file at a time
        assert rows_of(tmp_path / name) == recorder.truth(900)[300 * part : 300 * (part + 1)]


def test_parts_by_size(tmp_path):
    sink = recorder.record(tmp_path / "run.mcap", range(8000), split_size=200_000)
    sizes = [path.stat().st_size for path in sorted(tmp_path.iterdir())]
    assert len(sizes) == sink.part > 2
    assert all(200_000 <= size < 200_000 + 600_000 for size in sizes[:-1])  # and one chunk
    assert sum(sizes) == sink.size
    assert read(tmp_path) == (recorder.truth(8000), [])


def test_parts_by_time_hold_equal_times(tmp_path):
    numbers = [*range(1000), *range(1600, 2000)]  # a message a ms, and a pause longer than a part
    recorder.record(tmp_path / "run.mcap", numbers, split_ns=250_000_000)
    spans = []
    for path in [tmp_path / "run.mcap", *later_parts(tmp_path / "run.mcap")]:
        times = [m.log_time - EPOCH_NS for _, _, m in messages_of(path)]
        spans.append((min(times) // 10**6, max(times) // 10**6))
    assert spans == [(0, 249), (250, 499), (500, 749), (750, 999), (1600, 1749), (1750, 1999)]


def test_an_empty_part_is_not_split_again(tmp_path):
    sink = recorder.open_sink(tmp_path / "run.mcap")
    assert sink.split() == tmp_path / "run.mcap"
    recorder.write(sink, 0)
    assert sink.split() == tmp_path / "run_0002.mcap"
    assert sink.split() == tmp_path / "run_0002.mcap"
    sink.close(())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run_0002.mcap"]
    assert read(tmp_path) == (recorder.truth(1), [])


def test_channels_opened_late_have_the_same_number_in_all_parts(tmp_path):
    path = tmp_path / "run.mcap"
    sink = DurableSink(path)
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, sink=sink) as writer:
        writer.attach("scenario.toml", "application/toml", b"x = 1\n")
        early = writer.string("/early")
        early.write(EPOCH_NS, "0")
        sink.split()
        early.write(EPOCH_NS + 1, "1")
        late = writer.joint_state("/late", ["a"], unit="V")
        late.write(EPOCH_NS + 2, [1.5])
        sink.split()
        late.write(EPOCH_NS + 3, [2.5])
        early.write(EPOCH_NS + 4, "2")
        writer.set_verdict("degraded", ["because"])
    with Session(path) as session:
        assert [m.data for _, m in session.messages("/early")] == ["0", "1", "2"]
        assert session.table("/late")["position[0]"].tolist() == [1.5, 2.5]
        assert session.verdict == "degraded"
        assert session.attachments == {"scenario.toml": b"x = 1\n"}
        assert session.warnings == []
    health = check_session(path)
    assert health.file.damage == ()
    assert all(channel.sequence.dropped in (0, None) for channel in health.channels)


def test_a_next_part_that_is_there_already_costs_no_message(tmp_path):
    path = tmp_path / "run.mcap"
    sink = recorder.open_sink(path, split_ns=100_000_000)
    (tmp_path / "run_0002.mcap").write_bytes(b"somebody else's")
    for number in range(250):
        recorder.write(sink, number)
    assert isinstance(sink.split_trouble, OutputExistsError)
    assert sink.part == 1
    with pytest.raises(OutputExistsError):
        sink.split()
    (tmp_path / "run_0002.mcap").unlink()
    for number in range(250, 500):
        recorder.write(sink, number)
    assert sink.split_trouble is None
    sink.close(())
    assert read(path) == (recorder.truth(500), [])


@pytest.mark.parametrize("harm", ["file", "folder", "after"])
def test_what_somebody_deletes_is_written_to_a_rescue_file(harm, tmp_path):
    place = tmp_path / "gone"
    place.mkdir()
    sink = recorder.open_sink(place / "run.mcap", flush_interval_s=0.01)
    for number in range(500):
        recorder.write(sink, number)
    if harm == "after":
        wait_for(lambda: not sink.backlog, "the disk's thread", meanwhile=sink.tick)
    (place / "run.mcap.part").unlink() if harm == "file" else shutil.rmtree(place)
    for number in range(500, 1000):
        recorder.write(sink, number)
    # Which of the two the recorder misses first is a matter of its threads.
    missed = {f"{place / 'run.mcap'}: ", f"{place / 'run.mcap.wal'}: "}
    assert any(sink.must_end.startswith(name) for name in missed)
    assert "was deleted while it was being written" in sink.must_end
    sink.close(())
    (rescue,) = sink.rescued
    assert sink.files() == (rescue,)
    assert rescue.parent == (place if harm == "file" else tmp_path)
    assert read(rescue) == (recorder.truth(1000), [])
    assert rows_of(rescue) == recorder.truth(1000)


def test_a_read_only_disk_is_left_for_a_rescue_file(tmp_path, monkeypatch):
    sink = recorder.open_sink(tmp_path / "run.mcap", flush_interval_s=0.01)
    real, part = os.write, tmp_path / "run.mcap.part"

    def read_only(file, data):
        if Path(f"/proc/self/fd/{file}").readlink() == part and os.fstat(file).st_size > 10_000:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return real(file, data)

    monkeypatch.setattr(os, "write", read_only)
    for number in range(2000):
        recorder.write(sink, number)
    wait_for(lambda: sink.must_end, "the rescue", meanwhile=sink.tick)
    assert "Read-only file system" in sink.must_end
    sink.close(())
    assert rows_of(sink.rescued[0]) == recorder.truth(2000)


def test_without_room_for_a_rescue_file_that_is_reported(tmp_path, monkeypatch):
    place = tmp_path / "gone"
    place.mkdir()
    sink = recorder.open_sink(place / "run.mcap")
    recorder.write(sink, 0)
    monkeypatch.setattr(part_stream, "free_bytes", lambda _: 1000)
    shutil.rmtree(place)
    with pytest.raises(LogWriteError) as caught:
        sink.close(())
    for text in (
        "was deleted",
        "no rescue file of",
        f"{tmp_path} has 1000 bytes",
        "nothing is left",
    ):
        assert text in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == []


def test_a_moved_folder_gets_the_whole_session(tmp_path):
    place, moved = tmp_path / "place", tmp_path / "moved"
    place.mkdir()
    sink = recorder.open_sink(place / "run.mcap")
    for number in range(500):
        recorder.write(sink, number)
    place.rename(moved)
    place.mkdir()
    other = recorder.open_sink(place / "run.mcap")  # its files have the same names
    recorder.write(other, 0)
    recorder.write(sink, 500)
    assert str(moved) in sink.must_end
    sink.close(())
    assert (sink.files(), sink.rescued) == ((moved / "run.mcap",), ())
    assert read(moved / "run.mcap") == (recorder.truth(501), [])
    assert [path.name for path in moved.iterdir()] == ["run.mcap"]
    other.close(())
    assert read(place / "run.mcap") == (recorder.truth(1), [])
    assert [path.name for path in place.iterdir()] == ["run.mcap"]


def test_a_name_that_is_taken_meanwhile_leaves_both_files_whole(tmp_path):
    sink = recorder.open_sink(tmp_path / "run.mcap")
    recorder.write(sink, 0)
    (tmp_path / "run.mcap").write_text("another's")
    with pytest.raises(LogWriteError, match=r"the recording is in .*run\.mcap\.part, whole"):
        sink.close(())
    assert (tmp_path / "run.mcap").read_text() == "another's"
    assert rows_of(tmp_path / "run.mcap.part") == recorder.truth(1)


# -- reading -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_naming_any_part_or_the_folder_opens_the_whole(tmp_path, command):
    split_session(tmp_path / "run.mcap")
    for name in ("run.mcap", "run_0002.mcap", "run_0003.mcap", "."):
        assert read(tmp_path / name) == (recorder.truth(900), [])
        with Session(tmp_path / name) as session:
            assert session.channels["/rare"].count == 18
            assert len(session.table("/a")) == 450
            start_ns, stop_ns = (EPOCH_NS + ms * 10**6 for ms in (299, 302))
            assert len(session.table("/b", start_ns=start_ns, stop_ns=stop_ns)) == 1
            assert session.duration_s == pytest.approx(0.899)
        assert "900 messages" in command("log", "info", tmp_path / name).out
        file = check_session(tmp_path / name).file
        assert (file.damage, file.indexed, file.chunks, file.checked) == ((), True, 3, 3)


def test_a_folder_with_other_sessions_is_refused_and_part_names_are_not_enough(tmp_path):
    split_session(tmp_path / "run.mcap")
    (tmp_path / "x").mkdir()
    with pytest.raises(NotALogError, match="no session"):
        Session(tmp_path / "x")
    assert part_record(split_session(tmp_path / "other.mcap", parts=1)) == {}
    with pytest.raises(LogError, match=r"2 sessions .* name one: other\.mcap, run\.mcap"):
        Session(tmp_path)
    # A file that only looks like a part is a session of its own.
    (tmp_path / "other.mcap").rename(tmp_path / "alone_0002.mcap")
    assert read(tmp_path / "alone_0002.mcap") == (recorder.truth(900), [])


@pytest.mark.parametrize(
    ("gone", "warning"),
    [
        (1, r"part 1 (run.mcap) is missing"),
        (2, r"part 2 (run_0002.mcap) is missing"),
        (3, r"part 3 (run_0003.mcap) is missing; whether more followed it is unknown"),
    ],
)
def test_a_missing_part_is_reported(tmp_path, gone, warning):
    path = split_session(tmp_path / "run.mcap")
    part_path(path, gone).unlink()
    truth = recorder.truth(900)
    del truth[300 * (gone - 1) : 300 * gone]
    for number in {1, 2, 3} - {gone}:
        assert read(part_path(path, number)) == (truth, [warning])
    assert read(tmp_path) == (truth, [warning])
    with Session(tmp_path) as session:
        assert session.warnings == [warning]
    health = check_session(tmp_path)
    assert health.verdict == "bad"
    assert warning in health.reasons


def test_an_exchanged_part_is_found_and_one_of_another_session_is_left_out(tmp_path):
    path = split_session(tmp_path / "run.mcap")
    split_session(tmp_path / "x.mcap", count=1200)
    (tmp_path / "x_0002.mcap").replace(tmp_path / "run_0002.mcap")
    health = check_session(path)
    assert health.verdict == "bad"
    fault = "is not the file that run_0003.mcap was recorded after: its hash is another"
    assert f"run_0002.mcap {fault}" in health.reasons
    for part in ("x.mcap", "x_0003.mcap"):
        (tmp_path / part).unlink()
    other = tmp_path / "x.mcap"
    sink = DurableSink(other)
    with SessionWriter(other, session_id="other", epoch_ns=EPOCH_NS, sink=sink) as writer:
        channel = writer.string("/a")
        channel.write(EPOCH_NS, "0")
        sink.split()
        channel.write(EPOCH_NS, "1")
    (tmp_path / "x_0002.mcap").replace(tmp_path / "run_0002.mcap")
    messages, warnings = read(tmp_path / "run.mcap")
    assert messages == recorder.truth(900)[:300] + recorder.truth(900)[600:]
    assert warnings == ["run_0002.mcap is of another session: left out"]


def test_edits_take_all_parts_and_damage_names_its_part(tmp_path):
    path = split_session(tmp_path / "run.mcap")
    cut_log(tmp_path / "run_0003.mcap", tmp_path / "cut.mcap", start_s=0.25, stop_s=0.65)
    assert read(tmp_path / "cut.mcap") == (recorder.truth(900)[250:650], [])
    assert part_record(tmp_path / "cut.mcap") == {}
    merge_logs([path, tmp_path / "cut.mcap"], tmp_path / "merged.mcap")
    assert len(read(tmp_path / "merged.mcap")[0]) == 1300
    second = tmp_path / "run_0002.mcap"
    raw = bytearray(second.read_bytes())
    raw[len(raw) // 2] ^= 1
    second.write_bytes(raw)
    health = check_session(path)
    assert any(text.startswith("run_0002.mcap: the chunk at byte") for text in health.file.damage)
    messages, warnings = read(path)
    assert len(messages) == 600
    assert any("run_0002.mcap" in text for text in warnings)
