"""A line on a real pseudo-terminal at 1 Mbaud, driven by the vendors' SDKs."""

import contextlib
import fcntl
import os
import random
import re
import select
import sys
from pathlib import Path

import numpy as np
import pytest
from scservo_sdk import PortHandler

from support.processes import process, python
from support.serial_lines import Line
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.log.messages.frames import SERIAL_MORE, SERIAL_NOISE
from undulog.capture.robot.serial_servos import dynamixel_packet, feetech_packet
from undulog.capture.sources.contract import open_source, parse_address
from undulog.capture.sources.events import Tally
from undulog.capture.sources.serial_port import OverrunWatch


@pytest.fixture
def line(tmp_path):
    serial_line = Line(tmp_path / "ttyUSB0")
    yield serial_line
    serial_line.close()


def source_at(tmp_path, query="protocol=feetech"):
    return open_source(parse_address(f"serial:{tmp_path}/ttyUSB0?{query}"))


def packets_in(records):
    """Join the pieces of records; return the packets and all bytes."""
    packets, all_bytes, begun = [], b"", b""
    for record in records:
        data = record["data"][: record["len"]].tobytes()
        all_bytes += data
        begun += data
        if record["fd_flags"] & SERIAL_MORE:
            continue
        if not record["fd_flags"] & SERIAL_NOISE:
            packets.append(begun)
        begun = b""
    return packets, all_bytes


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["feetech", "dynamixel2"])
def test_nothing_is_lost_at_1_mbaud_with_noise_cuts_and_a_silence(tmp_path, listen, line, protocol):
    make = feetech_packet if protocol == "feetech" else dynamixel_packet
    reader = listen(source_at(tmp_path, f"protocol={protocol}"))
    reader.until_event("connected")
    draw, stream, sent = random.Random(5), b"", []

    def taken():
        return sum(int(a["len"].sum()) for a in reader.fd_arrays)

    for k in range(3000):
        packet = make(draw.randrange(1, 9), 3, draw.randbytes(draw.randrange(3, 20)))
        if draw.random() < 0.05:
            stream += draw.randbytes(draw.randrange(1, 30))
        elif draw.random() < 0.1:
            stream += packet[: draw.randrange(1, len(packet))]
        stream += packet
        sent.append(packet)
        if k == 1500:
            line.send(stream + packet[:5])
            total, stream = len(stream) + 5, b""
            reader.until(
                lambda least=total: taken() >= least
            )  # the five are given up after a silence
    line.send(stream)
    total += len(stream)
    reader.until(lambda: taken() >= total)
    packets, _ = packets_in(reader.fd_frames)
    remaining = iter(packets)
    assert not [packet for packet in sent if not any(other == packet for other in remaining)]
    assert reader.counts.malformed > 100


def test_it_never_writes(tmp_path, listen, line):
    reader = listen(source_at(tmp_path))
    line.send(feetech_packet(1, 2, b"\x38\x02") * 50)
    reader.until(lambda: len(reader.fd_frames) == 50)
    with pytest.raises(BlockingIOError):
        os.read(line.master, 1)
    (ours,) = _only_readers(tmp_path / "ttyUSB0")
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.write(ours, b"x")


