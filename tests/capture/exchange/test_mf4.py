"""MF4 files of other makers: python-can's writer, and asammdf with the groups that loggers have."""

import gzip
import math
import random
import struct
import sys
from datetime import UTC, datetime, timedelta, timezone

import can
import numpy as np
import pytest

from support.imported import import_can
from support.written_frames import log_messages
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import ImportFormatError
from undulog.capture.exchange.formats.mf4 import open_mf4
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS, joined
from undulog.capture.log.messages.frames import ERROR_FLAG, REMOTE_FLAG

asammdf = pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
from asammdf.blocks.v4_blocks import SourceInformation  # noqa: E402
from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS  # noqa: E402

T0 = 1_700_000_000.25
START = datetime(2024, 2, 29, 12, 0, 0, 125_000, tzinfo=UTC)
START_NS = 1_709_208_000_125_000_000


def read(path):
    """Everything in a file: frames, name of each one's bus, the log; without a child process."""
    with open_mf4(path, path.parent) as log:
        blocks = list(log.blocks)
        frames = joined(blocks).classic()
        buses = [log.buses[i] for block in blocks for i in block.bus]
    assert blocks[-1].done == pytest.approx(1.0)
    return frames, buses, log


def group(kind, times, columns):
    """A channel group as loggers write it, for asammdf's ``append``."""
    dtype = [(f"{kind}.{name}", *field) for name, (field, _) in columns.items()]
    samples = np.zeros(len(times), dtype=dtype)
    for name, (_, values) in columns.items():
        samples[f"{kind}.{name}"] = values
    source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
    return asammdf.Signal(samples, np.asarray(times, dtype="<f8"), name=kind, source=source)


def data_group(times, ids, data):
    lengths = [len(payload) for payload in data]
    cells = np.array([list(payload.ljust(8, b"\xee")) for payload in data], dtype=np.uint8)
    columns = {
        "ID": (("<u4",), ids),
        "DLC": (("u1",), lengths),
        "DataLength": (("u1",), lengths),
        "DataBytes": (("u1", (8,)), cells),
    }
    return group("CAN_DataFrame", times, columns)


def written(path, *groups, start=START, compression=0, ways=None):
    """``ways``: conversion of the directions, as loggers have it: numbers that stand for texts."""
    mdf = asammdf.MDF(version="4.10")
    mdf.header.start_time = start
    for part in groups:
        mdf.append(part)
    for part in mdf.groups if ways else ():
        channel = next(c for c in part.channels if c.name == "CAN_DataFrame.Dir")
        channel.conversion = asammdf.blocks.conversion_utils.from_dict(ways)
    mdf.save(path, compression=compression)
    mdf.close()
    return path


def some_messages(count, step_s):
    for i in range(count):
        yield can.Message(timestamp=T0 + i * step_s, arbitration_id=i, data=bytes(i % 9))


def test_a_compressed_file_is_read_the_same(tmp_path):
    plain, packed = tmp_path / "log.mf4", tmp_path / "log.mf4.gz"
    log_messages(plain, some_messages(500, 1e-3))
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    frames, buses, log = read(packed)
    assert frames.tobytes() == read(plain)[0].tobytes()
    assert (len(frames), set(buses), log.problems) == (500, {"can0"}, [])


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_groups_of_a_logger_merge_by_time_to_the_nanosecond(compression, tmp_path):
    """One group for each bus, with texts for directions, the extended bit in the identifier."""
    steps = np.arange(200_000) * 12_345  # more than one block of either
    times = steps / 1e9
    ways = {"val_0": 0, "text_0": b"Rx", "val_1": 1, "text_1": b"Tx"}
    expected, groups = [], []
    for bus in (1, 2):
        mine = np.flatnonzero(steps % 5 < 3 if bus == 1 else steps % 5 >= 3)
        ids = np.where(mine % 2, 0x8000_0000 | mine, mine % 2048)
        data = mine.astype("<u8").view(np.uint8).reshape(-1, 8)
        columns = {
            "BusChannel": (("u1",), bus),
            "ID": (("<u4",), ids),
            "DLC": (("u1",), 8),
            "DataLength": (("u1",), 8),
            "DataBytes": (("u1", (8,)), data),
            "Dir": (("u1",), mine % 3 == 0),
        }
        groups.append(group("CAN_DataFrame", times[mine], columns))
        expected.append(np.stack([mine, ids, mine % 3 == 0, np.full(len(mine), bus)]))
    path = written(tmp_path / "log.mf4", *groups, compression=compression, ways=ways)
    frames, buses, log = read(path)
    truth = np.concatenate(expected, axis=1)
    truth = truth[:, np.argsort(truth[0])]
    np.testing.assert_array_equal(frames["t_host_ns"].astype(np.int64) - START_NS, steps)
    np.testing.assert_array_equal(frames["id_flags"], truth[1])
    np.testing.assert_array_equal(frames["dir"], truth[2])
    np.testing.assert_array_equal(frames["data"].view("<u8")[:, 0], truth[0])
    assert buses == [f"can{number}" for number in truth[3]]
    assert (log.time, log.problems) == ("to 1 ns from a start to 1 us, in UTC", [])


