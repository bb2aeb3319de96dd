"""Faults of the virtual robot, logged on its bus, and of the twin: named by every output."""

import json
import math
import re
import time
from contextlib import closing

import pytest

import undulog
from support.processes import serving
from undulog.capture import Session, load_robot
from undulog.capture.sources.contract import parse_address
from undulog.capture.sources.events import Tally
from undulog.sim.drive.links import find_virtual_robot
from undulog.sim.drive.loop import CommandEncoder
from undulog.sim.drive.motion import find_motion
from undulog.sim.gait.contract import Readings
from zoo.judging import judge
from zoo.outputs import OUTPUTS, statements
from zoo.planting import RESPONSE
from zoo.truth import PAUSED, STOPPED, JointTruth, Truth

PATIENCE_S = 300
DURATION_S = 12.0
FREQUENCY_HZ = 0.8
SCENARIO = f"""
description = "A healthy robot; faults are ordered on the command line."
robot = "snake25"
duration_s = {DURATION_S}
seed = 20250131
{{more}}
[gait]
ramp_s = 1.0

[gait.horizontal]
amplitude = 0.3
frequency_hz = {FREQUENCY_HZ}
lag = {math.pi / 6!r}

[noise]
position = 0.001
"""

BROKEN = STOPPED | PAUSED
BUS = {
    "stuck:joint05@5": (STOPPED, 5.0),
    "frozen:joint13@6": (frozenset({"frozen_sensor"}), 6.0),
    "lost:joint19:0.2": (frozenset({"lost_samples"}), None),
    "stuck:joint23": (STOPPED, None),
    "frozen:joint03@4+3": (frozenset({"frozen_sensor", "stale_sensor"}), 4.0),
    "stuck:joint13@5+2.5": (BROKEN, 5.0),
}
"""What is ordered, the kinds of which one must be stated and no other, and the onset [s]."""

RUNS = [list(BUS)[:3], list(BUS)[3:]]


class SnakeOfTheBus:
    """A robot as a judge takes it."""

    names = load_robot("snake25").joint_names
    omega = 2 * math.pi * FREQUENCY_HZ


def logged_on_the_bus(folder, scenario, faults):
    """Serve and drive in lockstep, and log what is on the bus by the robot's own clock.

    Its time is simulated, so the log is the same however busy the computer is. The driver looks
    at nothing, so it never gives up.
    """
    robot = load_robot("snake25")
    words = [word for fault in faults for word in ("--fault", fault)]
    words += ["--lockstep", "--fast", "--duration", str(DURATION_S)]
    lines = []
    with serving(scenario, *words) as (served, ready):
        gait = find_motion(str(scenario)).make(robot, None)
        encoder, blind = CommandEncoder(robot), Readings.nothing(robot)
        address = parse_address(f"can:socketcand:can0?port={ready['port']}")
        with closing(find_virtual_robot(address, Tally(time.time_ns))) as link:
            for tick in range(round(DURATION_S * 100) + 1):
                now, received = link.wait_tick(PATIENCE_S)
                assert now == tick
                sent = encoder.frames(gait.step(tick / 100, blind).command)
                link.send(sent)
                lines += [(int(f["t_device_ns"]), True, f) for frames in received for f in frames]
                lines += [(tick * 10**7, False, frame) for frame in sent]
        end = json.loads(served.communicate(timeout=PATIENCE_S)[0])
        assert served.returncode == 0
    start_ns = round(end["start_s"] * 1e9)
    log = folder / "bus.log"
    with log.open("w") as file:
        times = [(t_ns - start_ns * of_robot, frame) for t_ns, of_robot, frame in lines]
        for t_ns, frame in sorted(times, key=lambda row: row[0]):
            data = frame["data"][: frame["dlc"]].tobytes().hex().upper()
            identifier = frame["id_flags"] & 0x7FF
            file.write(f"({1_700_000_000 + t_ns * 1e-9:.6f}) can0 {identifier:03X}#{data}\n")
    output = folder / "run.mcap"
    assert undulog.run(["import", str(log), "-o", str(output), "--robot", "snake25"]) == 0
    return output


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("virtual") / "served.toml"
    path.write_text(SCENARIO.format(more=""))
    return path


@pytest.fixture(scope="module")
def healthy(scenario):
    path = scenario.with_name("healthy.mcap")
    assert undulog.run(["sim", "run", str(scenario), "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def healthy_on_the_bus(scenario):
    return logged_on_the_bus(scenario.parent, scenario, [])


def problems(path, healthy, truth):
    """What is wrong with any output, a line each; where a neighbour differs it does so indeed."""
    results = statements(path, healthy, second=False)
    assert set(results) == set(OUTPUTS)
    return "\n".join(
        f"{output}: {reason}; found: {statement.text!r}"
        for output, statement in results.items()
        for reason in judge(output, statement, truth, SnakeOfTheBus).missing
    )


@pytest.mark.nightly
@pytest.mark.parametrize("faults", RUNS, ids="; ".join)
def test_faults_on_the_bus_are_named(tmp_path, scenario, healthy_on_the_bus, faults):
    """By every output."""
    path = logged_on_the_bus(tmp_path, scenario, faults)
    place = SnakeOfTheBus.names.index
    with Session.open(path) as session:  # its clock starts before the robot's does
        sampled_ns = min(int(t_ns[0]) for t_ns in session.joints("/joint_states").t_ns)
        first_s = (sampled_ns - session.start_ns) * 1e-9
    truths = []
    for fault in faults:
        joint, (kinds, since) = place(re.split("[:@]", fault)[1]), BUS[fault]
        times = {"since_s": None if since is None else first_s + since}
        truths.append(JointTruth(joint, kinds, kinds, compared=kinds != {"lost_samples"}, **times))
    wrong = problems(path, healthy_on_the_bus, Truth(tuple(truths)))
    assert not wrong, wrong


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("torque", "truth"),
    [
        (0.25, JointTruth(12, stands_out=RESPONSE, checked=False)),
        # Without power its neighbours swing it: far from its command, at hardly any effort.
        (1e-4, JointTruth(12, frozenset({"dead"}), frozenset({"dead"}))),
    ],
    ids=["weak", "dead"],
)
def test_a_servo_of_the_twin_is_named_by_every_output(tmp_path, healthy, torque, truth):
    path = tmp_path / "run.toml"
    path.write_text(SCENARIO.format(more=f"[servo_of.joint13]\nstall_torque = {torque}\n"))
    assert undulog.run(["sim", "run", str(path), "-o", str(tmp_path / "run.mcap")]) == 0
    wrong = problems(tmp_path / "run.mcap", healthy, Truth((truth,)))
    assert not wrong, wrong
