"""Sessions whose recorder was killed, or lost its power, or still runs: each message, once."""

import contextlib
import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from support import durable_child as recorder
from support import processes
from support.damage import damaged_bytes
from support.kills import killed_after, last_number
from support.processes import wait_for
from support.read_back import read, rows_of, summary_of
from undulog.capture import Session, SessionWriter
from undulog.capture.common import errors
from undulog.capture.common.part_files import unfinished_path
from undulog.capture.log.cut import cut_log, recover_log, recovered_path
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.merge import merge_logs

pytestmark = pytest.mark.slow


def fingerprint(folder):
    """Every file below a folder and its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def child_command(path, **options):
    """The command of a recorder in a process of its own."""
    usual = {"segment_size": 1 << 16, "ballast": 1 << 16}
    usual |= {"sync_interval_s": 0.05, "flush_interval_s": 0.2}
    return [sys.executable, recorder.__file__, str(path), json.dumps(usual | options)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


def start(path, **options):
    return subprocess.Popen(child_command(path, **options), stdout=subprocess.PIPE)


def unfinished(path, count, **options):
    """A session whose recorder died after so many messages, the disk having what it could."""
    with start(path, count=count, flush_interval_s=60.0, **options) as child:
        reported, _ = child.communicate()
    assert (child.returncode, last_number(reported)) == (-9, count)


def check_killed(path, accepted):
    """Everything that was accepted is read, once, and nothing on the disk is changed by it."""
    before = fingerprint(path.parent)
    messages, warnings = read(path)
    # The child may have been killed between accepting and reporting.
    assert len(messages) in (accepted, accepted + 1)
    assert messages == recorder.truth(len(messages))
    assert fingerprint(path.parent) == before
    return warnings


# -- the kill ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("run", "split_size", "split_every"),
    [(0, None, 0), (1, None, 0), (2, 1 << 18, 0), (3, None, 700)],
)
def test_a_killed_session_reads_as_if_it_had_been_closed(path, run, split_size, split_every):
    least = random.Random(run).randrange(1500, 20_000)
    accepted = killed_after(
        child_command(path, split_size=split_size, split_every=split_every), least
    )
    warnings = check_killed(path, accepted)
    assert "the recorder did not finish" in warnings[0]
    assert "none is missing" in warnings[0]
    assert all("no whole records" in text for text in warnings[1:])  # it was being written
    with Session(path) as session:
        assert session.session_id == "killed"
        total = sum(channel.count for channel in session.channels.values())
        assert total in (accepted, accepted + 1)
        assert sum(len(list(session.messages(topic))) for topic in session.channels) == total


@pytest.mark.parametrize("kills", [10, pytest.param(30, marks=pytest.mark.nightly)])
def test_kills_lose_no_accepted_message(kills, tmp_path):
    rng = random.Random(5)
    with ThreadPoolExecutor(1) as killer:  # kills the next ones while one is checked
        killed = []
        for run in range(kills):
            path = tmp_path / str(run) / "run.mcap"
            path.parent.mkdir()
            options = {"split_size": rng.choice([None, 1 << 17, 1 << 19])}
            options["split_every"] = rng.choice([0, 0, 300])
            command, least = child_command(path, **options), rng.randrange(1, 30_000)
            killed.append((path, killer.submit(killed_after, command, least)))
        for path, accepted in killed:
            warnings = check_killed(path, accepted.result())
            assert any("none is missing" in text for text in warnings)
            output = path.with_name("whole.mcap")
            assert recover_log(path, output).missing == 0
            messages, warnings = read(output)
            assert messages == recorder.truth(len(messages))
            assert warnings == []
            shutil.rmtree(path.parent)


WHOLE = 700_000
"""Somewhat more than the bytes of the file."""


def _kill_at(child, path, size):
    """Kill a process as soon as its file has a size, or has its name."""
    part = unfinished_path(path)
    with contextlib.suppress(FileNotFoundError):
        while not path.exists() and part.stat().st_size < size:
            pass
    child.kill()


@pytest.mark.parametrize("runs", [3, pytest.param(30, marks=pytest.mark.nightly)])
def test_a_kill_while_it_is_finalised_loses_nothing(tmp_path, runs):
    rng = random.Random(8)
    for run in range(runs):
        path = tmp_path / str(run) / "run.mcap"
        path.parent.mkdir()
        splits = [3000] if run % 2 else []
        with start(path, count=6000, splits=splits, close=True) as child:
            reported = b""
            while len(reported) < 6000 * 8:
                reported += os.read(child.stdout.fileno(), 1 << 16)
            _kill_at(child, path, rng.randrange(WHOLE) if run else sys.maxsize)
            child.stdout.read()
        before = fingerprint(path.parent)
        messages, warnings = read(path)
        assert messages == recorder.truth(6000)
        assert fingerprint(path.parent) == before
        if warnings:
            assert any(text in warnings[0] for text in ("none is missing", "is unknown", "whole"))
        with Session(path) as session:  # what was known at the end is in the log before it
            assert run or session.verdict == "good"
        shutil.rmtree(path.parent)


def test_a_recording_that_runs_can_be_read(tmp_path, path):
    sink = recorder.open_sink(path, segment_size=1 << 16)
    for count in range(1, 3001):
        recorder.write(sink, count - 1)
        if count % 500 == 0:
            messages, warnings = read(path)
            assert messages == recorder.truth(count)
            assert len(warnings) == 1
            assert f"this recording is running: its first {count} messages are read" in warnings[0]
    assert check_session(path).file.running
    with pytest.raises(errors.LogError, match="is running; end it first"):
        recover_log(path, tmp_path / "out.mcap")
    sink.close(())
    assert read(path) == (recorder.truth(3000), [])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap"]


@pytest.mark.parametrize("recordings", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_a_recording_can_be_read_at_any_moment(tmp_path, recordings):
    """A reader that comes while the recorder writes and splits in another process."""
    truth = recorder.truth(50_000)
    for number in range(recordings):
        path = tmp_path / str(number) / "run.mcap"
        path.parent.mkdir()
        with start(path, split_size=1 << 17) as child:
            try:
                os.read(child.stdout.fileno(), 8)
                counts = []
                for _ in range(5):
                    messages, _ = read(path)
                    assert messages == truth[: len(messages)]
                    counts.append(len(messages))
                    os.read(child.stdout.fileno(), 1 << 16)  # let it go on
            finally:
                child.kill()
                child.stdout.read()
        assert counts == sorted(counts)


def test_what_the_log_let_go_of_while_it_was_read_is_no_reason_to_read_twice(tmp_path):
    """A reader that had the first segment before those behind it went."""
    sink = recorder.open_sink(tmp_path / "run.mcap", segment_size=1 << 16, sync_interval_s=0.01)
    folder = tmp_path / "run.mcap.wal"
    for number in range(1000):
        recorder.write(sink, number)
    early = {path.name: path.read_bytes() for path in sorted(folder.glob("0*.seg"))[:1]}
    for number in range(1000, 8000):
        recorder.write(sink, number)
    wait_for(lambda: not (folder / next(iter(early))).exists(), "a release", meanwhile=sink.tick)
    copy = tmp_path / "copy"
    (copy / folder.name).mkdir(parents=True)
    for name, data in early.items():
        (copy / folder.name / name).write_bytes(data)
    for left in sorted(folder.iterdir()):  # as a reader comes to them: the log, then the file
        with contextlib.suppress(FileNotFoundError):
            shutil.copy(left, copy / folder.name)
    shutil.copy(tmp_path / "run.mcap.part", copy)
    sink.close(())
    messages, warnings = read(copy / "run.mcap")
    assert messages == recorder.truth(8000)
    assert "none is missing" in warnings[0]


# -- power loss and damage -----------------------------------------------------------------------


@pytest.mark.parametrize("left", ["missing", "empty", "magic"])
def test_a_session_of_which_only_the_write_ahead_log_is_left(tmp_path, path, left):
    unfinished(path, 100)
    part = unfinished_path(path)
    os.truncate(part, 8 if left == "magic" else 0)
    if left == "missing":
        part.unlink()
    messages, warnings = read(path)
    assert messages == recorder.truth(100)
    assert any("100 of them from its write-ahead log; none is missing" in w for w in warnings)
    with Session(path) as session:
        assert session.metadata["undulog"]["session_id"] == "killed"
        assert session.profile == "ros2"
    with Session(tmp_path) as session:  # the folder
        assert session.session_id == "killed"


def test_wherever_the_file_ends_the_write_ahead_log_has_the_rest(path):
    """Power is lost: of the file's last chunks, which were not synced, only some is there."""
    unfinished(path, 4000, segment_size=8 << 20)  # nothing released
    part = unfinished_path(path)
    whole = part.read_bytes()
    assert len(whole) > 300_000
    rng = random.Random(3)
    for size in [0, 7, 8, 50, *(rng.randrange(len(whole)) for _ in range(30)), len(whole)]:
        part.write_bytes(whole[:size])
        messages, warnings = read(path)
        assert sorted(messages, key=lambda m: m[2]) == recorder.truth(4000), size
        assert any("none is missing" in text for text in warnings)


