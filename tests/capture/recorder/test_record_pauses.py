"""Recorders that are stopped and continued, and links that break.

The senders are other processes without undulog; what their writes returned for is the truth.
"""

import signal
import socket
import struct
import time
from contextlib import suppress
from itertools import product

import numpy as np
import pytest

from campaign.interruptions import KINDS, run_case
from support.processes import wait_for
from support.recorders import ended, events, greet, recording, status_of
from support.written_frames import frames_of


class Chosen:
    """The random numbers of a case: the middle of each interval."""

    def uniform(self, low, high):
        return (low + high) / 2


IN_INTEGRATION = {("unix", "running"), ("serial", "ending")}
"""The rest of the sources and moments is for the night."""


def marked(case):
    return pytest.param(*case, marks=() if case in IN_INTEGRATION else pytest.mark.nightly)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "when"), [*map(marked, product(KINDS, ("running", "ending")))])
def test_a_stopped_recorder_loses_no_accepted_frame(kind, when, tmp_path):
    result = run_case(tmp_path, kind, 0.05, when, Chosen())
    assert not result.failures
    assert result.figures["n_accepted"] > 5000


@pytest.mark.slow
@pytest.mark.clock(0.2, "the kernel stamps what arrives while the recorder is stopped")
def test_frames_that_waited_during_a_stop_have_the_time_of_their_arrival(tmp_path):
    bus, output = tmp_path / "bus.sock", tmp_path / "run.mcap"
    with (
        recording(output, f"bus=unix:{bus}") as recorder,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sender,
    ):
        wait_for(lambda: sender.connect_ex(str(bus)) == 0, "the source")
        time.sleep(0.5)
        recorder.send_signal(signal.SIGSTOP)
        for number in range(100):
            t_ns = time.time_ns()
            sender.send(struct.pack("<QQIBB2x8s", t_ns, 0, number, 8, 0, bytes(8)))
            time.sleep(0.03)
        recorder.send_signal(signal.SIGCONT)
        report, _ = ended(recorder, signal.SIGTERM)
    assert recorder.returncode == 0
    frames = frames_of(output, "/can/bus")
    late_ns = frames["t_host_ns"].astype(np.int64) - frames["t_device_ns"].astype(np.int64)
    assert len(late_ns) == 100
    # Sent over 3 s: a time of reading would be late by 1.5 s in the median.
    assert np.median(late_ns) < 300_000_000
    assert report["recorder"]["pauses"] == "1"


def is_as_expected(link, back):
    """Whether a link is gone, or back with its second frame."""
    return (link["connected"], link["frames"]) == (back, 1 + back)


@pytest.mark.slow
@pytest.mark.parametrize("back", [False, True], ids=["gone", "back"])
def test_a_lost_link_is_an_error_unless_it_came_back(back, tmp_path):
    output = tmp_path / "run.mcap"
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"bus=can:socketcand:can0?host=127.0.0.1&port={server.getsockname()[1]}"
        with recording(output, address) as recorder:
            with server.accept()[0] as client:
                greet(client)
                client.sendall(b"< frame 1 1.000000 11 >")
            if back:
                client = server.accept()[0]
                greet(client)
                client.sendall(b"< frame 1 2.000000 11 >")
            else:
                server.close()
            wait_for(lambda: is_as_expected(status_of(output)["sources"][0], back), "the link")
            report, err = ended(recorder, signal.SIGTERM)
            with suppress(OSError):
                client.close()
    assert recorder.returncode == (0 if back else 1), err
    assert report["failed"] is not back
    assert back or "bus" in err
    assert [text for _, text in events(output) if text.startswith("lost ")]
    assert len(frames_of(output, "/can/bus")) == 1 + back
