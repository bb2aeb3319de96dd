"""Accelerometer and compass against gravity, turning frames and the earth's field."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from undulog.capture.robot.model import Sensor, SensorKind
from undulog.sim.physics.sensing import rotation_from_rpy
from undulog.sim.physics.sensors import Accelerometer, Compass
from undulog.sim.physics.steps import Steps
from undulog.sim.scenario.sensors import AccelerometerModel, CompassModel

DT, PERIOD, G = 1e-3, 10, 9.81
GRAVITY = (0.0, 0.0, -G)
EXACT = AccelerometerModel(noise=0.0, resolution=0.0)
FIELD = CompassModel(noise=0.0, resolution=0.0)


@pytest.fixture(scope="module")
def robot(make_robot):
    return make_robot(2)


def accelerometer(position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)):
    kind = SensorKind.ACCELEROMETER
    return Sensor("accelerometer", kind, "link01", position, rpy, axes=("x", "y", "z"))


def magnetometer(rpy=(0.0, 0.0, 0.0), axes=("x", "y")):
    return Sensor("compass", SensorKind.COMPASS, "link01", (0.0, 0.0, 0.0), rpy, axes=axes)


def periods(count, motion):
    """Control periods; ``motion(t)`` gives position, velocity, orientation and spin of link 1."""
    for p in range(count):
        steps = Steps.empty(PERIOD + 1, 2, 1)
        body = steps.stacked.body
        for k in range(PERIOD + 1):
            position, velocity, turn, spin = motion((p * PERIOD + k) * DT)
            body.position[k] = np.array(position)[:, None]
            body.velocity[k] = np.array(velocity)[:, None]
            body.quaternion[k] = turn.as_quat()[:, None]
            body.spin[k] = np.array(spin)[:, None]
        yield p * PERIOD, steps


@pytest.fixture
def make_accelerometer(robot):
    return lambda mount=None, model=EXACT: Accelerometer(
        model, [mount or accelerometer()], robot, GRAVITY, dt=DT, seed=1
    )


@pytest.fixture
def make_compass(robot):
    return lambda mount=None, model=FIELD: Compass(
        model, [mount or magnetometer()], robot, dt=DT, seed=1
    )


def taken(kind, count, motion):
    return [
        sample for start, steps in periods(count, motion) for sample in kind.observe(steps, start)
    ]


def at_rest(*euler):
    turn = Rotation.from_euler("ZYX", euler)
    return lambda t: ((0, 0, 0), (0, 0, 0), turn, (0, 0, 0))


@pytest.mark.parametrize("degrees", [0.0, 10.0, 35.0])
def test_a_tilted_block_at_rest_feels_gravitys_opposite(make_accelerometer, degrees):
    tilt = math.radians(degrees)
    samples = taken(make_accelerometer(), 3, at_rest(0.7, tilt, 0.0))
    assert [sample.time_s for sample in samples] == pytest.approx([0.005, 0.015, 0.025])
    for sample in samples:
        # Nose down by the tilt: the x axis points down by sin(tilt).
        expected = (-G * math.sin(tilt), 0.0, G * math.cos(tilt))
        np.testing.assert_allclose(sample.vector, expected, atol=1e-12)


def test_free_fall_feels_nothing_and_thrust_feels_itself(make_accelerometer):
    level = Rotation.identity()
    fall = taken(make_accelerometer(), 2, lambda t: ((0, 0, 0), (0, 0, -G * t), level, (0, 0, 0)))
    np.testing.assert_allclose([sample.vector for sample in fall], 0.0, atol=1e-9)
    thrust = taken(
        make_accelerometer(), 2, lambda t: ((0, 0, 0), (3.0 * t, 0, 0), level, (0, 0, 0))
    )
    np.testing.assert_allclose([sample.vector for sample in thrust], [(3.0, 0, G)] * 2, atol=1e-9)


def test_a_turning_mount_feels_the_centripetal_force(make_accelerometer):
    # Spinning about z at 6 rad/s, 0.03 m off the axis: w^2 r towards the axis.
    w = 6.0
    kind = make_accelerometer(accelerometer((0.03, 0.01, 0.0)))

    def motion(t):
        return (0, 0, 0), (0, 0, 0), Rotation.from_rotvec((0, 0, w * t)), (0, 0, w)

    for sample in taken(kind, 10, motion):
        expected = (-w * w * 0.03, -w * w * 0.01, G)
        np.testing.assert_allclose(sample.vector, expected, rtol=1e-4, atol=1e-9)


def test_a_swinging_mount_feels_the_tangential_force_too(make_accelerometer):
    # Angle a sin(n t): w' r across. The mean over 10 ms around the stamp.
    a, n, r = 0.5, 2 * math.pi, 0.05
    kind = make_accelerometer(accelerometer((r, 0.0, 0.0)))

    def motion(t):
        turn = Rotation.from_rotvec((0, 0, a * math.sin(n * t)))
        return (0, 0, 0), (0, 0, 0), turn, (0, 0, a * n * math.cos(n * t))

    for sample in taken(kind, 100, motion):
        rate, change = a * n * math.cos(n * sample.time_s), -a * n * n * math.sin(n * sample.time_s)
        np.testing.assert_allclose(sample.vector, (-rate * rate * r, change * r, G), atol=2e-3)


def test_the_sensor_frame_is_turned_in_the_links(make_accelerometer):
    rpy = (0.3, -0.2, 1.1)
    turn = Rotation.from_euler("xyz", rpy)
    np.testing.assert_allclose(rotation_from_rpy(rpy), turn.as_matrix(), atol=1e-15)
    vector = taken(make_accelerometer(accelerometer(rpy=rpy)), 1, at_rest(0.4, 0.1, -0.3))[0].vector
    frame = Rotation.from_euler("ZYX", (0.4, 0.1, -0.3)) * turn
    np.testing.assert_allclose(vector, frame.inv().apply((0, 0, G)), atol=1e-12)


def test_slower_sampling_means_over_its_own_period(make_accelerometer):
    kind = make_accelerometer(model=dataclasses.replace(EXACT, rate_hz=40.0))
    thrust = taken(kind, 10, lambda t: ((0, 0, 0), (t * t, 0, 0), Rotation.identity(), (0, 0, 0)))
    assert [sample.time_s for sample in thrust] == pytest.approx([0.0125, 0.0375, 0.0625, 0.0875])
    # v = t^2: the mean acceleration around t is 2 t.
    expected = [2 * sample.time_s for sample in thrust]
    np.testing.assert_allclose([sample.vector[0] for sample in thrust], expected, atol=1e-9)


def test_the_accelerometer_has_noise_and_steps(make_accelerometer):
    noisy = dataclasses.replace(EXACT, noise=0.05)
    kind = make_accelerometer(model=noisy)
    values = np.array([sample.vector for sample in taken(kind, 3000, at_rest(0.0, 0.0, 0.0))])
    np.testing.assert_allclose(values.std(axis=0), 0.05, rtol=0.05)
    np.testing.assert_allclose(values.mean(axis=0), (0, 0, G), atol=4e-3)
    kind = make_accelerometer(model=dataclasses.replace(noisy, resolution=0.04))
    values = np.array([sample.vector for sample in taken(kind, 100, at_rest(0.0, 0.0, 0.0))]) / 0.04
    np.testing.assert_allclose(values, np.rint(values), atol=1e-9)


def heading(sample):
    return math.atan2(-sample.vector[1], sample.vector[0])


@pytest.mark.parametrize("degrees", [-170.0, -45.0, 0.0, 30.0, 120.0])
def test_a_level_compass_gives_its_heading(make_compass, degrees):
    sample = taken(make_compass(), 1, at_rest(math.radians(degrees), 0.0, 0.0))[0]
    assert math.degrees(heading(sample)) == pytest.approx(degrees, abs=1e-9)
    assert math.hypot(*sample.vector[:2]) == pytest.approx(20e-6)
    assert math.isnan(sample.vector[2])  # it has two axes


def test_a_degree_of_roll_turns_the_heading_by_two_degrees(make_compass):
    sample = taken(make_compass(), 1, at_rest(0.0, 0.0, math.radians(1.0)))[0]
    assert math.degrees(abs(heading(sample))) == pytest.approx(2.1, abs=0.05)
    assert math.degrees(heading(sample)) == pytest.approx(math.tan(math.radians(65.0)), abs=0.01)
    # Pointing east the same roll mixes the vertical field into the axis along the field's level
    # part: the heading stays.
    east = taken(make_compass(), 1, at_rest(-math.pi / 2, 0.0, math.radians(1.0)))[0]
    assert math.degrees(heading(east)) == pytest.approx(-90.0, abs=0.01)


def test_north_can_be_turned_and_a_third_axis_sees_the_dip(make_compass):
    model = dataclasses.replace(FIELD, north=0.5)
    kind = make_compass(magnetometer(axes=("x", "y", "z")), model=model)
    sample = taken(kind, 1, at_rest(0.5, 0.0, 0.0))[0]
    expected = (20e-6, 0.0, -20e-6 * math.tan(math.radians(65)))
    np.testing.assert_allclose(sample.vector, expected, atol=1e-15)


def test_the_compass_has_its_rate_noise_and_steps(make_compass):
    kind = make_compass(model=CompassModel(resolution=0.0))
    samples = taken(kind, 5000, at_rest(0.3, 0.0, 0.0))
    assert len(samples) == 1000
    np.testing.assert_allclose(np.diff([sample.time_s for sample in samples]), 0.05, atol=1e-12)
    values = np.array([sample.vector[:2] for sample in samples])
    np.testing.assert_allclose(values.std(axis=0), 2e-7, rtol=0.1)
    kind = make_compass(model=CompassModel())
    steps = (
        np.array([sample.vector[:2] for sample in taken(kind, 50, at_rest(0.3, 0.0, 0.0))]) / 1e-7
    )
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