def test_damaged_chunks_come_from_the_write_ahead_log_where_it_still_has_them(path):
    unfinished(path, 8000, segment_size=16 << 20)
    part = unfinished_path(path)
    whole = part.read_bytes()
    rng = random.Random(4)
    for _ in range(20):
        raw = bytearray(whole)
        at = rng.randrange(2000, len(raw) - 5000)
        raw[at : at + 4096] = bytes(4096)  # a page that never reached the disk
        part.write_bytes(raw)
        messages, _ = read(path)
        assert sorted(messages, key=lambda m: m[2]) == recorder.truth(8000)


def test_what_is_in_neither_is_counted(tmp_path, path):
    unfinished(path, 6000)
    segments = sorted((tmp_path / "run.mcap.wal").glob("0*.seg"))
    assert len(segments) > 3
    segments[1].unlink()
    os.truncate(unfinished_path(path), 0)  # or it may have them by now: that is the disk's affair
    messages, warnings = read(path)
    lost = 6000 - len(messages)
    assert lost > 0
    kept = {m[2] for m in messages}
    assert messages == [m for m in recorder.truth(6000) if m[2] in kept]
    assert any(f"{lost} of 6000 are missing" in text for text in warnings)
    health = check_session(path)
    assert health.verdict == "bad"
    assert f"{lost} of 6000 messages that the recorder accepted are missing" in health.reasons


