"""The control loop over a bus, against the virtual robot of ``sim serve`` and a plain server."""

import dataclasses
import os
import signal
import socket
import threading
from contextlib import contextmanager

import can
import numpy as np
import pytest

from support.can_messages import can_message, speaking
from support.plain_socketcand import SOCKETCAND, plain_server
from support.processes import wait_for
from support.twin_runs import sensed, simulate
from support.written_sessions import write_commands
from undulog.capture import Session, load_robot
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.common.errors import LogWriteError, SourceError, UsageError
from undulog.capture.common.process import StopRequest, raised_priority
from undulog.capture.log.messages.frames import DIR_TX
from undulog.capture.robot.model import Direction, OnFault, Quantity
from undulog.sim import load_scenario
from undulog.sim.drive.motion import find_motion
from undulog.sim.drive.outcome import DriveEnding
from undulog.sim.drive.over_bus import LISTEN_S, bus_plan, drive_bus
from undulog.sim.physics.sensing import JointSample
from undulog.sim.serve.pacing import Pacer
from undulog.sim.serve.robot import PERIOD_NS, VirtualRobot
from undulog.sim.serve.socketcand_server import SocketcandServer, VirtualBus
from undulog.sim.twin.adaptive import build_gait

STEP = np.radians(0.01)  # of a command on the bus of snake25


@contextmanager
def alive(scenario, *, lockstep=True):
    """A virtual robot in a thread: its bus's address, and how its run went."""
    silent = {"log_event": lambda _level, _text: None}
    server = SocketcandServer("127.0.0.1", 0, "can0", **silent)
    bus, stop, served = VirtualBus(server, None, **silent), StopRequest(), []
    pacer = Pacer(PERIOD_NS, fast=lockstep)
    robot = VirtualRobot(scenario, bus, pacer, lockstep=lockstep, stop=stop, **silent)

    def live():
        try:
            served.append(robot.run())
        finally:
            bus.close()

    thread = threading.Thread(target=live)
    thread.start()
    try:
        yield f"can:socketcand:can0?host=127.0.0.1&port={server.address[1]}", served
    finally:
        stop.signal = signal.SIGTERM
        thread.join()


class Rounded:
    """A gait whose commands are rounded as snake25's bus rounds them."""

    names = ()

    def __init__(self, gait):
        self._gait = gait

    def step(self, time_s, readings):
        tick = self._gait.step(time_s, readings)
        return tick._replace(command=np.round(tick.command / STEP) * STEP, values=np.empty(0))


def weak(duration_s):
    return load_scenario("weak-servo-pi3").changed(duration_s=duration_s)


TOPICS = {
    "/joint_commands": "/joint_commands",
    "/gait": "/gait",
    "/gate/wanted": "/joint_commands",
}


def test_in_lockstep_the_robot_gets_the_gaits_commands_tick_by_tick(tmp_path, command, report_of):
    path, direct = tmp_path / "bus.mcap", tmp_path / "direct.mcap"
    words = ["drive", "weak-servo-pi3", "--duration", "0.3"]
    with alive(weak(0.3)) as (on, served):
        report = report_of(*words, "--on", on, "--arm", "-o", path)
        wait_for(lambda: served, "the robot goes on")  # it has its last tick still to do
    assert (report["pace"], report["ticks"], report["overruns"]) == ("lockstep", 31, 0)
    assert (report["sent"], report["complete"], report["outcome"]) == (31 * 25, True, "complete")
    assert (report["approach_s"], report["lateness"]) == (0.0, None)  # it stands straight already
    assert report["decoded"] == report["received"] > 25 * 20
    assert (served[0].complete, served[0].commands) == (True, 31 * 25)
    command(*words, "--on", "twin", "-o", direct)
    with Session.open(path) as over_bus, Session.open(direct) as in_process:
        for topic, like in TOPICS.items():
            driven, expected = over_bus.joints(topic), in_process.joints(like)
            np.testing.assert_array_equal(driven.values, expected.values)
            np.testing.assert_array_equal(driven.t_ns, expected.t_ns)
        assert (over_bus.verdict, over_bus.warnings) == ("good", [])
        facts = over_bus.metadata["undulog"]
        assert (facts["driven"], facts["armed"], facts["source.can0"]) == ("gait", "yes", on)
        assert over_bus.robot == load_robot("snake25")
        measured = over_bus.joints("/joint_states")
        assert (over_bus.frames("/can/can0")["dir"] == DIR_TX).sum() == 31 * 25
        assert over_bus.metadata["undulog.gate"]["rate"] == "4.0"
        assert [message.data for _, message in over_bus.messages("/gate/phase")] == ["run"]
    # The robot did what the twin does with commands rounded to the bus, and reported it, rounded.
    samples = sensed(weak(0.3), Rounded(build_gait(weak(0.3))))
    cycles = np.array([sample.position for sample in samples if isinstance(sample, JointSample)])[
        :-2
    ]
    driven = np.array(measured.values)
    assert not driven[:, 0].any()  # how it stood before the first command
    driven = driven[:, 1 : 1 + len(cycles)]
    assert np.abs(driven - cycles[: driven.shape[1]].T).max() <= STEP / 2 * (1 + 1e-6)


