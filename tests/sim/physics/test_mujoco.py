"""Two engines under one force law: PyBullet and MuJoCo must tell the same story to rounding."""

import dataclasses
import math
import os

import numpy as np
import pytest

from support.processes import python
from support.twin_runs import energies, simulate
from undulog.capture.common.errors import SimulationError, UsageError
from undulog.capture.robot.model import Plane
from undulog.sim import Box, Cylinder, FrictionLaw, Ground, PlaneGait, Serpentine, World
from undulog.sim.physics.engine import BodyStart, engine_type
from undulog.sim.scenario.scenario import EngineKind

pytest.importorskip("mujoco")

LATERAL = {Plane.HORIZONTAL: PlaneGait(0.4, 0.5, math.pi / 3)}
SIDEWINDING = {
    Plane.HORIZONTAL: PlaneGait(0.4, 0.5, math.pi / 6),
    Plane.VERTICAL: PlaneGait(0.15, 0.5, math.pi / 6, phase=math.pi / 2),
}
ROLLING = {
    Plane.HORIZONTAL: PlaneGait(0.3, 0.5, 0.0),
    Plane.VERTICAL: PlaneGait(0.3, 0.5, 0.0, phase=math.pi / 2),
}


def both(scenario):
    return (simulate(dataclasses.replace(scenario, engine=engine)) for engine in EngineKind)


def apart(ones, others):
    """Greatest distance between the links of two runs [m]."""
    pairs = zip(ones, others, strict=True)
    return max(np.abs(a.step.body.position - b.step.body.position).max() for a, b in pairs)


@pytest.mark.parametrize(
    ("gait", "law"),
    [
        pytest.param(LATERAL, FrictionLaw.ELLIPSE, id="lateral-ellipse", marks=pytest.mark.nightly),
        *(
            pytest.param(gait, law, id=f"{name}-{law}", marks=pytest.mark.nightly)
            for name, gait in (("lateral", LATERAL), ("sidewinding", SIDEWINDING))
            for law in FrictionLaw
            if (gait, law) != (LATERAL, FrictionLaw.ELLIPSE)
        ),
    ],
)
def test_engines_agree_after_six_seconds_on_the_ground(make_scenario, make_robot, law, gait):
    robot = make_robot(stall_torque=0.25)
    world = World(heading=0.3, ground=Ground(law=law))
    scenario = make_scenario(robot, gait=Serpentine(gait, 2.0), world=world, duration_s=6.0)
    bullet, mujoco = both(scenario)
    assert np.abs(bullet[-1].step.body.position - bullet[0].step.body.position).max() > 0.05
    assert apart(bullet, mujoco) < 1e-10
    np.testing.assert_allclose(mujoco[-1].energy, bullet[-1].energy, atol=1e-10)


@pytest.mark.nightly
def test_engines_agree_between_obstacles(make_scenario, make_robot):
    obstacles = (
        Cylinder(position=(0.2, 0.03), radius=0.05),
        Box(position=(-0.5, -0.25), size=(0.6, 0.2), heading=0.2),
    )
    scenario = make_scenario(make_robot(), world=World(obstacles=obstacles), duration_s=6.0)
    bullet, mujoco = both(scenario)
    assert energies(bullet[-1])["obstacle_friction"] > 1e-3  # it has met them
    assert apart(bullet, mujoco) < 1e-10
    np.testing.assert_allclose(mujoco[-1].energy, bullet[-1].energy, atol=1e-10)


@pytest.mark.nightly
def test_engines_agree_on_a_body_that_rolls_over(make_scenario, make_robot):
    gait = Serpentine(ROLLING, 2.0)
    bullet, mujoco = both(make_scenario(make_robot(), gait=gait, duration_s=6.0))
    x, y = np.array([sample.step.body.quaternion[:2, 0] for sample in bullet]).T
    upright = 1 - 2 * (x * x + y * y)  # the head's z axis on the world's
    assert upright.min() < -0.9  # it has stood on its back
    assert apart(bullet, mujoco) < 1e-10


def test_engines_agree_on_an_uneven_body_that_tumbles(make_uneven):
    # No force law of ours: forces and torques of chance, anywhere on the links, in two portions.
    start = BodyStart((0.3, -0.2, -1.0), 1.0, 0.7, (0.2, 0.1, 0), 1e-3)
    states = []
    for kind in EngineKind:
        random = np.random.default_rng(5)
        body = engine_type(kind)(make_uneven(6), start)
        for _ in range(1000):
            state = body.read()
            for _ in range(2):
                force, arm = random.normal(size=(2, 3, 6)) * [[[0.5]], [[0.03]]]
                body.push(force, state.position + arm)
            body.step(0.02 * random.normal(size=5) - 2e-3 * state.rate)
        states.append(body.read())
        body.close()
    bullet, mujoco = states
    assert np.abs(bullet.spin).max() > 1.0
    for a, b in zip(bullet, mujoco, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


@pytest.mark.nightly
def test_two_processes_find_the_same_bits(tmp_path):
    code = """
import dataclasses, hashlib
from undulog.sim import load_scenario
from undulog.sim.scenario.scenario import EngineKind
from undulog.sim.twin.twin import Twin
scenario = load_scenario("flat").changed(duration_s=0.5)
with Twin(dataclasses.replace(scenario, engine=EngineKind.MUJOCO)) as twin:
    rows = [b"".join(part.tobytes() for part in s.step.body) for s in twin.samples()]
print(hashlib.sha256(b"".join(rows)).hexdigest())
"""
    digests = {
        python(code, env=os.environ | {"PYTHONHASHSEED": seed}).stdout for seed in ("1", "2")
    }
    assert (len(digests), len(*digests)) == (1, 65)


def test_an_impossible_state_is_an_error_and_leaves_no_file(
    make_scenario, make_robot, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    world = World(ground=Ground(stiffness=1e7))
    engine = EngineKind.MUJOCO
    scenario = make_scenario(make_robot(5), ramp_s=0.0, duration_s=2.0, world=world, engine=engine)
    with pytest.raises(SimulationError, match="the twin failed at 0"):
        simulate(scenario)
    assert not list(tmp_path.iterdir())


def test_a_body_that_cannot_be_is_refused(make_uneven):
    # A thin rod about x, but with two moments that no rod has: A + B >= C for every body.
    robot, start = make_uneven(6), BodyStart((0, 0, -9.81), 1.0, 0.0, (0, 0, 0), 1e-3)
    links = (dataclasses.replace(robot.links[0], inertia=(1e-5, 1e-5, 9e-5)), *robot.links[1:])
    with pytest.raises(UsageError, match=r"cannot hold robot chain: .*A \+ B >= C"):
        engine_type(EngineKind.MUJOCO)(dataclasses.replace(robot, links=links), start)