def test_fields_that_a_group_may_lack(tmp_path):
    path = written(
        tmp_path / "log.mf4",
        data_group([0.5, 1.5], [0x123, 0x456], [b"\1\2", b""]),
        group("CAN_ErrorFrame", [1.0], {"BusChannel": (("u1",), 0)}),
        group("CAN_RemoteFrame", [2.0], {"ID": (("<u4",), 7), "DLC": (("u1",), 6)}),
    )
    frames, buses, log = read(path)
    assert frames["id_flags"].tolist() == [0x123, ERROR_FLAG, 0x456, 7 | REMOTE_FLAG]
    assert frames["dlc"].tolist() == [2, 0, 0, 6]
    assert frames["data"].tolist() == [[1, 2] + [0] * 6, *[[0] * 8] * 3]
    assert (frames["t_host_ns"] - START_NS).tolist() == [5e8, 1e9, 1.5e9, 2e9]
    assert set(buses) == {"can0"}
    assert log.directions is False


def test_what_is_left_out_is_reported(tmp_path):
    long_columns = {
        "ID": (("<u4",), 2),
        "DLC": (("u1",), 15),
        "DataLength": (("u1",), 64),
        "DataBytes": (("u1", (64,)), 1),
        "EDL": (("u1",), 1),
        "Dir": (("u1",), 0),
    }
    path = written(
        tmp_path / "log.mf4",
        data_group([0.0], [1], [b"\1"]),
        group("CAN_DataFrame", [1.0, 2.0], long_columns),
        group("CAN_OverloadFrame", [3.0], {"BusChannel": (("u1",), 0)}),
        asammdf.Signal(np.arange(4.0), np.arange(4.0), name="motor_temperature"),
    )
    report = import_can(path, tmp_path / "run.mcap", load_robot("arcsnake-joint"))
    left_out = "left out: only CAN data, remote and error frames are kept"
    assert report.frames == 3
    assert report.problems[:3] == [
        f"1 records of CAN_OverloadFrame {left_out}",
        f"4 records of motor_temperature {left_out}",
        "1 frames have no direction, unlike others",
    ]
    assert report.problems[3].startswith("none of 3 CAN frames can be decoded")
    assert report.verdict == "degraded"
    with Session.open(tmp_path / "run.mcap") as session:
        facts = session.metadata["undulog"]
        assert (facts["import.format"], facts["import.directions"]) == ("mf4", "recorded")


@pytest.mark.parametrize(
    ("start", "truth_ns"),
    [
        (START.astimezone(timezone(timedelta(hours=9))), START_NS),
        (datetime(1970, 1, 1, tzinfo=UTC), RELATIVE_EPOCH_NS),
        (START.astimezone().replace(tzinfo=None), START_NS),
    ],
)
def test_the_start_of_the_measurement(start, truth_ns, tmp_path):
    path = written(tmp_path / "log.mf4", data_group([0.0, 0.25], [1, 2], [b"", b""]), start=start)
    frames, _, log = read(path)
    assert (frames["t_host_ns"].astype(np.int64) - truth_ns).tolist() == [0, 250_000_000]
    assert ("this machine's" in log.time) == (start.tzinfo is None)


def test_times_that_go_back_stay_in_their_order(tmp_path):
    first = data_group([0.0, 2.0, 1.0, 3.0], [1, 2, 3, 4], [b""] * 4)
    other = data_group([1.5, 2.5], [5, 6], [b"", b""])
    frames, *_ = read(written(tmp_path / "log.mf4", first, other))
    assert frames["id_flags"].tolist() == [1, 5, 2, 3, 6, 4]


def test_files_that_hold_no_frames(tmp_path):
    temperature = asammdf.Signal(np.arange(4.0), np.arange(4.0), name="temperature")
    path = written(tmp_path / "log.mf4", temperature)
    with pytest.raises(ImportFormatError, match=r"log\.mf4: holds no CAN frames"):
        read(path)
    old = asammdf.MDF(version="3.30")
    old.append(temperature)
    old.save(tmp_path / "old.mdf")
    old.close()
    path.write_bytes((tmp_path / "old.mdf").read_bytes())
    with pytest.raises(ImportFormatError, match=r"version '3\.30'; bus logging began with MDF 4"):
        read(path)


