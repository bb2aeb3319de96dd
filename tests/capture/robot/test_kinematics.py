"""Forward kinematics against SciPy's rotations and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from undulog.capture import load_robot
from undulog.capture.common.errors import DataError
from undulog.capture.robot import kinematics
from undulog.capture.robot.model import Plane

ROBOT = load_robot("snake13")
RNG = np.random.default_rng(5)


def test_quaternions_and_rotations_agree_with_scipy():
    random = Rotation.random(500, rng=RNG)
    half_turns = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), -np.eye(3)]))
    for rotation in (random, half_turns):
        matrix = kinematics.rotation_from_quaternion(rotation.as_quat())
        np.testing.assert_allclose(matrix, rotation.as_matrix(), atol=1e-14)
        back = kinematics.rotation_from_quaternion(kinematics.quaternion_from_rotation(matrix))
        np.testing.assert_allclose(back, matrix, atol=1e-14)


def test_a_straight_robot_lies_behind_its_head():
    position, rotation = kinematics.link_poses(ROBOT, np.zeros(3), np.eye(3), np.zeros(12))
    np.testing.assert_allclose(position[:, 0], -0.06 * np.arange(13), atol=1e-15)
    np.testing.assert_allclose(position[:, 1:], 0)
    np.testing.assert_allclose(rotation, np.broadcast_to(np.eye(3), (13, 3, 3)))


def test_the_chain_composes_as_scipy_composes():
    angles = RNG.normal(scale=0.4, size=12)
    head = Rotation.from_euler("zyx", [0.3, -0.2, 0.1])
    position, rotation = kinematics.link_poses(
        ROBOT, np.array([1.0, 2.0, 3.0]), head.as_matrix(), angles
    )
    at, turn = np.array([1.0, 2.0, 3.0]), head
    for i, (joint, angle) in enumerate(zip(ROBOT.joints, angles, strict=True)):
        axis = [0, 0, 1] if joint.plane is Plane.HORIZONTAL else [0, 1, 0]
        at = at + turn.apply([-0.03, 0, 0])
        turn = turn * Rotation.from_rotvec(angle * np.array(axis))
        at = at + turn.apply([-0.03, 0, 0])
        np.testing.assert_allclose(position[i + 1], at, atol=1e-14)
        np.testing.assert_allclose(rotation[i + 1], turn.as_matrix(), atol=1e-14)


def test_many_instants_at_once_are_the_same_as_one_by_one():
    angles = RNG.normal(scale=0.4, size=(7, 12))
    heads = Rotation.random(7, rng=RNG).as_matrix()
    places = RNG.normal(size=(7, 3))
    position, rotation = kinematics.link_poses(ROBOT, places, heads, angles)
    for k in range(7):
        poses = kinematics.link_poses(ROBOT, places[k], heads[k], angles[k])
        np.testing.assert_array_equal(position[k], poses[0])
        np.testing.assert_array_equal(rotation[k], poses[1])


def test_a_wrong_number_of_angles_is_reported():
    with pytest.raises(DataError, match=r"shape \(3, 5\); the robot snake13 has 12 joints"):
        kinematics.link_poses(ROBOT, np.zeros(3), np.eye(3), np.zeros((3, 5)))


def test_an_angle_that_is_not_known_leaves_what_is_in_front_of_its_joint():
    angles = RNG.normal(scale=0.4, size=(2, 12))
    angles[1, 4] = np.nan
    position, rotation = kinematics.link_poses(ROBOT, np.zeros(3), np.eye(3), angles)
    reached = np.arange(13) <= 4
    for values in (position[1], rotation[1].reshape(13, 9)):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), reached)
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), ~reached)
    assert np.isfinite(position[0]).all()
    assert np.isfinite(rotation[0]).all()


def test_an_unknown_place_of_the_head_leaves_all_orientations():
    angles = RNG.normal(scale=0.4, size=12)
    position, rotation = kinematics.link_poses(ROBOT, np.full(3, np.nan), np.eye(3), angles)
    assert np.isnan(position).all()
    _, placed = kinematics.link_poses(ROBOT, np.zeros(3), np.eye(3), angles)
    np.testing.assert_array_equal(rotation, placed)


def test_positions_are_those_of_the_poses():
    angles = RNG.normal(scale=0.4, size=(5, 12))
    heads = Rotation.random(5, rng=RNG).as_matrix()
    position, _ = kinematics.link_poses(ROBOT, RNG.normal(size=3), heads, angles)
    positions = kinematics.link_positions(ROBOT, position[:, 0], heads, angles)
    np.testing.assert_array_equal(positions, position)
