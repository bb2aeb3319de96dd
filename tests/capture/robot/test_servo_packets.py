"""Packets of serial servos against the manuals' examples and the vendors' SDKs."""

import random

import numpy as np
import pytest
from dynamixel_sdk import Protocol2PacketHandler
from scservo_sdk import SCS_SETEND
from scservo_sdk import PacketHandler as Feetech

from campaign.structure import nested_packets
from support.serial_lines import Captured
from undulog.capture.log.messages.frames import SERIAL_MORE, SERIAL_NOISE
from undulog.capture.robot.serial_servos import (
    PROTOCOLS,
    PacketSplitter,
    crc16,
    dynamixel_packet,
    feetech_packet,
)
from undulog.capture.sources.events import Tally
from undulog.capture.sources.serial_port import PacketClock

MANUAL = {
    # ROBOTIS e-Manual, DYNAMIXEL Protocol 2.0: ping, its status, read, its status, write, sync
    # read, sync write.
    "dynamixel2": [
        "FFFFFD0001030001194E",
        "FFFFFD000107005500060426655D",
        "FFFFFD0001070002840004001D15",
        "FFFFFD0001080055 00A6000000 8CC0",
        "FFFFFD000109000374000002 0000CA89",
        "FFFFFD00FE09008284000400 0102 CEFA",
        "FFFFFD00FE110083740004000196000000 02AA000000 8287",
    ],
    # Feetech, communication protocol of SMS/STS servos: ping and its reply, read of the position of
    # servo 1 and its reply, write of a new ID, synchronous write to servos 1 to 4.
    "feetech": [
        "FFFF010201FB",
        "FFFF010200FC",
        "FFFF0104023802BE",
        "FFFF01040018 05DD",
        "FFFFFE04030501F4",
        "FFFFFE20832A06 010008 0000E803 0200080000E803 0300080000E803 0400080000E803 58",
    ],
}


def packets_of(protocol):
    return [bytes.fromhex(text) for text in MANUAL[protocol]]


def valid(pieces):
    return [piece.data for piece in pieces if piece.valid]


def split(protocol, stream, sizes):
    splitter, pieces, at = PacketSplitter(protocol), [], 0
    for size in sizes:
        pieces += splitter.feed(stream[at : at + size])
        at += size
    pieces += splitter.feed(stream[at:])
    return pieces + splitter.feed(b"", silence=True)


def checksum_holds(protocol, packet):
    if protocol == "feetech":
        return ~sum(packet[2:-1]) & 0xFF == packet[-1]
    return crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_packets_of_the_manual(protocol):
    for packet in packets_of(protocol):
        assert valid(split(protocol, packet, [])) == [packet], packet.hex(" ")


