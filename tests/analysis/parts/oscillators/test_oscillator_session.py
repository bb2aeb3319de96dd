"""Sessions whose generator logged its phases, analysed by the command."""

import dataclasses
import math

import numpy as np
import pytest

from undulog.capture import SessionWriter, load_robot
from undulog.capture.robot.model import Plane
from undulog.sim import Readings
from undulog.sim.gait.oscillators import OscillatorChain, OscillatorChains, OscillatorGait

EPOCH_NS = 1_735_689_600_000_000_000
ROBOT = load_robot("snake13")
YAW = ROBOT.joint_indices(Plane.HORIZONTAL)
NAMES = [ROBOT.joint_names[k] for k in YAW]
PAIRS = len(NAMES) - 1
FORWARD = tuple(np.linspace(1.0, 3.0, PAIRS).tolist())
BACKWARD = tuple(np.linspace(2.5, 0.8, PAIRS).tolist())
LAG = math.pi / 3


def write(path, seconds, **fields):
    """The generator's own log, its joints following with a gain and a lag."""
    chain = OscillatorChain(0.4, 0.5, LAG, forward=FORWARD, backward=BACKWARD, **fields)
    gait = OscillatorGait(OscillatorChains({Plane.HORIZONTAL: chain}), ROBOT)
    readings = Readings.nothing(ROBOT)
    with SessionWriter(path, session_id=path.stem, epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        channel = writer.joint_state("/gait", gait.names, unit="rad, omega in rad/s")
        commands = writer.joint_state("/joint_commands", ROBOT.joint_names, unit="rad")
        states = writer.joint_state("/joint_states", ROBOT.joint_names, unit="rad")
        before = np.zeros(len(ROBOT.joints))
        for k in range(round(100 * seconds) + 1):
            t_ns = EPOCH_NS + k * 10_000_000
            tick = gait.step(k / 100, readings)
            angle = before + 0.2 * (tick.command - before)
            channel.write(t_ns, tick.values)
            commands.write(t_ns, tick.command)
            states.write(t_ns, before)
            # What a sample tells is known a period later.
            readings = dataclasses.replace(readings, angle=before)
            before = angle
    return path


def planted(link):
    i, j = NAMES.index(link["target"]), NAMES.index(link["source"])
    return FORWARD[j] if j < i else BACKWARD[i]


@pytest.mark.nightly
@pytest.mark.parametrize("feedback", [0.0, 0.6])
def test_a_kicked_session_gives_its_couplings(tmp_path, feedback, command, report_of):
    path = write(tmp_path / "run.mcap", 29.0, kick_every_s=3.0, kick_size=1.0, feedback=feedback)
    (chain,) = report_of("analyse", path)["oscillators"]
    assert (chain["identifiable"], chain["plane"], chain["kicks"]) == (True, "horizontal", 9)
    assert len(chain["links"]) == 2 * PAIRS
    errors = [abs(link["K"]["value"] / planted(link) - 1) for link in chain["links"]]
    assert np.median(errors) < 0.05
    for link in chain["links"]:
        ahead = NAMES.index(link["source"]) - NAMES.index(link["target"])
        # A wave from head to tail: the phase falls by the lag from joint to joint.
        assert link["lag_rad"]["value"] == pytest.approx(-ahead * LAG, abs=0.1)
    for oscillator in chain["oscillators"]:
        assert oscillator["feedback"]["value"] == pytest.approx(feedback, abs=0.06)
    out = command("analyse", path).out
    assert "Oscillators, horizontal: 10 couplings identified (condition number" in out


@pytest.mark.slow
def test_a_locked_session_is_refused(tmp_path, command, report_of):
    path = write(tmp_path / "locked.mcap", 10.0)
    (chain,) = report_of("analyse", path)["oscillators"]
    assert (chain["identifiable"], chain["links"]) == (False, [])
    assert "locked" in chain["why"]
    assert "kick_every_s" in chain["record"]
    assert "coupling not identifiable: the phases are locked" in command("analyse", path).out
