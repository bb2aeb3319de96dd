"""All sensors together: order of arrival, readings, scenarios, and how a session holds them."""

import dataclasses
import math
import tomllib

import numpy as np
import pytest

from support.twin_runs import SNAKE25, check_keys, faults_of, sensed, simulate
from undulog import sim
from undulog.capture import Session
from undulog.capture.robot.model import Plane
from undulog.sim.physics.sensing import JointSample, RangeSample, VectorSample

SCENARIO = f"""{SNAKE25.replace("2.0", "0.6")}
[world]
heading = 0.2
[[world.obstacles]]
shape = "cylinder"
position = [0.9, 0.1]
radius = 0.1
[sensing.servo]
slot_s = 3e-4
resolution = 1.5e-3
"""


@pytest.fixture(scope="module")
def scenario():
    return sim.parse_scenario(SCENARIO, "x.toml")


@pytest.fixture(scope="module")
def run(scenario):
    with sim.Twin(scenario) as twin:
        return [(sample, twin._sensing.readings) for sample in twin.samples()], twin.flush()


def test_nothing_is_delivered_before_it_was_measured_or_twice(run):
    seen = {}
    for sample, _ in run[0]:
        cycles = [value.cycle for value in sample.sensed if isinstance(value, JointSample)]
        assert cycles == ([sample.tick - 2] if sample.tick >= 2 else [])
        for value in sample.sensed:
            if isinstance(value, JointSample):
                continue
            assert sample.time_s - 0.01 <= value.time_s + 1e-9 < sample.time_s + 1e-9
            assert value.time_s > seen.get(value.name, -1.0)
            seen[value.name] = value.time_s
        times = [value.time_s for value in sample.sensed if not isinstance(value, JointSample)]
        assert times == sorted(times)
    assert (len(seen), [value.cycle for value in run[1]]) == (18, [59, 60])


def test_the_readings_hold_the_newest_value_of_each_sensor(run, scenario):
    newest = {}
    assert run[0][0][1].angle.tolist() == pytest.approx([math.nan] * 25, nan_ok=True)
    for sample, readings in run[0]:
        for value in sample.sensed:
            newest["joints" if isinstance(value, JointSample) else value.name] = value
        for name, value in newest.items():
            if isinstance(value, JointSample):
                np.testing.assert_array_equal(readings.angle, value.position)
                np.testing.assert_array_equal(readings.velocity, value.velocity)
            elif isinstance(value, RangeSample):
                assert readings.ranges[name] == value.distance
            elif name == "compass":
                np.testing.assert_array_equal(readings.magnetic_field[name], value.vector)
            else:
                np.testing.assert_array_equal(readings.acceleration[name], value.vector)
    last = run[0][-1][1]
    assert len(last.ranges) == 16
    # The head looks at the cylinder, 0.2 rad off to the left.
    assert last.ranges["sonar"] == pytest.approx(0.9 - 0.1 - 0.03, abs=0.06)
    field = last.magnetic_field["compass"]
    assert math.atan2(-field[1], field[0]) == pytest.approx(0.2, abs=0.1)


def test_a_session_holds_every_sample_with_both_its_times(run, scenario, tmp_path):
    path = tmp_path / "senses.mcap"
    sim.record(scenario, path)
    value = [(sample.tick, reading) for sample, _ in run[0] for reading in sample.sensed]
    topics = {sensor.name: sensor.topic for sensor in scenario.robot.sensors}
    with Session.open(path) as session:
        for name, topic in topics.items():
            mine = [
                (tick, reading) for tick, reading in value if getattr(reading, "name", "") == name
            ]
            received = list(session.messages(topic))
            assert len(received) == len(mine) > 5
            for (tick, reading), (log_ns, message) in zip(mine, received, strict=True):
                assert log_ns == scenario.epoch_ns + tick * 10_000_000
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                assert stamp == scenario.epoch_ns + round(reading.time_s * 1e9)
                assert message.header.frame_id == name
                if isinstance(reading, VectorSample):
                    field = "magnetic_field" if topic == "/compass" else "linear_acceleration"
                    vector = getattr(message, field)
                    np.testing.assert_array_equal([vector.x, vector.y, vector.z], reading.vector)
                else:
                    assert message.range == np.float32(reading.distance)
        assert session.warnings == []


