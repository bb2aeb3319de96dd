"""CAN FD frames: kept exactly, on a topic of their own, from and to other tools."""

import threading
import time

import can
import cantools
import numpy as np
import pytest
from can.util import CAN_FD_DLC
from hypothesis import given, settings
from hypothesis import strategies as st

from support.bus_robots import bus_robot
from support.imported import export_file as export_log
from support.imported import import_can
from support.read_back import decoded_of
from support.written_frames import T0, every_kind, frames_of, imported, log_messages, write_frames
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import DataError
from undulog.capture.common.process import StopRequest
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages import frames as fr
from undulog.capture.recorder.loop import Ending, Recorder
from undulog.capture.recorder.status import SessionClock
from undulog.capture.sources.contract import SourceContext, open_source, parse_address

S = 1_000_000_000
FD = "/can_fd/can0"
FIELDS = ("t_host_ns", "id_flags", "len", "dir", "fd_flags", "data")


def classic_frames(count, start_ns, step_ns):
    frames = fr.empty_frames(count)
    frames["t_host_ns"] = start_ns + step_ns * np.arange(count)
    frames["id_flags"], frames["dlc"] = np.arange(count) % 0x800, 8
    frames["data"] = np.random.default_rng(1).integers(0, 256, (count, 8))
    return frames


def same(frames, expected, fields=FIELDS):
    for name in fields:
        np.testing.assert_array_equal(frames[name], expected[name], name)


# -- the log -------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_what_is_written_is_read_the_same(data, tmp_path_factory):
    sizes = data.draw(st.lists(st.integers(1, 9), min_size=1, max_size=6))
    raw = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    frames = np.frombuffer(raw.bytes(sum(sizes) * 88), fr.empty_fd_frames(0).dtype)
    path = tmp_path_factory.mktemp("fd") / "x.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=T0) as writer:
        channel = writer.fd_frames("/can_fd/can0")
        ends = np.cumsum(sizes)
        for k, (size, end) in enumerate(zip(sizes, ends, strict=True)):
            channel.write(T0 + k, frames[end - size : end])
    with Session.open(path) as session:
        assert session.fd_frames("/can_fd/can0").tobytes() == frames.tobytes()
        window = session.fd_frames("/can_fd/can0", start_ns=T0 + 1, stop_ns=T0 + 2)
        assert window.tobytes() == frames[ends[0] : ends[0] + [*sizes, 0][1]].tobytes()


def test_a_foreign_reader_finds_the_record_by_its_label(tmp_path):
    frames = every_kind(fd=True)[:5]
    path = write_frames(tmp_path / "x.mcap", {FD: frames})
    ((topic, _, message),) = decoded_of(path)
    frame, record = message.layout.dim
    assert (topic, frame.label, frame.size) == ("/can_fd/can0", "frame", 5)
    assert (record.label, record.size) == (fr.FD_FRAME_LAYOUT, 88)
    # The label, taken by its word, is the layout.
    at, offsets = 0, {}
    for part in record.label.split(","):
        name, kind = part.split(":")
        offsets[name] = at
        at += int(kind[1:]) // 8 if kind.startswith("u") else int(kind)
    assert at == 88
    data = bytes(message.data)
    for k, expected in enumerate(frames):
        row = data[88 * k : 88 * (k + 1)]
        assert int.from_bytes(row[offsets["id_flags"] :][:4], "little") == expected["id_flags"]
        assert row[offsets["len"]] == expected["len"]
        assert row[offsets["fd_flags"]] == expected["fd_flags"]
        assert row[offsets["data"] :] == expected["data"].tobytes()