@pytest.mark.nightly
def test_an_adaptive_controller_does_the_same_over_the_bus_as_in_process(tmp_path):
    scenario = load_scenario("target-following").changed(duration_s=3.0)
    over_bus = []
    with alive(scenario) as (on, served):
        drive_bus(
            planned("target-following", on, tmp_path / "a.mcap", duration_s=3.0),
            stop=StopRequest(),
            on_tick=lambda tick: over_bus.append(tick.step.gait),
        )
    assert served[0].pace.ticks >= 300  # whether it still looks at the end, who stops it decides
    in_process = [sample.gait for sample in simulate(scenario, Rounded(build_gait(scenario)))]
    assert [tick.mode for tick in over_bus] == [tick.mode for tick in in_process]
    assert len({tick.mode for tick in over_bus}) > 1  # it met something
    commands = np.round(np.array([tick.command for tick in over_bus]) / STEP) * STEP
    error = np.abs(commands - np.array([tick.command for tick in in_process]))
    # Readings are rounded on the bus (angles 0.01 degrees, distances 1 mm), and so are commands.
    assert error.max() <= STEP * (1 + 1e-6)


def test_in_real_time_the_loop_keeps_to_the_clock(tmp_path):
    path = tmp_path / "a.mcap"
    with alive(load_scenario("flat").changed(duration_s=30.0), lockstep=False) as (on, _):
        report = drive_bus(planned("flat", on, path, duration_s=0.5), stop=StopRequest())
    assert (report.outcome.how, report.gait_s) == (DriveEnding.COMPLETE, 0.5)
    assert report.ticks <= 51 <= report.ticks + report.tally.overruns
    assert report.wall_s >= 0.5
    assert report.tally.sent == 25 * report.ticks
    assert sum(report.jitter.counts) == report.jitter.ticks >= report.ticks
    assert 0.0 <= report.jitter.median_s <= report.jitter.p99_s <= report.jitter.worst_s
    with Session.open(path) as session:
        times = session.joints("/joint_commands").t_ns[0]
        assert (np.diff(times) > 0).all()
        assert len(times) == report.ticks
        assert (session.verdict == "good") == (report.tally.overruns == 0)
        assert session.settle_s >= load_scenario("flat").settle_s > 0


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_drive_by_the_clock_has_what_priority_the_system_grants(tmp_path, lockstep):
    def policy():
        return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK

    with raised_priority():
        granted = policy()
    before, seen = policy(), set()
    with alive(load_scenario("flat").changed(duration_s=30.0), lockstep=lockstep) as (on, _):
        drive_bus(
            planned("flat", on, tmp_path / "a.mcap"),
            stop=StopRequest(),
            on_tick=lambda _: seen.add(policy()),
        )
    assert (seen, policy()) == ({before if lockstep else granted}, before)


def planned(what, on, output, *, duration_s=0.2, robot=None):
    return bus_plan(find_motion(what), on, output, robot, duration_s)


@pytest.mark.slow
@pytest.mark.parametrize("how", list(OnFault))
def test_asked_to_stop_it_ends_as_the_robots_file_says(tmp_path, how):
    path, stop = tmp_path / "a.mcap", StopRequest()
    robot = load_robot("snake25")
    robot = dataclasses.replace(robot, safety=dataclasses.replace(robot.safety, on_fault=how))

    def ask(tick):
        if tick.tick == 80:
            stop.signal = signal.SIGINT

    with alive(weak(9.0)) as (on, _):
        plan = planned("weak-servo-pi3", on, path, duration_s=9.0, robot=robot)
        report = drive_bus(plan, stop=stop, on_tick=ask)
    assert report.outcome.how is DriveEnding.STOPPED
    assert report.outcome.why == "stop requested (Ctrl-C)"
    with Session.open(path) as session:
        commands = np.array(session.joints("/joint_commands").values)
        notes = [message.msg for _, message in session.messages("/rosout")]
        phases = [message.data for _, message in session.messages("/gate/phase")]
        assert session.verdict == "good"
    assert phases == ["run", "ending"]
    held = commands[:, 80]
    ending = commands[:, 81:]
    assert np.abs(held).max() > 0.1  # the gait was in full swing
    if how is OnFault.HOLD:
        np.testing.assert_array_equal(ending, held[:, None] + np.zeros_like(ending))
        assert ending.shape[1] == 20
    else:
        assert not ending[:, -1].any()
        assert np.abs(np.diff(commands[:, 80:])).max() <= 0.5 * 0.01 * (1 + 1e-9)
        assert ending.shape[1] == pytest.approx(100 * (1.5 * np.abs(held).max() / 0.5 + 0.2), abs=1)
    assert notes[-1].startswith("stopped: stop requested (Ctrl-C); the joints were ")


