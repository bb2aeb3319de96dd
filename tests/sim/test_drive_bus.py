"""The control loop over a bus, against the virtual robot of ``sim serve`` and a plain server."""

import dataclasses
import json
import signal
import socket
import threading
import time
from contextlib import contextmanager

import can
import numpy as np
import pytest

import undulog as front
from capture import Session, load_robot
from capture.bus.encoding import BusEncoder
from capture.errors import SourceError, UsageError
from capture.interruption import StopRequest
from capture.log.frames import DIR_TX
from capture.robot import Direction, Quantity
from capture.sources.address import parse_address
from capture.sources.events import Tally
from sim import load_scenario
from sim.control.build import build_gait
from sim.drive.driven import find_driven
from sim.drive.link import VirtualRobotLink, sent_text
from sim.drive.loop import CommandEncoder
from sim.drive.over_bus import bus_plan, drive_bus
from sim.drive.pace import WallPace
from sim.gait import GaitTick
from sim.sensing.contract import JointSample
from sim.serve.bus import VirtualBus
from sim.serve.pacing import Pacer
from sim.serve.robot import PERIOD_NS, VirtualRobot
from sim.serve.socketcand_server import SocketcandServer
from sim.twin import Twin

STEP = np.radians(0.01)  # of a command on the bus of snake25


def silent(level, text):
    del level, text


@contextmanager
def alive(scenario, *, lockstep=True):
    """A virtual robot in a thread: its bus's address, and how its run went."""
    server = SocketcandServer("127.0.0.1", 0, "can0", silent)
    bus, stop, served = VirtualBus(server, None, silent), StopRequest(), []
    pacer = Pacer(PERIOD_NS, fast=lockstep)
    robot = VirtualRobot(scenario, bus, pacer, lockstep=lockstep, stop=stop, say=silent)

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


def ended(served):
    """Wait until a virtual robot's run is over."""
    deadline = time.monotonic() + 30
    while not served:
        assert time.monotonic() < deadline, "the robot goes on"
        time.sleep(0.01)


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


def test_in_lockstep_the_robot_gets_the_gaits_commands_tick_by_tick(tmp_path, capsys):
    path, direct = tmp_path / "bus.mcap", tmp_path / "direct.mcap"
    words = ["drive", "weak-servo-pi3", "--duration", "0.3"]
    with alive(weak(0.3)) as (on, served):
        assert front.run([*words, "--on", on, "--arm", "-o", str(path), "--json"]) == 0
        ended(served)  # it has its last tick still to do
    report = json.loads(capsys.readouterr().out)
    assert (report["pace"], report["ticks"], report["overruns"]) == ("lockstep", 31, 0)
    assert (report["sent"], report["complete"]) == (31 * 25, True)
    assert report["decoded"] == report["received"] > 25 * 20
    assert served[0].complete
    assert served[0].commands == 31 * 25
    assert front.run([*words, "--on", "twin", "-o", str(direct)]) == 0
    with Session.open(path) as over_bus, Session.open(direct) as in_process:
        for topic in ("/joint_commands", "/gait"):
            found, expected = over_bus.joints(topic), in_process.joints(topic)
            np.testing.assert_array_equal(found.values, expected.values)
            np.testing.assert_array_equal(found.t_ns, expected.t_ns)
        assert (over_bus.verdict, over_bus.warnings) == ("good", [])
        facts = over_bus.metadata["undulog"]
        assert (facts["driven"], facts["armed"], facts["source.can0"]) == ("gait", "yes", on)
        assert over_bus.robot == load_robot("snake25")
        measured = over_bus.joints("/joint_states")
    # The robot did what the twin does with commands rounded to the bus, and said so, rounded.
    with Twin(
        weak(0.3), Rounded(find_driven("weak-servo-pi3").make(load_robot("snake25"), None))
    ) as twin:
        samples = [one for sample in twin.samples() for one in sample.sensed]
    cycles = np.array([one.position for one in samples if isinstance(one, JointSample)])
    found = np.array(measured.values)[:, : len(cycles)]
    assert np.abs(found - cycles[: found.shape[1]].T).max() <= STEP / 2 * (1 + 1e-6)


