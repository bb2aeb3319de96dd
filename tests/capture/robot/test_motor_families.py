"""Motor families against the frames that their manufacturers' manuals and libraries print."""

import json
import math
import struct

import numpy as np
import pytest

from support.bus_robots import TWO_JOINTS
from support.paths import TRACE
from undulog.capture import Session
from undulog.capture.bus.decoders import open_decoder
from undulog.capture.common.errors import RobotFileError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, empty_fd_frames, empty_frames
from undulog.capture.robot.description import load_robot, parse_robot
from undulog.capture.robot.families import models_of

HEAD = f"{TWO_JOINTS}[bus]\n"
RMD = """name = "arcsnake-rmd"
clock = "host"
assumed = ["links", "joints", "servo"]
joints = [{ name = "joint01", plane = "horizontal" }]
[defaults.link]
length = 0.1
radius = 0.05
mass = 1.0
inertia = [1.3e-3, 1.5e-3, 1.5e-3]
[defaults.joint]
lower = -6283.0
upper = 6283.0
max_velocity = 200.0
[bus]
family = "rmd"
model = "v2"
ids = [11]
"""


def robot(bus):
    return parse_robot(HEAD + bus, "arm.toml", {})


def frame(identifier, data, *, sent=False):
    frames = empty_frames(1)
    frames["id_flags"], frames["dlc"], frames["dir"] = identifier, len(data), sent
    frames["data"][0, : len(data)] = list(data)
    return frames


def decoded(robot, *frames):
    samples, tally = open_decoder(robot).decode(np.concatenate(frames))
    values = {
        (sample.signals[m].target, sample.signals[m].quantity.value): value
        for sample in samples
        for m, value in zip(sample.member.tolist(), sample.values.tolist(), strict=True)
    }
    return values, tally


def test_rmd_v3_frames_of_the_manual():
    """Servo motor control protocol V3.x/V4.x, the examples of 0xA4, 0x9C, 0x92 and 0x9A."""
    arm = robot('family = "rmd"\nmodel = "v3"\nids = [1, 2]')
    values, _ = decoded(
        arm,
        frame(0x141, bytes.fromhex("A400F401A08C0000"), sent=True),
        frame(0x242, bytes.fromhex("9C326400F4012D00")),
        frame(0x241, bytes.fromhex("92000000A08C0000")),
        frame(0x242, bytes.fromhex("9A320001E5010400")),
    )
    assert values == pytest.approx(
        {
            ("joint01", "command"): math.tau,
            ("joint02", "temperature"): 50.0,
            ("joint02", "current"): 1.0,
            ("joint02", "velocity"): math.radians(500),
            ("joint01", "position"): math.tau,
            ("joint02", "voltage"): 48.5,
        }
    )


def test_a_request_of_the_old_protocol_is_no_position():
    """One identifier both ways: the request 0x92 is all zeros."""
    arm = robot('family = "rmd"\nmodel = "v2"\nids = [11, 12]')
    asked = frame(0x14B, bytes.fromhex("9200000000000000"), sent=True)
    values, tally = decoded(arm, asked)
    assert not values
    assert tally.silent["14B"] == 1
    values, _ = decoded(arm, asked, frame(0x14B, bytes.fromhex("92A08C0000000000")))
    assert values == pytest.approx({("joint01", "position"): math.tau})


