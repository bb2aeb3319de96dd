"""``sim serve`` as its users run it: robot, recorders and controller, each a process of its own."""

import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import undulog as front
from support.paths import ROOT
from support.processes import UNDULOG, process, serving, undulog, wait_for
from undulog.capture import Session, load_robot
from undulog.capture.log.health.session_check import check_session
from undulog.capture.recorder.control_client import ControlClient
from undulog.capture.sources.contract import parse_address
from undulog.capture.sources.events import Tally
from undulog.sim.drive.links import find_virtual_robot
from undulog.sim.drive.loop import CommandEncoder
from undulog.sim.drive.motion import find_motion
from undulog.sim.gait.contract import Readings

PATIENCE_S = 300
DURATION_S = 3.0
STEP = {  # of the robot's DBC, in SI
    ("/joint_commands", "position"): math.radians(0.01),
    ("/joint_states", "position"): math.radians(0.01),
    ("/joint_states", "velocity"): math.radians(0.1),
    ("/joint_states", "effort"): 0.001,
    ("/joint_current", "position"): 0.001,
}
SCENARIO = f"""
description = "On the bus and in process."
robot = "snake25"
duration_s = {DURATION_S}
seed = 3

[gait]
ramp_s = 1.0

[gait.horizontal]
amplitude = 0.4
frequency_hz = 0.5
lag = 1.0471975511965976

[noise]
position = 0.001

[sensing.servo]
slot_s = 0.0003
command_resolution = {math.radians(0.01)!r}

[[world.obstacles]]
shape = "wall"
from = [0.8, -3.0]
to = [0.8, 3.0]
"""


def ask(control, **request):
    with ControlClient(control, patience_s=PATIENCE_S) as client:
        return client.ask(request)


@contextmanager
def recorder(source, output):
    """A recorder whose source is connected; it is asked to end at the end."""
    control = output.with_suffix(".ctl")
    words = ("--robot", "snake25", "-o", str(output), "--socket", str(control), "--floor", "0")
    with process(*UNDULOG, "record", f"can0={source}", *words, "--json", "--quiet") as started:

        def connected():
            assert started.poll() is None, started.stdout.read()
            return control.exists() and ask(control, do="status")["sources"][0]["connected"]

        wait_for(connected, f"the recorder of {source}")
        yield control
        ask(control, do="stop", wait=True)


def driven(scenario, port, control, *words):
    on = ("--on", f"can:socketcand:can0?port={port}", "--arm", "--recorder", control, "--json")
    done = undulog("drive", scenario, *on, *words, "-o", control.with_suffix(".drive.mcap"), code=0)
    return json.loads(done.stdout)


@dataclass
class Run:
    """One scenario, in process and over the bus."""

    ready: dict
    end: dict
    drive: dict
    in_process: Path
    over_bus: dict[str, Path]


def heedless(scenario, port, control):
    """A controller in lockstep that looks at nothing, and so goes on whatever is wrong."""
    del control
    robot = load_robot("snake25")
    gait = find_motion(str(scenario)).make(robot, None)
    encoder, blind = CommandEncoder(robot), Readings.nothing(robot)
    address = parse_address(f"can:socketcand:can0?host=127.0.0.1&port={port}")
    link = find_virtual_robot(address, Tally(lambda: 0))
    with closing(link):
        for tick in range(round(DURATION_S * 100) + 1):
            assert link.wait_tick(PATIENCE_S)[0] == tick
            link.send(encoder.frames(gait.step(tick / 100, blind).command))


def on_the_bus(folder, scenario, *words, controller=driven):
    """Robot, two recorders and a controller; returns what each reported and wrote."""
    bus = folder / "bus.sock"
    over_bus = {way: folder / f"{way}.mcap" for way in ("tcp", "unix")}
    words = ("--unix", str(bus), "--duration", str(DURATION_S), "--lockstep", *words)
    with serving(scenario, *words) as (robot, ready), ExitStack() as recorders:
        tcp = f"can:socketcand:can0?port={ready['port']}"
        control = recorders.enter_context(recorder(tcp, over_bus["tcp"]))
        recorders.enter_context(recorder(f"unix:{bus}", over_bus["unix"]))
        drive = controller(scenario, ready["port"], control)
        out, _ = robot.communicate(timeout=PATIENCE_S)
        assert robot.returncode == 0
    return ready, json.loads(out), drive, over_bus


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("serve") / "served.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="module")
def run(scenario):
    ready, end, drive, over_bus = on_the_bus(scenario.parent, scenario)
    in_process = scenario.parent / "in_process.mcap"
    assert front.run(["sim", "run", str(scenario), "-o", str(in_process)]) == 0
    return Run(ready, end, drive, in_process, over_bus)


def columns(session, topic, field):
    series = session.joints(topic, field)
    return series.names, np.array(series.values), np.array(series.t_ns)


@pytest.mark.slow
def test_over_the_bus_come_the_same_columns_to_within_half_a_step_of_the_dbc(run):
    assert (run.end["complete"], run.end["commands"]) == (True, 25 * 301)
    assert run.end["unix_refused"] == run.end["dropped_clients"] == 0
    with Session.open(run.in_process) as truth:
        for path in run.over_bus.values():
            with Session.open(path) as recorded:
                for (topic, field), step in STEP.items():
                    names, expected, _ = columns(truth, topic, field)
                    own_names, values, _ = columns(recorded, topic, field)
                    assert own_names == names
                    assert values.shape == expected.shape == (25, 301)
                    assert np.abs(values - expected).max() <= step / 2 * (1 + 1e-9), topic


