"""Samples as frames: against cantools, on every message of the shipped database, and its times."""

import math

import cantools
import numpy as np
import pytest

from undulog.capture import load_robot
from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.common.errors import DataError
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX, EXTENDED_FLAG, empty_frames
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Direction, Quantity
from undulog.sim.physics.sensing import JointSample, RangeSample, VectorSample
from undulog.sim.serve.reply_frames import ReplyEncoder
from undulog.sim.serve.robot import CommandLatch


@pytest.fixture(scope="module")
def robot():
    return load_robot("snake25")


@pytest.fixture(scope="module")
def database(robot):
    return cantools.database.load_string(dict(robot.databases)["snake25.dbc"], "dbc")


def cycle(number=3, joints=25, slot_s=0.0003):
    values = np.random.default_rng(number).uniform(-0.5, 0.5, (5, joints))
    return JointSample(number, slot_s * np.arange(joints), *values)


def clock_ns(elapsed_ns):
    return 7_000_000 + elapsed_ns


def distances(names, time_s, values):
    return [RangeSample(name, time_s, value) for name, value in zip(names, values, strict=True)]


def test_every_message_is_what_cantools_encodes(robot, database):
    sample = cycle()
    names = [sensor.name for sensor in robot.sensors[:16]]
    metres = [math.inf, *np.random.default_rng(1).uniform(0.0, 4.0, 15).tolist()]
    samples = [
        sample,
        *distances(names, 0.04, metres),
        VectorSample("accelerometer", 0.04, np.array([-9.81, 0.5, 19.6])),
        VectorSample("compass", 0.04, np.array([2e-5, -1.2e-5, math.nan])),
    ]
    expected = {}
    for i, joint in enumerate(robot.joint_names):
        expected[f"{joint}_state"] = {
            "position": math.degrees(sample.position[i]),
            "velocity": math.degrees(sample.velocity[i]),
            "torque": 1e3 * sample.effort[i],
            "current": 1e3 * sample.current[i],
            "temperature": "unknown",
        }
    millimetres = dict(zip(names, [1e3 * value for value in metres], strict=True))
    millimetres["ir01"] = "nothing in range"
    for k in range(4):
        message = database.get_message_by_name(f"ranges_{k + 1}")
        expected[message.name] = {s.name: millimetres[s.name] for s in message.signals}
    g = 9.80665e-3
    expected["acceleration"] = {"x": -9.81 / g, "y": 0.5 / g, "z": 19.6 / g}
    expected["magnetic_field"] = {"x": 20.0, "y": -12.0}
    frames = ReplyEncoder(robot).frames(samples, clock_ns)
    payloads = {}
    for frame in frames:
        message = database.get_message_by_frame_id(int(frame["id_flags"]))
        assert (int(frame["dlc"]), int(frame["dir"])) == (message.length, DIR_RX)
        payloads[message.name] = frame["data"].tobytes()[: message.length]
    rx = {s.message for s in robot.bus.signals if s.direction is Direction.RX}
    assert set(payloads) == set(expected) == rx
    for name, values in expected.items():
        assert payloads[name] == database.encode_message(name, values), name


def test_each_frame_has_the_time_of_its_sample(robot):
    frames = ReplyEncoder(robot).frames([cycle()], clock_ns)
    assert frames["id_flags"].tolist() == list(range(513, 538))
    expected = 7_000_000 + 30_000_000 + 300_000 * np.arange(25)
    assert frames["t_device_ns"].tolist() == expected.tolist()


def test_sensors_of_one_frame_read_at_different_times_have_a_frame_each(robot):
    samples = [*distances(["ir01", "ir02"], 0.04, [0.5, 0.6]), RangeSample("ir04", 0.05, 0.7)]
    frames = ReplyEncoder(robot).frames(samples, clock_ns)
    assert frames["t_device_ns"].tolist() == [47_000_000, 57_000_000]
    assert frames["id_flags"].tolist() == [769, 769]
    decoded, _ = BusDecoder(robot).decode(frames)
    by_target = {batch.signals[0].target: batch.values.tolist() for batch in decoded}
    nan = math.nan
    np.testing.assert_allclose(by_target["ir01"], [0.5, nan])
    np.testing.assert_allclose(by_target["ir04"], [nan, 0.7])