@pytest.mark.slow
def test_a_damaged_file_is_one_error_and_nothing_else(tmp_path, capfd, monkeypatch):
    """Read or refused, whatever is damaged; neither asammdf nor the interpreter says a word."""
    messages = []
    monkeypatch.setattr(sys, "unraisablehook", messages.append)
    path = tmp_path / "log.mf4"
    log_messages(path, some_messages(300, 1.0))
    whole, chance, refused = path.read_bytes(), random.Random(7), 0
    for k in range(60):
        damaged = bytearray(whole[: chance.randrange(len(whole))] if k % 3 == 0 else whole)
        for _ in range(k % 5):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        path.write_bytes(damaged)
        try:
            read(path)
        except ImportFormatError as error:
            assert str(path) in str(error)  # noqa: PT017
            refused += 1
    assert refused > 20
    assert messages == []
    assert capfd.readouterr() == ("", "")


def test_without_asammdf_the_command_names_the_extra(tmp_path, command, monkeypatch):
    (tmp_path / "x.mf4").write_bytes(b"MDF     4.10    ".ljust(64, b"\0"))
    monkeypatch.setitem(sys.modules, "asammdf", None)
    source, output = tmp_path / "x.mf4", tmp_path / "run.mcap"
    refused = command("import", source, "-o", output, "--robot", "snake25", code=2).err
    missing = "importing x.mf4 needs the package asammdf, which is not installed"
    fix = "the extra 'mf4' brings it: pip install 'asammdf>=8.8'"
    assert refused == f"error: {missing}; {fix}\n"
    assert not (tmp_path / "run.mcap").exists()


def test_the_times_are_rounded_not_cut(tmp_path):
    """A time as a floating-point number of seconds lies beside its nanosecond."""
    steps = [1, 3, 999_999_999, 1_000_000_001, 3_600_000_000_007]
    times = [math.nextafter(step / 1e9, 0) for step in steps]
    path = written(tmp_path / "log.mf4", data_group(times, [1] * 5, [b""] * 5))
    assert (read(path)[0]["t_host_ns"].astype(np.int64) - START_NS).tolist() == steps


def test_a_file_that_its_logger_did_not_finish(tmp_path):
    """No counts, no lengths, as a logger leaves it that lost its power."""
    times = np.arange(500) * 1e-3
    frames = data_group(times, np.arange(500), [bytes([i % 256]) for i in range(500)])
    path = written(tmp_path / "log.mf4", frames)
    data = bytearray(path.read_bytes())
    group_at, data_at = data.index(b"##CG"), data.index(b"##DT")
    (links,) = struct.unpack_from("<Q", data, group_at + 16)
    struct.pack_into("<Q", data, group_at + 24 + 8 * links + 8, 0)
    struct.pack_into("<Q", data, data_at + 8, 24)
    struct.pack_into("<H", data, 60, 0b101)
    data[:8] = b"UnFinMF "
    path.write_bytes(data)
    read_back, _, log = read(path)
    assert read_back["id_flags"].tolist() == list(range(500))
    assert (read_back["t_host_ns"] - START_NS).tolist() == [1_000_000 * i for i in range(500)]
    assert read_back["data"][:, 0].tolist() == [i % 256 for i in range(500)]
    assert log.problems == []
    assert path.read_bytes() == data


@pytest.mark.parametrize("text", [False, True])
def test_data_of_varying_length(text, tmp_path):
    """Data bytes in a list of their own, each as long as it is; as text they would lose zeros."""
    lengths, times = np.arange(300) % 9, np.arange(300) * 1e-3
    data = [bytes((i + k) % 256 for k in range(length)) for i, length in enumerate(lengths)]
    columns = {
        "": np.zeros(300, dtype="u1"),
        ".ID": np.arange(300, dtype="<u4"),
        ".DLC": lengths.astype("u1"),
        ".DataLength": lengths.astype("u1"),
        ".DataBytes": np.array(data, dtype="S8"),
    }
    encodings = {".DataBytes": "latin-1"}
    signals = [
        asammdf.Signal(cells, times, name=f"CAN_DataFrame{name}", encoding=encodings.get(name))
        for name, cells in columns.items()
    ]
    path = written(tmp_path / "log.mf4", signals)
    if not text:  # asammdf writes lists of texts alone; the type is the third byte of the channel
        whole, at = bytearray(path.read_bytes()), 0
        while (at := whole.find(b"##CN", at + 1)) > 0:
            (links,) = struct.unpack_from("<Q", whole, at + 16)
            if whole[at + 24 + 8 * links] == 1:
                whole[at + 24 + 8 * links + 2] = 10
        path.write_bytes(whole)
        frames, *_ = read(path)
        assert [bytes(row) for row in frames["data"]] == [
            payload.ljust(8, b"\0") for payload in data
        ]
        assert frames["dlc"].tolist() == lengths.tolist()
    else:
        with pytest.raises(ImportFormatError, match=r"DataBytes are of type .*, not bytes"):
            read(path)
