"""Traces for other tools: back through the import, and through readers of other makes."""

import json
import struct
import zlib

import can
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from support.imported import FRAME_SUFFIXES, import_can
from support.imported import export_file as export_log
from support.paths import TRACE as RECORDING
from support.written_frames import T0, every_kind, frames_of, imported, write_frames
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import UsageError
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS
from undulog.capture.exchange.python_can import channel_numbers
from undulog.capture.log.messages import frames as fr

S = 1_000_000_000
CAN_MSGS_FRAME = (
    "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\n"
    "uint8 dlc\nuint8[8] data\n"
)


def write_session(path, frames_of_bus, **options):
    topics = {f"/can/{bus}": frames for bus, frames in frames_of_bus.items()}
    return write_frames(path, topics, **options)


@pytest.fixture(scope="module")
def session_of_every_kind(tmp_path_factory):
    frames = every_kind()
    return write_session(tmp_path_factory.mktemp("kinds") / "run.mcap", {"can0": frames}), frames


READERS = {
    ".log": can.CanutilsLogReader,
    ".blf": can.BLFReader,
    ".asc": lambda path: can.ASCReader(path, relative_timestamp=False),
}


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("fd", [False, True])
def test_python_can_reads_them(suffix, fd, tmp_path):
    frames = every_kind(fd=fd)
    source = write_frames(tmp_path / "run.mcap", {"/can_fd/can0" if fd else "/can/can0": frames})
    export_log(source, tmp_path / f"x{suffix}")
    with READERS[suffix](tmp_path / f"x{suffix}") as reader:
        messages = list(reader)
    times = [round(message.timestamp * 1e6) for message in messages]
    assert times == (frames["t_host_ns"] // 1000).tolist()
    for message, frame in zip(messages, frames, strict=True):
        id_flags = int(frame["id_flags"])
        assert message.is_fd == fd
        assert message.is_error_frame == bool(id_flags & fr.ERROR_FLAG)
        if message.is_error_frame:
            continue
        assert message.is_rx == (frame["dir"] == fr.DIR_RX)
        assert message.arbitration_id == id_flags & 0x1FFF_FFFF
        assert message.is_extended_id == bool(id_flags & fr.EXTENDED_FLAG)
        if fd:
            assert message.bitrate_switch == bool(frame["fd_flags"] & fr.FD_BRS)
            assert message.error_state_indicator == bool(frame["fd_flags"] & fr.FD_ESI)
        else:
            assert message.is_remote_frame == bool(id_flags & fr.REMOTE_FLAG)
            assert message.dlc == frame["dlc"]
        if not id_flags & fr.REMOTE_FLAG:
            assert bytes(message.data) == bytes(frame["data"][: frame["len" if fd else "dlc"]])


def blf_times(path):
    """Object times [ns since the file's start], read by the definition of the format."""
    data, inside, at = path.read_bytes(), b"", 144
    while at < len(data):
        signature, header, _, size, kind = struct.unpack_from("<4sHHII", data, at)
        assert (signature, kind) == (b"LOBJ", 10)
        method, _ = struct.unpack_from("<HxxxxxxI", data, at + header)
        body = data[at + header + 16 : at + size]
        inside += zlib.decompress(body) if method == 2 else body
        at += size + size % 4
    times, at = [], 0
    while at < len(inside):
        signature, _, _, size, _ = struct.unpack_from("<4sHHII", inside, at)
        assert signature == b"LOBJ"
        times.append(struct.unpack_from("<IHHQ", inside, at + 16)[3])
        at += size + size % 4
    return times


def test_a_blf_has_each_nanosecond(tmp_path):
    frames = every_kind(step_ns=12_345_679, start_ns=T0 + 7)
    frames["t_host_ns"][5] = frames["t_host_ns"][0] - 3 * S  # a time may go back
    frames["t_host_ns"][-1] += 3600 * S
    source = write_session(tmp_path / "run.mcap", {"can0": frames}, batch=len(frames))
    export_log(source, tmp_path / "x.blf")
    start_ns = int(frames["t_host_ns"].min()) // S * S
    assert blf_times(tmp_path / "x.blf") == (frames["t_host_ns"] - start_ns).tolist()
    header = struct.unpack_from("<8H", (tmp_path / "x.blf").read_bytes(), 40)
    assert header == (2023, 11, 2, 14, 22, 13, 20, 0)  # UTC, as python-can and Vector's library


def test_asc_has_no_clock_of_this_machine(tmp_path):
    source = write_session(tmp_path / "run.mcap", {"can0": every_kind()})
    export_log(source, tmp_path / "x.asc")
    text = (tmp_path / "x.asc").read_text()
    first, base, events, trigger, *_ = text.splitlines()
    assert first.replace("date", "Begin Triggerblock") == trigger
    assert (base, events) == ("base hex  timestamps absolute", "internal events logged")
    export_log(source, tmp_path / "x.asc", force=True)
    assert (tmp_path / "x.asc").read_text() == text


def test_what_no_format_but_candump_has_is_counted(tmp_path):
    frames = fr.empty_frames(3)
    frames["t_host_ns"], frames["id_flags"] = T0, [5, 6, 7]
    frames["dlc"], frames["t_device_ns"] = [11, 8, 8], [0, T0, 5]
    source = write_session(tmp_path / "run.mcap", {"can0": frames})
    device = "1 frame loses its device time"
    assert export_log(source, tmp_path / "x.log").warnings == [device]
    assert " can0 005#0000000000000000_B R\n" in (tmp_path / "x.log").read_text()
    assert export_log(source, tmp_path / "x.blf").warnings == [device]
    assert imported(tmp_path / "x.blf", tmp_path)[1]["dlc"].tolist() == [11, 8, 8]
    code = "1 data frame loses its length code"
    assert export_log(source, tmp_path / "x.asc").warnings == [code, device]


# -- ROS 2 ---------------------------------------------------------------------------------


def test_ros_messages_hold_everything(session_of_every_kind, tmp_path):
    source, frames = session_of_every_kind
    assert export_log(source, tmp_path / "x.mcap").warnings == []
    by_sequence = {}
    with (tmp_path / "x.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema.name == "can_msgs/msg/Frame"
            assert decoded.header.frame_id == "can0"
            stamp_ns = decoded.header.stamp.sec * S + decoded.header.stamp.nanosec
            assert message.log_time == message.publish_time == stamp_ns
            way = {"/can0/from_can_bus": fr.DIR_RX, "/can0/to_can_bus": fr.DIR_TX}[channel.topic]
            flags = decoded.is_extended * fr.EXTENDED_FLAG | decoded.is_rtr * fr.REMOTE_FLAG
            flags |= decoded.id | decoded.is_error * fr.ERROR_FLAG
            by_sequence[message.sequence] = (stamp_ns, flags, decoded.dlc, way, bytes(decoded.data))
    columns = [frames[name].tolist() for name in ("t_host_ns", "id_flags", "dlc", "dir")]
    assert by_sequence == dict(enumerate(zip(*columns, map(bytes, frames["data"]), strict=True)))


def test_rosbags_reads_them(session_of_every_kind, tmp_path):
    source, frames = session_of_every_kind
    export_log(source, tmp_path / "x.mcap")
    store = get_typestore(Stores.EMPTY)
    full = get_typestore(Stores.ROS2_HUMBLE)
    full.register(get_types_from_msg(CAN_MSGS_FRAME, "can_msgs/msg/Frame"))
    with AnyReader([tmp_path / "x.mcap"], default_typestore=store) as reader:
        read = [(t, full.deserialize_cdr(data, c.msgtype)) for c, t, data in reader.messages()]
    rows = [(t, message.id, bytes(message.data)) for t, message in read]
    columns = (frames["t_host_ns"], frames["id_flags"] & 0x1FFF_FFFF, map(bytes, frames["data"]))
    assert rows == list(zip(*columns, strict=True))


def test_names_that_a_format_has_not_are_reported(tmp_path):
    frames = every_kind()[:20]
    source = write_session(tmp_path / "run.mcap", {"can3": frames, "left-arm": frames, "0": frames})
    report = export_log(source, tmp_path / "x.mcap")
    names = {"0": "/can_0", "left-arm": "/left_arm"}
    lost = [f"topics can't be named after bus {b}: its are in {name}" for b, name in names.items()]
    assert report.warnings == lost
    warnings = export_log(source, tmp_path / "x.asc", bus="left-arm").warnings
    assert "it has no names: bus left-arm is channel 1" in warnings
    assert channel_numbers(["can3", "left-arm", "0", "can0", "can01"]) == [3, 1, 2, 0, 4]


@pytest.mark.parametrize(
    ("suffix", "words"), [(".blf", "written as received"), (".mcap", "on from_can_bus")]
)
def test_directions_that_are_none_are_reported(suffix, words, tmp_path):
    facts = {"import.directions": "none"}
    source = write_session(tmp_path / "run.mcap", {"can0": every_kind()[:20]}, **facts)
    warnings = export_log(source, tmp_path / f"x{suffix}").warnings
    assert f"no directions were recorded: all frames are {words}" in warnings


def test_a_trace_without_a_date(tmp_path):
    frames = every_kind(start_ns=100 * S)
    report = export_log(write_session(tmp_path / "run.mcap", {"can0": frames}), tmp_path / "x.blf")
    note = "its dates begin in 1990: the times are those since 1970, without a date"
    assert report.warnings[0] == note
    back = imported(tmp_path / "x.blf", tmp_path)[1]["t_host_ns"] - RELATIVE_EPOCH_NS
    assert back.tolist() == frames["t_host_ns"].tolist()


# -- several buses, a stretch at a time ----------------------------------------------------


@pytest.mark.parametrize("suffix", FRAME_SUFFIXES)
def test_stretches_make_no_difference(suffix, tmp_path, monkeypatch):
    rng = np.random.default_rng(1)
    buses = {}
    for bus in ("can0", "can1", "can2"):
        frames = every_kind()
        frames["t_host_ns"] = T0 + 1000 * np.sort(rng.integers(0, 9_000_000, len(frames)))
        buses[bus] = frames
    source = write_session(tmp_path / "run.mcap", buses, batch=3)
    whole = export_log(source, tmp_path / f"whole{suffix}")
    monkeypatch.setattr("undulog.capture.exchange.frame_log._MESSAGES_PER_BLOCK", 7)
    parts = export_log(source, tmp_path / f"parts{suffix}")
    assert whole == parts
    assert whole.facts["buses"] == dict.fromkeys(buses, len(every_kind()))
    assert (tmp_path / f"whole{suffix}").read_bytes() == (tmp_path / f"parts{suffix}").read_bytes()
    if suffix == ".log":
        times = [line.split()[0] for line in (tmp_path / "parts.log").read_text().splitlines()]
        assert times == sorted(times)
    for bus, frames in buses.items() if suffix != ".mcap" else ():
        back = imported(tmp_path / f"parts{suffix}", tmp_path, f"/can/{bus}")[1]
        keep = (frames["id_flags"] & fr.ERROR_FLAG) == 0
        for name in ("id_flags", "dlc", "data", "dir"):
            assert back[name][keep].tolist() == frames[name][keep].tolist()


# -- a real trace --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arcsnake(tmp_path_factory):
    if not RECORDING.exists():
        pytest.skip(f"the ArcSnake recording is not at {RECORDING}")
    path = tmp_path_factory.mktemp("arcsnake") / "run.mcap"
    import_can(RECORDING, path, load_robot("arcsnake-joint"))
    return path, frames_of(path)


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_a_real_trace_comes_back(suffix, arcsnake, tmp_path):
    path, frames = arcsnake
    report = export_log(path, tmp_path / f"x{suffix}")
    assert (report.facts["buses"], report.warnings) == ({"can0": 19_297}, [])
    back = imported(tmp_path / f"x{suffix}", tmp_path)[1]
    for name in ("id_flags", "dlc", "data", "dir"):
        np.testing.assert_array_equal(back[name], frames[name])
    start_ns = int(frames["t_host_ns"][0]) // S * S - RELATIVE_EPOCH_NS if suffix == ".asc" else 0
    np.testing.assert_array_equal(back["t_host_ns"] + start_ns, frames["t_host_ns"])


def test_a_real_trace_as_ros_messages(arcsnake, tmp_path):
    path, frames = arcsnake
    export_log(path, tmp_path / "x.mcap")
    with Session.open(tmp_path / "x.mcap") as session:
        assert session.warnings == []
        for topic, way in (("/can0/from_can_bus", fr.DIR_RX), ("/can0/to_can_bus", fr.DIR_TX)):
            table, of_way = session.table(topic), frames[frames["dir"] == way]
            assert table.index.tolist() == of_way["t_host_ns"].tolist()
            assert table["id"].tolist() == of_way["id_flags"].tolist()
            assert table["dlc"].tolist() == of_way["dlc"].tolist()
            data = table[[f"data[{k}]" for k in range(8)]].to_numpy()
            np.testing.assert_array_equal(data, of_way["data"])


# -- the command ------------------------------------------------------------------------------


def test_the_verb_lists_what_is_lost(session_of_every_kind, tmp_path, command):
    (source, frames), output = session_of_every_kind, tmp_path / "x.blf"
    export = ("log", "export", source, "-o", output)
    loss = "18 error frames lose their direction"
    done = f"{output}: {len(frames)} frames of can0, in the format of Vector BLF"
    assert command(*export).out == f"{done}\n  warning: {loss}\n"
    report = json.loads(command(*export, "--force", "--json").out)
    assert (report["warnings"], report["buses"]) == ([loss], {"can0": len(frames)})
    refused = command(*export, "--force", "--topics", "/x", code=2).err
    assert "--topics is for tables and layouts; a .blf file has CAN frames" in refused


def test_a_session_is_not_replaced_by_its_export(tmp_path):
    source = write_session(tmp_path / "run.mcap", {"can0": every_kind()[:1]})
    with pytest.raises(UsageError, match="is the session itself"):
        export_log(source, source, force=True)