def test_a_complete_session_is_degraded_at_most_and_a_cut_file_without_its_log(tmp_path, path):
    unfinished(path, 6000)
    health = check_session(path)
    assert (health.file.truncated, health.file.damage) == (True, ())
    start = "the recorder did not finish: 6000 messages are read"
    assert any(text.startswith(start) for text in health.reasons)
    assert not any("cut short" in text for text in (*health.reasons, *health.notes))
    shutil.rmtree(tmp_path / "run.mcap.wal")
    messages, warnings = read(path)
    assert messages == recorder.truth(len(messages))
    assert 0 < len(messages) < 6000
    assert any("no footer" in text for text in warnings)


# -- log recover ---------------------------------------------------------------------------------


def test_log_recover_writes_one_whole_file(tmp_path, path, command):
    unfinished(path, 5000, splits=(1500, 3000))
    before = fingerprint(tmp_path)
    output = tmp_path / "run.recovered.mcap"
    printed = command("log", "recover", path).out
    assert printed.startswith(f"{output}: 5000 messages over 5.00 s, ")
    assert "none is missing" in printed
    after = fingerprint(tmp_path)
    recovered = after.pop(output)
    assert after == before
    assert read(output) == (recorder.truth(5000), [])
    health = check_session(output)
    assert (health.file.damage, health.file.indexed) == ((), True)
    with Session(output) as session:
        facts = session.metadata["undulog.recovered"]
        assert (facts["messages"], facts["missing"]) == ("5000", "0")
        assert json.loads(facts["sources"]) == [
            "run.mcap",
            "run_0002.mcap",
            "run_0003.mcap.part",
        ]
        assert "undulog.part" not in session.metadata
        assert session.session_id == "killed"
    assert "exists already" in command("log", "recover", path, code=2).err
    assert output.read_bytes() == recovered
    recover = ("log", "recover", tmp_path / "run_0002.mcap", "--json", "--force")
    report = json.loads(command(*recover).out)
    assert (sum(report["messages"].values()), report["missing"]) == (5000, 0)
    assert output.read_bytes() == recovered


