"""The compiled kernels against the NumPy laws, our own kinematics, and the engine link by link."""

import dataclasses

import numpy as np
import pytest

from support.processes import python
from support.twin_runs import simulate
from undulog.capture import Session
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.sim import Cylinder, FrictionLaw, Ground, World, load_scenario, record
from undulog.sim.physics.bullet import BulletEngine
from undulog.sim.physics.compiled_bullet import CompiledBulletEngine
from undulog.sim.physics.compiled_kernels import CompiledLaws
from undulog.sim.physics.engine import BodyStart
from undulog.sim.physics.servo import Servos
from undulog.sim.physics.steps import NumpyLaws, Steps
from undulog.sim.scenario.scenario import EngineKind, Kernels

START = BodyStart((0.3, 0, -9.81), 0.3, 0.7, (0.2, 0.1, 0.0), 1e-3)


@pytest.fixture
def uneven(make_uneven):
    return make_uneven(6)


@pytest.mark.parametrize("law", FrictionLaw)
def test_laws_agree_to_the_last_digits(uneven, law):
    random = np.random.default_rng(3)
    servos = Servos([joint.servo for joint in uneven.joints])
    ground = Ground(law=law)
    tables = [Steps.empty(2, 6, 5) for _ in range(2)]
    for _ in range(50):
        row = random.normal(size=tables[0].table.shape)
        reference = random.normal(scale=0.3, size=5)
        for steps, laws in zip(tables, (NumpyLaws, CompiledLaws), strict=True):
            steps.table[:] = row
            steps.stacked.body.position[:, 2] = 0.02 + 0.005 * row[:, :6]
            steps.stacked.rotors.angle[:] = steps.stacked.body.angle + 0.02 * row[:, :5]
            compute = laws(steps, uneven, ground, servos, 1e-3)
            compute.command(0, reference)
            compute.start(0)
            compute.follow(1)
        ours, theirs = (steps.stacked for steps in tables)
        for group, other in zip(ours[1:4], theirs[1:4], strict=True):
            for measured, two in zip(group, other, strict=True):
                np.testing.assert_allclose(
                    two, measured, rtol=1e-13, atol=1e-13 * np.abs(measured).max()
                )
    assert 0 < np.count_nonzero(ours.contact.force[:, 2]) < 12  # some touch, some don't


def test_without_ground_there_is_no_force(uneven):
    steps = Steps.empty(1, 6, 5)
    steps.table[:] = np.random.default_rng(3).normal(size=steps.table.shape)
    steps.stacked.body.position[:, 2] = 0.0
    CompiledLaws(steps, uneven, None, Servos([j.servo for j in uneven.joints]), 1e-3).start(0)
    assert not steps.stacked.contact.force.any()


def test_the_chain_lies_where_the_kinematics_has_it_and_moves_as_the_engine_says(uneven):
    random = np.random.default_rng(5)
    engines = [kind(uneven, START) for kind in (BulletEngine, CompiledBulletEngine)]
    for _ in range(200):
        theirs, ours = (engine.read() for engine in engines)
        head = rotation_from_quaternion(ours.quaternion[:, 0])
        centres, turns = link_poses(uneven, ours.position[:, 0], head, ours.angle)
        np.testing.assert_allclose(ours.position.T, centres, atol=1e-14)
        np.testing.assert_allclose(rotation_from_quaternion(ours.quaternion.T), turns, atol=1e-14)
        for name in ("position", "velocity", "spin", "angle", "rate"):
            reference, two = getattr(theirs, name), getattr(ours, name)
            np.testing.assert_allclose(two, reference, atol=1e-12 * (1 + np.abs(reference).max()))
        # Pushed in two calls, off the centres, and with torques: the generalised force.
        force = random.normal(scale=0.3, size=(2, 3, 6))
        point = theirs.position + random.normal(scale=0.01, size=(2, 3, 6))
        torque = random.normal(scale=0.01, size=5)
        for engine in engines:
            engine.push(force[0], point[0])
            engine.push(force[1], point[1])
            engine.step(torque)
    for engine in engines:
        engine.close()
    assert np.abs(theirs.angle).max() > 0.1


@pytest.mark.nightly
@pytest.mark.parametrize("engine", EngineKind)
def test_a_run_is_the_same_within_rounding(make_scenario, uneven, engine):
    # No chaotic growth: a gait on the ground is a stable cycle, errors are damped as they arise.
    world = World(obstacles=(Cylinder((-0.2, 0.06), 0.03),))
    scenario = make_scenario(uneven, ramp_s=0.5, duration_s=2.0, engine=engine, world=world)
    ours, theirs = (
        simulate(scenario, kernels=kernels) for kernels in (Kernels.NUMBA, Kernels.NUMPY)
    )
    assert ours[-1].contact_s.any()
    for k in (1, 100, 200):
        mine, two = ours[k], theirs[k]
        np.testing.assert_allclose(mine.step.body.position, two.step.body.position, atol=1e-12)
        np.testing.assert_allclose(mine.step.body.angle, two.step.body.angle, atol=1e-12)
        np.testing.assert_allclose(mine.energy, two.energy, atol=1e-12)


def test_compiled_runs_give_the_same_bytes_and_say_how_they_were_made(
    tmp_path, make_scenario, make_robot
):
    scenario = make_scenario(make_robot(5), ramp_s=0.1, duration_s=0.3)
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path in paths:
        record(scenario, path, kernels=Kernels.NUMBA)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with Session.open(paths[0]) as session:
        facts = session.metadata["undulog"]
        assert session.session_id != scenario.session_id
    assert facts["kernels"] == "numba"
    assert "numba" in set(facts) - {"kernels"}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("package", "words"),
    [("numba", "--kernels numba"), ("mujoco", ""), ("numba", "--kernels auto")],
    ids=["numba", "mujoco", "auto"],
)
def test_a_missing_extra_is_named_and_auto_goes_without(tmp_path, package, words):
    engine = "mujoco" if package == "mujoco" else "bullet"
    short = load_scenario("flat").changed(duration_s=0.02)
    scenario = dataclasses.replace(short, engine=EngineKind(engine))
    (tmp_path / "a.toml").write_text(scenario.toml())
    code = (
        f"import sys; sys.modules[{package!r}] = None; import undulog\n"
        f"sys.exit(undulog.run(['sim', 'run', 'a.toml', '-o', 'a.mcap', *{words.split()!r}]))"
    )
    completed = python(code, cwd=tmp_path)
    if words.endswith("auto"):
        assert (completed.returncode, completed.stderr) == (0, "")
    else:
        assert completed.returncode == 2
        assert f"needs the package {package}, which is not installed" in completed.stderr
        assert f"the extra '{package}' brings it: pip install '{package}>=" in completed.stderr
