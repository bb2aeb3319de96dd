"""``undulog record`` as its users run it: a process, real sockets, real signals, a full disk."""

import json
import os
import shutil
import signal
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from support import recorders
from support.paths import ROOT
from support.processes import run, wait_for
from support.recorders import connected_sender, ended, events, polling, recording, send
from support.written_frames import frames_of
from undulog.capture import Session
from undulog.capture.common.process import StopRequest
from undulog.capture.log.health.session_check import check_session
from undulog.capture.recorder.control_client import ControlClient
from undulog.capture.recorder.health import LiveHealth
from undulog.capture.recorder.recording import RunningRecording
from undulog.capture.recorder.settings import resolve

FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")


def ask(output, **request):
    """One request over the control socket."""
    with ControlClient(output.with_name("control.sock")) as client:
        return client.ask(request)


@pytest.fixture
def output(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture
def bus(tmp_path):
    return tmp_path / "bus.sock"


# -- sources ---------------------------------------------------------------------------------


def test_frames_come_back_exactly_and_mean_what_the_map_says(output, bus):
    frames, hundredths = polling(40)
    with recording(output, f"can0=unix:{bus}", "--robot", "snake25") as process:
        send(bus, frames)
        wait_for(lambda: ask(output, do="status")["sources"][0]["frames"] == len(frames))
        ask(output, do="stop", wait=True)
        report, _ = ended(process)
    assert process.returncode == 0
    assert report["sources"]["can0"]["frames"] == len(frames)
    with Session.open(output) as session:
        kept = session.frames("/can/can0")
        for field in ("t_device_ns", "id_flags", "dlc", "dir", "data"):
            np.testing.assert_array_equal(kept[field], frames[field], err_msg=field)
        assert (np.diff(kept["t_host_ns"].astype(np.int64)) >= 0).all()
        states, commands = map(session.joints, ("/joint_states", "/joint_commands"))
        for k, (measured, commanded) in enumerate(zip(states.values, commands.values, strict=True)):
            mine = np.deg2rad(hundredths.reshape(-1, 25, 2)[:, k] / 100)
            np.testing.assert_allclose(commanded, mine[:, 0], rtol=0, atol=1e-12)
            np.testing.assert_allclose(measured, mine[:, 1], rtol=0, atol=1e-12)
        # All samples are on one clock: device times, shifted by one offset and a small drift.
        device = frames["t_device_ns"].reshape(-1, 25, 2)
        shift = np.array([states.t_ns[k] - device[:, k, 1].astype(np.int64) for k in range(25)])
        assert np.ptp(shift) < 20_000_000
        assert int(session.metadata["undulog.clock"]["can0.samples"]) == len(frames)
        references = session.table("/clock/can0")
        device_ns = references["time_ref.sec"] * 10**9 + references["time_ref.nanosec"]
        assert np.isin(device_ns, frames["t_device_ns"]).all()


@pytest.mark.slow
def test_unknown_identifiers_and_losses_are_reported_and_the_verdict_is_that_of_a_check(
    output, bus
):
    frames, _ = polling(300)
    frames = np.delete(frames, slice(5000, 7000))
    frames["id_flags"][::50] = 0x7AB
    unknown = len(frames[::50])
    with recording(output, f"can0=unix:{bus}", "--robot", "snake25") as process:
        send(bus, frames)
        report, _ = ended(process, signal.SIGTERM)
    health = check_session(output)
    assert report["verdict"] == health.verdict == health.stored != "good"
    assert tuple(report["reasons"]) == health.reasons == health.stored_reasons
    text = "identifiers that are in no database: 7AB"
    reported = {("can0", text), ("can0", f"{unknown} frames with {text} ({unknown})")}
    assert reported <= {*events(output)}
    assert (frames_of(output)["id_flags"] == 0x7AB).sum() == unknown


@pytest.mark.slow
def test_the_twin_brings_its_robot_and_ends_by_itself(tmp_path):
    output = tmp_path / "twin.mcap"
    options = ("--fast", "--duration", "4s", "--json", "--floor", "0")
    report = json.loads(run(*recorders.command(output, "twin:flat"), *options, cwd=ROOT).stdout)
    assert (report["robot"], report["ended"]) == ("snake25", "all sources have ended")
    with Session.open(output) as session:
        states = session.joints("/joint_states")
        np.testing.assert_array_equal(np.diff(states.t_ns[0]), 10_000_000)
        assert len(states.t_ns[0]) == report["sources"]["flat"]["frames"] == 401
        assert {"scenario.toml", "robot.urdf", "robot.toml"} <= set(session.attachments)


# -- the end ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
        signal.SIGTERM,
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
    ],
)
def test_a_signal_leaves_a_whole_file(number, tmp_path, output, bus):
    with recording(output, f"unix:{bus}") as process, connected_sender(bus):
        report, err = ended(process, number)
    assert (process.returncode, err) == (0, "")
    assert report["ended"] == f"{number.name} was received"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap"]
    assert check_session(output).file.indexed