def _only_readers(path):
    """File numbers of this process that can only read a device."""
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            same = descriptor.readlink() == path.resolve()
            if (
                same
                and fcntl.fcntl(int(descriptor.name), fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
            ):
                yield int(descriptor.name)


HOLD = """import os, sys, time
os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
print(1, flush=True)
time.sleep(60)
"""


def test_a_port_that_is_held_is_refused_with_its_holder(tmp_path, listen, line):
    with process(sys.executable, "-c", HOLD, tmp_path / "ttyUSB0") as holder:
        holder.stdout.readline()
        with pytest.raises(SourceError, match=rf"is held by python\S* \({holder.pid}\)"):
            listen(source_at(tmp_path))


def test_it_is_opened_for_one_alone(tmp_path, listen, line):
    reader = listen(source_at(tmp_path))
    reader.until_event("connected")
    code = (
        "import sys; from undulog.capture.sources.serial_port import open_exclusively\n"
        "try: open_exclusively(sys.argv[1], 1000000)\n"
        "except Exception as error: print(error)"
    )
    assert f"({os.getpid()})" in python(code, tmp_path / "ttyUSB0", code=0).stdout


def test_an_unplugged_port_is_lost_and_comes_back(tmp_path, listen):
    line = Line(tmp_path / "ttyUSB0")
    reader = listen(source_at(tmp_path))
    reader.until_event("connected")
    line.send(feetech_packet(1, 0, b"\1\2"))
    reader.until(lambda: len(reader.fd_frames) == 1)
    line.close()
    reader.until_event("lost")
    line = Line(tmp_path / "ttyUSB0")
    reader.until_event("is back")
    line.send(feetech_packet(2, 0, b"\1\2"))
    reader.until(lambda: len(reader.fd_frames) == 2)
    line.close()
    assert reader.fd_frames["id_flags"].tolist() == [1, 2]
    assert np.all(np.diff(reader.fd_frames["t_host_ns"].astype(np.int64)) > 0)


@pytest.mark.parametrize(
    ("query", "part"),
    [
        ("baud=1000000", "dynamixel2"),
        ("protocol=feetec", "feetech"),
        ("protocol=feetech&baud=999", "is not one of"),
        ("protocol=feetech&bitrate=1", "no option"),
    ],
)
def test_wrong_addresses(tmp_path, query, part):
    with pytest.raises(UsageError, match=part):
        source_at(tmp_path, query)


def test_no_device(tmp_path):
    (tmp_path / "ttyUSB0").write_text("")
    with pytest.raises(SourceError, match="no serial device"):
        source_at(tmp_path)


def test_a_tap_passes_bytes_both_ways_unchanged_and_knows_the_direction(tmp_path, listen, line):
    reader = listen(source_at(tmp_path, f"protocol=feetech&tap={tmp_path}/ttyTAP"))
    reader.until_event("tapped")
    port = PortHandler(str(tmp_path / "ttyTAP"))
    assert port.openPort()
    draw, asked, answered = random.Random(2), [], []
    for k in range(200):
        size = draw.randrange(1, 16)
        request = feetech_packet(k % 6 + 1, 2, bytes((56, size)))
        reply = feetech_packet(k % 6 + 1, draw.choice((0, 2)), draw.randbytes(size))
        port.writePort(request)
        heard = b""
        while len(heard) < len(request):
            select.select([line.master], [], [], 60)
            heard += os.read(line.master, 100)
        assert heard == request
        line.send(reply)
        back = b""
        while len(back) < len(reply):
            back += port.readPort(len(reply) - len(back))
        assert back == reply
        asked.append(request)
        answered.append(reply)
    reader.until(lambda: len(reader.fd_frames) == 400)
    port.closePort()
    records = reader.fd_frames
    assert packets_in(records[records["dir"] == 1])[0] == asked
    assert packets_in(records[records["dir"] == 0])[0] == answered
    reader.source.stop()
    assert not (tmp_path / "ttyTAP").is_symlink()


def test_a_pseudo_terminal_has_no_counter_of_overruns_and_its_losses_stay_unknown():
    master, slave = os.openpty()
    try:
        tally = Tally(lambda: 0)
        watch = OverrunWatch(slave, tally)
        watch.look()
        assert tally.counts.dropped is None
    finally:
        os.close(master)
        os.close(slave)


def listed_ports():
    """Ports with a chip, and the overruns that the kernel lists of each (``oe``, ``bo``)."""
    rows = []
    with contextlib.suppress(OSError):
        rows = Path("/proc/tty/driver/serial").read_text().splitlines()[1:]
    ports = {}
    for row in rows:
        number, _, words = row.partition(":")
        port = Path(f"/dev/ttyS{number}")
        if "uart:unknown" not in words and os.access(port, os.R_OK):
            counts = re.findall(r"\b(?:oe|bo):(\d+)", words)
            ports[port] = sum(map(int, counts))
    return ports


def test_overruns_of_a_port_are_those_that_the_kernel_lists():
    """None at all where the machine has no such port; a pseudo-terminal is tested above."""
    for port, overruns in listed_ports().items():
        fileno = os.open(port, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        try:
            tally = Tally(lambda: 0)
            assert OverrunWatch(fileno, tally).total == overruns
            assert tally.counts.dropped == 0
        finally:
            os.close(fileno)