def test_the_kinds_are_not_mixed_up(tmp_path):
    # 4 CAN FD frames have as many bytes as 11 classic ones: the label tells them apart.
    topics = {"/can_fd/can0": every_kind(fd=True)[:4], "/can/can0_fd": classic_frames(11, T0, 1000)}
    path = write_frames(tmp_path / "x.mcap", topics)
    with Session.open(path) as session:
        with pytest.raises(DataError, match="/can_fd/can0 does not hold frames of 32 bytes"):
            session.frames("/can_fd/can0")
        with pytest.raises(DataError, match="/can/can0_fd does not hold frames of 88 bytes"):
            session.fd_frames("/can/can0_fd")
        assert len(session.frames("/can/can0_fd")) == 11
    with SessionWriter(tmp_path / "y.mcap", session_id="s", epoch_ns=T0) as writer:
        with pytest.raises(DataError, match="frames have the layout"):
            writer.fd_frames("/can_fd/can0").write(T0, fr.empty_frames(1))
        with pytest.raises(DataError, match="frames have the layout"):
            writer.frames("/can/can0").write(T0, fr.empty_fd_frames(1))


def test_the_check_counts_them(tmp_path, command):
    # The classic frames pause for 3 s in which CAN FD frames come: the bus isn't silent.
    classic = classic_frames(200, T0, 10_000_000)
    classic["t_host_ns"][100:] += 3 * S
    fd = every_kind(fd=True, step_ns=10_000_000)
    path = write_frames(tmp_path / "x.mcap", {"/can/can0": classic, "/can_fd/can0": fd})
    health = check_session(path)
    by_topic = {bus.topic: (bus.frames, bus.rate_hz) for bus in health.buses}
    assert by_topic.keys() == {"/can/can0", FD}
    assert (by_topic["/can/can0"][0], by_topic[FD]) == (200, (len(fd), pytest.approx(100)))
    text = " ".join(finding.sentence for finding in health.findings)
    assert "silent" not in text
    assert "can't be read" not in text
    alone = write_frames(tmp_path / "y.mcap", {"/can/can0": classic, "/can_fd/can1": fd})
    sentences = [finding.sentence for finding in check_session(alone).findings]
    (silence,) = (sentence for sentence in sentences if "silent" in sentence)
    assert silence.startswith("/can/can0: silent for 3.01 s, at ")
    assert f"  {len(fd)} frames\n" in command("log", "info", path).out
    checked = command("log", "check", path).out
    assert f"/can_fd/can0: {len(fd)} frames, 100.0 Hz, 0 error frames" in checked


# -- other tools ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session_of_every_kind(tmp_path_factory):
    frames = every_kind(fd=True)
    folder = tmp_path_factory.mktemp("kinds")
    return write_frames(folder / "run.mcap", {"/can_fd/can0": frames}), frames


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_frames_of_every_kind_come_back(suffix, session_of_every_kind, tmp_path):
    source, frames = session_of_every_kind
    report = export_log(source, tmp_path / f"x{suffix}")
    assert (report.facts["buses"], report.warnings) == ({"can0": len(frames)}, [])
    _, back = imported(tmp_path / f"x{suffix}", tmp_path, FD)
    expected = frames.copy()
    if suffix == ".asc":  # without the date
        expected["t_host_ns"] -= np.uint64(T0 // S * S - RELATIVE_EPOCH_NS)
    same(back, expected)


def some_messages(channel=0):
    """CAN FD and classic frames by turns, as python-can has them, one a millisecond."""
    rng = np.random.default_rng(5)
    return [
        can.Message(
            timestamp=T0 / S + i * 1e-3,
            arbitration_id=0x18FEF100 + i if i % 2 else 0x100 + i,
            is_extended_id=i % 2 == 1,
            is_fd=i % 3 != 0,
            bitrate_switch=i % 3 == 1,
            error_state_indicator=i % 4 == 1 and i % 3 != 0,
            is_rx=i % 5 != 0,
            data=rng.bytes(CAN_FD_DLC[i % 16] if i % 3 else i % 9),
            channel=channel,
        )
        for i in range(480)
    ]


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".asc.gz"])
def test_logs_of_python_can(suffix, tmp_path):
    messages = some_messages()
    report, frames = imported(log_messages(tmp_path / f"log{suffix}", messages), tmp_path, FD)
    fd = [message for message in messages if message.is_fd]
    assert report.frames == len(messages)
    assert report.problems == ["nothing decoded: the robot snake13 has no bus map"]
    assert len(frames_of(report.output)) == len(messages) - len(fd)
    start_ns = T0 - RELATIVE_EPOCH_NS if ".asc" in suffix else 0
    expected = records_of(fd)
    expected["t_host_ns"] -= np.uint64(start_ns)
    same(frames, expected)