@pytest.mark.slow
def test_a_mistake_in_what_looks_on_does_not_end_the_recording(output, bus, monkeypatch):
    def fails(self, now_ns):
        raise ZeroDivisionError(f"at {now_ns}")

    monkeypatch.setattr(LiveHealth, "step", fails)
    given = {"sources": (f"can0=unix:{bus}",), "output": output, "robot": "snake25"}
    given |= {"duration": 2.5, "floor": 0, "socket": output.with_name("control.sock")}
    settings = resolve(given, {})
    frames, _ = polling(100)
    sender = threading.Thread(target=send, args=(bus, frames))
    sender.start()
    report = RunningRecording(settings, StopRequest()).run()
    sender.join()
    assert not report.ending.failed
    assert len(frames_of(output)) == len(frames)
    with Session.open(output) as session:
        assert len(session.joints("/joint_states").t_ns[0]) == 100
        assert session.verdict == "degraded"
    assert any("live health is given up" in text for _, text in events(output))


@pytest.mark.parametrize(
    ("existing", "floor", "code", "fault"),
    [
        ("bus.sock", "0", 1, "is no socket"),
        ("run.mcap", "0", 2, "exists already"),
        (None, "900TB", 1, "less than the floor"),
    ],
    ids=["a source that can never work", "an existing output", "no space to begin with"],
)
def test_what_can_not_be_recorded_leaves_no_file(
    existing, floor, code, fault, *, tmp_path, command
):
    output, bus = tmp_path / "run.mcap", tmp_path / "bus.sock"
    if existing is not None:
        (tmp_path / existing).write_text("precious")
    words = (f"unix:{bus}", "-o", output, "--socket", tmp_path / "control.sock", "--floor", floor)
    assert fault in command("record", *words, code=code).err
    left = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert left == ({} if existing is None else {existing: "precious"})


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["cam:0"], "no kind of source 'cam'"),
        (["unix:/tmp/a.sock", "unix:/tmp/b.sock", "--robot", "snake25"], "--bus NAME"),
        (["unix:/tmp/a.sock", "--bus", "b"], "no such bus"),
        (["twin:flat", "--robot", "snake13"], "brings the robot snake25"),
        (["unix:/tmp/a.sock", "--fast"], "--fast"),
        (["unix:/tmp/a.sock", "--split-size", "many"], "--split-size"),
    ],
)
def test_wrong_usage_is_reported_before_anything_is_made(arguments, fault, tmp_path, command):
    output = ("-o", tmp_path / "run.mcap", "--socket", tmp_path / "control.sock")
    assert fault in command("record", *arguments, *output, code=2).err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("floor", ["10MB", "0"], ids=["floor", "to the last byte"])
