"""Other processes, with our sender and with one made from the packets' description alone."""

import json
import os
import socket
import stat
import struct
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from support.can_messages import same, traffic
from support.processes import python, start, wait_for
from undulog.capture.common.errors import DataError, SourceError, UsageError
from undulog.capture.log.messages.frames import ERROR_FLAG, empty_frames
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import open_source, parse_address
from undulog.capture.sources.unix_socket import MOST_SENDERS, FrameSender

# Shares nothing with us but the packets: 32 bytes a frame, packed by struct.
FOREIGN = """
import socket, struct, sys
path, first, count, per_packet, head = sys.argv[1], *map(int, sys.argv[2:6])
peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
peer.connect(path)
for start in range(first, first + count, per_packet):
    numbers = range(start, min(start + per_packet, first + count))
    packet = struct.pack("<QQ", start, 0) if head else b""
    for n in numbers:
        packet += struct.pack("<QQIBB2x8s", 10**18 + n * 1000, 0, n % 2048, n % 9, 0,
                              (n.to_bytes(8, "little") * 2)[: n % 9].ljust(8, b"\\0"))
    peer.send(packet)
peer.close()
"""

OURS = """
import json, sys, time
import numpy as np
from undulog.capture.sources.unix_socket import FrameSender
frames = np.load(sys.argv[1])
with FrameSender(sys.argv[2]) as sender:
    at = 0
    while at < len(frames):
        at += sender.send(frames[at : at + 700])
        time.sleep(0.001)
    print(json.dumps([sender.accepted, sender.refused]))
"""


def foreign_truth(first, count):
    frames, numbers = empty_frames(count), np.arange(first, first + count)
    frames["t_device_ns"] = 10**18 + numbers * 1000
    frames["id_flags"], frames["dlc"] = numbers % 2048, numbers % 9
    frames["data"] = numbers.astype("<u8").view(np.uint8).reshape(-1, 8)
    frames["data"][np.arange(8) >= frames["dlc"][:, None]] = 0
    return frames


def source_at(path, query=""):
    return open_source(parse_address(f"unix:{path}{query}"))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "snake.sock"


@pytest.fixture
def reader(path, listen):
    """A source at that path."""
    return listen(source_at(path))


@pytest.fixture
def peer(path):
    """Connects sockets of this process."""
    with ExitStack() as opened:

        def connect():
            sock = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            sock.connect(str(path))
            return sock

        yield connect


@pytest.mark.parametrize(("per_packet", "head"), [(256, 1), (1, 0), (7, 1)])
def test_twenty_thousand_frames_of_a_foreign_process(path, reader, per_packet, head):
    truth = foreign_truth(0, 20_000)
    with start(sys.executable, "-c", FOREIGN, path, 0, 20_000, per_packet, head) as process:
        received = reader.until_frames(20_000)
        assert process.wait() == 0
    assert same(received, truth)
    assert np.array_equal(received["t_device_ns"], truth["t_device_ns"])
    assert (np.diff(received["t_host_ns"].astype(np.int64)) >= 0).all()
    assert reader.counts.frames == 20_000
    assert reader.counts.dropped == (0 if head else None)
    reader.until_event("disconnected")
    assert reader.texts[1:] == ["a sender connected", "a sender disconnected"]
    assert reader.source.clock is ClockDomain.DEVICE


def test_what_our_sender_offers_arrives(tmp_path, path, reader):
    truth = traffic(20_000)
    np.save(tmp_path / "frames.npy", truth)
    with start(sys.executable, "-c", OURS, tmp_path / "frames.npy", path) as process:
        received = reader.until_frames(20_000)
        accepted, refused = json.loads(process.communicate()[0])
    reader.until_event("disconnected")
    assert accepted == 20_000
    assert same(received, truth)
    assert np.array_equal(received["t_device_ns"], truth["t_device_ns"])
    before = 0 if reader.counts.dropped == refused else refused
    assert reader.counts.dropped == refused - before  # refused before it was connected


def test_frames_that_found_no_room_are_proved_lost(path, reader):
    truth = traffic(200)
    sender = FrameSender(path)
    sent = []
    while sender.refused == 0:  # faster than it is read: the buffer fills
        sent.append(truth[: sender.send(truth)])
    assert same(reader.until_frames(sender.accepted), np.concatenate(sent))
    assert reader.counts.dropped == 0  # not known yet
    sent.append(truth[: sender.send(truth)])
    assert same(reader.until_frames(sender.accepted), np.concatenate(sent))
    assert reader.counts.dropped == sender.refused > 0
    reader.until_event("lost before it reached us")
    sender.close()