def test_a_recovered_file_opens_in_foreign_readers(path):
    unfinished(path, 500)
    output = recovered_path(path)
    recover_log(path, output)
    truth = recorder.truth(500)
    assert rows_of(output) == truth
    with AnyReader([output]) as reader:
        by_rosbags = [
            (connection.topic, t_ns, reader.deserialize(data, connection.msgtype).data)
            for connection, t_ns, data in reader.messages()
        ]
    assert by_rosbags == [(m[0], m[2], m[4][8:-1].decode()) for m in truth]

    rerun = Path(sys.executable).with_name("rerun")
    if not rerun.exists():
        pytest.skip("rerun is not installed")
    processes.run(rerun, "mcap", "check", output, code=0)


def test_a_damaged_file_without_a_write_ahead_log_gives_what_is_readable(tmp_path, path):
    recorder.record(path, range(6000))
    raw = bytearray(path.read_bytes())
    third = len(raw) // 3
    raw[third : third + 100_000] = bytes(100_000)
    path.write_bytes(raw[:-2000])
    report = recover_log(path, tmp_path / "out.mcap")
    assert (report.missing, bool(report.warnings)) == (None, True)
    messages, warnings = read(tmp_path / "out.mcap")
    assert warnings == []
    times = {m[2] for m in messages}
    assert messages == [m for m in recorder.truth(6000) if m[2] in times]
    assert 1000 < len(messages) < 6000


def test_a_write_ahead_log_left_behind_by_a_copy_is_not_mixed_in(tmp_path, path, command):
    """Another session is copied over a killed one; what that had can still be recovered."""
    unfinished(path, 3000)
    other = tmp_path / "other.mcap"
    with SessionWriter(other, session_id="other", epoch_ns=recorder.EPOCH_NS) as writer:
        channel = writer.string("/gait/mode")
        for k in range(100):
            channel.write(recorder.EPOCH_NS + k * 10_000_000, f"mode {k}")
    truth, _ = read(other)
    shutil.copy(other, path)
    messages, warnings = read(path)
    assert messages == truth
    assert len(warnings) == 1
    assert warnings[0].startswith("run.mcap.wal is the write-ahead log of another session (killed)")
    health = check_session(path)
    assert (health.file.unfinished, health.file.damage) == ("", ())
    assert warnings[0] in health.file.notes
    assert warnings[0] in command("log", "recover", path, "-o", tmp_path / "out.mcap").out
    assert read(tmp_path / "out.mcap")[0] == truth
    for left in ("wal", "part"):  # as the warning says
        path.with_name(f"run.mcap.{left}").rename(tmp_path / f"old.mcap.{left}")
    command("log", "recover", tmp_path / "old.mcap")
    assert read(tmp_path / "old.recovered.mcap") == (recorder.truth(3000), [])


def test_a_recovery_gives_no_advice_to_recover_but_names_what_a_copy_lacks(path, command):
    copy = path.parent / "copy" / "run.mcap"
    copy.parent.mkdir()
    unfinished(path, 6000)
    with Session(path) as session:
        assert any("'undulog log recover'" in text for text in session.warnings)
    out = command("log", "recover", path).out
    assert "the recorder did not finish" in out
    assert "log recover" not in out
    shutil.copy(unfinished_path(path), unfinished_path(copy))
    with Session(copy) as session:
        assert len(session.warnings) == 2
        assert session.warnings[1].startswith("run.mcap.part has not got its final name")
    lacks = "note: there is no run.mcap.wal beside run.mcap.part"
    assert lacks in command("log", "recover", copy).out
    shutil.copytree(path.with_name("run.mcap.wal"), copy.with_name("run.mcap.wal"))
    assert "; none is missing" in command("log", "recover", copy, "--force").out
    assert read(copy.with_name("run.recovered.mcap")) == (recorder.truth(6000), [])


def test_a_whole_file_needs_no_recovery(tmp_path, path):
    recorder.record(path, range(1))
    report = recover_log(path, tmp_path / "out.mcap")
    assert report.notes == ["the log was whole: nothing had to be recovered"]


