"""An armed drive that is killed, or whose disk is full: what was commanded is in its session.

Robot, controller and listener are three processes; what was on the bus is what the listener wrote.
"""

import json
import random
import re

import numpy as np
import pytest

from support import gate_stage
from support.gate_stage import JOINTS, Written, staged
from support.processes import UNDULOG, process, serving, undulog
from undulog.capture import Session
from undulog.capture.log.health.session_check import check_session

pytestmark = pytest.mark.slow

# -- kill -9 --------------------------------------------------------------------------------------


def check_kept(written, lines):
    """All that was on the bus is there, but for the tick in which the process died."""
    on_bus = [
        (line["id"], line["data"]) for line in lines if (line["name"] or "").endswith("_command")
    ]
    assert written.sent == on_bus[: len(written.sent)]
    assert len(on_bus) - len(written.sent) in {0, len(JOINTS)}
    for name, (_, angle) in gate_stage.commands_of(lines).items():
        given = np.array([row[name] for _, row in written.commands])
        assert len(angle) - len(given) in {0, 1}
        assert np.abs(given - angle[: len(given)]).max() <= gate_stage.STEP / 2 * (1 + 1e-6)
    notes = [text for _, _, text in written.notes]
    assert notes[0] == "drives wave.mcap (commands) on " + notes[0].rpartition(" on ")[2]
    assert "gate: reading the pose" in notes
    assert any(text.startswith("gate: approach, ") for text in notes)
    assert "gate: run" in notes


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(1, 6))]
)
def test_a_drive_that_is_killed_has_all_that_was_commanded(seed, driving, session, tmp_path):
    repaired = tmp_path / "repaired.mcap"
    with driving() as drive:
        drive.begun(80 + random.Random(seed).randrange(150))
        drive.controller.kill()
        drive.communicate()
        path, lines = drive.path, drive.stage.lines
        again = undulog(*drive.stage.words(session, path)[len(UNDULOG) :])
    assert again.returncode == 2
    assert "exists already" in again.stderr
    with Session.open(path) as left:
        commands = left.joints("/joint_commands")
        assert any("undulog log recover" in warning for warning in left.warnings)
    report = json.loads(undulog("log", "recover", path, "-o", repaired, "--json", code=0).stdout)
    assert report["missing"] == 0 < report["from_wal"]
    written = Written(repaired)
    check_kept(written, lines)
    assert len(commands.t_ns[0]) == len(written.commands)
    for name, values in zip(commands.names, commands.values, strict=True):
        assert values.tolist() == [row[name] for _, row in written.commands]
    gate_stage.check_limits(lines)


# -- a full disk ----------------------------------------------------------------------------------


def fill(folder):
    """Take the rest of a disk, as somebody else would."""
    with (folder / "hog").open("wb", buffering=0) as hog:
        size = 1 << 20
        while size:
            try:
                hog.write(bytes(size))
            except OSError:
                size //= 2


def check_missing(err, size):
    """The bytes that are needed are those that are free, and those that are missing."""
    match = re.search(rf"needs {size} bytes and the disk has (\d+) free: (\d+) bytes are mi", err)
    assert int(match[1]) + int(match[2]) == size


def check_told(err, path, disk, *, ramp_rate=gate_stage.RAMP_RATE):
    """The robot came to its safe end, and that is in a whole session; its report and log."""
    assert err.startswith(f"error: the disk at {disk} is full or fails: {path}")
    assert "; the joints were brought straight within " in err
    assert not (path.parent / f"{path.name}.wal").exists()
    file = check_session(path).file
    assert (file.indexed, file.damage) == (True, ())
    written = Written(path)
    gate_stage.check_ramp_down(written, "fault: the disk at ", ramp_rate=ramp_rate)
    health = written.metadata["undulog.health"]
    assert health["verdict"] == "bad"
    assert json.loads(health["reasons"])[0].startswith(f"the disk at {disk} is full")
    return written


def test_a_disk_that_somebody_fills_brings_the_robot_down_first(driving, disk_of):
    disk = disk_of("64m")
    with driving(disk=disk) as drive:
        drive.begun()
        fill(disk)
        _, err = drive.communicate()
        assert drive.controller.returncode == 1, err
        check_told(err, drive.path, disk)
        lines = drive.stage.lines
        assert "No space left on device" in err
        gate_stage.check_limits(lines)
        gate_stage.check_session(drive.path, lines)


@pytest.mark.nightly
def test_a_disk_that_the_drive_itself_fills_brings_the_robot_down_first(disk_of):
    disk = disk_of("50m")
    path = disk / "a.mcap"
    with serving("flat", "--lockstep", "--fast") as (_, ready):
        words = (*UNDULOG, "drive", "flat", "--on", f"can:socketcand:can0?port={ready['port']}")
        words += ("--arm", "-o", path, "--duration", "600")
        with process(*words) as controller:
            _, err = controller.communicate()
            assert controller.returncode == 1, err
    written = check_told(err, path, disk, ramp_rate=0.5)
    assert len(written.commands) > 1000
    check_missing(err, 1 << 24)


def test_on_a_disk_without_room_nothing_is_sent(small, session, tmp_path, disk_of):
    disk = disk_of("44m")
    path = disk / "a.mcap"
    with staged(tmp_path, small[1]) as on_stage, on_stage.replay(session, path) as controller:
        _, err = controller.communicate()
        on_stage.settle()
        assert on_stage.lines
        assert not on_stage.command_lines
    assert controller.returncode == 1
    assert err.startswith(f"error: {path}: needs")
    check_missing(err, 48 << 20)
    assert list(disk.iterdir()) == []
