"""The ground's law against closed forms and what friction may never do."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undulog.capture.robot.kinematics import rotation_from_quaternion
from undulog.sim import FrictionLaw, Ground
from undulog.sim.physics.contact import FRICTION, GroundLaw, normal_force, tangents
from undulog.sim.physics.steps import Steps

COULOMB = tuple(law for law in FrictionLaw if law is not FrictionLaw.VISCOUS)
MU = np.array([[0.05], [0.5]])
EPS = 0.01
speeds = st.floats(-5, 5, allow_subnormal=False)
angles = st.floats(-math.pi, math.pi)


def touch(ground, *state):
    """What the ground does to a link of radius 25 mm, given its pose and velocities."""
    link = Steps.empty(1, 1, 0)[0]
    for field, value in zip(link.body, state, strict=False):
        field[...] = value
    GroundLaw(ground, np.array([0.025]), link.body, link.contact).act()
    return link.contact


def test_normal_force_is_equation_7():
    # F_n = -k p_z - d v_z at p_z = -1 mm, v_z = -0.02 m/s
    force = normal_force(np.array([1e-3]), np.array([0.02]), 2000.0, 20.0)
    assert force == pytest.approx([2000.0 * 1e-3 + 20.0 * 0.02])


def test_normal_force_never_pulls_and_ends_at_the_surface():
    depth = np.array([1e-3, 1e-3, 0.0, -1e-3])
    rate = np.array([-0.2, 0.0, 5.0, 5.0])  # the first leaves fast enough to be pulled back
    assert normal_force(depth, rate, 2000.0, 20.0).tolist() == [0.0, 2.0, 0.0, 0.0]


@pytest.mark.parametrize("law", COULOMB)
@pytest.mark.parametrize("axis", [0, 1])
def test_along_one_axis_every_law_is_smoothed_coulomb(law, axis):
    v = np.array([-2.0, -0.01, 0.0, 0.003, 1.0])
    slip = np.zeros((2, 5))
    slip[axis] = v
    force = FRICTION[law](MU, EPS)(slip) * np.full(5, 3.0)
    np.testing.assert_allclose(force[axis], -MU[axis] * 3.0 * v / np.hypot(v, EPS), rtol=1e-14)
    assert not force[1 - axis].any()


@pytest.mark.parametrize("law", COULOMB)
def test_without_coefficients_there_is_no_friction(law):
    slip = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert not FRICTION[law](np.zeros((2, 1)), EPS)(slip).any()
    slippery = FRICTION[law](np.array([[0.0], [0.5]]), EPS)(slip)
    assert slippery[1, 2] == pytest.approx(-0.5, rel=1e-3)
    assert not slippery[0].any()


@given(vt=speeds, vn=speeds, law=st.sampled_from(COULOMB))
def test_friction_dissipates_and_stays_inside_its_bound(vt, vn, law):
    slip = np.array([[vt], [vn]])
    force = FRICTION[law](MU, EPS)(slip)
    assert float((force * slip).sum()) <= 0.0
    share = np.abs(force / MU)[:, 0]
    bound = share.max() if law is FrictionLaw.BOX else math.hypot(*share)
    assert bound <= 1.0 + 1e-12


@given(vt=speeds.filter(lambda v: abs(v) > 1), vn=speeds.filter(lambda v: abs(v) > 1))
def test_the_ellipse_dissipates_most(vt, vn):
    # Maximum dissipation: no force on the ellipse opposes this slip with more power.
    slip = np.array([[vt], [vn]])
    force = FRICTION[FrictionLaw.ELLIPSE](MU, 1e-9)(slip)
    around = np.linspace(0, 2 * np.pi, 3601)
    others = MU * np.array([np.cos(around), np.sin(around)])
    assert -(force * slip).sum() >= -(others * slip).sum(axis=0).min() - 1e-9


@settings(max_examples=50)
@given(roll=angles, pitch=st.floats(-1.5, 1.5), yaw=angles)
def test_tangents_are_the_x_axes_laid_on_the_ground(roll, pitch, yaw):
    half = np.array([roll, pitch, yaw]) / 2
    (sr, sp, sy), (cr, cp, cy) = np.sin(half), np.cos(half)
    q = [sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy]
    q += [cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy]
    quaternion = np.array(q)
    x_axis = rotation_from_quaternion(quaternion)[:2, 0]
    expected = x_axis / np.linalg.norm(x_axis)
    np.testing.assert_allclose(np.array(tangents(quaternion[:, None]))[:, 0], expected, atol=1e-12)


def test_a_vertical_link_has_no_tangent_and_no_fault():
    upright = np.array([[0.5], [0.5], [0.5], [-0.5]])
    assert not rotation_from_quaternion(upright[:, 0])[:2, 0].any()
    assert not np.array(tangents(upright)).any()


@settings(max_examples=50)
@given(turn=angles, yaw=angles, law=st.sampled_from(FrictionLaw), seed=st.integers(0, 99))
def test_turning_everything_turns_the_forces(turn, yaw, law, seed):
    velocity, spin = np.random.default_rng(seed).normal(size=(2, 3, 1))

    def at(heading, by):
        c, s = math.cos(by), math.sin(by)
        matrix = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        quaternion = np.array([[0.0], [0.0], [math.sin(heading / 2)], [math.cos(heading / 2)]])
        state = np.array([[0.0], [0.0], [0.024]]), quaternion, matrix @ velocity, matrix @ spin
        return matrix, touch(Ground(law=law), *state).force

    matrix, turned = at(yaw + turn, turn)
    np.testing.assert_allclose(turned, matrix @ at(yaw, 0.0)[1], atol=1e-12)


@given(vt=speeds, vn=speeds, depth=st.floats(1e-6, 1e-2))
def test_viscous_drag_is_linear_and_takes_no_notice_of_the_load(vt, vn, depth):
    ground = Ground(law=FrictionLaw.VISCOUS, drag_tangential=0.3, drag_normal=4.0)
    level, still = np.array([[0.0], [0.0], [0.0], [1.0]]), np.zeros((3, 1))
    position, velocity = np.array([[0.0], [0.0], [0.025 - depth]]), np.array([[vt], [vn], [0.0]])
    force = touch(ground, position, level, velocity, still).force[:, 0]
    assert force == pytest.approx([-0.3 * vt, -4.0 * vn, 2000.0 * depth], rel=1e-9)
    above = touch(ground, position + np.array([[0.0], [0.0], [2 * depth]]), level, velocity, still)
    assert not above.force.any()


def test_a_spinning_link_slips_at_its_lowest_point():
    # Rolling about x without moving: the contact point, r below, moves at omega x r = +y.
    zero, level = np.zeros((3, 1)), np.array([[0.0], [0.0], [0.0], [1.0]])
    low, spin = np.array([[0.0], [0.0], [0.024]]), np.array([[4.0], [0.0], [0.0]])
    contact = touch(Ground(), low, level, zero, spin)
    assert contact.velocity[:, 0] == pytest.approx([0.0, 4.0 * 0.025, 0.0])
    assert contact.force[1, 0] < 0.0


def test_without_ground_there_is_no_force():
    level = np.array([[0.0], [0.0], [0.0], [1.0]])
    assert not touch(None, np.zeros((3, 1)), level, np.ones((3, 1)), np.ones((3, 1))).force.any()
