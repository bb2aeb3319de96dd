"""Infrared sensors and sonar: the data sheet, walls at an angle, hold times, steps and noise."""

import dataclasses
import math

import numpy as np
import pytest

from undulog.capture.robot.model import Sensor, SensorKind
from undulog.sim import Cylinder, InfraredModel, SonarModel, Wall
from undulog.sim.physics.ranging import Infrared, RayCaster, Sonar, cone, decoded, voltage
from undulog.sim.physics.steps import Steps

DT, PERIOD = 1e-3, 10
EXACT = InfraredModel(noise_v=0.0, adc_bits=24)


def infrared(name, **where):
    fields = {"link": "link01", "position": (0.03, 0.0, 0.0), "rpy": (0.0, 0.0, 0.0)} | where
    return Sensor(name, SensorKind.IR, range_min=0.2, range_max=1.5, field_of_view=0.05, **fields)


SONAR = Sensor(
    "sonar", SensorKind.SONAR, "link01", (0.03, 0.0, 0.0), (0.0, 0.0, 0.0), 0.03, 4.0, math.pi / 6
)


def still(links, *, at=(0.0, 0.0, 0.025), yaw=0.0, pitch=0.0, forward=0.0, start=0):
    """A control period of links that do not turn; they move along x at some speed."""
    steps = Steps.empty(PERIOD + 1, links, links - 1)
    body = steps.stacked.body
    times = (start + np.arange(PERIOD + 1)) * DT
    body.position[:] = np.array(at)[:, None]
    body.position[:, 0] += forward * times[:, None]
    # Rz(yaw) Ry(pitch)
    cy, sy, cp, sp = (f(a / 2) for a in (yaw, pitch) for f in (math.cos, math.sin))
    body.quaternion[:] = np.array([-sy * sp, cy * sp, sy * cp, cy * cp])[:, None]
    return steps


def taken(kind, periods, links=2, **where):
    samples = []
    for p in range(periods):
        start = p * PERIOD
        samples += kind.observe(still(links, start=start, **where), start)
    return samples


@pytest.fixture(scope="module")
def robot(make_robot):
    return make_robot(2)


@pytest.fixture
def infrared_at(robot):
    """An infrared sensor before a wall across its way, its face at some distance [m]."""

    def build(face, model=EXACT, sensors=None, seed=1):
        caster = RayCaster([Wall((face + 0.01, -5.0), (face + 0.01, 5.0), 0.02)], ground=True)
        return Infrared(model, sensors or [infrared("ir01")], robot, caster, dt=DT, seed=seed)

    return build


@pytest.mark.parametrize(
    ("centimetres", "volts", "tolerance"),
    # Sharp GP2Y0A02YK0F: typical output, read off the data sheet's diagram; the last from its
    # table, 0.25 to 0.55 V.
    [
        *((20, 2.5, 0.1), (30, 2.0, 0.1), (40, 1.55, 0.1)),
        *((60, 1.1, 0.1), (100, 0.65, 0.1), (150, 0.4, 0.05)),
    ],
)
def test_the_curve_is_that_of_the_data_sheet(centimetres, volts, tolerance):
    assert voltage(np.array([centimetres / 100]), 0.15)[0] == pytest.approx(volts, abs=tolerance)


def test_the_span_of_the_data_sheet():
    # Between 20 and 150 cm the data sheet gives 2.05 V, 1.8 to 2.3 V.
    near, far = voltage(np.array([0.2, 1.5]), 0.15)
    assert 1.8 <= near - far <= 2.3


def test_the_computer_inverts_the_falling_branch_and_is_fooled_before_the_peak():
    far = np.linspace(0.15, 3.0, 50)
    np.testing.assert_allclose(decoded(voltage(far, 0.15)), far, rtol=1e-12)
    near = np.linspace(0.0, 0.149, 50)
    assert (decoded(voltage(near, 0.15)) > near).all()
    assert (np.diff(voltage(near, 0.15)) > 0.0).all()
    assert voltage(np.array([0.0, np.inf]), 0.15).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("degrees", [0.0, 30.0, 50.0])
def test_a_wall_at_an_angle_as_an_infrared_sensor_measures_it(infrared_at, degrees):
    angle = math.radians(degrees)
    samples = taken(infrared_at(0.78, sensors=[infrared("ir01", rpy=(0.0, 0.0, angle))]), 20)
    expected = (0.78 - 0.03) / math.cos(angle)
    assert [sample.distance for sample in samples] == pytest.approx([expected] * 6, rel=1e-5)


def test_the_mount_turns_and_moves_with_its_link(robot):
    # Yawed by 90 degrees the sensor sits at y = 0.03 and looks along y.
    caster = RayCaster([Wall((-5.0, 1.0), (5.0, 1.0), 0.1)], ground=True)
    kind = Infrared(EXACT, [infrared("ir01")], robot, caster, dt=DT, seed=1)
    assert taken(kind, 1, yaw=math.pi / 2)[0].distance == pytest.approx(0.92, rel=1e-5)
    # Pitched down by 10 degrees it looks at the ground: from 0.025 - 0.03 sin(10 deg) up.
    kind = Infrared(EXACT, [infrared("ir01")], robot, caster, dt=DT, seed=1)
    pitch = math.radians(2.0)
    expected = (0.025 - 0.03 * math.sin(pitch)) / math.sin(pitch)
    assert taken(kind, 1, pitch=pitch)[0].distance == pytest.approx(expected, rel=1e-5)


