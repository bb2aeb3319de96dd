"""The write-ahead log: what goes in comes out, and the life of its segments."""

import random
import shutil
import struct
import zlib

import pytest
from mcap.records import Attachment, Header, Metadata, Schema

from support.frozen_records import mutable_dataclasses
from support.processes import wait_for
from support.wal_messages import CHANNEL, check_messages, filled, message
from undulog.capture.common import errors
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.writer import WriteAheadLog, wal_folder


def payloads(folder):
    """The payloads of an undamaged log."""
    recovery = recover(folder)
    contents = [item.payload for item in recovery]
    assert recovery.warnings == []
    return contents


# -- what goes in comes out ----------------------------------------------------------------------


def test_messages_come_back_bit_for_bit_over_many_segments(tmp_path):
    folder = filled(tmp_path / "x.mcap.wal", 200)
    assert len(list(folder.glob("0*.seg"))) > 10
    recovery = recover(folder)
    assert check_messages(list(recovery)) == list(range(1, 201))
    assert (recovery.returned, recovery.before, recovery.missing) == (200, 0, 0)
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


def test_a_message_longer_than_a_segment_has_one_of_its_own(tmp_path):
    long = random.Random(3).randbytes(100_000)
    with WriteAheadLog(tmp_path / "w", segment_size=4096) as wal:
        wal.define(CHANNEL)
        for payload in (b"a", long, b"", long, b"b"):
            wal.append(1, 0, 0, 0, payload)
    assert payloads(tmp_path / "w") == [b"a", long, b"", long, b"b"]


def test_a_spare_segment_that_is_too_small_is_removed(tmp_path):
    with WriteAheadLog(tmp_path / "w", segment_size=4096) as wal:
        spare = tmp_path / "w" / "000002.seg"
        wait_for(spare.exists, "the spare segment")
        wal.append(1, 0, 0, 0, bytes(100_000))
        assert not spare.exists()
        assert (tmp_path / "w" / "000003.seg").exists()


def test_a_log_whose_folder_is_gone_ends_where_nothing_is_to_be_kept(tmp_path):
    wal = WriteAheadLog(tmp_path / "w")
    wait_for(lambda: wal._spare is not None, "the last file to be made")
    shutil.rmtree(tmp_path / "w")
    wal.close()
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize(
    "values",
    [(1 << 16, 0, 0, 0), (-1, 0, 0, 0), (1, -1, 0, 0), (1, 0, 1 << 64, 0), (1, 0, 0, 1 << 32)],
)
def test_a_number_out_of_range_is_refused_and_leaves_no_trace(tmp_path, values):
    with WriteAheadLog(tmp_path / "w") as wal:
        wal.define(CHANNEL)
        wal.append(1, 0, 0, 0, b"before")
        with pytest.raises(errors.DataError, match="out of range"):
            wal.append(*values, b"x" * 1000)
        with pytest.raises(errors.DataError, match="go up to 1"):
            wal.release(2)
        assert wal.append(1, 0, 0, 0, b"after") == 2
    assert payloads(tmp_path / "w") == [b"before", b"after"]


def test_bytes_of_another_log_in_a_payload_are_not_taken_for_messages(tmp_path):
    raw = (filled(tmp_path / "inner", 3) / "000001.seg").read_bytes()
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
    wait_for(lambda: len(list(folder.glob("0*.seg"))) <= before / 2, "the release")
    assert check_messages(list(recover(folder)))[-1] == 200  # a log in use can be looked at
    wal.release(200)
    wal.close()
    wal.close()
    assert not folder.exists()
    with pytest.raises(errors.LogWriteError, match="closed"):
        wal.append(1, 0, 0, 0, b"")
    with pytest.raises(errors.LogWriteError, match="closed"):
        wal.define(CHANNEL)


def test_a_log_that_was_not_released_is_kept_and_not_written_over(tmp_path):
    filled(tmp_path / "w", 5)
    with pytest.raises(errors.OutputExistsError):
        WriteAheadLog(tmp_path / "w")
    assert len(list(recover(tmp_path / "w"))) == 5
    (tmp_path / "w" / "note.txt").write_text("not ours")
    with WriteAheadLog(tmp_path / "w", force=True) as wal:
        wal.release(0)
    assert [path.name for path in (tmp_path / "w").iterdir()] == ["note.txt"]


@pytest.mark.parametrize("options", [{"segment_size": 100}, {"sync_interval_s": 0.0}])
def test_senseless_options_are_refused(tmp_path, options):
    with pytest.raises(errors.DataError, match="at least 4096"):
        WriteAheadLog(tmp_path / "w", **options)
    assert not (tmp_path / "w").exists()


def test_what_is_no_log_is_refused(tmp_path):
    with pytest.raises(errors.LogWriteError, match=r"no/w: can't be created: No such file"):
        WriteAheadLog(tmp_path / "no" / "w")
    with pytest.raises(errors.LogError, match="No such file"):
        recover(tmp_path / "none")
    with pytest.raises(errors.NotALogError, match="no segment"):
        recover(tmp_path)


def test_what_is_handed_on_can_not_be_changed():
    assert mutable_dataclasses("undulog.capture.log.wal") == {"_Mapping"}