def test_the_last_losses_are_reported_on_leaving(path, reader):
    truth = traffic(200)
    sender = FrameSender(path)
    while sender.refused == 0:
        sender.send(truth)
    reader.until_frames(sender.accepted)
    sender.close()
    reader.until_event("disconnected")
    assert reader.counts.dropped == sender.refused > 0


def test_a_gap_in_the_numbers_is_a_loss(reader, peer):
    sock, record = peer(), bytes(empty_frames(1).tobytes())
    for sequence, dropped in ((1000, 5), (1001, 5), (1012, 5), (1013, 8), (1014, 8), (0, 0)):
        sock.send(struct.pack("<QQ", sequence, dropped) + record)
    reader.until_frames(6)
    assert reader.counts.dropped == 10 + 3


def test_malformed_packets_are_counted_and_reported(reader, peer):
    truth = traffic(3)
    sock = peer()
    sock.send(truth[:1].tobytes())
    for bad in (b"x", b"x" * 31, b"x" * 33, b"", bytes(32 * 257), bytes(100_000)):
        sock.send(bad)
    sock.send(struct.pack("<QQ", 0, 0))  # a head alone is allowed
    sock.send(truth[1:].tobytes())
    assert same(reader.until_frames(3), truth)
    assert reader.counts.malformed == 6
    reader.until_event("malformed packet")
    assert reader.source.connected


def test_an_empty_packet_is_counted_whenever_the_next_one_comes(reader, peer):
    """Beyond a sender's end all reads are empty: only a packet after it shows that it was one."""
    truth = traffic(2)
    sock = peer()
    sock.send(truth[:1].tobytes())
    sock.send(b"")
    assert same(reader.until_frames(1), truth[:1])
    reader.until(lambda: reader.source._senders[0].empty == 1)
    assert reader.counts.malformed == 0
    sock.send(truth[1:].tobytes())
    assert same(reader.until_frames(2)[-1:], truth[1:])
    assert reader.counts.malformed == 1


def test_arrival_is_when_it_came_not_when_it_was_fetched(reader, peer, context):
    sock = peer()
    reader.until_event("connected")
    record = empty_frames(1).tobytes()
    bounds = []
    for _ in range(20):
        before_ns = context.now_ns()
        sock.send(record)
        bounds.append((before_ns, context.now_ns()))
    wait_for(lambda: context.now_ns() > bounds[-1][1] + 50_000_000, "a later time")
    received = reader.until_frames(20)
    slack_ns = 1_000_000  # two clocks are read one after the other
    for t_ns, (low_ns, high_ns) in zip(received["t_host_ns"].tolist(), bounds, strict=True):
        assert low_ns - slack_ns <= t_ns <= high_ns + slack_ns


def test_two_senders_are_put_in_the_order_of_arrival(reader, peer):
    first, second = peer(), peer()
    reader.until(lambda: len(reader.source._senders) == 2)
    frames = empty_frames(40)
    frames["id_flags"] = np.arange(40)
    for number in range(40):
        (first, second)[number % 3 == 0].send(frames[number : number + 1].tobytes())
    senders = reader.source._senders
    wait_for(lambda: not any(sender.receiver.pending for sender in senders), "both threads")
    assert reader.until_frames(40)["id_flags"].tolist() == list(range(40))


def test_a_sender_may_leave_and_come_back(path, reader):
    for first in (0, 100):
        with start(sys.executable, "-c", FOREIGN, path, first, 100, 10, 1) as process:
            reader.until_frames(first + 100)
            reader.until(lambda: not reader.source.connected)
            assert process.wait() == 0
    assert same(reader.frames, foreign_truth(0, 200))
    assert reader.counts.reconnects == 1
    reader.until_event("is back")
    assert reader.counts.dropped == 0
    assert not reader.source.finished


def test_a_killed_sender_loses_nothing_that_it_sent(path, reader):
    code = FOREIGN.replace("peer.close()", "import os; os.kill(os.getpid(), 9)")
    assert python(code, path, 0, 200, 1, 1).returncode == -9
    assert same(reader.until_frames(200), foreign_truth(0, 200))
    reader.until_event("disconnected")
    assert reader.counts.malformed == 0