def test_a_real_recording_has_slope_one_and_a_lag_of_7_ms(tmp_path, command):
    if not TRACE.is_file():
        pytest.skip(f"the real recording {TRACE.name} is not beside this checkout")
    (tmp_path / "rmd.toml").write_text(RMD)
    log = tmp_path / "rmd.mcap"
    command("import", TRACE, "--robot", tmp_path / "rmd.toml", "-o", log)
    with Session.open(log) as session:
        start = session.start_ns

        def column(topic):
            angles = [
                (m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec - start * 1e-9, m.position[0])
                for _, m in session.messages(topic)
            ]
            return np.array(angles).T

        (tc, c), (tp, p) = column("/joint_commands"), column("/joint_states")
    inside = (tp >= 3) & (tp <= 10.5)

    def fitted(lag):
        a = np.column_stack([np.interp(tp[inside] - lag, tc, c), np.ones(inside.sum())])
        x, rest, *_ = np.linalg.lstsq(a, p[inside], rcond=None)
        return rest[0], x[0]

    lags = np.arange(0, 0.02, 1e-4)
    fits = [fitted(lag) for lag in lags]
    best = int(np.argmin([rest for rest, _ in fits]))
    assert lags[best] == pytest.approx(7.4e-3, abs=2e-4)
    assert fits[best][1] == pytest.approx(1.0, abs=5e-4)
    old = load_robot("arcsnake-joint")
    assert decoded(old, frame(0x14B, b"\x92" + b"\x10" * 7))[0] == pytest.approx(
        decoded(load_robot(tmp_path / "rmd.toml"), frame(0x14B, b"\x92" + b"\x10" * 7))[0]
    )


