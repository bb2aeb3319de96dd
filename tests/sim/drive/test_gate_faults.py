"""Ten faults to order: whatever goes wrong, no command beyond a limit, a safe end, and the truth.

Robot, controller and listener are three processes. What was on the bus is judged by the listener,
which has nothing of undulog: python-can's socketcand and cantools.
"""

import json
import os
import pty
import re
import signal
import sys
from contextlib import ExitStack

import numpy as np
import pytest

from support import gate_stage
from support.gate_stage import SAFETY, Driving, Written, staged
from support.processes import process
from support.witness import LateComputerError

NOTHING_MORE = "nothing more was sent; the servos hold their last commands"
FAULT_AT_S = 1.5  # after the first command: the way to the first pose is over by then
ERROR = 40  # of rcl_interfaces/msg/Log


def errors(written):
    return [text for _, level, text in written.notes if level >= ERROR]


def check_told(written, reason):
    """The fault is reported when it is found and at the end, and no other one is."""
    first, end = errors(written)
    assert first.startswith(f"fault: {reason}")
    assert end.startswith(f"fault: {reason}")
    assert written.metadata["undulog.health"]["verdict"] == "bad"
    assert json.loads(written.metadata["undulog.health"]["reasons"])[0].startswith(reason)


# -- what the robot and its bus do --------------------------------------------------------------


@pytest.mark.slow
def test_a_stuck_servo_is_a_tracking_error_and_the_others_come_down(driving):
    with driving(f"stuck:joint03@{FAULT_AT_S}") as drive:
        _, err, written = drive.ended()
    assert err.startswith("error: joint03: tracking error 0.")
    # It lasts to the first tick that finds 0.5 s over, a little later on a busy computer.
    assert re.search(
        r"rad, more than 0\.3 rad for 0\.5\d? s; the joints were brought straight", err
    )
    check_told(written, "joint03: tracking error 0.")
    gate_stage.check_ramp_down(written, "fault: ")


@pytest.mark.slow
def test_lost_replies_end_it_and_name_the_joint(driving):
    with driving(f"lost:joint02:1@{FAULT_AT_S}") as drive:
        _, err, written = drive.ended()
    assert err.startswith("error: joint02 is lost: no angle for more than 1 s; the joints were bro")
    check_told(written, "joint02 is lost: no angle for more than 1 s")
    gate_stage.check_ramp_down(written, "fault: ")


@pytest.mark.nightly
def test_the_robots_file_can_say_that_joints_are_held(driving, tmp_path):
    holds = SAFETY | {"on_fault": '"hold"'}
    robot, scenario = gate_stage.robot_files(tmp_path / "holds", safety=holds)
    holding = gate_stage.commanded(tmp_path / "holding.mcap", robot, 60.0)
    lost = f"lost:1@{FAULT_AT_S}"
    with driving(lost, scenario=scenario, recorded=holding, silence=True) as drive:
        _, err, written = drive.ended()
    assert err.startswith("error: the bus was silent: no joint was received for ")
    # On a busy machine three ticks may be silent before the fault begins, and joints come again.
    again = any("gate: a joint was received again" in text for _, _, text in written.notes)
    how = "then the joints were held where they were" if again else NOTHING_MORE
    assert how in err
    gate_stage.check_hold(written, "fault: ")


@pytest.mark.nightly
def test_after_bus_off_nothing_more_is_sent(driving):
    with driving(f"bus-off@{FAULT_AT_S}+2") as drive:
        _, err, written = drive.ended()
    assert err.startswith("error: bus-off: ")
    assert "nothing more was sent" in err
    check_told(written, "bus-off: ")
    assert all(len(angle) == 0 for angle in written.after("fault: ").values())


@pytest.mark.nightly
def test_a_servo_that_draws_too_much_gives_way_and_then_ends_it(driving):
    with driving(f"over-current:joint02:1.5@{FAULT_AT_S}") as drive:
        _, err, written = drive.ended()
    assert err.startswith("error: joint02: current 1.5 A, more than 1.4 A for 0.")
    check_told(written, "joint02: current 1.5 A")
    yields = "gate: joint02: draws more than 1.4 A: its command gives way"
    assert written.time_of(yields) < written.time_of("fault: ")
    gate_stage.check_ramp_down(written, "fault: ", yields=["joint02"])


@pytest.mark.nightly
def test_a_process_that_comes_late_does_not_jump(driving):
    with driving() as drive:
        drive.begun()
        drive.signal(signal.SIGSTOP, 2.2)
        drive.signal(signal.SIGCONT)
        _, err, written = drive.ended()
    assert re.match(  # what came meanwhile is found at once
        r"error: a control tick was 2\.\S* s late, more than 1\.5 s; the joints were brought "
        r"straight within ",
        err,
    )
    check_told(written, "a control tick was 2.")
    gate_stage.check_ramp_down(written, "fault: ")