def sdk_packets(protocol, draw):
    """Random requests and writes, encoded by the vendor's SDK."""
    port, servo = Captured(), draw.randrange(1, 20)
    data = [
        draw.choice((0xFF, 0xFF, 0xFD, draw.randrange(256))) for _ in range(draw.randrange(1, 9))
    ]
    if protocol == "feetech":
        SCS_SETEND(0)
        sdk = Feetech(0)
        draw.choice(
            (
                lambda: sdk.ping(port, servo),
                lambda: sdk.readTx(port, servo, 56, 15),
                lambda: sdk.writeTxOnly(port, servo, 42, len(data), data),
                lambda: sdk.syncReadTx(port, 56, 2, [1, 2, 3], 3),
                lambda: sdk.syncWriteTxOnly(port, 42, 1, [1, *data[:1], 2, *data[-1:]], 4),
            )
        )()
    else:
        sdk = Protocol2PacketHandler()
        draw.choice(
            (
                lambda: sdk.ping(port, servo),
                lambda: sdk.readTx(port, servo, 132, 4),
                lambda: sdk.writeTxOnly(port, servo, 116, len(data), data),
                lambda: sdk.syncReadTx(port, 132, 4, [1, 2, 3], 3, False),
                lambda: sdk.syncWriteTxOnly(port, 116, 1, [1, *data[:1], 2, *data[-1:]], 4),
                lambda: sdk.bulkWriteTxOnly(port, [1, 116, 0, 1, 0, *data[:1]], 6),
            )
        )()
    return port.take()


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("seed", range(5))
def test_no_valid_packet_is_lost_and_no_byte(protocol, seed):
    """Noise, cut packets and reads of any size between packets of the SDK."""
    draw = random.Random(seed)
    stream, sent = b"", []
    for _ in range(400):
        kind = draw.random()
        packet = sdk_packets(protocol, draw)
        if kind < 0.1:
            stream += draw.randbytes(draw.randrange(1, 40))
        elif kind < 0.25:
            stream += packet[: draw.randrange(1, len(packet))]
        sent.append(packet)
        stream += packet
    sizes = [draw.randrange(1, 60) for _ in range(len(stream) // 30)]
    pieces = split(protocol, stream, sizes)
    assert b"".join(piece.data for piece in pieces) == stream
    assert [piece.stop for piece in pieces] == np.cumsum([len(p.data) for p in pieces]).tolist()
    assert all(checksum_holds(protocol, data) for data in valid(pieces))
    packets = iter(valid(pieces))
    lost = [packet.hex(" ") for packet in sent if not any(other == packet for other in packets)]
    assert not lost


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_our_encoder_makes_the_packets_of_the_sdk(protocol):
    draw = random.Random(7)
    for _ in range(200):
        packet = sdk_packets(protocol, draw)
        if protocol == "feetech":
            assert feetech_packet(packet[2], packet[4], packet[5:-1]) == packet
        elif b"\xff\xff\xfd" not in packet[7:]:  # this SDK forgets to stuff what it sends
            assert dynamixel_packet(packet[4], packet[7], packet[8:-2]) == packet


def test_stuffing_is_that_of_the_sdk():
    draw, sdk = random.Random(3), Protocol2PacketHandler()
    for _ in range(300):
        data = [draw.choice((0xFF, 0xFF, 0xFD, 0, 7)) for _ in range(12)]
        plain = [0xFF, 0xFF, 0xFD, 0, 5, 15, 0, 3, *data, 0, 0]
        stuffed = bytes(sdk.addStuffing(plain))
        ours = dynamixel_packet(5, 3, bytes(data))
        assert ours[:-2] == stuffed[:-2]
        assert sdk.updateCRC(0, list(ours), len(ours) - 2) == crc16(ours[:-2])


@pytest.mark.parametrize("baud", [115_200, 1_000_000])
def test_a_packet_has_the_time_of_its_last_byte_exactly(baud):
    """Reads of 16 ms with several packets each, one of them across two reads."""
    packets = [feetech_packet(k % 6 + 1, 0, bytes(range(k % 9 + 1))) for k in range(60)]
    stream = b"".join(packets)
    clock, tally, t_ns, blocks, stamps = (
        PacketClock("feetech", baud),
        Tally(lambda: 0),
        10**18,
        [],
        [],
    )
    ends = np.cumsum([len(packet) for packet in packets])
    reads = list(range(0, len(stream), 117))
    for start in reads:
        t_ns += 16_000_000
        stamps.append(t_ns)
        blocks.append(clock.feed(stream[start : start + 117], t_ns, tally))
    records = np.concatenate(blocks)
    expected = []
    for end in ends.tolist():
        read = (end - 1) // 117
        behind = min(117 * (read + 1), len(stream)) - end
        expected.append(stamps[read] - round(behind * 10 * 1e9 / baud))
    assert records["t_host_ns"].tolist() == expected
    assert (records["t_device_ns"] == records["t_host_ns"]).all()
    assert records["id_flags"].tolist() == [packet[2] for packet in packets]


def test_long_packets_and_noise_are_kept_in_pieces():
    packet = feetech_packet(0xFE, 0x83, bytes(150))
    clock, tally = PacketClock("feetech", 1_000_000), Tally(lambda: 0)
    records = clock.feed(b"\x01\x02\x03" + packet, 10**9, tally)
    assert records["len"].tolist() == [3, 64, 64, 28]
    assert records["fd_flags"].tolist() == [SERIAL_NOISE, SERIAL_MORE, SERIAL_MORE, 0]
    kept = b"".join(r["data"][: r["len"]].tobytes() for r in records)
    assert kept == b"\x01\x02\x03" + packet
    assert tally.counts.malformed == 1


def test_packets_in_packets_are_judged_once_each():
    """The time doubled with each: forty of them would have taken days."""
    packet = nested_packets(40)
    pieces = PacketSplitter("feetech").feed(packet)
    assert [(piece.data, piece.valid) for piece in pieces] == [(packet, True)]