@pytest.mark.slow
def test_an_adaptive_controller_does_the_same_over_the_bus_as_in_process():
    scenario = load_scenario("target-following").changed(duration_s=3.0)
    over_bus = []
    with alive(scenario) as (on, served):
        drive_bus(
            planned("target-following", on, duration_s=3.0),
            stop=StopRequest(),
            on_tick=lambda tick: over_bus.append(tick.gait),
        )
    assert served[0].pace.ticks >= 300  # whether it still looks at the end, who stops it decides
    with Twin(scenario, Rounded(build_gait(scenario))) as twin:
        in_process = [sample.gait for sample in twin.samples()]
    assert [tick.mode for tick in over_bus] == [tick.mode for tick in in_process]
    assert len({tick.mode for tick in over_bus}) > 1  # it met something
    commands = np.round(np.array([tick.command for tick in over_bus]) / STEP) * STEP
    error = np.abs(commands - np.array([tick.command for tick in in_process]))
    # Readings are rounded on the bus (angles 0.01 degrees, distances 1 mm), and so are commands.
    assert error.max() <= STEP * (1 + 1e-6)


def test_in_real_time_the_loop_keeps_to_the_clock(tmp_path):
    with alive(load_scenario("flat").changed(duration_s=30.0), lockstep=False) as (on, _):
        plan = planned("flat", on, duration_s=0.5, output=tmp_path / "a.mcap")
        report = drive_bus(plan, stop=StopRequest())
    assert report.tally.complete
    assert report.tally.duration_s == 0.5
    assert report.tally.ticks <= 51 <= report.tally.ticks + report.tally.overruns
    assert report.wall_s >= 0.5
    assert report.tally.sent == 25 * report.tally.ticks
    with Session.open(tmp_path / "a.mcap") as session:
        times = session.joints("/joint_commands").t_ns[0]
        assert (np.diff(times) > 0).all()
        assert len(times) == report.tally.ticks
        assert (session.verdict == "good") == (report.tally.overruns == 0)


def planned(what, on, *, duration_s=0.2, armed=True, output=None):
    return bus_plan(
        find_driven(what),
        on,
        duration_s=duration_s,
        armed=armed,
        output=output,
        recorder=None,
        force=False,
    )


def test_a_dry_run_sends_nothing_and_says_what_it_would(tmp_path, capsys):
    path = tmp_path / "dry.mcap"
    with alive(load_scenario("flat").changed(duration_s=30.0), lockstep=False) as (on, served):
        words = ["drive", "flat", "--on", on, "--duration", "0.3", "-o", str(path)]
        assert front.run(words) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"{on}: dry run of flat for 0.3 s"
    assert told[2].startswith("0 frames sent, ")
    assert "nothing was sent; the first tick would have been 101#0000 102#0000" in told[3]
    assert served[0].commands == 0
    with Session.open(path) as session:
        assert "/joint_commands" not in session.channels
        assert session.metadata["undulog"]["armed"] == "no"
        assert session.settle_s == load_scenario("flat").settle_s > 0
        assert session.channels["/dry_run/joint_commands"].count > 1
        assert session.channels["/joint_states"].count > 1  # it listened
        assert not (session.frames("/can/can0")["dir"] == DIR_TX).any()


def test_a_dry_run_listens_to_any_bus_and_puts_nothing_on_it(capsys):
    robot = load_robot("snake25")
    frames = BusEncoder(robot, Direction.RX).encode({("joint01", Quantity.POSITION, ""): 0.1})
    message = can.Message(
        arbitration_id=int(frames["id_flags"][0]), data=frames["data"][0], is_extended_id=False
    )
    with can.Bus(interface="virtual", channel="drive-dry") as other:
        ended = threading.Event()

        def talk():
            while not ended.wait(0.005):
                other.send(message)

        talker = threading.Thread(target=talk)
        talker.start()
        try:
            words = ["drive", "flat", "--on", "can:virtual:drive-dry", "--duration", "0.3"]
            assert front.run([*words, "--json"]) == 0
        finally:
            ended.set()
            talker.join()
        assert other.recv(0.1) is None
    report = json.loads(capsys.readouterr().out)
    assert (report["armed"], report["sent"]) == (False, 0)
    assert report["decoded"] == report["received"] > 3
    assert report["first_frames"][:2] == ["101#0000", "102#0000"]