def test_an_empty_write_ahead_log_and_an_empty_file_are_no_log(tmp_path):
    (tmp_path / "run.mcap").touch()
    (tmp_path / "run.mcap.wal").mkdir()
    for use in (Session, lambda path: recover_log(path, tmp_path / "out.mcap")):
        with pytest.raises(errors.NotALogError):
            use(tmp_path / "run.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_edits_take_an_unfinished_session_as_it_is(tmp_path, path):
    unfinished(path, 1000, splits=(400,))
    before = fingerprint(tmp_path)
    for output in (path, tmp_path / "run_0002.mcap"):
        with pytest.raises(errors.UsageError, match="is a source"):
            recover_log(path, output, force=True)
    (tmp_path / "out.mcap").write_bytes(b"mine")
    with pytest.raises(errors.OutputExistsError):
        recover_log(path, tmp_path / "out.mcap")
    (tmp_path / "out.mcap").unlink()
    assert fingerprint(tmp_path) == before
    cut_log(path, tmp_path / "cut.mcap", start_s=0.3, stop_s=0.9)
    assert read(tmp_path / "cut.mcap")[0] == recorder.truth(1000)[300:900]
    with Session(tmp_path / "cut.mcap") as session:
        assert "undulog.part" not in session.metadata
        assert "did not finish" in session.metadata["undulog.edit"]["warnings"]
    merge_logs([path, tmp_path / "cut.mcap"], tmp_path / "merged.mcap")
    assert len(read(tmp_path / "merged.mcap")[0]) == 1600


def test_behind_a_broken_chain_of_records_the_next_chunks_are_found(path):
    recorder.record(path, range(12_000))
    raw = path.read_bytes()
    chunks = summary_of(path).chunk_indexes
    assert len(chunks) > 4
    truth = recorder.truth(12_000)
    for broken in (1, 2, len(chunks) - 2):  # the first one has the channels
        index = chunks[broken]
        whole = bytearray(raw[:-1000])  # nor is there a summary
        at = index.chunk_start_offset
        for length in (0, 1 << 40, index.chunk_length // 3):
            whole[at + 1 : at + 9] = length.to_bytes(8, "little")
            path.write_bytes(whole)
            messages, warnings = read(path)
            first = (index.message_start_time - recorder.EPOCH_NS) // 10**6
            last = (index.message_end_time - recorder.EPOCH_NS) // 10**6
            rest = [m for m in messages if not first <= (m[2] - recorder.EPOCH_NS) // 10**6 <= last]
            assert rest == truth[:first] + truth[last + 1 :], (broken, length)
            assert set(messages) <= set(truth)
            assert any("is damaged and was skipped" in text for text in warnings)


def damage(rng, folder):
    """Damage up to three files of a session in one of several ways each."""
    files = [
        path for path in sorted(folder.rglob("*")) if path.suffix in (".mcap", ".part", ".seg")
    ]
    for path in rng.sample(files, rng.randint(1, 3)):
        damaged = damaged_bytes(rng, path.read_bytes(), rng.choice([1, 8, 64, 4096]))
        path.unlink() if damaged is None else path.write_bytes(damaged)


@pytest.mark.parametrize(
    ("runs", "total"),
    [
        (12, 900),
        pytest.param(150, 300, marks=pytest.mark.slow),
        pytest.param(500, 300, marks=pytest.mark.nightly),
    ],
)
def test_whatever_is_damaged_true_messages_come_out_once_and_losses_are_reported(
    tmp_path, runs, total
):
    source = tmp_path / "source"
    source.mkdir()
    splits, size = [total // 3, total // 3 * 2], 1 << (13 if total == 300 else 15)
    unfinished(source / "run.mcap", total, splits=splits, segment_size=size)
    truth = set(recorder.truth(total))
    place = tmp_path / "damaged"
    outcomes = Counter()
    rng = random.Random(runs)
    for run in range(runs):
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(source, place)
        damage(rng, place)
        try:
            messages, warnings = read(place / "run.mcap")
            check_session(place)
            report = recover_log(place, tmp_path / "out.mcap", force=True)
        except errors.UndulogError:
            outcomes["none"] += 1
            continue
        assert set(messages) <= truth, run
        assert len(set(messages)) == len(messages), run
        assert sum(report.messages.values()) == len(messages), run
        # What the damaged log itself can't tell any more is not counted.
        assert report.missing is None or report.missing <= total - len(messages), run
        assert len(messages) == total or warnings, run
        outcomes["all" if len(messages) == total else "some"] += 1
    assert outcomes["none"] <= runs // 20
    assert outcomes.keys() >= {"all", "some"}