def records_of(messages):
    frames = fr.empty_fd_frames(len(messages))
    for frame, message in zip(frames, messages, strict=True):
        frame["t_host_ns"] = round(message.timestamp * 1e6) * 1000
        frame["id_flags"] = message.arbitration_id
        frame["id_flags"] |= fr.EXTENDED_FLAG if message.is_extended_id else 0
        frame["len"], frame["dir"] = len(message.data), fr.DIR_RX if message.is_rx else fr.DIR_TX
        frame["fd_flags"] |= fr.FD_BRS if message.bitrate_switch else 0
        frame["fd_flags"] |= fr.FD_ESI if message.error_state_indicator else 0
        frame["data"][: len(message.data)] = list(message.data)
    return frames


def test_an_mf4_of_python_can(tmp_path):
    pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
    messages = some_messages()
    log_messages(tmp_path / "x.mf4", messages)
    report, frames = imported(tmp_path / "x.mf4", tmp_path, FD)
    fd = [message for message in messages if message.is_fd]
    assert report.frames == len(messages)
    same(frames, records_of(fd), [name for name in FIELDS if name != "t_host_ns"])
    truth_ns = [round(message.timestamp * 1e6) * 1000 for message in fd]
    assert np.abs(frames["t_host_ns"].astype(np.int64) - truth_ns).max() <= 1000
    classic = frames_of(report.output)
    others = [message for message in messages if not message.is_fd]
    assert classic["dlc"].tolist() == [message.dlc for message in others]
    assert [bytes(f["data"][: f["dlc"]]) for f in classic] == [bytes(m.data) for m in others]


TRC = """;$FILEVERSION=2.1
;$STARTTIME=45243.9317
;$COLUMNS=N,O,T,B,I,d,R,L,D
      1      1059.900 DT 1     0300 Rx -  7    00 00 00 00 04 00 00
      2      1283.231 FD 1     0300 Rx -  8    00 00 00 00 04 00 00 07
      3      1298.945 FB 1     0400 Tx -  9    00 00 00 00 00 00 00 00 00 00 00 0C
      4      1323.201 FE 1 18FEF100 Rx -  15   {}
      5      1334.416 BI 1     0500 Rx -  0
"""


def test_a_trc_of_version_2(tmp_path):
    (tmp_path / "x.trc").write_text(TRC.format(" ".join(f"{k:02X}" for k in range(64))))
    report, frames = imported(tmp_path / "x.trc", tmp_path, "/can_fd/can1")
    assert report.frames == 5
    assert frames["id_flags"].tolist() == [0x300, 0x400, 0x18FEF100 | fr.EXTENDED_FLAG, 0x500]
    assert frames["len"].tolist() == [8, 12, 64, 0]
    assert frames["fd_flags"].tolist() == [0, fr.FD_BRS, fr.FD_BRS | fr.FD_ESI, fr.FD_ESI]
    assert frames["dir"].tolist() == [fr.DIR_RX, fr.DIR_TX, fr.DIR_RX, fr.DIR_RX]
    assert frames["data"][2].tolist() == list(range(64))
    assert frames["data"][1].tolist() == [0] * 11 + [12] + [0] * 52


def test_a_csv_shows_can_fd_by_the_length_alone(tmp_path):
    messages = some_messages()
    log_messages(tmp_path / "x.csv", messages)
    report, frames = imported(tmp_path / "x.csv", tmp_path, FD)
    long = [message for message in messages if len(message.data) > 8]
    assert report.problems[0] == (
        f"{len(long)} frames of more than 8 bytes are CAN FD frames; the log does not mark them, "
        "and shorter ones count as classic"
    )
    payloads = [bytes(frame["data"][: frame["len"]]) for frame in frames]
    assert payloads == [bytes(message.data) for message in long]


