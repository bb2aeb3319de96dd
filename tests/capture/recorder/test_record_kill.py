"""kill -9 at random moments, under load: whatever was accepted 50 ms before is in the session.

The senders are other processes, and their own logs say what the recorder's socket accepted and
when; what is in the session is held against those logs and against the frames they made.
"""

import random
import struct
import sys
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from subprocess import DEVNULL

import numpy as np
import pytest
from bus_sender import cycle_frames
from rosbags.highlevel import AnyReader

from support.paths import ROOT
from support.processes import process, run, wait_for
from support.read_back import messages_of
from support.recorders import recording
from undulog.capture import Session

SENDER = ROOT / "bench" / "bus_sender.py"

SAFE_NS = 50_000_000
RATE = 3000  # frames a second and bus: a loaded machine must still keep up


@pytest.fixture(scope="module")
def cycle(tmp_path_factory):
    """The frames that every sender repeats, so that none has to make them."""
    path = tmp_path_factory.mktemp("cycle") / "cycle.npy"
    np.save(path, cycle_frames())
    return path


def accepted_before(log, moment_ns):
    """Frames that a sender had logged as accepted before a moment."""
    data = log.read_bytes()
    rows = np.frombuffer(data[: len(data) // 16 * 16], dtype="<u8").reshape(-1, 2)
    rows = rows[rows[:, 0] < moment_ns]
    return int(rows[-1, 1]) if len(rows) else 0


def record_and_kill(cycle, folder, seed, *options):
    """Record two buses, kill the recorder; the session, and what each sender had accepted."""
    chance = random.Random(seed)
    session = folder / "run.mcap"
    sockets = [folder / f"{name}.sock" for name in ("front", "rear")]
    logs = [path.with_suffix(".accepted") for path in sockets]
    sources = [f"unix:{path}" for path in sockets]
    words = (*sources, "--robot", "snake25", "--bus", "front", *options, "--quiet")
    with ExitStack() as senders, recording(session, *words) as recorder:
        for path, log in zip(sockets, logs, strict=True):
            words = ("unix", path, "--rate", RATE, "--seconds", 120, "--log", log)
            words += ("--cycle", cycle)
            silent = {"cwd": ROOT, "stdout": DEVNULL, "stderr": DEVNULL}
            senders.enter_context(process(sys.executable, SENDER, *words, **silent))
        least = 16 * chance.randrange(50, 2 * RATE)
        wait_for(
            lambda: all(log.exists() and log.stat().st_size >= least for log in logs),
            "the senders",
            alive=[recorder],
        )
        killed_ns = time.monotonic_ns()
        recorder.kill()
        recorder.wait()
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


def check_kill(command, folder, path, accepted):
    before = {file: file.read_bytes() for file in folder.rglob("*.mcap")}
    with Session.open(path) as session:
        check_frames(session, accepted)
        assert any("recover" in warning for warning in session.warnings)
    assert {file: file.read_bytes() for file in folder.rglob("*.mcap")} == before
    repaired = folder / "repaired.mcap"
    command("log", "recover", path, "-o", repaired)
    with Session.open(repaired) as session:
        check_frames(session, accepted)
    files = sorted(folder.glob("repaired*.mcap"))
    for file in files:
        counter = Counter()
        for _, channel, message in messages_of(file):
            counter[channel.topic] += 1
            dimensions = struct.unpack_from("<I", message.data, 4)[0]
            assert dimensions == 2 or not channel.topic.startswith("/can/")
        with AnyReader([file]) as reader:
            assert {c.topic: c.msgcount for c in reader.connections if c.msgcount} == counter
    return files


@pytest.mark.slow
@pytest.mark.clock(0.03, "a recorder that is killed has what was accepted 50 ms before")
@pytest.mark.parametrize("options", [(), ("--split-size", "1MB")], ids=["whole", "split"])
def test_a_killed_recording_has_what_was_accepted(options, tmp_path, command, cycle):
    check_kill(command, tmp_path, *record_and_kill(cycle, tmp_path, 0, *options))


@pytest.mark.nightly
@pytest.mark.clock(0.03, "a recorder that is killed has what was accepted 50 ms before")
@pytest.mark.parametrize("options", [(), ("--split-size", "1MB")], ids=["whole", "split"])
def test_fifty_kills(options, tmp_path, command, cycle):
    rerun = Path(sys.executable).with_name("rerun")
    for seed in range(1, 26):
        folder = tmp_path / str(seed)
        folder.mkdir()
        for file in check_kill(command, folder, *record_and_kill(cycle, folder, seed, *options)):
            run(rerun, "mcap", "check", file, code=0)
