"""The body against rigid-body mechanics, our own kinematics, and its URDF read by the engine."""

import math
from xml.etree import ElementTree as ET

import numpy as np
import pybullet
import pytest

from support.twin_runs import simulate
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.sim.physics.bullet import BulletEngine
from undulog.sim.physics.engine import BodyStart, engine_type
from undulog.sim.physics.steps import Steps
from undulog.sim.scenario.scenario import EngineKind, Kernels
from undulog.sim.twin.session_log import frame_origins, urdf
from undulog.sim.twin.twin import Twin

AT_REST = BodyStart((0, 0, 0), 1.0, 0.0, (0, 0, 0), 1e-3)


@pytest.fixture
def uneven(make_uneven):
    return make_uneven(5)


@pytest.fixture
def writhe(uneven):
    """Swing that chain by its joints in free space; states 2 ms apart."""

    def swing(rate_hz=1000):
        dt = 1.0 / rate_hz
        body = BulletEngine(uneven, BodyStart((0, 0, 0), 0.3, 0.7, (0.2, 0.1, 0.0), dt))
        states = []
        for k in range(round(0.4 * rate_hz)):
            state = body.read()
            if k % (rate_hz // 500) == 0:
                states.append(state)
            body.step(0.01 * np.sin(50.0 * k * dt + np.arange(4)) - 1e-3 * state.rate)
        body.close()
        return states

    return swing


def test_links_lie_where_our_kinematics_has_them(uneven, writhe):
    states = writhe()
    for state in states:
        head = rotation_from_quaternion(state.quaternion[:, 0])
        centres, turns = link_poses(uneven, state.position[:, 0], head, state.angle)
        np.testing.assert_allclose(state.position.T, centres, atol=1e-12)
        np.testing.assert_allclose(rotation_from_quaternion(state.quaternion.T), turns, atol=1e-12)
    assert np.abs(states[-1].angle).max() > 0.1


def test_velocities_are_those_of_the_centres(writhe):
    states = writhe()
    positions = np.array([state.position for state in states])
    velocities = np.array([state.velocity for state in states])
    slopes = (positions[2:] - positions[:-2]) / 4e-3  # central differences
    np.testing.assert_allclose(slopes, velocities[1:-1], atol=0.03 * np.ptp(velocities))


def test_joints_cannot_change_the_momentum(uneven, writhe):
    mass = np.array([link.mass for link in uneven.links])
    inertia = np.array([link.inertia for link in uneven.links])

    def momentum(state):
        turns = rotation_from_quaternion(state.quaternion.T)
        world_inertia = turns @ (inertia[:, :, None] * turns.swapaxes(1, 2))
        intrinsic = np.einsum("nij,jn->i", world_inertia, state.spin)
        orbital = mass @ np.cross(state.position.T, state.velocity.T)
        return np.concatenate([state.velocity @ mass, intrinsic + orbital])

    def drift(rate_hz):
        momenta = np.array([momentum(state) for state in writhe(rate_hz)])
        return np.abs(momenta - momenta[0]).max(axis=0)

    # The integrator's error, of first order in the step: it goes as the step does.
    coarse, fine = drift(1000), drift(4000)
    np.testing.assert_allclose(fine, coarse / 4, rtol=0.3, atol=1e-9)
    assert (coarse[:3] < 1e-2 * 0.2 * mass.sum()).all()


def test_a_thrown_body_flies_a_parabola(make_robot):
    body = BulletEngine(make_robot(4), BodyStart((0, 0, -9.81), 1.0, 0.3, (1, 0, 2), 1e-3))
    for _ in range(500):
        body.step(np.zeros(3))
    state = body.read()
    body.close()
    t, dt = 0.5, 1e-3
    assert state.position[2] == pytest.approx(1.0 + 2 * t - 9.81 * t * (t + dt) / 2, abs=1e-12)
    assert not np.abs(state.spin).max() > 1e-9


@pytest.mark.parametrize("kind", EngineKind)
@pytest.mark.parametrize("kernels", Kernels)
def test_an_engine_may_be_closed_twice(make_robot, kind, kernels):
    body, other = (engine_type(kind, kernels)(make_robot(n), AT_REST) for n in (3, 4))
    body.close()
    body.close()
    assert other.read().position.shape == (3, 4)  # nobody else's world was freed
    other.close()


def test_steps_are_views_of_one_table():
    steps = Steps.empty(4, 3, 2)
    steps.table[:] = np.arange(steps.table.size).reshape(steps.table.shape)
    stacked = steps.stacked
    for k, step in enumerate(steps):
        for group, all_of_it in zip(step[:4], stacked[:4], strict=True):
            for field, all_times in zip(group, all_of_it, strict=True):
                assert np.shares_memory(field, steps.table)
                np.testing.assert_array_equal(field, all_times[k])
    # Every number of a row is in one field.
    fields = [field.ravel() for group in steps[1][:4] for field in group]
    assert sorted(np.concatenate(fields)) == steps.table[1].tolist()
    part = steps[1:3].copy()
    part.table[:] = 0.0
    assert len(part) == 2
    assert steps.table[1:].all()


def test_the_engine_cannot_hold_every_robot(make_robot):
    with pytest.raises(UsageError, match="has 128 joints; the twin takes at most 127"):
        BulletEngine(make_robot(129), AT_REST)


def test_the_urdf_describes_the_same_body(uneven, tmp_path):
    # Read back by the engine's own URDF reader.
    path = tmp_path / "robot.urdf"
    path.write_text(urdf(uneven))
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(
        str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
    )
    angles = np.array([0.2, -0.3, 0.1, 0.4])
    for i, angle in enumerate(angles):
        pybullet.resetJointState(body, i, angle, physicsClientId=client)
        info = pybullet.getJointInfo(body, i, client)
        joint = uneven.joints[i]
        assert (info[1].decode(), info[12].decode()) == (joint.name, uneven.links[i + 1].name)
        assert info[6] == info[7] == 0.0  # damping, friction
        assert info[8:12] == (joint.lower, joint.upper, joint.servo.stall_torque, 10.0)
    for i, link in enumerate(uneven.links):
        dynamics = pybullet.getDynamicsInfo(body, i - 1, client)
        assert (dynamics[0], dynamics[2]) == (link.mass, link.inertia)
    link_states = pybullet.getLinkStates(body, range(4), 0, 1, client)
    pybullet.disconnect(client)
    centres, turns = link_poses(uneven, np.zeros(3), np.eye(3), angles)
    np.testing.assert_allclose([state[0] for state in link_states], centres[1:], atol=1e-7)
    quaternions = np.array([[0, 0, 0, 1.0], *(state[1] for state in link_states)])
    np.testing.assert_allclose(rotation_from_quaternion(quaternions), turns, atol=1e-7)
    origins = frame_origins(uneven, centres, quaternions)
    np.testing.assert_allclose([state[4] for state in link_states], origins[1:], atol=1e-7)


def test_the_urdf_is_plain_xml_with_shapes(uneven):
    root = ET.fromstring(urdf(uneven))
    assert (root.get("name"), len(root.findall("link"))) == (uneven.name, 5)
    assert {len(link.findall("visual")) for link in root.findall("link")} == {3}


def test_two_bodies_live_side_by_side(make_scenario, make_robot):
    small = make_scenario(make_robot(4), duration_s=0.2, ramp_s=0.0)
    expected = [sample.step.body.angle for sample in simulate(small)]
    with Twin(small) as twin, Twin(make_scenario(make_robot(6), amplitude=0.0)) as other:
        angles = [a.step.body.angle for a, _ in zip(twin.samples(), other.samples(), strict=False)]
    assert math.isclose(np.abs(np.array(angles) - expected[: len(angles)]).max(), 0.0)
