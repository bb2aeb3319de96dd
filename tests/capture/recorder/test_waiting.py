"""A recording that waits for its first command: a real virtual robot, and a silent line."""

import os
import pty
import signal

import numpy as np
import pytest

from support.paths import ROOT
from support.processes import serving, undulog, wait_for
from support.recorders import ended, polling, recording, send, status_of
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages.frames import DIR_TX


@pytest.fixture
def status(tmp_path):
    """Returns the status of the only recorder of the folder."""
    return lambda: status_of(tmp_path / "run.mcap")


WAITING = "waiting for commands"


def joints_came(status):
    """Whether a recorder waits by the joints that it has judged, and not as its line is silent."""
    return any(note.startswith(WAITING) for note in status["notes"])


@pytest.mark.slow
def test_a_robot_without_a_controller_waits_for_commands(tmp_path, status):
    output = tmp_path / "run.mcap"
    with serving("flat", "--wait", cwd=ROOT) as (robot, ready):
        address = f"can0=can:socketcand:can0?port={ready['port']}"
        with recording(output, address, "--robot", "snake25") as recorder:
            wait_for(lambda: joints_came(status()), "the robot's joints", alive=[robot, recorder])
            text = undulog("record", "status", "--socket", tmp_path / "control.sock").stdout
            report, _ = ended(recorder, signal.SIGTERM)
    assert text.startswith(f"{output}: {WAITING}, ")
    # On a busy computer the robot itself may be late; that no command came is no reason.
    assert not any("command" in reason for reason in report["reasons"]), report["reasons"]
    health = check_session(output)
    assert (health.verdict, health.stored) == (report["verdict"],) * 2
    assert [note for note in health.notes if note.startswith(WAITING)]


def test_servos_that_only_answer_wait_until_they_are_asked(tmp_path, status):
    master, slave = pty.openpty()
    device, output = os.ttyname(slave), tmp_path / "run.mcap"
    os.close(slave)
    try:
        address = f"line=serial:{device}?protocol=feetech"
        with recording(output, address, "--robot", "so101") as recorder:
            wait_for(lambda: status()["state"] == WAITING, "the line", alive=[recorder])
            assert (status()["verdict"], status()["reasons"]) == ("good", [])
            report, _ = ended(recorder, signal.SIGTERM)
    finally:
        os.close(master)
    assert report["verdict"] == "bad"
    assert check_session(output).verdict == "bad"


def test_a_robot_that_is_not_connected_waits_for_no_command(tmp_path, status):
    words = ("can0=can:slcan:/dev/nothing", "--robot", "snake25")
    with recording(tmp_path / "run.mcap", *words) as recorder:
        assert status()["state"] == "recording"
        ended(recorder, signal.SIGTERM)


@pytest.mark.slow
def test_commands_that_come_end_the_waiting_and_their_late_start_is_a_note(tmp_path, status):
    output, bus = tmp_path / "run.mcap", tmp_path / "bus.sock"
    frames, _ = polling(500)
    answers = frames[frames["dir"] != DIR_TX]
    late = np.concatenate([answers[: 25 * 250], frames[50 * 250 :]])
    with recording(output, f"can0=unix:{bus}?directions=yes", "--robot", "snake25") as recorder:
        send(bus, late[: 25 * 250], per_packet=25)
        wait_for(lambda: status()["state"] == WAITING, "its waiting", alive=[recorder])
        wait_for(lambda: status()["messages"] > 250, "the joints", alive=[recorder])
        assert not any("command" in reason for reason in status()["reasons"])
        send(bus, late[25 * 250 :])
        wait_for(lambda: status()["state"] == "recording", "its commands", alive=[recorder])
        ended(recorder, signal.SIGTERM)
    health = check_session(output)
    starts = [finding for finding in health.findings if "after the session" in finding.sentence]
    assert starts
    assert all(start.weight == 0 for start in starts)