def angles_of(received):
    """Return the raw angles in the commands of each joint, by identifier."""
    return np.array([np.frombuffer(b"".join(data), "<i2") for _, data in sorted(received.items())])


def test_a_session_that_can_not_be_written_brings_the_robot_to_rest_first(tmp_path):
    path = tmp_path / "a.mcap"

    def full(tick):
        if tick.tick == 40:
            raise LogWriteError(path, "no space left on device")

    with alive(weak(9.0)) as (on, _):
        port = int(on.rpartition("=")[2])
        listener = can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0")
        plan = planned("weak-servo-pi3", on, path, duration_s=9.0)
        with listener:
            reason = "the joints were brought straight .* the last 1?[0-9]{2} control ticks are"
            with pytest.raises(LogWriteError, match=f"no space left on device; {reason}"):
                drive_bus(plan, stop=StopRequest(), on_tick=full)
            taken = {}
            while (message := listener.recv(0.2)) is not None:
                if 0x101 <= message.arbitration_id <= 0x119:
                    taken.setdefault(message.arbitration_id, []).append(bytes(message.data))
    raw = angles_of(taken)
    assert raw.shape[0] == 25
    assert raw.shape[1] > 41 + 20
    assert np.abs(raw[:, 40]).max() > 0
    assert not raw[:, -1].any()


@pytest.mark.slow
def test_a_pose_elsewhere_is_left_by_a_ramp_and_the_gait_begins_then(tmp_path):
    """A session whose first command is bent: the robot stands straight."""
    recorded, path = tmp_path / "bent.mcap", tmp_path / "a.mcap"
    robot = load_robot("snake25")
    bent = np.where(np.arange(25) % 2, 0.0, 0.2)
    commands = [bent * np.cos(tick / 100) for tick in range(31)]
    write_commands(recorded, robot.joint_names, commands, robot=robot)
    with alive(weak(9.0)) as (on, _):
        report = drive_bus(planned(str(recorded), on, path, duration_s=0.3), stop=StopRequest())
    assert report.outcome.how is DriveEnding.COMPLETE
    assert report.approach_s == pytest.approx(1.5 * 0.2 / 0.5, abs=0.011)
    with Session.open(path) as session:
        given = np.array(session.joints("/joint_commands").values)
        assert session.metadata["undulog"]["driven.session_id"] == "commands"
        phases = [message.data for _, message in session.messages("/gate/phase")]
    assert phases == ["approach", "run"]
    approach, run = given[:, :-31], given[:, -31:]
    np.testing.assert_array_equal(run.T, commands)
    assert np.abs(np.diff(approach)).max() <= 0.5 * 0.01 * (1 + 1e-9)
    assert np.abs(run[:, 0] - approach[:, -1]).max() <= 0.5 * 0.01


def test_a_robot_that_goes_away_is_reported_with_its_bus(tmp_path, command):
    path = tmp_path / "a.mcap"
    with alive(weak(0.1)) as (on, _):
        words = ("drive", "weak-servo-pi3", "--on", on, "--arm", "-o", path, "--duration", "5")
        out, err = command(*words, code=1)
    assert f"error: {on}: the robot closed the connection; nothing more was sent" in err
    assert out.startswith(f"{on}: stopped at 0.1 s of 5 s: ")
    with Session.open(path) as session:
        assert (session.verdict, session.channels["/joint_commands"].count) == ("bad", 11)


