"""The stored verdict and clock of a real recording, against what was done to its source."""

import signal
import socket
import time

import numpy as np
import pytest

from support.processes import wait_for
from support.read_back import metadata_of
from support.recorders import ended, recording
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.sources.contract import HEAD

NS = 1_000_000_000


def send(path, seconds, lost):
    """Frames at about 1 kHz on a clock that runs 80 ppm fast; some numbers are never sent."""
    sequence = sent = 0
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.connect(str(path))
        begun = time.monotonic_ns()
        while (now := time.monotonic_ns()) - begun < seconds * NS:
            frames = empty_frames(1)
            frames["t_device_ns"] = 5 * NS + (now - begun) + (now - begun) // 12_500
            frames["id_flags"], frames["dlc"] = 0x123, 8
            if sent == 1000:
                sequence += lost
            sock.send(HEAD.pack(sequence, 0) + frames.tobytes())
            sequence, sent = sequence + 1, sent + 1
            time.sleep(0.001)
    return sent


@pytest.mark.slow
@pytest.mark.clock(0.02, "a drift is between two clocks that run")
def test_what_is_stored_is_what_a_check_finds_and_what_was_done(tmp_path):
    output, source = tmp_path / "run.mcap", tmp_path / "snake.sock"
    with recording(output, f"bus=unix:{source}") as recorder:
        wait_for(source.exists, "the source", alive=[recorder])
        sent = send(source, seconds=10.0, lost=12)
        report, trouble = ended(recorder, signal.SIGINT)
    assert recorder.returncode == 0, trouble
    health = check_session(output)
    assert (health.stored, health.stored_reasons) == (health.verdict, health.reasons)
    assert (report["verdict"], tuple(report["reasons"])) == (health.verdict, health.reasons)
    (health_of_source,) = health.sources
    assert (health_of_source.name, health_of_source.frames, health_of_source.dropped) == (
        "bus",
        sent,
        12,
    )
    assert any(f"source bus lost 12 of {sent + 12} frames" in text for text in health.reasons)
    clock = metadata_of(output)["undulog.clock"]
    unsure = float(clock["bus.drift_uncertainty_ppm"])
    assert unsure < 10.0
    assert float(clock["bus.drift_ppm"]) == pytest.approx(80.0, abs=10.0 + 4 * unsure)
    assert float(clock["bus.delay_p99_s"]) < 0.02
    assert int(clock["bus.samples"]) == sent
    assert clock["bus.resets"] == "0"
    assert np.abs(int(clock["bus.offset_ns"]) - (health.start_ns - 5 * NS)) < 60 * NS
