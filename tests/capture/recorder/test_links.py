"""Recordings of sources that are not there: the file is whole, and the exit code is 1."""

import json
import os
import pty
import signal
from types import SimpleNamespace

import pytest

from support import recorders
from support.processes import run, undulog, wait_for
from support.recorders import connected_sender, ended, events, recording
from support.written_frames import frames_of
from undulog.capture.log.health.session_check import check_session
from undulog.capture.recorder.links import SourceLink, link_faults
from undulog.capture.sources.contract import Polled, SourceCounts, SourceEvent


@pytest.fixture
def output(tmp_path):
    return tmp_path / "run.mcap"


def test_only_a_source_that_was_never_connected_is_a_fault():
    links = {
        "a": SourceLink(listens=False, ever_connected=True, latest="lost /dev/x: gone"),
        "b": SourceLink(listens=False, latest="waits for /dev/y: No such file or directory"),
        "c": SourceLink(listens=True, latest="listens at /run/c.sock"),
        "d": SourceLink(listens=True, ever_connected=True),
        "e": SourceLink(listens=False),
    }
    assert link_faults(links) == (
        "source b was never connected: waits for /dev/y: No such file or directory",
        "source c was never connected: listens at /run/c.sock, and no sender came",
        "source e was never connected: no attempt to connect has ended",
    )
    assert link_faults({}) == ()


@pytest.mark.parametrize("connected", [False, True])
@pytest.mark.parametrize("frames", [0, 7])
def test_who_was_connected_at_a_poll_or_gave_a_frame_was_there(connected, frames):
    source = SimpleNamespace(connected=connected, counts=SourceCounts(frames=frames))
    link = SourceLink(listens=True)
    link.note(source, Polled())
    assert link.ever_connected == (connected or frames > 0)
    source.connected, source.counts.frames = False, 0
    link.note(source, Polled(events=(SourceEvent(0, "info", "is gone"),)))
    assert link.ever_connected == (connected or frames > 0)
    assert (link.latest, link.lost) == ("is gone", False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("address", "reason"),
    [
        (
            "can0=can:socketcand:can0?host=localhost&port=1",
            "waits for can0 at localhost:1: Connection refused",
        ),
        *(
            pytest.param(
                address,
                "waits for /dev/nothing: No such file or directory",
                marks=pytest.mark.nightly,
            )
            for address in (
                "can0=serial:/dev/nothing?protocol=feetech",
                "can0=can:slcan:/dev/nothing",
            )
        ),
        ("can0=unix:{}/can0.sock", "listens at {}/can0.sock, and no sender came"),
    ],
    ids=["socketcand", "serial", "slcan", "unix"],
)
def test_a_device_that_is_not_there_is_exit_code_1_with_the_reason(
    address, reason, output, tmp_path
):
    words = (address.format(tmp_path), "--duration", "0.5s", "--floor", "0", "--json")
    done = run(*recorders.command(output, *words), code=1)
    fault = f"source can0 was never connected: {reason.format(tmp_path)}"
    assert done.stderr.splitlines()[-1] == f"error: 0.5 s are over; {fault}"
    report = json.loads(done.stdout)
    assert (report["failed"], report["ended"]) == (True, f"0.5 s are over; {fault}")
    assert ("recorder", fault) in events(output)
    assert check_session(output).file.indexed


def test_one_of_several_sources_that_never_came_fails_the_recording_and_the_others_are_whole(
    output, tmp_path
):
    sources = (f"here=unix:{tmp_path}/here.sock", "gone=can:slcan:/dev/nothing")
    with recording(output, *sources) as process, connected_sender(tmp_path / "here.sock"):
        report, _ = ended(process, signal.SIGTERM)
    assert process.returncode == 1
    assert report["ended"].startswith("SIGTERM was received; source gone was never connected: ")
    assert "here was" not in report["ended"]
    assert len(frames_of(output, "/can/here")) == 1


@pytest.mark.slow
def test_a_device_that_comes_late_is_no_fault(output, tmp_path):
    port = tmp_path / "port"
    master, slave = pty.openpty()
    device = os.ttyname(slave)
    os.close(slave)  # no other process holds the line
    try:
        with recording(output, f"can0=serial:{port}?protocol=feetech") as process:
            control = output.with_name("control.sock")
            undulog("record", "status", "--socket", control)  # it runs, without its device
            port.symlink_to(device)

            def is_connected():
                text = undulog("record", "status", "--socket", control, "--json").stdout
                return json.loads(text)["recordings"][0]["sources"][0]["connected"]

            wait_for(is_connected, "the serial line", alive=[process])
            report, _ = ended(process, signal.SIGTERM)
    finally:
        os.close(master)
    assert (process.returncode, report["failed"]) == (0, False)


def test_a_request_to_stop_reports_that_the_robot_never_came(output, tmp_path, command):
    with recording(output, f"can0=unix:{tmp_path}/can0.sock") as process:
        words = ("record", "stop", "--wait", "--socket", output.with_name("control.sock"))
        text = command(*words, code=1).out
        ended(process)
    assert "it was stopped; source can0 was never connected" in text
    assert process.returncode == 1
