"""Capsules against SciPy's rotations and hand-made postures; colours of power."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from undulog.capture.robot.kinematics import link_poses
from undulog.replay.draw import body
from undulog.replay.draw.motion import HeadPath, assemble, frames_of
from undulog.replay.samples.quantities import power_limit, segment_power
from undulog.replay.samples.tracks import Track


@pytest.fixture(scope="module")
def postures(snake25):
    """Forty random postures: head positions, quaternions, angles, link poses."""
    rng = np.random.default_rng(3)
    turn = Rotation.random(40, rng=rng)
    position = rng.normal(size=(40, 3))
    angles = rng.uniform(-0.5, 0.5, size=(40, 25))
    return position, turn, angles, link_poses(snake25, position, turn.as_matrix(), angles)


def test_capsules_run_from_behind_the_centre_to_before_it(snake25, postures):
    centre, rotation = postures[3]
    origin, quaternion = body.capsule_poses(snake25, centre, rotation)
    length, _ = body.capsule_shape(snake25)
    drawn = Rotation.from_quat(quaternion.reshape(-1, 4).astype(float))
    along = drawn.apply([0.0, 0.0, 1.0]).reshape(origin.shape)
    # An error of half a rounding step in each of three components.
    np.testing.assert_allclose(along, rotation[..., 0], atol=2 * body.TURN_ROUNDING)
    room = body.ROUNDING / 2 + length[0] * body.TURN_ROUNDING
    np.testing.assert_allclose(origin + 0.5 * length[:, None] * along, centre, atol=room)


def test_capsules_point_straight_up_and_straight_down(snake25):
    turn = Rotation.from_rotvec([[0.0, -np.pi / 2, 0.0], [0.0, np.pi / 2, 0.0]]).as_matrix()
    rotation = np.repeat(turn[:, None], 26, axis=1)
    _, quaternion = body.capsule_poses(snake25, np.zeros((2, 26, 3)), rotation)
    along = Rotation.from_quat(quaternion[:, 0].astype(float)).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(along, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], atol=1e-12)


def test_poses_are_multiples_of_the_rounding(snake25, postures):
    steps = (body.ROUNDING, body.TURN_ROUNDING)
    for values, step in zip(body.capsule_poses(snake25, *postures[3]), steps, strict=True):
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values / step, np.round(values / step))


def test_a_straight_snake_lies_behind_its_head(snake25):
    centre, rotation = link_poses(snake25, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 25)))
    origin, _ = body.capsule_poses(snake25, centre, rotation)
    length, radius = body.capsule_shape(snake25)
    expected = -0.06 * np.arange(26) - length / 2
    np.testing.assert_allclose(origin[0, :, 0], expected, atol=body.ROUNDING / 2)
    np.testing.assert_allclose(length + radius, [link.length for link in snake25.links])


def test_links_whose_pose_is_unknown_are_left_out(snake25):
    angles = np.zeros((3, 25))
    angles[1, 9] = np.nan
    head = np.zeros((3, 3))
    head[2] = np.nan
    poses = body.capsule_poses(snake25, *link_poses(snake25, head, np.eye(3)[None], angles))
    columns = body.capsule_columns(snake25, poses, np.array([1, 2, 3, 255], dtype=np.uint8))
    counts = {tuple(len(row) for row in c.as_arrow_array().to_pylist()) for c in columns}
    assert counts == {(26, 10, 0)}


def test_power_of_the_links_is_power_of_the_joints():
    power = np.random.default_rng(4).normal(size=(7, 25))
    shares = segment_power(power)
    assert shares.shape == (7, 26)
    np.testing.assert_allclose(shares.sum(axis=1), power.sum(axis=1))
    np.testing.assert_allclose(segment_power(np.array([0.0, 4.0, 0.0])), [0.0, 2.0, 2.0, 0.0])


def test_markers_float_four_radii_over_their_joints(snake25):
    centre, rotation = link_poses(snake25, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 25)))
    centres = body.above_joints(snake25, ("joint01", "joint25"), centre, rotation)
    np.testing.assert_allclose(centres[0], [[-0.03, 0.0, 0.1], [-0.03 - 24 * 0.06, 0.0, 0.1]])


def test_the_body_is_drawn_on_the_heads_own_times(snake25):
    t_ns = 3 + np.arange(100, dtype=np.int64) * 10_000_000
    head = HeadPath(t_ns, np.zeros((100, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (100, 1)), tracked=True)
    slow = t_ns[::4] + 1_000_000
    positions = tuple(Track(n, slow, 1e-9 * slow) for n in snake25.joint_names)
    path, sparse = frames_of(head, int(t_ns[-1]))
    motion = assemble(snake25, path, {("/joint_states", "position"): tuple(positions)})
    np.testing.assert_array_equal(motion.t_ns, t_ns[::2])
    inside = (motion.t_ns >= slow[0]) & (motion.t_ns <= slow[-1])
    np.testing.assert_allclose(motion.angles[inside, 7], 1e-9 * motion.t_ns[inside])
    assert np.isnan(motion.angles[~inside]).all()
    assert (motion.commands, motion.power_w) == (None, None)
    np.testing.assert_array_equal(motion.t_ns[sparse], t_ns[::4])


def test_sign_and_size_of_power_can_be_read_from_the_colour():
    power = np.array([-2.0, 0.0, 2.0, 5.0, np.nan])
    driven, idle, drives, beyond, unknown = body.power_colors(power, 2.0)
    assert driven[2] > driven[0]  # cyan
    assert drives[0] > drives[2]  # vermilion
    assert np.ptp(idle[:3].astype(int)) < 12  # grey
    np.testing.assert_array_equal(beyond, drives)
    assert unknown.tolist() != idle.tolist()
    half = body.power_colors(np.array([1.0]), 2.0)[0].astype(int)
    np.testing.assert_allclose(half, (idle.astype(int) + drives) / 2, atol=1)


def test_the_limit_is_a_percentile_with_two_digits():
    power = np.linspace(-0.1234, 0.1234, 10001)
    assert (power_limit(power), power_limit(1000 * power)) == (0.13, 130.0)
    assert power_limit(np.append(power, [np.nan, 1e6])) == 0.13
    assert (power_limit(np.zeros(4)), power_limit(np.full(4, np.nan))) == (1.0, 1.0)
