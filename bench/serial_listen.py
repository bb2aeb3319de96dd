"""Listening to serial servos: how late packets are stamped, and what a packet costs.

Cost: the same bytes (a read request and its reply in turn, 15 registers of 12 servos) through
the vendor's own parser (``rxPacket`` of the SDK, which gives lists of bytes) and through ours, from
bytes to records and on to values in SI. In one process, in turn; processor time.

Times: packets are written to a pseudo-terminal at the pace of 1 Mbaud, 10 us a byte; what is shown
is the time of a packet minus the time at which its last byte was written. The bytes of a write come
at once, so early values down to the length of a write are the bench's own.

Run: python bench/serial_listen.py [--frames 20000] [--runs 3]
"""

from __future__ import annotations

import os
import tempfile
import time
import tty
from pathlib import Path

import numpy as np
from dynamixel_sdk import Protocol2PacketHandler
from measuring import arguments
from records import compared, versions
from scservo_sdk import PacketHandler

from undulog.capture import SessionWriter
from undulog.capture.bus.decoders import open_decoder
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.serial_servos import dynamixel_packet, feetech_packet
from undulog.capture.sources.contract import SourceContext, open_source, parse_address
from undulog.capture.sources.events import Tally
from undulog.capture.sources.serial_port import PacketClock

SERVOS = range(1, 13)
ROBOT = """name = "line"
clock = "host"
[chain]
joints = 12
[defaults.link]
length = 0.1
radius = 0.05
mass = 1.0
inertia = [1.3e-3, 1.5e-3, 1.5e-3]
[bus]
family = "{family}"
model = "{model}"
ids = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
"""


class Memory:
    """A port of the SDKs that reads from memory."""

    is_using = False

    def __init__(self, data: bytes) -> None:
        """Read from the data's begin."""
        self._data, self.at = data, 0

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return the next bytes."""
        chunk = self._data[self.at : self.at + length]
        self.at += len(chunk)
        return chunk

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Whether no more will come."""
        return self.at >= len(self._data)


def stream(protocol: str, packets: int) -> list[bytes]:
    """Return requests and replies in turn."""
    traffic: list[bytes] = []
    draw = np.random.default_rng(1)
    for k in range(packets // 2):
        servo, data = SERVOS[k % 12], draw.integers(0, 120, 21, np.uint8).tobytes()
        if protocol == "feetech":
            traffic.append(feetech_packet(servo, 2, bytes((56, 15))))
            traffic.append(feetech_packet(servo, 0, data[:15]))
        else:
            traffic.append(dynamixel_packet(servo, 2, bytes((126, 0, 21, 0))))
            traffic.append(dynamixel_packet(servo, 0x55, bytes(1) + data))
    return traffic


def sdk_s(protocol: str, data: bytes, count: int) -> float:
    """Return the processor time of the SDK's parser [s]."""
    port = Memory(data)
    begun = time.process_time()
    parsed = 0
    if protocol == "feetech":
        sdk = PacketHandler(0)
        while port.at < len(data):
            parsed += sdk.rxPacket(port)[1] == 0
    else:
        handler = Protocol2PacketHandler()
        while port.at < len(data):
            parsed += handler.rxPacket(port, False)[1] == 0
    took = time.process_time() - begun
    # Dynamixel's parser looks at the bytes of requests, too, and passes over them.
    assert parsed == (count if protocol == "feetech" else count // 2), (parsed, count)
    return took


def our_s(protocol: str, data: bytes, count: int) -> tuple[float, float]:
    """Return the processor time to records, and on to values [s]; reads of 512 bytes."""
    model = "sts3215" if protocol == "feetech" else "xm430"
    decoder = open_decoder(parse_robot(ROBOT.format(family=protocol, model=model), "line.toml", {}))
    clock, tally = PacketClock(protocol, 1_000_000), Tally(lambda: 0)
    begun = time.process_time()
    reads = range(0, len(data), 512)
    parts = [clock.feed(data[at : at + 512], 10**18 + 10**4 * at, tally) for at in reads]
    framed = time.process_time()
    values = records = 0
    for at in range(0, len(parts), 64):
        block = np.concatenate(parts[at : at + 64])
        records += len(block)
        values += sum(len(record.values) for record in decoder.decode(block)[0])
    decoded = time.process_time()
    assert records == count
    assert values == count // 2 * 5, values  # position, velocity, voltage, temperature, current
    return framed - begun, decoded - framed


def delays_s(packets: list[bytes]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the time of each packet minus that of its last byte's write [s]."""
    with tempfile.TemporaryDirectory() as folder:
        master, slave = os.openpty()
        tty.setraw(slave)
        address = f"line=serial:{os.ttyname(slave)}?protocol=feetech"
        path = Path(folder) / "x.mcap"
        with SessionWriter(path, session_id="x", epoch_ns=time.time_ns()) as writer:
            source = open_source(parse_address(address))
            source.start(SourceContext(time.monotonic_ns, writer))
            sent, reported = os.pipe()
            if not (sender := os.fork()):  # a process, so that it doesn't share the interpreter
                written: list[int] = []
                due = 0
                for packet in packets:
                    due = max(due, time.monotonic_ns()) + len(packet) * 10_000
                    while time.monotonic_ns() < due:
                        pass
                    os.write(master, packet)
                    written.append(time.monotonic_ns())
                os.write(reported, np.array(written, np.int64).tobytes())
                os._exit(0)
            stamps: list[int] = []
            while len(stamps) < len(packets):
                for array in source.poll().fd_frames:
                    stamps += array["t_host_ns"].tolist()
                time.sleep(0.005)
            sent_times = b""
            while len(sent_times) < 8 * len(packets):
                sent_times += os.read(sent, 1 << 16)
            os.waitpid(sender, 0)
            source.stop()
        os.close(master)
        os.close(slave)
    return (np.array(stamps) - np.frombuffer(sent_times, np.int64)) * 1e-9


def main() -> None:
    """Print both tables."""
    args = arguments(__doc__, frames=20_000, runs=3).parse_args()
    for protocol in ("feetech", "dynamixel2"):
        packets = stream(protocol, args.frames)
        data = b"".join(packets)
        rows = [
            (sdk_s(protocol, data, len(packets)), *our_s(protocol, data, len(packets)))
            for _ in range(args.runs)
        ]
        per_packet = np.array(rows) / len(packets) * 1e6
        sdk, framing, decoding = np.min(per_packet, axis=0)
        line_us = len(data) / len(packets) * 10
        peer = versions("feetech-servo-sdk" if protocol == "feetech" else "dynamixel-sdk")
        both = per_packet[:, 1:].sum(axis=1).tolist()
        what = f"take and decode a packet, {protocol}"
        compared(what, both, per_packet[:, 0].tolist(), peer, bar=2.0, unit="us")
        ours = framing + decoding
        print(
            f"  SDK's parser {sdk:.1f} us a packet; ours {framing:.1f} us to records and "
            f"{decoding:.1f} us to values; of a core at 1 Mbaud: ours {100 * ours / line_us:.1f} %"
            f", the SDK {100 * sdk / line_us:.1f} %"
        )
    late = delays_s(stream("feetech", min(args.frames, 4000))) * 1e6
    shares = np.percentile(late, (1, 50, 90, 99, 100))
    print(
        "time of a packet minus the write of its last byte [us]: "
        + ", ".join(f"{p} % {x:.0f}" for p, x in zip((1, 50, 90, 99, 100), shares, strict=True))
    )


if __name__ == "__main__":
    main()
