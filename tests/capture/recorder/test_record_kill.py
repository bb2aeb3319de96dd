"""kill -9 at random moments, under load: whatever was accepted 50 ms before is in the session.

The senders are other processes, and their own logs say what the recorder's socket accepted and
when; what is in the session is held against those logs and against the frames they made.
"""

import os
import random
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from support.paths import ROOT
from support.processes import run, wait_for
from undulog.capture import Session

SENDER = ROOT / "bench" / "bus_sender.py"

SAFE_NS = 50_000_000
RATE = 3000  # frames a second and bus: a loaded machine must still keep up


def accepted_before(log, moment_ns):
    """Frames that a sender had logged as accepted before a moment."""
    data = log.read_bytes()
    rows = np.frombuffer(data[: len(data) // 16 * 16], dtype="<u8").reshape(-1, 2)
    rows = rows[rows[:, 0] < moment_ns]
    return int(rows[-1, 1]) if len(rows) else 0


def record_and_kill(folder, seed, *options):
    """Record two buses, kill the recorder; the session, and what each sender had accepted."""
    chance = random.Random(seed)
    session = folder / "run.mcap"
    sockets = [folder / f"{name}.sock" for name in ("front", "rear")]
    command = [sys.executable, "-m", "undulog", "record", *(f"unix:{path}" for path in sockets)]
    command += ["--robot", "snake25", "--bus", "front", "-o", str(session), "--floor", "0"]
    started = []
    try:
        with (folder / "recorder.err").open("wb") as errors:
            recorder = subprocess.Popen(
                [*command, *options, "--quiet", "--socket", str(folder / "control.sock")],
                cwd=ROOT,
                stderr=errors,
            )
        started.append(recorder)
        logs = [path.with_suffix(".accepted") for path in sockets]
        for path, log in zip(sockets, logs, strict=True):
            sender = [sys.executable, str(SENDER), "unix", str(path), "--rate", str(RATE)]
            started.append(
                subprocess.Popen(
                    [*sender, "--seconds", "120", "--log", str(log)],
                    cwd=ROOT,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )

        def under_load():
            assert recorder.poll() is None, (folder / "recorder.err").read_text()
            return all(log.exists() and log.stat().st_size >= 16 * 50 for log in logs)

        wait_for(under_load, "the senders")
        time.sleep(chance.uniform(0.0, 2.0))
        killed_ns = time.monotonic_ns()
        os.kill(recorder.pid, signal.SIGKILL)
        recorder.wait(timeout=30)
    finally:
        for process in started:
            if process.poll() is None:
                process.kill()
            process.wait(timeout=30)
    return session, [accepted_before(log, killed_ns - SAFE_NS) for log in logs]


def check_frames(session, accepted):
    for name, least in zip(("front", "rear"), accepted, strict=True):
        frames = session.frames(f"/can/{name}")
        assert len(frames) >= least, (name, len(frames), least, session.warnings)
        number = np.rint((frames["t_device_ns"] - frames["t_device_ns"][0]) * (RATE / 1e9))
        np.testing.assert_array_equal(number, np.arange(len(frames)), err_msg=name)
        wide = frames["dlc"] >= 4  # these carry the sender's counter
        carried = frames["data"][wide, 2:4].copy().view("<u2")[:, 0]
        np.testing.assert_array_equal(carried, np.flatnonzero(wide) % 65536, err_msg=name)


def check_kill(folder, seed, *options):
    path, accepted = record_and_kill(folder, seed, *options)
    before = {file: file.read_bytes() for file in folder.rglob("*.mcap")}
    with Session.open(path) as session:
        check_frames(session, accepted)
        assert any("recover" in warning for warning in session.warnings)
    assert {file: file.read_bytes() for file in folder.rglob("*.mcap")} == before
    repaired = folder / "repaired.mcap"
    undulog = [sys.executable, "-m", "undulog"]
    subprocess.run(
        [*undulog, "log", "recover", str(path), "-o", str(repaired)],
        check=True,
        cwd=ROOT,
        capture_output=True,
    )
    with Session.open(repaired) as session:
        check_frames(session, accepted)
    files = sorted(folder.glob("repaired*.mcap"))
    for file in files:
        counts = {}
        with file.open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages():
                counts[channel.topic] = counts.get(channel.topic, 0) + 1
                if channel.topic.startswith("/can/"):
                    assert struct.unpack_from("<I", message.data, 4)[0] == 2  # dimensions
        with AnyReader([file]) as reader:
            assert {c.topic: c.msgcount for c in reader.connections if c.msgcount} == counts
    return files


@pytest.mark.parametrize("options", [(), ("--split-size", "1MB")], ids=["whole", "split"])
def test_a_killed_recording_has_what_was_accepted(options, tmp_path):
    check_kill(tmp_path, 0, *options)


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--split-size", "1MB")], ids=["whole", "split"])
def test_fifty_kills(options, tmp_path):
    rerun = Path(sys.executable).with_name("rerun")
    for seed in range(1, 26):
        folder = tmp_path / str(seed)
        folder.mkdir()
        for file in check_kill(folder, seed, *options):
            done = run(rerun, "mcap", "check", file)
            assert done.returncode == 0, (seed, done.stdout, done.stderr)
