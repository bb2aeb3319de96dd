"""Packets to quantities: the vendors' SDKs encode, replies are built from the manuals."""

import math
import struct

import numpy as np
import pytest
from dynamixel_sdk import (
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    Protocol2PacketHandler,
)
from scservo_sdk import PacketHandler as Feetech

from support.bus_robots import TWO_JOINTS
from support.serial_lines import Captured
from undulog.capture.bus.decoders import open_decoder
from undulog.capture.robot.description import load_robot, parse_robot
from undulog.capture.robot.serial_servos import dynamixel_packet, feetech_packet
from undulog.capture.sources.events import Tally
from undulog.capture.sources.serial_port import PacketClock

ARM = f"""{TWO_JOINTS}[bus]
family = "dynamixel2"
motors = [
  {{ joint = "joint01", id = 11, model = "xm430" }},
  {{ joint = "joint02", id = 12, model = "xl430", scale = -1.0, offset = 0.25 }},
]
"""
STEP = math.tau / 4096


def decoded(robot, protocol, packets, pieces=1):
    """Decode packets, each at the millisecond of its number, in several calls."""
    clock, tally = PacketClock(protocol, 1_000_000), Tally(lambda: 0)
    records = np.concatenate(
        [clock.feed(packet, 10**9 + k * 10**6, tally) for k, packet in enumerate(packets)]
    )
    decoder, rows, counts = open_decoder(robot), [], []
    for part in np.array_split(records, pieces):
        samples, count = decoder.decode(part)
        counts.append(count)
        for sample in samples:
            for m, t, value in zip(sample.member, sample.t_ns, sample.values, strict=True):
                key = (sample.signals[m].target, sample.signals[m].quantity.value)
                rows.append((*key, (int(t) - 10**9) // 10**6, value))
    total = counts[0]
    for count in counts[1:]:
        total.add(count)
    return sorted(rows), total


def le(value, size):
    return [value >> 8 * k & 0xFF for k in range(size)]


@pytest.mark.parametrize("pieces", [1, 3])
def test_dynamixel_commands_and_replies(pieces):
    robot, port, sdk = parse_robot(ARM, "arm.toml", {}), Captured(), Protocol2PacketHandler()
    packets = []
    write = GroupSyncWrite(port, sdk, 116, 4)
    write.addParam(11, le(3048, 4))
    write.addParam(12, le(1024, 4))
    write.txPacket()
    packets.append(port.take())
    read = GroupSyncRead(port, sdk, 126, 10)
    read.addParam(11)
    read.addParam(12)
    read.txPacket()
    packets.append(port.take())
    for servo in (11, 12):  # current -100, velocity 50, position 2048
        data = bytes(1) + struct.pack("<hii", -100, 50, 2048)
        packets.append(dynamixel_packet(servo, 0x55, data))
    bulk = GroupBulkRead(port, sdk)
    bulk.addParam(11, 146, 1)
    bulk.addParam(12, 144, 3)
    bulk.txPacket()
    packets.append(port.take())
    packets.append(dynamixel_packet(11, 0x55, bytes((0, 41))))
    packets.append(dynamixel_packet(12, 0x55, bytes((0, *le(119, 2), 42))))
    both = GroupBulkWrite(port, sdk)
    both.addParam(11, 116, 4, le(2048, 4))
    both.addParam(12, 104, 4, le(7, 4))  # a goal velocity: in no map
    both.txPacket()
    packets.append(port.take())
    packets.append(dynamixel_packet(11, 0x55, bytes((0, 9))))  # a reply to nothing
    packets.append(dynamixel_packet(77, 3, bytes((116, 0, *le(1, 4)))))
    records, tally = decoded(robot, "dynamixel2", packets, pieces)
    rpm = 0.229 * math.tau / 60
    expected = sorted(
        [
            ("joint01", "command", 0, 1000 * STEP),
            ("joint02", "command", 0, 1024 * STEP + 0.25),
            ("joint01", "current", 2, -0.269),
            ("joint01", "velocity", 2, 50 * rpm),
            ("joint01", "position", 2, 0.0),
            ("joint02", "velocity", 3, -50 * rpm),
            ("joint02", "position", 3, 0.25),
            ("joint01", "temperature", 5, 41.0),
            ("joint02", "temperature", 6, 42.0),
            ("joint02", "voltage", 6, 11.9),
            ("joint01", "command", 7, 0.0),
        ]
    )
    assert [record[:3] for record in records] == [record[:3] for record in expected]
    assert [record[3] for record in records] == pytest.approx(
        [record[3] for record in expected], abs=1e-12
    )
    assert tally.unknown == {"servo 77 register 116": 1}
    assert tally.silent["servo 12 register 104"] == 1
    assert tally.silent["servo 11"] == 1


def test_feetech_staged_writes_repeated_requests_and_error_bits():
    robot, port, sdk = load_robot("so101"), Captured(), Feetech(0)
    sdk.regWriteTxOnly(port, 1, 42, 2, [0, 12])
    packets = [port.take()]
    packets.append(feetech_packet(0xFE, 5))  # action
    sdk.readTx(port, 2, 56, 2)
    request = port.take()
    packets += [request, request]  # the first had no reply
    packets.append(feetech_packet(2, 2, bytes((0, 4))))  # error bit 1 has the number of a read
    packets += [request, feetech_packet(3, 0, bytes((0, 4)))]  # of another servo
    packets += [request, feetech_packet(2, 0, bytes(3))]  # of another length
    sdk.writeTxOnly(port, 1, 41, 8, [0, 0xFF, 7, 0, 0, 0, 0, 0])  # acceleration, goal, time, speed
    packets.append(port.take())
    records, tally = decoded(robot, "feetech", packets)
    assert [record[:3] for record in records] == [
        ("shoulder_lift", "position", 4),
        ("shoulder_pan", "command", 1),
        ("shoulder_pan", "command", 9),
    ]
    values = [record[3] for record in records]
    assert values == pytest.approx([-1024 * STEP, 1024 * STEP, -STEP], abs=1e-12)
    assert tally.decoded == 3


def test_signs_and_the_big_endian_scs_series():
    text = (
        ARM.replace("dynamixel2", "feetech").replace("xm430", "sts3215").replace("xl430", "scs0009")
    )
    robot = parse_robot(text, "arm.toml", {})
    packets = [
        feetech_packet(11, 2, bytes((56, 15))),
        feetech_packet(11, 0, struct.pack("<HHHBB5xH", 2049, 0x8000 | 100, 0, 121, 30, 0x8000 | 2)),
        feetech_packet(12, 2, bytes((56, 2))),
        feetech_packet(12, 0, struct.pack(">H", 512 + 100)),
    ]
    records, _ = decoded(robot, "feetech", packets)
    values = {record[:2]: record[3] for record in records}
    assert values == pytest.approx(
        {
            ("joint01", "position"): STEP,
            ("joint01", "velocity"): -100 * STEP,
            ("joint01", "voltage"): 12.1,
            ("joint01", "temperature"): 30.0,
            ("joint01", "current"): -0.013,
            ("joint02", "position"): 0.25 - 100 * math.radians(300) / 1024,
        }
    )