def test_a_frame_of_several_joints_has_the_time_of_the_last():
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: c\n\nBO_ 2147484672 pair: 8 c\n'
        ' SG_ one : 7|16@0- (0.01,0) [0|0] "deg" c\n'
        ' SG_ two : 16|32@1- (1,0) [0|0] "rad" c\n\nSIG_VALTYPE_ 2147484672 two : 1;\n'
    )
    signals = "".join(
        f'{{ message = "pair", signal = "{word}", direction = "rx", target = "joint0{n}",'
        f' quantity = "position", unit = "{unit}" }},'
        for n, word, unit in ((1, "one", "deg"), (2, "two", "rad"))
    )
    description = f"""
name = "two"
clock = "device"
joints = [{{ name = "joint01", plane = "horizontal" }}, {{ name = "joint02", plane = "vertical" }}]
defaults.link = {{ length = 0.06, radius = 0.025, mass = 0.1, inertia = [4e-5, 5e-5, 5e-5] }}
[bus]
databases = ["two.dbc"]
bitrate = 1000000
signals = [{signals}]
"""
    encoder = ReplyEncoder(parse_robot(description, "two.toml", {"two.dbc": text}))
    (frame,) = encoder.frames([cycle(0, joints=2, slot_s=0.001)], clock_ns)
    assert (frame["id_flags"], frame["t_device_ns"]) == (1024 | EXTENDED_FLAG, 8_000_000)
    pair = cantools.database.load_string(text, "dbc").get_message_by_name("pair")
    values, position = pair.decode(frame["data"].tobytes()), cycle(0, joints=2).position
    assert values["one"] == pytest.approx(math.degrees(position[0]), abs=0.005)
    assert values["two"] == pytest.approx(position[1], rel=1e-7)
    assert encoder.identifiers("joint02").tolist() == encoder.identifiers().tolist()


def test_what_the_twin_lacks_and_the_map_cannot_call_unknown_is_named(robot):
    assert ReplyEncoder(robot).made_up == []
    assert ReplyEncoder(load_robot("arcsnake-joint")).made_up == ["joint01 temperature"]


def test_a_robot_without_a_bus_map_is_named():
    with pytest.raises(DataError, match="snake13 has no bus map"):
        ReplyEncoder(load_robot("snake13"))


def commands(robot, angles, t_ns=0):
    values = {(name, Quantity.COMMAND, ""): angle for name, angle in angles.items()}
    return BusEncoder(robot, Direction.TX).encode(values, t_ns)


def test_servos_hold_their_last_command_within_their_limits(robot):
    latch = CommandLatch(robot)
    assert not latch.angle.any()
    assert latch.commanded.all()
    frames = commands(robot, {"joint02": 0.1, "joint03": 1.5, "joint01": -math.pi / 6}, 10**9)
    assert set(frames["dir"]) == {DIR_TX}
    assert np.flatnonzero(latch.take(frames)).tolist() == [0, 1, 2]
    assert latch.angle[:3] == pytest.approx([-math.pi / 6, 0.1, math.pi / 6], abs=1e-4)
    assert latch.cut == {"joint03"}
    latch.take(np.concatenate([commands(robot, {"joint02": a}) for a in (0.3, 0.2)]))
    assert latch.angle[1] == pytest.approx(0.2, abs=1e-4)  # the later one
    assert latch.take(commands(robot, {"joint02": -0.2}), received=False)[1]
    assert (latch.angle[1], latch.frames) == (pytest.approx(0.2, abs=1e-4), 6)


def test_commands_are_read_as_cantools_writes_them(robot, database):
    angles = np.random.default_rng(2).uniform(-0.5, 0.5, 25)
    frames = empty_frames(25)
    for frame, name, angle in zip(frames, robot.joint_names, angles, strict=True):
        message = database.get_message_by_name(f"{name}_command")
        data = message.encode({"position": math.degrees(angle)})
        frame["id_flags"], frame["dlc"], frame["dir"] = message.frame_id, len(data), DIR_TX
        frame["data"][: len(data)] = list(data)
    latch = CommandLatch(robot)
    latch.take(frames[np.random.default_rng(3).permutation(25)])
    assert np.abs(latch.angle - angles).max() <= math.radians(0.005) * (1 + 1e-9)


def test_replies_and_foreign_frames_are_no_commands(robot):
    latch = CommandLatch(robot)
    frames = ReplyEncoder(robot).frames([cycle()], clock_ns)
    frames["dir"] = DIR_TX
    frames["id_flags"][:3] = 0x7FF
    assert not latch.take(frames).any()
    assert not latch.angle.any()


def test_silence_is_that_of_servos_that_were_commanded(robot):
    latch = CommandLatch(robot)
    latch.take(commands(robot, {"joint02": 0.1}, 10**9))
    latch.take(commands(robot, {"joint03": 0.1}, 2 * 10**9))
    assert np.flatnonzero(latch.silent(2 * 10**9, 5 * 10**8)).tolist() == [1]
