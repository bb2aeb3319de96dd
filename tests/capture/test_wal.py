"""The write-ahead log against kills, full disks and damaged bytes."""

import functools
import itertools
import os
import random
import re
import resource
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
import zlib
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap.writer import Writer

from capture.errors import DataError, LogError, LogWriteError, NotALogError, OutputExistsError
from capture.log.wal import WriteAheadLog, wal_folder
from capture.log.wal_format import SegmentHeader
from capture.log.wal_recover import recover
from capture.log.wal_segment import free_bytes, require_space

EPOCH_NS = 1_700_000_000_000_000_000
CHANNEL = Channel(id=1, topic="/t", message_encoding="cdr", metadata={"unit": "rad"}, schema_id=1)

# The same in the children that get killed and here, so that each payload can be told again.
MESSAGE = """
import random

def message(position):
    size = random.Random(position).randrange(0, 700)
    payload = random.Random(-position).randbytes(size)
    return 1 + position % 3, 10**18 + position, 10**18 - position, position % 2**32, payload
"""
_space: dict = {}
exec(MESSAGE, _space)
message = functools.cache(_space["message"])


def filled(folder, count, *, segment_size=4096):
    """A log with so many messages that nobody released; closed."""
    with WriteAheadLog(folder, segment_size=segment_size) as wal:
        for channel in (1, 2, 3):
            wal.define(Channel(channel, f"/{channel}", "cdr", {}, 0))
        for position in range(1, count + 1):
            assert wal.append(*message(position)) == position
    return folder


def check_messages(found):
    """Every message is what was appended at its position, and they are in order."""
    for item in found:
        assert tuple(item[i] for i in (1, 3, 4, 2, 5)) == message(item.position)
    positions = [item.position for item in found]
    assert positions == sorted(set(positions))
    return positions


# -- what goes in comes out ----------------------------------------------------------------------


def test_messages_come_back_bit_for_bit_over_many_segments(tmp_path):
    folder = filled(tmp_path / "x.mcap.wal", 200)
    assert len(list(folder.glob("0*.seg"))) > 10
    recovery = recover(folder)
    assert check_messages(list(recovery)) == list(range(1, 201))
    assert (recovery.found, recovery.before, recovery.missing) == (200, 0, 0)
    assert recovery.warnings == []


def test_a_record_has_the_documented_layout(tmp_path):
    with WriteAheadLog(tmp_path / "w") as wal:
        wal.append(7, 11, 13, 17, b"payload")
    raw = (tmp_path / "w" / "000001.seg").read_bytes()
    assert raw[:64] == raw[-64:]
    magic, stream, salt, number, size, _ = struct.unpack_from("<8sIIQQ16s", raw)
    assert (magic, stream, number, size) == (b"\x89UWAL1\r\n", 0, 1, len(raw))
    crc, *fields = struct.unpack_from("<IIQBBHIQQ", raw, 64)
    assert fields == [7, 1, 5, 0xA5, 7, 17, 11, 13]
    assert raw[104:111] == b"payload"
    assert crc == zlib.crc32(raw[68:111], salt)
    assert not any(raw[111:-64])


def test_definitions_outlive_the_segments_that_are_released(tmp_path):
    records = [
        Header("ros2", "undulog"),
        Schema(id=1, data=b"float64 data", encoding="ros2msg", name="std_msgs/msg/Float64"),
        CHANNEL,
        Metadata("undulog", {"session_id": "s", "ü": "ö"}),
        Attachment(1, 2, "robot.toml", "application/toml", random.Random(1).randbytes(700_000)),
    ]
    with WriteAheadLog(tmp_path / "w", segment_size=4096) as wal:
        for record in records:
            wal.define(record)
        for position in range(1, 101):
            wal.append(*message(position))
        wal.release(90)
    recovery = recover(tmp_path / "w")
    assert list(recovery.definitions) == records
    positions = check_messages(list(recovery))
    assert set(positions) >= set(range(91, 101))
    assert recovery.before == positions[0] - 1 > 50


