"""The write-ahead log against kills and damaged bytes."""

import collections
import itertools
import os
import random
import re
import shutil
import struct
import sys
import tempfile
import tracemalloc
import zlib
from pathlib import Path

import pytest

from support.damage import damaged_bytes
from support.kills import killed_after
from support.wal_messages import CHANNEL, MESSAGE, check_messages, filled, message
from undulog.capture.common.errors import LogError
from undulog.capture.log.wal.format import SegmentHeader
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.writer import WriteAheadLog

# -- the kill --------------------------------------------------------------------------------------

KILLED = f"""{MESSAGE}
import os, sys
from mcap.records import Channel
from undulog.capture.log.wal.writer import WriteAheadLog

wal = WriteAheadLog(sys.argv[1], segment_size=int(sys.argv[2]), sync_interval_s=0.05)
for channel in (1, 2, 3):
    wal.define(Channel(channel, f"/{{channel}}", "cdr", {{}}, 0))
while True:
    position = wal.append(*message(wal.position + 1))
    os.write(1, position.to_bytes(8, "little"))
    if position % 500 == 0 and sys.argv[3] == "release":
        wal.release(position - 200)
"""


SLOW_RUNS = (5, 6)
"""Of long segments, with release and without; the fast ones have shorter segments."""


def long_kill(run):
    rng = random.Random(run)
    size, release = rng.choice([4096, 1 << 14, 1 << 20]), rng.choice(["keep", "release"])
    mark = pytest.mark.slow if run in SLOW_RUNS else pytest.mark.nightly
    return pytest.param(run, size, release, marks=mark)


@pytest.mark.parametrize(
    ("run", "segment_size", "release"),
    [
        (0, 1 << 22, "keep"),
        (1, 1 << 14, "keep"),
        (2, 1 << 14, "release"),
        (3, 4096, "release"),
        *map(long_kill, range(4, 34)),
    ],
)
def test_a_kill_loses_no_accepted_message(tmp_path, run, segment_size, release):
    folder = tmp_path / "w"
    command = [sys.executable, "-c", KILLED, str(folder), str(segment_size), release]
    accepted = killed_after(command, random.Random(run).randrange(1, 20_000))
    recovery = recover(folder)
    positions = check_messages(list(recovery))
    assert recovery.missing == 0
    # The child may have been killed between accepting and reporting.
    assert positions[-1] in (accepted, accepted + 1)
    assert recovery.before == 0 if release == "keep" else recovery.before <= max(accepted - 200, 0)
    assert len(recovery.definitions) == 3


# -- damage ----------------------------------------------------------------------------------------


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
    assert check_messages(list(recovery)) == sorted({*range(1, 61)} - {10, 30, 31, 32, 50})
    assert (recovery.returned, recovery.missing) == (55, 5)
    damage, missing = recovery.warnings
    first = rf"the first at byte {places[9]}"
    assert re.fullmatch(rf"000001.seg: \d+ bytes are no whole records, {first}", damage)
    assert missing == "5 messages are missing between those found"


@pytest.mark.parametrize(("at", "value"), [(16, 4), (17, 0xA4)], ids=["kind", "mark"])
def test_a_record_of_another_kind_or_mark_is_none_though_its_crc_fits(tmp_path, at, value):
    folder = filled(tmp_path / "w", 10, segment_size=1 << 16)
    segment = folder / "000001.seg"
    raw = bytearray(segment.read_bytes())
    place, following = record_places(raw)[4:6]
    raw[place + at] = value
    (length,) = struct.unpack_from("<I", raw, place + 4)
    (salt,) = struct.unpack_from("<I", raw, 12)
    crc = zlib.crc32(raw[place + 4 : place + 40 + length], salt)
    struct.pack_into("<I", raw, place, crc)
    segment.write_bytes(raw)
    recovery = recover(folder)
    assert check_messages(list(recovery)) == sorted({*range(1, 11)} - {5})
    assert recovery.warnings[0] == (
        f"000001.seg: {following - place} bytes are no whole records, the first at byte {place}"
    )


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


def test_messages_without_their_channel_are_given_out_and_reported(tmp_path):
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
    for path in [rng.choice(files) for _ in range(rng.randint(1, 3))]:
        if not path.exists():
            continue
        hit.add(path.name)
        damaged = damaged_bytes(rng, path.read_bytes(), rng.choice([1, 2, 8, 64, 512]))
        if damaged is not None:
            path.write_bytes(damaged)
        elif path != last:  # a missing last segment leaves no trace
            path.unlink()
    return hit


@pytest.mark.slow
def test_whatever_bytes_there_are_only_true_messages_come_out(tmp_path, quick_folder):
    source = filled(tmp_path / "source", 40)
    originals = {path.name: path.read_bytes() for path in source.iterdir()}
    rng = random.Random(7)
    outcomes, folder = collections.Counter(), quick_folder
    hit = set(originals)
    for _ in range(3000):
        for name in hit:
            (folder / name).write_bytes(originals[name])
        hit = damage(rng, folder)
        try:
            recovery = recover(folder)
            messages = list(recovery)
        except LogError:
            outcomes["none"] += 1
            continue
        positions = check_messages(messages)
        assert recovery.returned == len(messages)
        if messages:
            gaps = sum(b - a - 1 for a, b in itertools.pairwise(positions))
            assert (recovery.before, recovery.missing) == (positions[0] - 1, gaps)
        whole = positions == list(range(1, 41))
        reported = recovery.before or recovery.missing or recovery.warnings
        outcomes["all" if whole else "some" if reported else "unreported"] += 1
    assert outcomes["all"] > 100
    assert outcomes["some"] > 1000
    assert outcomes["unreported"] == 0


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