def test_a_candump_log_of_both_kinds_comes_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(9)
    text = "".join(
        f"(1717639553.{i:06d}) {'vcan1' if i % 7 == 0 else 'can0'} {i % 0x800:03X}"
        + (f"##{i % 16:X}{rng.bytes(CAN_FD_DLC[i % 16]).hex().upper()}" if i % 3 else "#0102 "[:5])
        + f" {'RT'[i % 2]}\n"
        for i in range(3000)
    )
    (tmp_path / "x.log").write_text(text)
    import_can(tmp_path / "x.log", tmp_path / "run.mcap", load_robot("snake13"))
    report = export_log(tmp_path / "run.mcap", tmp_path / "back.log")
    assert (tmp_path / "back.log").read_text() == text
    assert report.facts["buses"] == {"can0": 3000 - 429, "vcan1": 429}
    report = export_log(tmp_path / "run.mcap", tmp_path / "one.log", bus="vcan1")
    expected = [line for line in text.splitlines() if " vcan1 " in line]
    assert (tmp_path / "one.log").read_text().splitlines() == expected


def test_can_msgs_have_no_can_fd(session_of_every_kind, tmp_path):
    frames = every_kind(fd=True)
    topics = {"/can_fd/can0": frames, "/can/can0": classic_frames(50, T0, 1000)}
    report = export_log(write_frames(tmp_path / "run.mcap", topics), tmp_path / "x.mcap")
    assert report.facts["buses"] == {"can0": 50}
    left_out = f"{len(frames)} CAN FD frames left out: the format has 8 bytes a frame"
    assert report.warnings == [left_out]
    report = export_log(session_of_every_kind[0], tmp_path / "y.mcap")
    assert (report.facts["buses"], report.warnings) == ({"can0": 0}, [left_out])


def test_what_a_format_loses_is_counted(tmp_path):
    frames = every_kind(fd=True, start_ns=T0 + 7)[:10]
    frames["id_flags"][:3] |= fr.REMOTE_FLAG  # there is no such thing in CAN FD
    frames["t_device_ns"] = frames["t_host_ns"] + 5
    source = write_frames(tmp_path / "run.mcap", {"/can_fd/can0": frames})
    assert export_log(source, tmp_path / "x.asc").warnings == [
        "3 CAN FD frames lose their flags",
        "10 CAN FD frames lose their time below 1 us",
        "10 frames lose their device time",
    ]


# -- decoding ------------------------------------------------------------------------------

BIG = """VERSION ""

BU_: a b

BO_ 256 big: 64 a
 SG_ angle : 500|12@1- (0.1,0) [0|0] "deg" b
 SG_ torque : 131|16@0- (0.01,0) [0|0] "N m" b

BO_ 257 small: 2 a
 SG_ target : 0|16@1- (0.01,0) [0|0] "deg" b
"""

SIGNALS = [
    ("big", "angle", "rx", "position", "deg", ""),
    ("big", "torque", "rx", "effort", "N m", ""),
    ("small", "target", "tx", "command", "deg", ""),
]


def test_import_decodes_both_kinds(tmp_path):
    database = cantools.database.load_string(BIG, "dbc")
    lines, angles, targets = [], [], []
    for i in range(200):
        angle, target = (i - 100) * 1.5, i * 0.25
        big = database.encode_message("big", {"angle": angle, "torque": i * 0.01})
        small = database.encode_message("small", {"target": target})
        lines.append(f"(1717639553.{1000 * i:06d}) can0 101#{small.hex()} T\n")
        lines.append(f"(1717639553.{1000 * i + 500:06d}) can0 100##1{big.hex()} R\n")
        angles.append(angle)
        targets.append(target)
    (tmp_path / "x.log").write_text("".join(lines))
    robot = bus_robot(BIG, SIGNALS)
    assert import_can(tmp_path / "x.log", tmp_path / "run.mcap", robot).problems == []
    with Session.open(tmp_path / "run.mcap") as session:
        state = session.joints("/joint_states").signal("joint01")
        effort = session.joints("/joint_states", "effort").signal("joint01")
        command = session.joints("/joint_commands").signal("joint01")
    assert np.degrees(state.values) == pytest.approx(angles, abs=1e-9)
    assert effort.values == pytest.approx(np.arange(200) * 0.01, abs=1e-12)
    assert np.degrees(command.values) == pytest.approx(targets, abs=1e-9)
    assert (state.t_ns - command.t_ns).tolist() == [500_000] * 200