def test_a_full_disk_ends_the_recording_in_good_order(floor, disk_of, tmp_path, opened):
    output, bus = disk_of("64m") / "run.mcap", tmp_path / "bus.sock"
    rng = np.random.default_rng(0)
    frames, _ = polling(400)
    sent = []
    with recording(output, f"can0=unix:{bus}", floor=floor) as process:
        wait_for(bus.exists, "the source's socket")
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sender:
            sender.connect(str(bus))
            while process.poll() is None:
                frames["data"] = rng.integers(0, 256, frames["data"].shape)  # no compression
                for start in range(0, len(frames), 250):
                    try:
                        sender.send(frames[start : start + 250].tobytes())
                    except OSError:
                        break
                    sent.append(frames[start : start + 250].copy())
        report, err = ended(process)
    assert process.returncode == 1, err  # not -SIGBUS
    assert "MB" in err or "space" in err
    assert report["failed"]
    kept = frames_of(output)
    assert opened(output).verdict is not None
    assert check_session(output).file.indexed
    sent = np.concatenate(sent)
    for field in ("t_device_ns", "id_flags", "data"):
        np.testing.assert_array_equal(kept[field], sent[field][: len(kept)], err_msg=field)
    assert len(kept) > 100_000


# -- time --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.clock(0.1, "the wall clock that is set is the operating system's")
def test_a_wall_clock_that_is_set_changes_no_order_and_no_duration(tmp_path, output, bus):
    if not FAKETIME.exists():
        assert not os.environ.get("UNDULOG_REQUIRE_ALL_TESTS"), "faketime is not installed"
        pytest.skip(f"{FAKETIME} is not installed")
    wall = tmp_path / "wall"
    wall.write_text("+0\n")
    env = os.environ | {
        "LD_PRELOAD": str(FAKETIME),
        "FAKETIME_TIMESTAMP_FILE": str(wall),
        "FAKETIME_NO_CACHE": "1",
        "DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_FORCE_MONOTONIC_FIX": "0",
    }
    frames, _ = polling(500)
    with recording(output, f"can0=unix:{bus}", "--robot", "snake25", env=env) as process:
        wait_for(bus.exists, "the source's socket")
        began = time.monotonic()
        send(bus, frames[:8000], stamp_ns=time.monotonic_ns)
        wall.write_text("+3600\n")
        send(bus, frames[8000:16000], stamp_ns=time.monotonic_ns)
        wall.write_text("-3600\n")
        send(bus, frames[16000:], stamp_ns=time.monotonic_ns)
        took_s = time.monotonic() - began
        ended(process, signal.SIGINT)
    with Session.open(output) as session:
        kept = session.frames("/can/can0")
        np.testing.assert_array_equal(kept["t_device_ns"], frames["t_device_ns"])
        host = kept["t_host_ns"].astype(np.int64)
        assert (np.diff(host) >= 0).all()
        assert np.ptp(host) * 1e-9 == pytest.approx(took_s, abs=0.15)
        assert session.duration_s == pytest.approx(took_s, abs=3.0)
        for topic in ("/joint_states", "/joint_commands"):
            t_ns = session.joints(topic).t_ns
            assert all((np.diff(t) > 0).all() for t in t_ns)
            assert np.ptp(t_ns[0]) * 1e-9 == pytest.approx(took_s, abs=0.15)
        assert not [warning for warning in session.warnings if "back" in warning]


# -- while it runs --------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_split_session_is_one_session(tmp_path, output, bus, opened):
    frames, _ = polling(300)
    with recording(output, f"can0=unix:{bus}", "--robot", "snake25") as process:
        send(bus, frames[:7500])
        assert ask(output, do="split")["part"] == 2
        send(bus, frames[7500:])
        report, _ = ended(process, signal.SIGINT)
    assert [Path(file).name for file in report["files"]] == ["run.mcap", "run_0002.mcap"]
    for named in (output, tmp_path / "run_0002.mcap"):
        with Session.open(named) as session:
            kept = session.frames("/can/can0")
            np.testing.assert_array_equal(kept["t_device_ns"], frames["t_device_ns"])
            assert session.warnings == []
    shutil.move(output, tmp_path / "elsewhere")
    assert any("part" in warning for warning in opened(tmp_path / "run_0002.mcap").warnings)