def test_asked_to_stop_the_robot_comes_to_rest_within_a_second(tmp_path):
    path, stop = tmp_path / "a.mcap", StopRequest()

    def ask(tick):
        if tick.tick == 20:
            stop.signal = signal.SIGINT

    with alive(weak(3.0)) as (on, _):
        report = drive_bus(
            planned("weak-servo-pi3", on, duration_s=3.0, output=path), stop=stop, on_tick=ask
        )
    assert not report.tally.complete
    assert report.tally.ticks == 21 + 101  # the next tick begins to fade, the last one is at rest
    with Session.open(path) as session:
        commands = np.array(session.joints("/joint_commands").values)
        said = [message.msg for _, message in session.messages("/rosout")]
        assert session.verdict == "good"
    assert not commands[:, -1].any()
    assert said[-1] == "at rest, as it was asked to stop, at 1.21 s"


def test_a_robot_that_goes_away_is_told_by_its_bus(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with alive(weak(0.1)) as (on, _):
        words = ["drive", "weak-servo-pi3", "--on", on, "--arm", "-o", str(path)]
        assert front.run([*words, "--duration", "5"]) == 1
    assert f"error: {on}: the robot closed the connection" in capsys.readouterr().err
    with Session.open(path) as session:
        assert session.verdict == "bad"
        assert session.channels["/joint_commands"].count == 11


def test_a_bus_that_goes_away_ends_a_dry_run(capsys):
    with alive(load_scenario("flat").changed(duration_s=1.5), lockstep=False) as (on, _):
        assert front.run(["drive", "flat", "--on", on, "--duration", "60"]) == 1
    assert "closed the connection" in capsys.readouterr().err


@contextmanager
def plain_server(answers, stream=()):
    """A server of one client: answers each message by its first word, then sends a stream."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        heard = []

        def serve():
            client, _ = listener.accept()
            with client:
                client.sendall(b"< hi >")
                while chunk := client.recv(65536):
                    for message in chunk.decode().split(">")[:-1]:
                        word = message.strip(" <").split()[0]
                        heard.append(word)
                        client.sendall(answers.get(word, b""))
                    for piece in stream if heard[-1] == "rawmode" else ():
                        client.sendall(piece)
                        time.sleep(0.01)

        thread = threading.Thread(target=serve)
        thread.start()
        port = listener.getsockname()[1]
        yield f"can:socketcand:can0?host=127.0.0.1&port={port}", heard
        thread.join()


SOCKETCAND = {
    "open": b"< ok >",
    "rawmode": b"< ok >",
    "undulog": b"< error unknown command >",  # as socketcand 0.6 answers
}


def test_commands_go_to_no_other_server_than_the_virtual_robots(capsys):
    with plain_server(SOCKETCAND) as (on, heard):
        assert front.run(["drive", "flat", "--on", on, "--arm"]) == 2
    said = capsys.readouterr().err
    assert "does not say that it is a virtual robot; commands are sent to undulog's own" in said
    assert "leave --arm out to look on" in said
    assert heard == ["undulog"]  # nothing was opened, nothing sent


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--on", "can:virtual:bus", "--arm"), "is no virtual robot's bus"),
        (("--on", "can:socketcand", "--arm"), "is no virtual robot's bus"),
        (("--on", "can:socketcan:can0?host=x", "--arm"), "commands are sent to undulog's own"),
        (("--on", "unix:/tmp/a.sock"), "expected twin, twin:SCENARIO or can:"),
        (("--on", "can:nothing:x"), "no CAN interface 'nothing'"),
        (("--on", "can:virtual:bus", "--duration", "0"), "a duration of 0 s"),
        (("--on", "can:virtual:bus", "--duration", "nan"), "a duration of nan s"),
        (("--on", "twin:"), "names no scenario"),
        (("--on", "twin", "--arm", "-o", "a.mcap"), "--arm and --recorder are for a bus"),
    ],
)
def test_wrong_usage_exits_2(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert front.run(["drive", "flat", *words]) == 2
    assert told in capsys.readouterr().err


def test_a_gait_for_another_robot_is_refused():
    scenario = weak(0.1)
    with alive(scenario) as (on, _):
        plan = planned("flat", on)
        other = dataclasses.replace(plan.driven.robot, name="other")
        plan = dataclasses.replace(plan, driven=dataclasses.replace(plan.driven, robot=other))
        with pytest.raises(UsageError, match="is snake25, and flat is for other"):
            drive_bus(plan, stop=StopRequest())


def test_nobody_there_exits_1(capsys):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    on = f"can:socketcand:can0?host=127.0.0.1&port={port}"
    for arm in ((), ("--arm",)):
        assert front.run(["drive", "flat", "--on", on, *arm, "--duration", "0.1"]) == 1
        assert "refused" in capsys.readouterr().err


def test_a_robot_that_says_nothing_is_lost():
    answers = SOCKETCAND | {"undulog": b"< undulog virtual-robot snake25 paced >"}
    lost = pytest.raises(SourceError, match=r"the robot is lost: silent for 0\.5 s")
    with plain_server(answers) as (on, heard), lost:
        drive_bus(planned("flat", on, duration_s=5.0), stop=StopRequest())
    assert heard[:3] == ["undulog", "open", "rawmode"]
    assert set(heard[3:]) == {"send"}


@pytest.mark.parametrize("cut", [3, 12, 40, 60, 100, 120])
def test_ticks_and_frames_stay_in_order_however_the_stream_is_cut(cut):
    answers = SOCKETCAND | {"undulog": b"< undulog virtual-robot snake25 lockstep >"}
    stream = (
        b"< tick 0 >< tick 1 >< frame 201 1.000000 0102 >< frame 202 1.000100 03 >< tick 2 >"
        b"< frame 203 1.010000 0A >"
    )
    with plain_server(answers, (stream[:cut], stream[cut:])) as (on, _):
        link = VirtualRobotLink(parse_address(on), Tally(lambda: 0))
        try:
            assert (link.robot_name, link.lockstep) == ("snake25", True)
            found = [link.wait_tick(5.0) for _ in range(3)]
            assert [tick for tick, _ in found] == [0, 1, 2]
            assert [identifiers(frames) for _, frames in found] == [[], [], [0x201, 0x202]]
            assert link.wait_tick(0.05) is None
            assert identifiers(link.receive()) == [0x203]
        finally:
            link.close()


def identifiers(arrays):
    return [identifier for frames in arrays for identifier in frames["id_flags"].tolist()]


def test_commands_are_rounded_to_the_bus_and_sent_as_socketcand_has_them():
    robot = load_robot("snake25")
    command = np.linspace(-0.5, 0.5, 25)
    frames = CommandEncoder(robot).frames(GaitTick(command, np.empty(0), "walk", ()))
    assert frames["id_flags"].tolist() == list(range(0x101, 0x11A))
    raw = frames["data"][:, :2].copy().view("<i2")[:, 0]
    np.testing.assert_array_equal(raw, np.round(np.degrees(command) * 100))
    assert np.abs(raw * STEP - command).max() <= STEP / 2
    assert sent_text(frames[:1]) == b"< send 101 2 %02X %02X >" % tuple(frames["data"][0, :2])


class _NoBus:
    """What a pace needs of a bus: nothing comes."""

    place = "none"

    def receive(self):
        return ()


def test_late_ticks_are_left_out_and_counted():
    pace = WallPace(_NoBus(), 100)
    assert pace.next()[0] == 0
    assert pace.next()[0] == 1
    time.sleep(0.045)  # until 5.5 periods after the start, at least
    tick = pace.next()[0]
    assert tick >= 5
    assert pace.overruns == tick - 2
    began = time.monotonic()
    after = pace.next()[0]
    assert after >= tick + 1
    assert time.monotonic() - began < 1.0
