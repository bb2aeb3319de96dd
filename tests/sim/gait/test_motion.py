"""What the shipped gaits do to the body, against figures measured with an earlier, separate twin.

That twin found (f = 0.5 Hz): caterpillar 0.039 m/s at lag pi/3 and 0.023 at pi/2; sidewinding 0.27
to 0.32 m/s sideways; rolling half a turn a second; twist 0.05 to 0.11 m/s.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from undulog.capture import Session
from undulog.capture.robot.model import Plane
from undulog.sim import Readings, Twin, load_scenario, record
from undulog.sim.scenario.motion import generator
from undulog.sim.scenario.scenario import Kernels

CYCLE = 200  # ticks


class Motion(NamedTuple):
    """Means over the last five cycles, along the mean direction from tail to head."""

    speed: float
    forward: float
    left: float
    turns_per_s: float
    positions: np.ndarray


@cache
def motion(name):
    positions, rolls = [], []
    with Twin(load_scenario(name), kernels=Kernels.NUMBA) as twin:
        for sample in twin.samples():
            body = sample.step.body
            x, y, z, w = body.quaternion
            axes = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
            rolls.append((axes * body.spin).sum(axis=0).mean())
            positions.append(body.position)
    positions = np.array(positions)
    centre = positions.mean(axis=2)  # the links are alike
    velocity = (centre[-1] - centre[-1 - 5 * CYCLE])[:2] / (5 * CYCLE / 100)
    body = positions[-5 * CYCLE :]
    axis = (body[:, :2, 0] - body[:, :2, -1]).mean(axis=0)
    axis /= np.linalg.norm(axis)
    return Motion(
        float(np.linalg.norm(velocity)),
        float(velocity @ axis),
        float(velocity @ (-axis[1], axis[0])),
        float(np.mean(rolls[-5 * CYCLE :])) / (2 * math.pi),
        positions,
    )


def commands(name):
    scenario = load_scenario(name)
    gait = generator(scenario.gait, scenario.robot)
    nothing = Readings.nothing(scenario.robot)
    return np.array([gait.step(k / 100, nothing).command for k in range(scenario.tick_count)])


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "speed"), [("caterpillar", 0.039), ("caterpillar-pi2", 0.023)])
def test_a_caterpillar_creeps_straight_ahead(name, speed):
    travel = motion(name)
    assert travel.forward == pytest.approx(speed, rel=0.03)
    assert abs(travel.left) < 1e-3 * travel.speed


@pytest.mark.nightly
def test_a_sidewinder_walks_sideways():
    travel = motion("sidewinding")
    assert 0.27 <= travel.speed <= 0.32
    assert abs(travel.left) > 0.95 * travel.speed
    assert abs(travel.turns_per_s) < 0.02  # it walks, it doesn't roll


@pytest.mark.nightly
def test_rolling_turns_once_a_cycle_and_slips_a_little():
    travel = motion("rolling")
    assert abs(travel.turns_per_s) == pytest.approx(0.5, rel=0.01)
    assert abs(travel.left) > 0.99 * travel.speed
    # A straight cylinder would roll at 2 pi r f; an arc has to slip.
    assert 0.8 < travel.speed / (2 * math.pi * 0.025 * 0.5) < 1.0


@pytest.mark.nightly
def test_a_helix_rolls_and_screws():
    travel = motion("twist")
    assert 0.05 <= travel.speed <= 0.11
    assert abs(travel.turns_per_s) == pytest.approx(0.5, rel=0.02)
    assert abs(travel.forward) > 0.2 * travel.speed  # obliquely, unlike rolling


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["horizontal", "vertical", "combined"])
def test_waves_of_the_papers_equations_go_head_first_and_straight(name):
    travel = motion(name)
    assert travel.forward > 0.04
    # Half a cycle later one wave alone is its own mirror image, two waves at once are not.
    assert abs(travel.left) < (0.02 if name == "combined" else 1e-3) * travel.speed


@pytest.mark.parametrize("name", ["delay-blocks", "oscillators", "oscillators-one-way"])
def test_other_generators_settle_into_the_wave_of_flat(name):
    angles, flat = commands(name), commands("flat")
    assert np.abs(angles[100] - flat[100]).max() > 0.05
    settled = round(load_scenario(name).settle_s * 100)
    np.testing.assert_allclose(angles[settled:], flat[settled:], atol=2e-3)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["delay-blocks", "oscillators"])
def test_the_same_wave_moves_the_body_alike_whatever_made_it(name):
    assert motion(name).forward == pytest.approx(motion("flat").forward, rel=1e-3)


@pytest.mark.nightly
def test_felt_servos_keep_the_wave_and_slow_it_a_little():
    # The responses follow their commands with gains near 1: see the closed form of the drift,
    # -eps^2 g^2 / 2 omega, in test_gait_oscillators.
    scenario = load_scenario("oscillators-feedback")
    with Twin(scenario, kernels=Kernels.NUMBA) as twin:
        names = list(twin.gait.names)
        values = np.array([sample.gait.values for sample in twin.samples()])
    joints = scenario.robot.joint_indices(Plane.HORIZONTAL)
    at = [names.index(f"{scenario.robot.joint_names[i]}.phase") for i in joints]
    chain = scenario.gait.planes[Plane.HORIZONTAL]
    time_s = np.arange(len(values)) / 100
    shift = values[:, at] - math.pi * time_s[:, None] - np.arange(13) * chain.signed_lag
    late = shift[-1 - CYCLE : -1].mean(axis=0)
    assert np.ptp(late) < math.radians(10.0)
    drift = (late - shift[1000 : 1000 + CYCLE].mean(axis=0)) / (time_s[-1 - CYCLE] - 10.0)
    np.testing.assert_allclose(drift, -(chain.feedback**2) / (2 * math.pi), rtol=0.2)


@pytest.mark.parametrize("name", ["delay-blocks", "oscillators-one-way"])
def test_a_session_records_what_each_joint_was_meant_to_do(tmp_path, name):
    scenario = load_scenario(name).changed(duration_s=0.3)
    record(scenario, tmp_path / "run.mcap")
    with Session.open(tmp_path / "run.mcap") as session:
        meant, commands = session.joints("/gait"), session.joints("/joint_commands")
    shown = dict(zip(meant.names, meant.values, strict=True))
    commanded = dict(zip(commands.names, commands.values, strict=True))
    for i in scenario.robot.joint_indices(Plane.HORIZONTAL):
        joint = scenario.robot.joint_names[i]
        angle = shown[f"{joint}.A"] * np.sin(shown[f"{joint}.phase"]) + shown[f"{joint}.offset"]
        np.testing.assert_allclose(commanded[joint], angle, atol=1e-12)