def test_beyond_its_range_it_gives_infinity(infrared_at):
    for face, seen in ((1.49, True), (1.59, False)):
        assert (taken(infrared_at(face), 1)[0].distance < math.inf) is seen


def test_a_new_value_comes_every_38_ms_and_the_sensors_take_turns(robot):
    sensors = [infrared(f"ir{i:02d}") for i in range(1, 16)]
    samples = taken(Infrared(EXACT, sensors, robot, RayCaster([], ground=True), dt=DT, seed=1), 100)
    first = {}
    for name in (sensor.name for sensor in sensors):
        times = [sample.time_s for sample in samples if sample.name == name]
        np.testing.assert_allclose(np.diff(times), 0.038, atol=1e-12)
        assert abs(len(times) - 1.0 / 0.038) < 1.0
        first[name] = times[0]
    assert len(set(first.values())) == 15
    assert max(first.values()) < 0.038
    times = [sample.time_s for sample in samples]
    assert times == sorted(times)


def test_a_sample_is_of_its_own_time(infrared_at):
    # Driving at a wall at 0.5 m/s: each distance is that of the instant of its stamp.
    for sample in taken(infrared_at(1.0), 100, forward=0.5):
        assert sample.distance == pytest.approx(0.97 - 0.5 * sample.time_s, rel=1e-5)


def test_the_converter_has_its_steps(infrared_at):
    kind = infrared_at(0.99, InfraredModel(noise_v=0.05, adc_bits=8))
    steps = voltage(np.array([s.distance for s in taken(kind, 2000)]), 0.15) / (3.3 / 255)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert len(set(np.rint(steps))) > 5


def test_the_noise_of_the_voltage_is_29_mv(infrared_at):
    sensors = [infrared(f"ir{i:02d}") for i in range(1, 16)]
    first, again = (
        [s.distance for s in taken(infrared_at(0.63, InfraredModel(), sensors, 3), periods)]
        for periods in (1000, 5)
    )
    assert first[: len(again)] == again
    volts = voltage(np.array(first), 0.15)
    assert len(volts) > 3900
    # Standard errors: 0.5 mV of the mean, 1.1 % of the deviation.
    assert volts.mean() == pytest.approx(voltage(np.array([0.6]), 0.15)[0], abs=2e-3)
    assert volts.std() == pytest.approx(0.029, rel=0.04)


QUIET = SonarModel(noise=0.0, resolution=0.0)


def test_the_sonar_measures_the_nearest_thing_in_its_cone(robot):
    # The wall's nearest point lies straight across, within the cone at 10 degrees.
    angle = math.radians(10.0)
    c, s = math.cos(angle), math.sin(angle)
    middle = np.array([2.01 * c + 0.03, 2.01 * s])
    ends = [tuple(middle + side * 4.0 * np.array([-s, c])) for side in (-1, 1)]
    caster = RayCaster([Wall(*ends, 0.02, 3.0)], ground=True)
    samples = taken(Sonar(QUIET, [SONAR], robot, caster, dt=DT, seed=1), 100)
    assert len(samples) == 20
    np.testing.assert_allclose(np.diff([sample.time_s for sample in samples]), 0.05, atol=1e-12)
    assert samples[0].distance == pytest.approx(2.0, rel=2e-3)
    assert samples[0].distance >= 2.0


def test_the_sonar_has_an_edge_and_does_not_hear_the_ground(robot):
    def received(degrees):
        at = 1.5 * math.cos(math.radians(degrees)), 1.5 * math.sin(math.radians(degrees))
        caster = RayCaster([Cylinder(at, 0.03, 3.0)], ground=True)
        return taken(Sonar(QUIET, [SONAR], robot, caster, dt=DT, seed=1), 1)[0].distance

    assert received(0) == pytest.approx(1.44, rel=1e-3)
    assert received(12) < 1.5
    assert received(18) == math.inf


def test_the_sonar_is_limited_and_has_steps_and_noise(robot):
    def samples(x, model, periods=1):
        caster = RayCaster([Wall((x + 0.04, -9.0), (x + 0.04, 9.0), 0.02)], ground=True)
        kind = Sonar(model, [SONAR], robot, caster, dt=DT, seed=1)
        return np.array([sample.distance for sample in taken(kind, periods)])

    assert (samples(4.2, QUIET)[0], samples(0.01, QUIET)[0]) == (math.inf, 0.03)
    noisy = samples(2.0, dataclasses.replace(QUIET, noise=0.005), 4000)
    assert noisy.std() == pytest.approx(0.005, rel=0.1)
    assert noisy.mean() == pytest.approx(2.0, abs=5e-4)
    steps = samples(2.0, SonarModel(), 300) / 0.01
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)


def test_the_cone_is_filled_evenly():
    rays = cone(61, math.pi / 6)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=0), 1.0, rtol=1e-12)
    off = np.arccos(rays[0])
    assert (off[0], off.max()) == (0.0, pytest.approx(math.pi / 12))
    # Half of the rays within half of the solid angle.
    assert (off < math.pi / 12 / math.sqrt(2)).mean() == pytest.approx(0.5, abs=0.02)
    assert np.diff(np.sort(np.arctan2(rays[1], rays[0]))).max() < math.radians(2.0)