def mit(values_bits):
    """Pack numbers, most significant bit first: float_to_uint of MIT's mini-cheetah firmware."""
    number = 0
    total = 0
    for value, low, high, bits in values_bits:
        number = number << bits | int((value - low) * ((1 << bits) - 1) / (high - low))
        total += bits
    return number.to_bytes(total // 8, "big")


@pytest.mark.parametrize(("family", "models"), [(f, models_of(f)) for f in ("damiao", "tmotor-ak")])
def test_mit_mode_of_every_model(family, models):
    """No manual prints a frame with its values; the packing is that of the libraries' function."""
    ranges = {"dm4310": (30, 10), "dm8009": (45, 54), "ak80-9": (50, 18), "ak10-9": (50, 65)}
    for model in models:
        arm = robot(f'family = "{family}"\nmodel = "{model}"\nids = [1, 2]')
        if model not in ranges:
            continue
        v, t = ranges[model]
        data = mit([(1.5, -12.5, 12.5, 16), (-v / 2, -v, v, 12), (t / 4, -t, t, 12)])
        asked = mit([(-0.75, -12.5, 12.5, 16), (0, -v, v, 12), (20, 0, 500, 12), (1, 0, 5, 12),
                     (0, -t, t, 12)])  # fmt: skip
        enable = bytes.fromhex("FFFFFFFFFFFFFFFC")
        values, _ = decoded(
            arm,
            frame(0, bytes((2,)) + data + bytes((40, 41))),
            frame(1, asked, sent=True),
        )
        warm = 40.0 if family == "damiao" else 0.0
        assert values["joint02", "position"] == pytest.approx(1.5, abs=25 / 65535)
        assert values["joint02", "velocity"] == pytest.approx(-v / 2, abs=2 * v / 4095)
        assert values["joint02", "effort"] == pytest.approx(t / 4, abs=2 * t / 4095)
        assert values["joint02", "temperature"] == warm
        assert values["joint01", "command"] == pytest.approx(-0.75, abs=25 / 65535)
        values, _ = decoded(arm, frame(1, enable, sent=True))
        assert math.isnan(values["joint01", "command"])


@pytest.mark.parametrize("family", ["cybergear", "robstride"])
def test_robstride_identifiers_carry_torque_mode_and_faults(family):
    """Layout of the manual's uint_to_float examples: 16 bits over -4 pi to 4 pi and so on."""
    model = "" if family == "cybergear" else 'model = "rs03"\n'
    arm = robot(f'family = "{family}"\n{model}ids = [127, 3]')
    v, t = (30, 12) if family == "cybergear" else (20, 60)
    data = struct.pack(">HHHH", 0xFFFF, 0x7FFF, 0, 315)
    for mode_and_faults in (0x00, 0x80, 0xBF):  # of motor 127, to the host 0xFD
        identifier = EXTENDED_FLAG | 2 << 24 | mode_and_faults << 16 | 0x7F00 | 0xFD
        values, _ = decoded(arm, frame(identifier, data))
        assert values == pytest.approx(
            {
                ("joint01", "position"): 4 * math.pi,
                ("joint01", "velocity"): -v / 65535,
                ("joint01", "effort"): -t,
                ("joint01", "temperature"): 31.5,
            }
        )
    torque = EXTENDED_FLAG | 1 << 24 | 0x8123 << 8 | 3
    values, _ = decoded(arm, frame(torque, struct.pack(">HHHH", 0, 0, 0, 0), sent=True))
    assert values == pytest.approx({("joint02", "command"): -4 * math.pi})
    write = EXTENDED_FLAG | 18 << 24 | 0xFD << 8 | 3
    values, _ = decoded(arm, frame(write, struct.pack("<HHf", 0x7016, 0, 1.25), sent=True))
    assert values == pytest.approx({("joint02", "command"): 1.25})
    speed_limit = struct.pack("<HHf", 0x7017, 0, 1.25)
    assert not decoded(arm, frame(write, speed_limit, sent=True))[0]


def test_odrive_frames_of_its_guide():
    """``struct.pack('<fhh', 1.0, 0, 0)`` to ``node << 5 | 0x0c``: ODrive documentation, CAN."""
    arm = robot('family = "odrive"\nids = [0, 1]')
    values, _ = decoded(
        arm,
        frame(1 << 5 | 0x0C, struct.pack("<fhh", 1.0, 0, 0), sent=True),
        frame(0x09, struct.pack("<ff", 0.5, -2.0)),
        frame(0x14, struct.pack("<ff", 9.0, 3.0)),
        frame(0x17, struct.pack("<ff", 24.0, 1.0)),
    )
    assert values == pytest.approx(
        {
            ("joint02", "command"): math.tau,
            ("joint01", "position"): math.pi,
            ("joint01", "velocity"): -2 * math.tau,
            ("joint01", "current"): 3.0,
            ("joint01", "voltage"): 24.0,
        }
    )


def test_gear_ratio_and_zero_of_a_motor():
    arm = robot(
        'family = "odrive"\nmotors = [{ joint = "joint02", id = 3, scale = -0.125, offset = 0.5 }]'
    )
    values, _ = decoded(arm, frame(3 << 5 | 0x09, struct.pack("<ff", 1.0, 1.0)))
    assert values == pytest.approx(
        {("joint02", "position"): 0.5 - math.tau / 8, ("joint02", "velocity"): -math.tau / 8}
    )


@pytest.mark.parametrize(
    ("bus", "key"),
    [
        ('family = "damia"\nids = [1, 2]', "bus.family"),
        ('family = "damiao"\nids = [1, 2]', "bus.model"),
        ('family = "damiao"\nmodel = "dm4311"\nids = [1, 2]', "bus.model"),
        ('family = "odrive"\nids = [1]', "bus.ids"),
        ('family = "odrive"\nids = [1, 1]', "bus.motors"),
        ('family = "odrive"\nids = [1.5, 1]', "bus.ids"),
        ('family = "odrive"\nids = [1, 2]\nsignals = []', "bus.signals"),
        ('family = "odrive"\nmotors = [{ joint = "x", id = 1 }]', "bus.motors[0].joint"),
    ],
)
def test_faults_name_the_key(bus, key):
    with pytest.raises(RobotFileError) as error:
        robot(bus)
    assert key in [fault.key for fault in error.value.faults], json.dumps(str(error.value))


def test_moteus_by_plug_in():
    """The frame and the reply that the protocol's documentation takes apart."""
    arm = robot('family = "moteus"\nids = [1, 2]')
    frames = empty_fd_frames(2)
    frames["id_flags"] = 0x8001, 0x0100
    frames["dir"] = 1, 0
    for k, data in enumerate(
        ("01000a07206000200150ff140400130d", "2404000a005000000170ff230d181400")
    ):
        frames["len"][k] = len(data) // 2
        frames["data"][k, : len(data) // 2] = list(bytes.fromhex(data))
    values, _ = decoded(arm, frames)
    assert values == pytest.approx(
        {
            ("joint01", "command"): 0x60 * 1e-4 * math.tau,
            ("joint01", "position"): 0x50 * 1e-4 * math.tau,
            ("joint01", "velocity"): 0x100 * 2.5e-4 * math.tau,
            ("joint01", "effort"): -0x90 * 0.01,
            ("joint01", "voltage"): 0x18 * 0.5,
            ("joint01", "temperature"): 0x14,
        }
    )