def test_an_mcap_made_from_a_recovery_is_the_one_the_writer_would_have_made(tmp_path):
    schema = Schema(id=1, data=b"string data", encoding="ros2msg", name="std_msgs/msg/String")
    with WriteAheadLog(tmp_path / "w") as wal:
        wal.define(schema)
        wal.define(CHANNEL)
        for position in range(1, 50):
            wal.append(1, *message(position)[1:])
    recovery = recover(tmp_path / "w")
    with (tmp_path / "again.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for record in recovery.definitions:
            if isinstance(record, Schema):
                writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                writer.register_channel(
                    record.topic, record.message_encoding, record.schema_id, record.metadata
                )
        for item in recovery:
            writer.add_message(
                item.channel_id, item.log_time_ns, item.payload, item.publish_time_ns, item.sequence
            )
        writer.finish()
    with (tmp_path / "again.mcap").open("rb") as file:
        read = list(make_reader(file).iter_messages(log_time_order=False))
    assert [m.data for _, _, m in read] == [message(p)[4] for p in range(1, 50)]
    assert {(s.name, c.topic, c.metadata["unit"]) for s, c, _ in read} == {
        ("std_msgs/msg/String", "/t", "rad")
    }


def test_a_message_longer_than_a_segment_has_one_of_its_own(tmp_path):
    long = random.Random(3).randbytes(100_000)
    with WriteAheadLog(tmp_path / "w", segment_size=4096) as wal:
        wal.define(CHANNEL)
        for payload in (b"a", long, b"", long, b"b"):
            wal.append(1, 0, 0, 0, payload)
    recovery = recover(tmp_path / "w")
    assert [item.payload for item in recovery] == [b"a", long, b"", long, b"b"]
    assert recovery.warnings == []


@pytest.mark.parametrize(
    "values",
    [(1 << 16, 0, 0, 0), (-1, 0, 0, 0), (1, -1, 0, 0), (1, 0, 1 << 64, 0), (1, 0, 0, 1 << 32)],
)
def test_a_number_out_of_range_is_refused_and_leaves_no_trace(tmp_path, values):
    with WriteAheadLog(tmp_path / "w") as wal:
        wal.define(CHANNEL)
        wal.append(1, 0, 0, 0, b"before")
        with pytest.raises(DataError, match="out of range"):
            wal.append(*values, b"x" * 1000)
        assert wal.append(1, 0, 0, 0, b"after") == 2
    recovery = recover(tmp_path / "w")
    assert [item.payload for item in recovery] == [b"before", b"after"]
    assert recovery.warnings == []


def test_bytes_of_another_log_in_a_payload_are_not_taken_for_messages(tmp_path):
    inner = filled(tmp_path / "inner", 3)
    raw = (inner / "000001.seg").read_bytes()
    with WriteAheadLog(tmp_path / "w") as wal:
        wal.define(CHANNEL)
        wal.append(1, 0, 0, 0, raw)
        wal.append(1, 0, 0, 0, b"last")
    segment = tmp_path / "w" / "000001.seg"
    damaged = bytearray(segment.read_bytes())
    damaged[64] ^= 1  # the outer record is broken: what it wraps is searched
    segment.write_bytes(damaged)
    recovery = recover(tmp_path / "w")
    assert [(item.position, item.payload) for item in recovery] == [(2, b"last")]
    assert recovery.before == 1


# -- life and end of a log -----------------------------------------------------------------------


def test_segments_go_when_released_and_the_folder_when_all_is(tmp_path):
    folder = wal_folder(tmp_path / "x.mcap")
    assert folder.name == "x.mcap.wal"
    wal = WriteAheadLog(folder, segment_size=4096)
    for position in range(1, 201):
        wal.append(*message(position))
    before = len(list(folder.glob("0*.seg")))
    wal.release(150)
    deadline = time.monotonic() + 10
    while len(list(folder.glob("0*.seg"))) > before / 2:
        assert time.monotonic() < deadline, "released segments are still there"
        time.sleep(0.01)
    assert check_messages(list(recover(folder)))[-1] == 200  # a log in use can be looked at
    wal.release(200)
    wal.close()
    wal.close()
    assert not folder.exists()
    with pytest.raises(LogWriteError, match="closed"):
        wal.append(1, 0, 0, 0, b"")
    with pytest.raises(LogWriteError, match="closed"):
        wal.define(CHANNEL)


def test_a_log_that_was_not_released_is_kept_and_not_written_over(tmp_path):
    filled(tmp_path / "w", 5)
    with pytest.raises(OutputExistsError):
        WriteAheadLog(tmp_path / "w")
    assert len(list(recover(tmp_path / "w"))) == 5
    (tmp_path / "w" / "note.txt").write_text("not ours")
    with WriteAheadLog(tmp_path / "w", force=True) as wal:
        wal.release(0)
    assert [path.name for path in (tmp_path / "w").iterdir()] == ["note.txt"]


def test_what_was_not_accepted_cannot_be_released(tmp_path):
    with WriteAheadLog(tmp_path / "w") as wal:
        with pytest.raises(DataError, match="go up to 0"):
            wal.release(1)
        wal.release(0)


@pytest.mark.parametrize("options", [{"segment_size": 100}, {"sync_interval_s": 0.0}])
def test_senseless_options_are_refused(tmp_path, options):
    with pytest.raises(DataError, match="at least 4096"):
        WriteAheadLog(tmp_path / "w", **options)
    assert not (tmp_path / "w").exists()


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    with pytest.raises(LogWriteError, match=r"no/w: can't be created: No such file"):
        WriteAheadLog(tmp_path / "no" / "w")


def test_what_is_no_log_is_told(tmp_path):
    with pytest.raises(LogError, match="No such file"):
        recover(tmp_path / "none")
    with pytest.raises(NotALogError, match="no segment"):
        recover(tmp_path)


# -- the disk --------------------------------------------------------------------------------


def test_syncing_is_done_off_the_appending_thread(tmp_path, monkeypatch):
    threads = set()
    for name in ("fsync", "fdatasync"):
        real = getattr(os, name)

        def noted(file, real=real):
            threads.add(threading.get_ident())
            return real(file)

        monkeypatch.setattr(os, name, noted)
    with WriteAheadLog(tmp_path / "w", sync_interval_s=0.01, segment_size=1 << 16) as wal:
        for position in range(1, 1001):
            wal.append(*message(position))
        deadline = time.monotonic() + 10
        while wal.synced < 1000:
            assert time.monotonic() < deadline, "nothing was synced"
            time.sleep(0.01)
        assert threads
        assert threading.get_ident() not in threads
        wal.release(1000)


def test_a_failing_disk_is_told_by_the_next_append_and_by_close(tmp_path, monkeypatch):
    wal = WriteAheadLog(tmp_path / "w", sync_interval_s=0.01)
    wal.append(*message(1))

    def broken(file):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    monkeypatch.setattr(os, "fdatasync", broken)
    accepted = 1

    def go_on():
        nonlocal accepted
        for _ in range(10_000):
            accepted = wal.append(*message(accepted + 1))
            time.sleep(0.001)

    with pytest.raises(LogWriteError, match=r"seg: can't be brought to the disk: Input/output"):
        go_on()
    with pytest.raises(LogWriteError, match="Input/output error"):
        wal.close()
    monkeypatch.undo()
    assert check_messages(list(recover(tmp_path / "w"))) == list(range(1, accepted + 1))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dead_background_thread_is_told_by_the_next_append(tmp_path, monkeypatch):
    def broken(self):
        raise RuntimeError("unforeseen")

    monkeypatch.setattr(WriteAheadLog, "_drop_released", broken)
    wal = WriteAheadLog(tmp_path / "w")
    wal._thread.join(10)
    with pytest.raises(LogWriteError, match=r"can't be looked after: RuntimeError\('unforeseen'\)"):
        wal.append(*message(1))
    monkeypatch.undo()
    wal.release(0)
    wal.close()


def test_room_is_asked_for_beforehand(tmp_path):
    free = free_bytes(tmp_path / "not" / "yet.mcap")
    assert free > 0
    require_space(tmp_path, 1)
    with pytest.raises(LogWriteError, match=r"needs \d+ bytes .* bytes are missing"):
        require_space(tmp_path / "x.mcap", 1 << 60)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 1 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no mount: {error}")
    if done.returncode:
        pytest.skip(f"mounting is not permitted here: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


# In a child, for the failure to be feared is a SIGBUS.
FILL = (
    MESSAGE
    + """
import sys
from capture.errors import LogWriteError
from capture.log.wal import WriteAheadLog

wal = WriteAheadLog(sys.argv[1], segment_size=1 << 16)
accepted = 0
try:
    while True:
        accepted = wal.append(*message(accepted + 1))
except LogWriteError as error:
    print(accepted, wal.shortage is not None, error, sep="|")
try:
    wal.append(*message(accepted + 1))
except LogWriteError:
    print("again")
if sys.argv[2] == "release":
    wal.release(accepted - 10)
    for _ in range(100):
        accepted = wal.append(*message(accepted + 1))
wal.close()
print(accepted)
"""
)


def run_child(script, *arguments, **options):
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        **options,
    )


@pytest.mark.parametrize("then", ["close", "release"])
def test_a_full_disk_is_an_error_that_loses_nothing(small_disk, then):
    done = run_child(FILL, small_disk / "w", then)
    assert done.returncode == 0, done.stderr
    told, again, last = done.stdout.splitlines()
    accepted, foreseen, error = told.split("|")
    assert foreseen == "True"
    assert again == "again"
    assert re.search(
        r"w/\d{6}\.seg: needs 65536 bytes and the disk has \d+ free: \d+ bytes are missing", error
    )
    recovery = recover(small_disk / "w")
    positions = check_messages(list(recovery))
    assert recovery.missing == 0
    assert positions[-1] == int(last) == int(accepted) + (100 if then == "release" else 0)
    if then == "close":
        assert positions[0] == 1
        assert int(accepted) > 1500  # the disk was used, all but the last segments


def test_a_disk_full_from_the_start_is_told_and_left_as_it_was(small_disk):
    with pytest.raises(LogWriteError, match=r"000001\.seg: needs 2097152 bytes"):
        WriteAheadLog(small_disk / "w", segment_size=2 << 20)
    assert list(small_disk.iterdir()) == []


def test_a_limit_on_file_size_is_an_error_not_a_signal(tmp_path):
    limit = 1 << 15  # above any page, below the segment

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = run_child(FILL, tmp_path / "w", "close", preexec_fn=limited)
    assert done.returncode == 1
    assert "LogWriteError" in done.stderr
    assert "can't be reserved: File too large" in done.stderr
    assert not (tmp_path / "w").exists()


# -- the kill ------------------------------------------------------------------------------------

KILLED = (
    MESSAGE
    + """
import os, sys
from mcap.records import Channel
from capture.log.wal import WriteAheadLog

wal = WriteAheadLog(sys.argv[1], segment_size=int(sys.argv[2]), sync_interval_s=0.05)
for channel in (1, 2, 3):
    wal.define(Channel(channel, f"/{channel}", "cdr", {}, 0))
while True:
    position = wal.append(*message(wal.position + 1))
    os.write(1, position.to_bytes(8, "little"))
    if position % 500 == 0 and sys.argv[3] == "release":
        wal.release(position - 200)
"""
)


def kill_at(folder, seconds, segment_size, release):
    """Run the child, kill it that long after its first message; the last position accepted."""
    command = [sys.executable, "-c", KILLED, str(folder), str(segment_size), release]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        pipe = child.stdout.fileno()
        told = os.read(pipe, 1 << 16)
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            if select.select([pipe], [], [], left)[0]:
                told += os.read(pipe, 1 << 16)
        child.kill()
        while rest := os.read(pipe, 1 << 16):
            told += rest
    assert child.returncode == -9
    assert told, "the child did not start"
    whole = len(told) // 8 * 8
    return int.from_bytes(told[whole - 8 : whole], "little")


@pytest.mark.parametrize(
    ("run", "segment_size", "release"),
    [(0, 1 << 22, "keep"), (1, 1 << 14, "keep"), (2, 1 << 14, "release"), (3, 4096, "release")],
)
def test_a_kill_loses_no_accepted_message(tmp_path, run, segment_size, release):
    seconds = random.Random(run).uniform(0.05, 0.4)
    accepted = kill_at(tmp_path / "w", seconds, segment_size, release)
    recovery = recover(tmp_path / "w")
    positions = check_messages(list(recovery))
    assert recovery.missing == 0
    # The child may have been killed between accepting and telling.
    assert positions[-1] in (accepted, accepted + 1)
    assert recovery.before == 0 if release == "keep" else recovery.before <= accepted - 200
    assert len(recovery.definitions) == 3


@pytest.mark.slow
def test_thirty_kills_lose_no_accepted_message(tmp_path):
    rng = random.Random(11)
    for run in range(30):
        folder = tmp_path / str(run)
        size = rng.choice([4096, 1 << 14, 1 << 20])
        release = rng.choice(["keep", "release"])
        accepted = kill_at(folder, rng.uniform(0.0, 0.5), size, release)
        recovery = recover(folder)
        positions = check_messages(list(recovery))
        assert recovery.missing == 0
        assert positions[-1] in (accepted, accepted + 1)
        assert recovery.before == 0 if release == "keep" else recovery.before <= accepted - 200
        shutil.rmtree(folder)


# -- damage --------------------------------------------------------------------------------------


def record_places(raw):
    """Where the records of an undamaged segment are."""
    at, places = 64, []
    while (head := struct.unpack_from("<IIQ", raw, at))[2]:
        places.append(at)
        at = (at + 40 + head[1] + 7) & -8
    return places


def test_a_torn_last_record_is_left_out(tmp_path):
    folder = filled(tmp_path / "w", 10, segment_size=1 << 16)
    segment = folder / "000001.seg"
    whole = segment.read_bytes()
    last = record_places(whole)[-1]
    for written in range(1, 40 + len(message(10)[4]), 7):
        segment.write_bytes(whole[: last + written].ljust(len(whole) - 64, b"\0") + whole[-64:])
        recovery = recover(folder)
        assert check_messages(list(recovery)) == list(range(1, 10)), written
        assert recovery.missing == 0


def test_damage_in_between_costs_only_what_it_hit(tmp_path):
    folder = filled(tmp_path / "w", 60, segment_size=1 << 16)
    segment = folder / "000001.seg"
    raw = bytearray(segment.read_bytes())
    places = record_places(raw)
    raw[places[9] + 4] ^= 0xFF  # a length: where the next record is must be searched
    raw[places[29] : places[32]] = bytes(places[32] - places[29])  # a block never written
    raw[places[49] + 20] ^= 0x01  # a sequence number
    segment.write_bytes(raw)
    recovery = recover(folder)
    assert check_messages(list(recovery)) == [
        p for p in range(1, 61) if p not in (10, 30, 31, 32, 50)
    ]
    assert (recovery.found, recovery.missing) == (55, 5)
    damage, missing = recovery.warnings
    assert re.fullmatch(
        rf"000001.seg: \d+ bytes are no whole records, the first at byte {places[9]}", damage
    )
    assert missing == "5 messages are missing between those found"


def test_a_missing_segment_is_counted(tmp_path):
    folder = filled(tmp_path / "w", 100)
    gone = [item.position for item in recover(folder)]
    (folder / "000003.seg").unlink()
    recovery = recover(folder)
    positions = check_messages(list(recovery))
    assert recovery.missing == len(gone) - len(positions) > 0
    assert recovery.warnings == [f"{recovery.missing} messages are missing between those found"]


def test_a_broken_header_is_read_at_the_other_end(tmp_path):
    folder = filled(tmp_path / "w", 10, segment_size=1 << 16)
    segment = folder / "000001.seg"
    raw = bytearray(segment.read_bytes())
    raw[:64] = bytes(64)
    segment.write_bytes(raw)
    assert check_messages(list(recover(folder))) == list(range(1, 11))
    raw[-64:] = bytes(64)
    segment.write_bytes(raw)
    recovery = recover(folder)
    assert list(recovery) == []
    assert recovery.warnings == ["000001.seg has no readable header; left out"]


def test_strangers_among_the_segments_are_left_out(tmp_path):
    folder = filled(tmp_path / "w", 100)
    other = filled(tmp_path / "other", 100)
    shutil.copy(other / "000002.seg", folder / "000099.seg")
    shutil.copy(other / "000003.seg", folder / "000003.seg")
    (folder / "000100.seg").mkdir()
    recovery = recover(folder)
    check_messages(list(recovery))
    assert recovery.missing > 0
    assert recovery.warnings[:3] == [
        "000003.seg is of another log; left out",
        "000099.seg is a renamed segment; left out",
        "000100.seg can't be read: Is a directory; left out",
    ]


def test_messages_without_their_channel_are_given_out_and_told(tmp_path):
    with WriteAheadLog(tmp_path / "w") as wal:
        wal.define(CHANNEL)
        wal.append(4, 0, 0, 0, b"stranger")
    recovery = recover(tmp_path / "w")
    assert [item.payload for item in recovery] == [b"stranger"]
    assert recovery.warnings == ["messages of channels that are not defined: 4"]


@pytest.fixture
def quick_folder(tmp_path):
    """A folder in memory where the machine has one: thousands of files come and go in it."""
    memory = Path("/dev/shm")
    place = memory if os.access(memory, os.W_OK) else tmp_path
    with tempfile.TemporaryDirectory(dir=place) as folder:
        yield Path(folder)


def damage(rng, folder):
    """Damage the files of a log in some of several ways; the names of those it hit."""
    files = sorted(folder.glob("*.seg"))
    last = max(folder.glob("0*.seg"))
    hit = set()
    for _ in range(rng.randint(1, 3)):
        path = rng.choice(files)
        if not path.exists():
            continue
        hit.add(path.name)
        raw = bytearray(path.read_bytes())
        at = rng.randrange(len(raw) + 1)
        length = rng.choice([1, 2, 8, 64, 512])
        kind = rng.randrange(6)
        if kind == 0:  # bytes
            for _ in range(rng.randint(1, 20)):
                if raw:
                    raw[rng.randrange(len(raw))] = rng.randrange(256)
        elif kind == 1:  # a stretch of noise, zeros or ones
            noise = rng.choice([rng.randbytes(length), bytes(length), b"\xff" * length])
            raw[at : at + length] = noise[: len(raw) - at]
        elif kind == 2:
            del raw[at:]
        elif kind == 3:  # bytes lost or doubled: all behind them moves
            raw[at : at + length] = rng.choice([b"", 2 * raw[at : at + length]])
        elif kind == 4:  # one block in the place of another
            start = rng.randrange(len(raw) + 1)
            raw[at : at + length] = raw[start : start + length]
        elif path != last:  # that the last one is gone, nothing could tell
            path.unlink()
            continue
        path.write_bytes(raw)
    return hit


def test_whatever_bytes_there_are_only_true_messages_come_out(tmp_path, quick_folder):
    source = filled(tmp_path / "source", 40)
    originals = {path.name: path.read_bytes() for path in source.iterdir()}
    rng = random.Random(7)
    outcomes = {"all": 0, "some": 0, "untold": 0, "none": 0}
    folder = quick_folder
    hit = set(originals)
    for _ in range(3000):
        for name in hit:
            (folder / name).write_bytes(originals[name])
        hit = damage(rng, folder)
        try:
            recovery = recover(folder)
            found = list(recovery)
        except LogError:
            outcomes["none"] += 1
            continue
        positions = check_messages(found)
        assert recovery.found == len(found)
        if found:
            gaps = sum(b - a - 1 for a, b in itertools.pairwise(positions))
            assert (recovery.before, recovery.missing) == (positions[0] - 1, gaps)
        whole = positions == list(range(1, 41))
        told = recovery.before or recovery.missing or recovery.warnings
        outcomes["all" if whole else "some" if told else "untold"] += 1
    assert outcomes["all"] > 100
    assert outcomes["some"] > 1000
    assert outcomes["untold"] == 0


def test_no_memory_is_given_to_a_length_before_it_is_vouched_for(tmp_path):
    folder = tmp_path / "w"
    folder.mkdir()
    size = 300 << 20  # sparse: no disk is used
    header = SegmentHeader(stream=0, salt=5, number=1, size=size, log_id=bytes(16)).pack()
    for claimed in (200 << 20, 0xFFFF_FFFF):
        record = struct.pack("<IIQBBHIQQ", 1, claimed, 1, 5, 0xA5, 1, 0, 0, 0)
        with (folder / "000001.seg").open("wb") as file:
            file.write(header + record)
            file.truncate(size)
        tracemalloc.start()
        assert list(recover(folder)) == []
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 16 << 20