@pytest.mark.slow
def test_sensors_come_over_the_bus_too(run):
    with Session.open(run.in_process) as truth:
        topics = {sensor.topic: sensor for sensor in truth.robot.sensors}
        for path in run.over_bus.values():
            with Session.open(path) as recorded:
                assert set(topics) <= set(recorded.channels)
                for topic in topics:
                    expected, values = truth.table(topic), recorded.table(topic)
                    assert len(values) == len(expected) > 0, topic
                    for column, step in SENSOR_COLUMNS[topics[topic].kind].items():
                        np.testing.assert_allclose(
                            values[column], expected[column], rtol=0, atol=step / 2 * (1 + 1e-9)
                        )


SENSOR_COLUMNS = {
    "ir": {"range": 0.001},
    "sonar": {"range": 0.001},
    "accelerometer": {f"linear_acceleration.{axis}": 9.80665e-3 for axis in "xyz"},
    "compass": {f"magnetic_field.{axis}": 1e-8 for axis in "xy"},
}


@pytest.mark.slow
def test_times_over_the_bus_are_those_of_the_run(run, opened):
    """Device times to the microsecond; what the recorder makes of them, within 2 ms."""
    start_ns = round(run.end["start_s"] * 1e9)
    _, _, expected = columns(opened(run.in_process), "/joint_states", "position")
    expected = expected - expected.min()
    for way, path in run.over_bus.items():
        with Session.open(path) as recorded:
            frames = recorded.frames("/can/can0")
            _, _, mapped = columns(recorded, "/joint_states", "position")
        states = frames[(frames["id_flags"] >= 513) & (frames["id_flags"] <= 537)]
        device = states["t_device_ns"].astype(np.int64).reshape(-1, 25).T
        gap = device - start_ns - expected
        assert np.ptp(gap, axis=0).max() <= 1000
        assert (np.diff(gap[0]) >= -1000).all()  # where simulated time stood still, if it did
        assert gap[0, -1] <= run.end["stood_still_s"] * 1e9 + 1e6
        late = (mapped - run.ready["epoch_ns"] - device)[:, 200:]  # the clock is known after 2 s
        assert late.min() > 0
        if way == "unix":
            assert late.max() < 2_000_000
        else:  # read a recorder's tick late, all alike
            assert np.ptp(late) < 2_000_000


@pytest.mark.nightly
def test_faults_that_were_ordered_are_in_the_verdict(tmp_path, scenario, opened):
    words = ("lost:joint07:0.2", "frozen:joint03@0.2", "noise:0.02", "bus-off@1.5+0.4")
    faults = [word for text in words for word in ("--fault", text)]
    _, end, _, over_bus = on_the_bus(tmp_path, scenario, *faults, controller=heedless)
    assert end["lost"] > 0
    assert end["hit"] > 0
    for path in over_bus.values():
        health = check_session(path)
        assert health.verdict != "good"
        reasons = "\n".join(health.reasons)
        missing = [text for text in health.reasons if "samples are not a number" in text]
        assert any("/joint_states" in text and "joint07" in text for text in missing)
        assert "/joint_states, joint03: frozen for " in reasons
        assert "error frames" in reasons
        (bus,) = health.buses
        assert bus.error_frames == end["hit"] + 2  # off, and back again
        notes = [message.msg for _, message in opened(path).messages("/rosout")]
        assert "bus-off: the controller left the bus" in notes
        assert "the controller is back on the bus" in notes


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_in_good_order(number, tmp_path):
    words = ("--wait", "--unix", str(tmp_path / "bus.sock")) if number is signal.SIGINT else ()
    with serving("flat", *words, stderr=subprocess.PIPE) as (robot, ready):
        assert ready["waits"] is bool(words)
        policy = os.sched_getscheduler(robot.pid) & ~os.SCHED_RESET_ON_FORK
        assert (ready["priority"] == "SCHED_RR 1") == (policy == os.SCHED_RR)
        with socket.create_connection((ready["host"], ready["port"])) as client:
            assert client.recv(100) == b"< hi >"
            client.sendall(b"< open can0 >< rawmode >")
            if not words:
                while b"< frame 219 " not in client.recv(65536):
                    pass
            robot.send_signal(number)
            out, err = robot.communicate()
    assert robot.returncode == 0, err
    end = json.loads(out)
    assert end["event"] == "end"
    assert end["complete"] is False
    assert (end["ticks"] > 0) is not bool(words)


@pytest.mark.slow
def test_the_manuals_own_controller_moves_the_robot():
    page = (ROOT / "docs" / "how-to/virtual-robot.md").read_text()
    (snippet,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with serving("flat", "--wait") as (robot, ready):
        snippet = snippet.replace("29536", str(ready["port"])).replace("range(1000)", "range(50)")
        subprocess.run([sys.executable, "-c", snippet], check=True, timeout=PATIENCE_S)
        robot.send_signal(signal.SIGTERM)
        end = json.loads(robot.communicate()[0])
    assert end["commands"] == 50 * 13
    assert end["ticks"] > 10


def test_what_cannot_be_served_is_refused_at_once(command):
    for words, message in (
        (["flat"], "give --socketcand PORT or --unix PATH"),
        (["flat", "--socketcand", "1e3"], "expected [HOST:]PORT"),
        (["flat", "--socketcand", "192.0.2.1:0"], "is not this computer's loopback"),
        (["snake13-horizontal-pi2", "--socketcand", "0"], "snake13 has no bus map"),
        (["flat", "--socketcand", "0", "--fast"], "only in lockstep"),
        (["flat", "--unix", "x", "--lockstep"], "give --socketcand PORT"),
        (["flat", "--socketcand", "0", "--fault", "lsot:0.1"], "did you mean lost?"),
        (["flat", "--socketcand", "0", "--duration", "0"], "a duration of 0 s"),
        (["flat", "--unix", "x" * 200], "AF_UNIX path too long"),
    ):
        assert message in command("sim", "serve", *words, code=2).err
