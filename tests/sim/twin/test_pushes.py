"""Pushes: momentum and energy by Newton's laws, on both engines; and how scenarios say them."""

import numpy as np
import pytest

from support.twin_runs import SNAKE13, energies, faults_of, simulate
from undulog.sim import World, parse_scenario
from undulog.sim.scenario.scenario import EngineKind
from undulog.sim.scenario.world import Push

FREE = World(gravity=(0.0, 0.0, 0.0), ground=None)
TEXT = f"""{SNAKE13}
[[disturbances]]
link = "link07"
force = [0.0, 2.0, 0.0]
start_s = 1.0
duration_s = 0.5
"""


@pytest.fixture
def pushed(make_robot, make_scenario):
    """The last sample of a straight robot that is pushed, and the robot."""

    def run(*pushes, **fields):
        robot = make_robot(5)
        fields |= {"amplitude": 0.0, "world": FREE, "disturbances": pushes}
        return simulate(make_scenario(robot, **fields))[-1], robot

    return run


def momentum(sample, robot):
    return sample.step.body.velocity @ np.array([link.mass for link in robot.links])


@pytest.mark.parametrize("engine", EngineKind)
def test_a_push_gives_its_impulse(pushed, engine):
    # Along the body, which stays straight: exact, also in the middle of control periods.
    push = Push("link02", (0.3, 0.0, 0.0), start_s=0.203, duration_s=0.25)
    gained = momentum(*pushed(push, engine=engine))
    np.testing.assert_allclose(gained, [0.075, 0.0, 0.0], rtol=1e-12, atol=1e-12)


def test_a_push_that_bends_the_body_converges_to_its_impulse(pushed):
    # Stepping joint coordinates keeps momentum to first order in the step.
    push = Push("link02", (0.3, -0.2, 0.1), start_s=0.2, duration_s=0.25)
    miss = [
        np.abs(momentum(*pushed(push, physics_rate_hz=rate)) - 0.25 * np.array(push.force)).max()
        for rate in (1000, 4000)
    ]
    assert miss[0] < 1e-3 * 0.075
    assert miss[1] == pytest.approx(miss[0] / 4, rel=0.05)


def test_its_work_is_on_the_ledger(pushed):
    pushes = (
        Push("link01", (0.0, 0.3, 0.0), start_s=0.2, duration_s=0.3),
        Push("link05", (0.0, 0.3, 0.1), start_s=0.3, duration_s=0.1),
    )
    left: list[float] = []
    for rate in (1000, 4000):
        energy = energies(pushed(*pushes, physics_rate_hz=rate)[0])
        assert energy["push_work"] > 1e-3
        left.append(abs(energy["mechanical_residual"]) / energy["push_work"])
    assert left[0] < 2e-3
    assert left[1] < 0.3 * left[0]  # first order in the step too


def test_two_pushes_on_one_link_add_up(pushed):
    alone = pushed(Push("link03", (0.2, 0.0, 0.0), 0.2, 0.3))[0]
    two = pushed(*[Push("link03", (0.1, 0.0, 0.0), 0.2, 0.3)] * 2)[0]
    np.testing.assert_array_equal(alone.step.body.velocity, two.step.body.velocity)


def test_a_push_is_read_and_written_back():
    scenario = parse_scenario(TEXT, "x.toml")
    assert scenario.disturbances == (Push("link07", (0.0, 2.0, 0.0), 1.0, 0.5),)
    assert parse_scenario(scenario.toml(), "y.toml") == scenario


def test_a_push_on_nobody_is_a_fault():
    assert 'found "link14"' in faults_of(TEXT.replace("link07", "link14"))["disturbances[0].link"]
