"""Rays of the distance sensors against geometry done by hand and by SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from undulog.capture.robot.kinematics import link_poses
from undulog.capture.robot.model import Sensor, SensorKind
from undulog.replay.draw.stage import rays


def ir(name="ir01", link="link01", position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0), limit=1.5):
    return Sensor(name, SensorKind.IR, link, position, rpy, 0.2, limit)


def straight(robot, turn):
    return link_poses(robot, np.zeros((1, 3)), turn.as_matrix()[None], np.zeros((1, 25)))


def test_the_left_sensor_of_a_head_that_looks_left_sees_what_is_behind(snake25):
    sensors = (ir(position=(0.01, 0.02, 0.0), rpy=(0.0, 0.0, np.pi / 2)),)
    centre, rotation = straight(snake25, Rotation.from_euler("z", 90, degrees=True))
    origin, vector = rays(snake25, sensors, centre, rotation, np.array([[0.7]]))
    np.testing.assert_allclose(origin[0, 0], [-0.02, 0.01, 0.0], atol=1e-12)
    np.testing.assert_allclose(vector[0, 0], [-0.7, 0.0, 0.0], atol=1e-12)


def test_mounting_angles_are_fixed_axis_roll_pitch_yaw(snake25):
    rpy = (0.3, -0.5, 1.1)
    centre, rotation = straight(snake25, Rotation.identity())
    _, vector = rays(snake25, (ir(rpy=rpy),), centre, rotation, np.array([[1.0]]))
    np.testing.assert_allclose(vector[0, 0], Rotation.from_euler("xyz", rpy).apply([1, 0, 0]))


@pytest.mark.parametrize("reading", [np.nan, np.inf, 1.5, 2.0])
def test_nothing_seen_draws_nothing(snake25, reading):
    centre, rotation = straight(snake25, Rotation.identity())
    _, vector = rays(snake25, (ir(),), centre, rotation, np.array([[reading]]))
    assert np.isnan(vector).all()