@pytest.mark.nightly
def test_polling_in_turn_changes_no_phase_where_each_joint_has_its_own_time(
    make_scenario, make_robot
):
    slot_s, hz = 0.7e-3, 1.0
    robot = make_robot(14)
    yaw = robot.joint_indices(Plane.HORIZONTAL)

    def phases(servo, *, own_times=True):
        short = {"frequency_hz": hz, "ramp_s": 0.5, "duration_s": 4.0}
        scenario = make_scenario(robot, **short, sensing=sim.SensorModels(servo))
        chosen = sensed(scenario)[-202:-2]  # two whole cycles
        angle = np.array([sample.position for sample in chosen])
        cycle = np.array([sample.cycle for sample in chosen])[:, None] / 100
        turn = (
            2 * np.pi * hz * (cycle + own_times * np.array([sample.offset_s for sample in chosen]))
        )
        phases = []
        for t, q in zip(turn.T[yaw], angle.T[yaw], strict=True):
            basis = np.column_stack([np.cos(t), np.sin(t), np.ones_like(t)])
            c, d = np.linalg.lstsq(basis, q, rcond=None)[0][:2]
            phases.append(math.degrees(math.atan2(c, d)))
        return np.array(phases)

    at_once, in_turn = phases(sim.ServoPolling()), phases(sim.ServoPolling(slot_s=slot_s))
    # Within a control period the joints ripple, each command being held: 0.055 degrees from peak to
    # peak of this phase, by the place in the period at which the physics steps are looked at.
    np.testing.assert_allclose(in_turn, at_once, atol=0.055)
    # One stamp for all would be off by omega times the skew, up to 3 degrees.
    careless = phases(sim.ServoPolling(slot_s=slot_s), own_times=False)
    np.testing.assert_allclose(careless - in_turn, 360.0 * hz * slot_s * yaw, atol=0.02)


def test_without_its_sensors_a_robot_has_its_servos_only_and_moves_alike(scenario, run):
    quiet = dataclasses.replace(scenario.sensing, enabled=False)
    mute = dataclasses.replace(scenario, sensing=quiet)
    samples = simulate(mute)
    assert {type(reading) for sample in samples for reading in sample.sensed} == {JointSample}
    assert sim.parse_scenario(mute.toml(), "y.toml") == mute
    np.testing.assert_array_equal(samples[-1].step.body.position, run[0][-1][0].step.body.position)


def test_a_robot_without_sensors_has_none(make_scenario):
    for sample in simulate(make_scenario(duration_s=0.05)):
        assert all(isinstance(reading, JointSample) for reading in sample.sensed)
    assert sim.Readings.nothing(make_scenario().robot).ranges == {}


def test_seeds_change_the_noise_and_only_that(scenario):
    def value(seed):
        samples = simulate(scenario.changed(seed=seed, duration_s=0.1))
        values = [
            reading.vector
            for s in samples
            for reading in s.sensed
            if isinstance(reading, VectorSample)
        ]
        return np.nan_to_num(values), samples[-1].step.body.angle

    (first, angle), (again, _), (other, same) = value(1), value(1), value(2)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    np.testing.assert_array_equal(angle, same)


SENSING = """
[sensing]
enabled = true
[sensing.servo]
slot_s = 3e-4
resolution = 1e-3
dead_band = 2e-3
command_resolution = 5e-3
[sensing.ir]
hold_s = 0.04
noise_v = 0.01
adc_bits = 10
adc_v = 5.0
peak = 0.1
[sensing.sonar]
rate_hz = 10
noise = 0.01
resolution = 0.02
rays = 7
[sensing.accelerometer]
rate_hz = 50
noise = 0.1
resolution = 0.05
[sensing.compass]
rate_hz = 8
noise = 1e-7
resolution = 2e-7
horizontal_field = 2.1e-5
inclination = 1.1
north = 0.3
"""


def test_every_key_is_read_and_written_back():
    scenario = sim.parse_scenario(SNAKE25 + SENSING, "x.toml")
    assert dataclasses.asdict(scenario.sensing) == tomllib.loads(SENSING)["sensing"]
    assert sim.parse_scenario(scenario.toml(), "y.toml") == scenario


def test_faults_are_listed_at_once():
    faults = faults_of(
        SNAKE25
        + """
            [sensing]
            enabled = "yes"
            gyro = 1
            [sensing.servo]
            slot_s = 4e-4
            dead_band = -1
            [sensing.ir]
            hold_s = 0
            adc_bits = 0
            [sensing.sonar]
            rays = 0.5
            [sensing.compass]
            inclination = 65
            """
    )
    # 25 turns of 0.4 ms are a whole control period.
    check_keys(
        faults,
        "sensing.enabled sensing.gyro sensing.servo.slot_s sensing.servo.dead_band "
        "sensing.ir.hold_s sensing.ir.adc_bits sensing.sonar.rays sensing.compass.inclination",
    )


def test_a_twin_between_walls_sees_them():
    flat = sim.load_scenario("flat").changed(duration_s=0.1)
    sensing = dataclasses.replace(flat.sensing, ir=sim.InfraredModel(noise_v=0.0))
    walls = (
        sim.Wall((-3.0, 0.5), (3.0, 0.5)),
        sim.Wall((-3.0, -0.7), (3.0, -0.7)),
        sim.Cylinder((9.0, 9.0), 1.0),
    )
    world = dataclasses.replace(flat.world, obstacles=walls)
    with sim.Twin(dataclasses.replace(flat, world=world, sensing=sensing)) as twin:
        for _ in twin.samples():
            pass
        ranges = twin._sensing.readings.ranges
    # The sensors on the sides sit 0.025 m off the axis, the walls' faces are 0.49 and 0.69 m off.
    for number in range(4, 14):
        expected = 0.665 if number % 2 else 0.465
        assert ranges[f"ir{number:02d}"] == pytest.approx(expected, abs=2e-3)
    assert ranges["ir01"] == math.inf