def test_our_sender_waits_for_a_recorder_and_for_the_next_one(path, listen):
    truth, sender = traffic(10), FrameSender(path)
    assert sender.send(truth) == 0
    assert not sender.connected
    for _ in range(2):
        reader = listen(source_at(path))
        wait_for(lambda: sender.send(truth) != 0)
        assert len(reader.until_frames(10)) == 10
        # What was refused without a recorder is not its loss.
        assert reader.counts.dropped == 0
        reader.source.stop()
        while sender.connected:
            sender.send(truth)
    sender.close()
    with pytest.raises(DataError, match="records of 32 bytes"):
        sender.send(np.zeros(3))


def test_senders_that_never_leave_hold_a_bounded_number_of_descriptors(reader, peer):
    worker = peer()
    worker.send(foreign_truth(0, 3).tobytes())
    reader.until_frames(3)

    def descriptors():
        return len(list(Path("/proc/self/fd").iterdir()))

    before, idle = descriptors(), []
    for _ in range(3 * MOST_SENDERS):
        idle.append(peer())
        reader.poll()
    most = before + len(idle) + MOST_SENDERS
    reader.until(lambda: descriptors() <= most)
    reader.until_event("more than 64 senders")
    worker.send(foreign_truth(3, 4).tobytes())  # who sends is not silent
    reader.until_frames(7)
    with pytest.raises(BrokenPipeError):
        idle[1].send(foreign_truth(0, 1).tobytes())
    idle[-1].send(foreign_truth(0, 1).tobytes())
    reader.until_frames(8)


def test_no_frame_of_a_sender_that_gives_its_place_is_lost(reader, peer):
    """Every sender's packets are counted by itself; none that was accepted is missing."""
    accepted, senders = 0, []
    for _ in range(3 * MOST_SENDERS):
        senders.append(peer())
        for sender in senders[-2 * MOST_SENDERS :: 7]:
            with suppress(BrokenPipeError):
                accepted += sender.send(foreign_truth(accepted, 1).tobytes()) == 32
        if len(senders) % 5 == 0:
            reader.poll()
    assert len(reader.until_frames(accepted)) == accepted > 3 * MOST_SENDERS


def test_error_frames_are_counted(reader, peer):
    frames = empty_frames(2)
    frames["id_flags"] = [ERROR_FLAG | 0x4, 5]
    frames["dlc"] = 8
    frames["data"][0, 1] = 0x10
    peer().send(frames.tobytes())
    reader.until_frames(2)
    assert reader.counts.error_frames == 1
    reader.until_event("controller problem, reception error passive")


def test_only_we_may_send_and_the_socket_goes_with_the_source(path, context):
    source = source_at(path)
    source.start(context)
    assert path.lstat().st_mode == stat.S_IFSOCK | 0o600
    with pytest.raises(SourceError, match="another program listens at"):
        source_at(path).start(context)
    assert path.exists()
    source.stop()
    assert not path.exists()
    assert source.finished


def test_a_socket_left_behind_is_replaced_and_nothing_else(path, context):
    code = (
        "import os, socket, sys\n"
        "s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)\n"
        "s.bind(sys.argv[1]); s.listen(); os.kill(os.getpid(), 9)\n"
    )
    assert python(code, path).returncode == -9
    assert path.exists()
    source = source_at(path)
    source.start(context)
    source.stop()
    path.write_text("precious")
    with pytest.raises(SourceError, match="is there already and is no socket"):
        source_at(path).start(context)
    assert path.read_text() == "precious"
    path.unlink()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(SourceError, match="another program listens"):
            source_at(path).start(context)
    if os.geteuid() == 0:
        os.chown(path, 12345, 12345)
        with pytest.raises(SourceError, match="belongs to another user"):
            source_at(path).start(context)


def test_the_successors_socket_is_not_removed(path, context):
    first, second = source_at(path), source_at(path)
    first.start(context)
    path.unlink()
    second.start(context)
    first.stop()
    assert path.exists()
    second.stop()


def test_a_place_that_can_not_be_used(tmp_path, context):
    for path in (tmp_path / "no" / "folder.sock", tmp_path / ("x" * 120)):
        with pytest.raises(SourceError, match=r"can't listen at|No such file"):
            source_at(path).start(context)
    with pytest.raises(UsageError, match="clock 'mine' is not one of device, host, simulated"):
        source_at(tmp_path / "s", "?clock=mine")
    with pytest.raises(UsageError, match="no option 'speed'"):
        source_at(tmp_path / "s", "?speed=1")
    assert source_at(tmp_path / "s", "?clock=host&directions=1").directions