def test_any_bus_of_python_can_will_do(tmp_path):
    """A robot that does not say its name: its frames tell who it is."""
    robot = load_robot("snake25")
    reply = BusEncoder(robot, Direction.RX)
    pose = np.linspace(-0.1, 0.1, 25)
    taken = {}

    def answer(bus):
        """A robot that is where it was commanded to be."""
        while (message := bus.recv(0)) is not None:
            taken.setdefault(message.arbitration_id, []).append(bytes(message.data))
            angle = int.from_bytes(message.data[:2], "little", signed=True) * STEP
            pose[message.arbitration_id - 0x101] = angle
        keys = [(name, Quantity.POSITION, "") for name in robot.joint_names]
        for frame in reply.encode(dict(zip(keys, pose.tolist(), strict=True))):
            bus.send(can_message(frame))

    with speaking("gate-any", answer):
        plan = planned("flat", "can:virtual:gate-any", tmp_path / "a.mcap", duration_s=0.3)
        report = drive_bus(plan, stop=StopRequest())
    assert report.outcome.how is DriveEnding.COMPLETE, report.outcome
    assert report.approach_s >= LISTEN_S + 1.5 * 0.1 / 0.5 - 0.02
    assert {len(commands) for commands in taken.values()} == {report.tally.sent // 25}
    raw = angles_of(taken)
    assert np.abs(np.diff(raw)).max() * STEP <= 4.0 * 0.01 + STEP  # also where ticks were late
    with Session.open(tmp_path / "a.mcap") as session:
        assert (session.frames("/can/gate_any")["dir"] == DIR_TX).sum() == report.tally.sent
        sent = np.array(session.joints("/joint_commands").values)
    assert np.abs(raw * STEP - sent).max() <= STEP / 2 * (1 + 1e-6)


def test_another_controller_on_the_bus_is_not_joined(command, tmp_path):
    frame = can.Message(arbitration_id=0x103, data=bytes(2), is_extended_id=False)
    path, why = tmp_path / "a.mcap", "another controller commands snake25 on this bus: frame 103"
    with speaking("gate-two", lambda bus: bus.send(frame)) as other:
        on = ("--on", "can:virtual:gate-two", "--arm", "-o", path)
        assert f"no command was sent: {why}" in command("drive", "flat", *on, code=1).err
        assert other.recv(0.1) is None, "something was sent"
    with Session.open(path) as session:
        assert session.verdict == "bad"
        commands = session.channels.get("/joint_commands")
        assert commands is None or commands.count == 0


ARMED = "flat --arm -o a.mcap --on"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("flat --on can:virtual:bus --arm", "name the session with -o"),
        (f"{ARMED} can:socketcand", "no channel"),
        (f"{ARMED} can:virtual:bus?host=x", "no option 'host'"),
        ("flat --on unix:/tmp/a.sock", "expected twin, twin:SCENARIO or can:"),
        (f"{ARMED} can:nothing:x", "no CAN interface 'nothing'"),
        (f"{ARMED} can:virtual:bus --duration 0", "of 0 s"),
        (f"{ARMED} can:virtual:bus --duration nan", "of nan s"),
        ("flat --on can:virtual:bus --recorder x", "--recorder is for --arm"),
        (f"{ARMED} can:virtual:bus --robot snake13", "no bus map"),
        (
            f"{ARMED} can:virtual:bus --robot arcsnake-joint",
            "arcsnake-joint can't be armed: its description lacks max_rate",
        ),
        ("flat --on twin:", "names no scenario"),
        (f"{ARMED} twin", "are for a bus"),
        ("flt --on twin -o a.mcap", "did you mean flat?"),
        ("flat --on twin", "name the session with -o"),
        ("vertical --on twin:snake13-planar-pi2 -o a.mcap", "vertical joints and"),
        ("flat --on twin -o a.csv", "name it a.mcap"),
        ("flat --on twins -o a.mcap", "expected twin"),
        ("flat --on twin -o a.mcap --duration 0", "a duration of 0 s"),
    ],
)
def test_wrong_usage_exits_2_and_writes_nothing(words, complaint, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    assert complaint in command("drive", *words.split(), code=2).err
    assert not list(tmp_path.iterdir())


def test_a_gait_for_another_robot_is_refused(tmp_path):
    other = dataclasses.replace(load_robot("snake25"), name="other")
    with alive(weak(0.1)) as (on, _):
        plan = planned("flat", on, tmp_path / "a.mcap", robot=other)
        with pytest.raises(UsageError, match="is snake25, and flat is for other; nothing was sent"):
            drive_bus(plan, stop=StopRequest())
    assert not (tmp_path / "a.mcap").exists()


def test_nobody_there_exits_1(tmp_path, command):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    on = f"can:socketcand:can0?host=127.0.0.1&port={port}"
    words = ("--arm", "-o", str(tmp_path / "a.mcap"), "--duration", "0.1")
    assert "refused" in command("drive", "flat", "--on", on, *words, code=1).err


@pytest.mark.slow
def test_a_robot_that_says_nothing_is_sent_nothing(tmp_path):
    answers = SOCKETCAND | {"undulog": b"< undulog virtual-robot snake25 paced >"}
    silent = pytest.raises(SourceError, match=r"no command was sent: the pose is not known, all 25")
    with plain_server(answers) as (on, taken), silent:
        drive_bus(planned("flat", on, tmp_path / "a.mcap", duration_s=5.0), stop=StopRequest())
    assert taken == ["undulog", "open", "rawmode"]