def test_a_frame_too_short_for_its_signal_is_reported(tmp_path):
    lines = ("(1.000000) can0 100##1" + "00" * 48, "(1.000100) can0 100#" + "00" * 8)
    (tmp_path / "x.log").write_text("".join(f"{line} R\n" for line in lines))
    report = import_can(tmp_path / "x.log", tmp_path / "run.mcap", bus_robot(BIG, SIGNALS))
    short = "3 values missing from frames too short for them: big.angle (2), big.torque (1)"
    assert report.problems == [short]


# -- recording -----------------------------------------------------------------------------


@pytest.mark.clock(0.02, "the device's clock has to run with this computer's for a mapping")
def test_a_recording_keeps_and_decodes_both_kinds(tmp_path):
    database = cantools.database.load_string(BIG, "dbc")
    robot = bus_robot(BIG, SIGNALS)
    output, clock, count = tmp_path / "run.mcap", SessionClock(), 300
    bus = can.Bus(interface="virtual", channel="fd", ignore_config=True, preserve_timestamps=True)
    messages, plain = [], {"is_extended_id": False}
    for i in range(count):
        target = database.encode_message("small", {"target": -i * 0.25})
        state = database.encode_message("big", {"angle": i * 0.5, "torque": i * 0.01})
        fast = {"is_fd": True, "bitrate_switch": True}
        messages.append(can.Message(arbitration_id=257, is_rx=False, data=target, **plain))
        messages.append(can.Message(arbitration_id=256, data=state, **fast, **plain))

    def send():
        begun = time.monotonic()
        for message in messages:
            message.timestamp = 1000 + round(time.monotonic() - begun, 6)
            bus.send(message)
            time.sleep(0.0005)

    def end():
        if source.counts.frames >= 2 * count:
            recorder.ending = Ending("all came")

    source = open_source(parse_address("front=can:virtual:fd?device_time=1&preserve_timestamps=1"))
    with SessionWriter(output, session_id="s", epoch_ns=clock.epoch_ns, robot=robot) as writer:
        recorder = Recorder(
            writer=writer,
            clock=clock,
            sources=[source],
            context=SourceContext(clock.now_ns, writer),
            robot=robot,
            decoded="front",
            each_tick=[end],
        )
        sender = threading.Thread(target=send)
        recorder.on_event(lambda *event: "connected" in event[3] and sender.start())
        recorder.run(StopRequest(), 60.0)
        sender.join()
    bus.shutdown()
    assert source.counts.frames == 2 * count
    with Session.open(output) as session:
        classic, frames = session.frames("/can/front"), session.fd_frames("/can_fd/front")
        state = session.joints("/joint_states").signal("joint01")
        command = session.joints("/joint_commands").signal("joint01")
    assert len(classic) == count
    truth = records_of([message for message in messages if message.is_fd])
    same(frames, truth, ("id_flags", "len", "dir", "fd_flags", "data"))
    assert frames["t_device_ns"].tolist() == truth["t_host_ns"].tolist()
    assert np.degrees(state.values) == pytest.approx(np.arange(count) * 0.5, abs=1e-9)
    assert np.degrees(command.values) == pytest.approx(np.arange(count) * -0.25, abs=1e-9)
    # One clock maps both kinds, in the order in which they were on the bus.
    assert recorder.clocks["front"].result().resets == 0
    device_ns = (frames["t_device_ns"] - classic["t_device_ns"]).astype(np.int64)
    assert np.median(np.abs(state.t_ns - command.t_ns - device_ns)) < 500_000