@pytest.mark.clock(0.02, "a robot in another process has to answer before the bus is silent")
@pytest.mark.parametrize("plain", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_a_process_that_stops_and_goes_on_commands_no_joint_too_fast(plain, driving, tmp_path):
    """It catches up at the greatest rate that the robot's file allows: in true time, too."""
    waits = dict.fromkeys(("reply_timeout_s", "max_late_s", "fault_after_s"), 60.0)
    robot, scenario = gate_stage.robot_files(tmp_path / "waits", safety=gate_stage.SAFETY | waits)
    session = gate_stage.commanded(tmp_path / "waits.mcap", robot, 60.0)
    with driving(scenario=scenario, recorded=session, plain=plain) as drive:
        drive.begun()
        for _ in range(8):
            drive.signal(signal.SIGSTOP, 0.3)
            drive.signal(signal.SIGCONT, 0.4)
        drive.signal(signal.SIGINT)
        out, _, written = drive.ended()
    left_out = [text for _, _, text in written.notes if " control ticks were left out" in text]
    assert sum("s of the gait" in text for text in left_out) >= 4
    assert any("command held back to 4 rad/s" in text for _, _, text in written.notes)
    given = re.search(r"(\d+) control ticks were left out, as the one before took too long", out)
    skipped = [re.search(r"late, (\S+) control tick", text) for _, _, text in written.notes]
    counts = [1 if match[1] == "a" else int(match[1]) for match in skipped if match]
    assert sum(counts) <= int(given[1]) >= 4 * 25


# -- what is refused ----------------------------------------------------------------------------


def refused(folder, scenario, sessions):
    """What the controller says of sessions that it refuses, by name; nothing at all is sent."""
    noted = {}
    with staged(folder, scenario) as on_stage, ExitStack() as running:
        started = {
            name: running.enter_context(on_stage.replay(chosen, folder / f"{name}-out.mcap"))
            for name, chosen in sessions.items()
        }
        for name, controller in started.items():
            _, noted[name] = controller.communicate()
            assert controller.returncode == 2, (name, noted)
            assert not (folder / f"{name}-out.mcap").exists(), name
        on_stage.settle()
        assert on_stage.lines  # the robot spoke all the while
        assert not on_stage.command_lines
    return noted


@pytest.mark.nightly
def test_a_robot_without_limits_is_refused_and_nothing_is_sent(small, tmp_path):
    bare, _ = gate_stage.robot_files(tmp_path / "bare", safety=None)
    session = gate_stage.commanded(tmp_path / "limits.mcap", bare, 1.0)
    noted = refused(tmp_path, small[1], {"limits": session})["limits"]
    assert noted.startswith(
        "error: snake4 can't be armed: its description lacks max_rate, ramp_rate, "
        "max_tracking_error, reply_timeout_s, max_late_s, max_current in [safety]"
    )
    assert "\n  [safety]\n  max_rate = " in noted


@pytest.mark.nightly
def test_another_joint_set_and_another_robot_are_refused_and_nothing_is_sent(small, tmp_path):
    write, sessions = gate_stage.commanded, {}
    joints = ("joint01", "joint02", "joint03", "wheel")
    sessions["foreign"] = write(tmp_path / "foreign.mcap", small[0], 1.0, names=joints)
    sessions["fewer"] = write(tmp_path / "fewer.mcap", small[0], 1.0, names=joints[:3])
    whole = {"names": [f"joint{k + 1:02d}" for k in range(25)]}
    whole["commands"] = lambda times_s: np.full((len(times_s), 25), 0.1)
    sessions["robot"] = write(tmp_path / "robot.mcap", "snake25", 1.0, **whole)
    noted = refused(tmp_path, small[1], sessions)
    for last in ("wheel", "joint04"):
        assert f"joint01, joint02, joint03, {last}" in noted["foreign"]
    assert "it commands 3 joints: joint01, joint02, joint03\n" in noted["fewer"]
    assert "snake4 has 4: joint01, joint02, joint03, joint04" in noted["fewer"]
    assert " is snake4, and robot.mcap is for snake25; nothing was sent" in noted["robot"]


@pytest.mark.nightly
def test_another_robot_is_known_by_its_frames_where_nobody_says_who_is_there(driving, tmp_path):
    folder = tmp_path / "moved"
    _, scenario = gate_stage.robot_files(folder)
    database = folder / "snake25.dbc"
    moved = re.sub(  # messages and the names of their values, to other identifiers
        r"^((?:BO|VAL)_ )(\d+)",
        lambda match: f"{match[1]}{int(match[2]) + 1024}",
        database.read_text(),
        flags=re.MULTILINE,
    )
    database.write_text(moved)
    with driving(scenario=scenario, plain=True) as drive:
        _, err = drive.communicate()
        lines = drive.stage.lines
    assert drive.controller.returncode == 2, err
    assert "no command was sent: another robot is on this bus" in err
    assert "0 are of snake4; others have the identifiers 601" in err
    # Nobody else spoke:
    assert {line["id"] for line in lines} == {1537, 1538, 1539, 1540, gate_stage.MARK}


# -- who is in charge goes ----------------------------------------------------------------------


@pytest.mark.slow
def test_ctrl_c_brings_the_joints_down(driving):
    with driving() as drive:
        drive.begun(60)
        drive.signal(signal.SIGINT)
        _, err, written = drive.ended()
    assert err.startswith("error: stop requested (Ctrl-C); the joints were brought straight within")
    assert not errors(written)
    gate_stage.check_ramp_down(written, "gate: ending, stop requested (Ctrl-C)")


@pytest.mark.nightly
def test_a_second_ctrl_c_ends_it_at_once(driving):
    with driving() as drive:
        drive.begun()
        drive.signal(signal.SIGINT, 0.2)
        drive.signal(signal.SIGINT)
        _, err, written = drive.ended()
    assert "stop requested (Ctrl-C)" in err
    assert NOTHING_MORE in err
    ending = written.after("gate: ending")
    assert all(len(angle) <= 60 for angle in ending.values())  # the way down takes more
    assert all(not len(angle) for angle in written.after("nothing is sent any more").values())


IN_A_TERMINAL = """
import fcntl, os, signal, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
if sys.argv[1] == "nohup":
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
os.execv(sys.argv[2], sys.argv[2:])
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hangup", pytest.param("nohup", marks=pytest.mark.nightly)])
def test_a_console_that_goes_brings_the_joints_down(kind, small, session, tmp_path):
    path = tmp_path / "a.mcap"
    master, slave = pty.openpty()
    with staged(tmp_path, small[1]) as on_stage:
        words = (sys.executable, "-c", IN_A_TERMINAL, kind, *on_stage.words(session, path))
        streams = {"stdin": slave, "stdout": slave, "stderr": slave, "start_new_session": True}
        with process(*words, **streams) as controller:
            os.close(slave)
            drive = Driving(lambda _: (on_stage, controller, path))
            drive.begun(60)
            shown = b""
            while b"wave.mcap" not in shown:  # a progress bar is on it
                shown += os.read(master, 1 << 16)
            os.close(master)
            _, _, written = drive.ended()
    gate_stage.check_ramp_down(written, "gate: ending, the console is gone")
    assert not errors(written)


@pytest.mark.nightly
def test_a_robot_that_is_gone_leaves_a_whole_session(driving):
    with driving() as drive:
        drive.begun()
        drive.stage.robot.kill()
        _, err = drive.communicate()
        lines = drive.stage.lines
    assert drive.controller.returncode == 1
    assert err.startswith(f"error: {drive.stage.on}: the robot ")
    gate_stage.check_limits(lines)
    written = Written(drive.path)
    assert written.metadata["undulog.health"]["verdict"] == "bad"
    assert len(written.commands) >= 150


# -- what is well -------------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.parametrize("plain", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_without_a_fault_it_runs_to_its_end(plain, small, driving, tmp_path):
    short = gate_stage.commanded(tmp_path / "short.mcap", small[0], 3.0)
    with driving(recorded=short, plain=plain) as drive:
        _, err, written = drive.ended(code=0)
    assert "error" not in err
    assert not errors(written)


@pytest.mark.nightly
def test_a_robot_that_comes_late_is_not_the_controllers_fault(driving):
    """By the listener these tests know whether a bus was silent by itself."""
    with driving() as drive:
        drive.begun()
        drive.stage.robot.send_signal(signal.SIGSTOP)
        drive.signal(signal.SIGINT, 0.5)
        drive.signal(signal.SIGINT)
        drive.controller.wait()
        drive.stage.robot.send_signal(signal.SIGCONT)
        with pytest.raises(LateComputerError):
            drive.ended()


@pytest.mark.slow
def test_all_joints_of_the_whole_robot_are_kept_within_their_limits(tmp_path):
    path = tmp_path / "a.mcap"
    names = [f"joint{k + 1:02d}" for k in range(25)]

    def wild(times_s):  # steps of all sizes, beyond the limits too
        levels = np.random.default_rng(7).uniform(-0.8, 0.8, (len(times_s) // 20 + 1, 25))
        return levels.repeat(20, axis=0)[: len(times_s)]

    steps = tmp_path / "steps.mcap"
    gate_stage.commanded(steps, "snake25", 1.0, names=names, commands=wild)
    # In lockstep the robot waits for its commands: no machine is too slow for 25 joints.
    with (
        staged(tmp_path, "flat", pace="--lockstep") as on_stage,
        on_stage.replay(steps, path) as controller,
    ):
        out, err = controller.communicate()
        on_stage.settle()
        lines = on_stage.lines
    assert controller.returncode in {0, 1}, (out, err)  # such steps can be too much for the servos
    gate_stage.check_limits(lines)
    written = gate_stage.check_session(path, lines, lockstep=True)
    assert len(gate_stage.commands_of(lines)) == 25
    assert [text for _, _, text in written.notes if "command held back to 4 rad/s" in text]
