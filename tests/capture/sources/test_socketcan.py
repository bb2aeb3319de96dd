"""The kernel's frames and messages, through real sockets of a family that is always there.

A raw CAN socket needs a kernel with CAN. What is read from it, the layout of ``struct can_frame``,
the control messages with the time and the count of drops, is the same on any datagram socket; the
frames are packed by python-can.
"""

import itertools
import socket

import numpy as np
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame

from support.can_messages import can_message, fd_traffic, same, traffic
from support.processes import wait_for
from undulog.capture.common.errors import SourceError
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX, FD_BRS, FD_ESI
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources import reader_thread
from undulog.capture.sources.contract import open_source, parse_address
from undulog.capture.sources.events import Tally
from undulog.capture.sources.socketcan import SocketcanLink, frames_of

CLOCK = SessionClock()


def packed(frame):
    return build_can_frame(can_message(frame))


@pytest.fixture
def pair(sockets):
    """A bound datagram socket that stamps and counts drops, and one connected to it."""
    for option in (reader_thread.SO_TIMESTAMPNS, reader_thread.SO_RXQ_OVFL):
        sockets[0].setsockopt(socket.SOL_SOCKET, option, 1)
    return sockets


def test_twenty_thousand_frames_as_packed_by_python_can(pair):
    ours, theirs = pair
    truth = traffic(20_000)
    tally = Tally(CLOCK.now_ns)
    link = SocketcanLink(ours, tally)
    blocks = []
    for start in range(0, len(truth), 50):
        for frame in truth[start : start + 50]:
            theirs.send(packed(frame))
        blocks += link.read(0)
    frames = np.concatenate(blocks)
    assert same(frames, truth)
    assert set(frames["dir"].tolist()) == {DIR_RX}
    assert np.array_equal(frames["t_device_ns"], frames["t_host_ns"])
    assert (np.diff(frames["t_host_ns"].astype(np.int64)) >= 0).all()
    assert (tally.counts.malformed, tally.counts.dropped) == (0, None)
    link.close()


def test_drops_are_those_that_the_kernel_counts(pair):
    ours, theirs = pair
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    frame = packed(traffic(1)[0])
    tally = Tally(CLOCK.now_ns)
    link = SocketcanLink(ours, tally)
    got = 0
    for _ in range(3):
        for _ in range(500):
            theirs.send(frame)
        got += sum(map(len, link.read(0)))
    theirs.send(frame)  # the count comes with the next packet that finds room
    got += sum(map(len, link.read(0)))
    assert 0 < got < 1501
    assert tally.counts.dropped == 1501 - got
    assert "dropped by the kernel" in tally.events.flush()[0].text
    link.close()


def test_arrival_is_the_kernels(pair):
    ours, theirs = pair
    link = SocketcanLink(ours, Tally(CLOCK.now_ns))
    before_ns = CLOCK.now_ns()
    theirs.send(packed(traffic(1)[0]))
    after_ns = CLOCK.now_ns()
    wait_for(lambda: CLOCK.now_ns() > after_ns + 20_000_000, "a later time")
    (frames,) = link.read(0)
    slack_ns = 1_000_000
    assert before_ns - slack_ns <= int(frames["t_host_ns"][0]) <= after_ns + slack_ns
    link.close()


def test_can_fd_frames_and_what_is_no_frame(pair):
    ours, theirs = pair
    truth, fd_truth = traffic(2), fd_traffic(40)
    fd_truth["fd_flags"][::3] |= FD_ESI
    tally = Tally(CLOCK.now_ns)
    link = SocketcanLink(ours, tally)
    theirs.send(packed(truth[0]))
    for frame in fd_truth:
        theirs.send(packed(frame))
    for odd in (b"", b"x" * 15, b"x" * 200):
        theirs.send(odd)
    theirs.send(packed(truth[1]))
    frames, fd_frames = link.read(0)
    assert same(frames, truth)
    fd_frames["fd_flags"] &= FD_BRS | FD_ESI  # a third flag marks CAN FD
    assert same(fd_frames, fd_truth)
    assert tally.counts.malformed == 3
    assert tally.events.flush()[0].text.startswith("packet that is no CAN frame")
    times = np.concatenate([frames["t_host_ns"], fd_frames["t_host_ns"]])
    assert abs(CLOCK.now_ns() - int(times.min())) < 60_000_000_000
    assert frames["t_host_ns"][0] <= fd_frames["t_host_ns"].min()
    assert fd_frames["t_host_ns"].max() <= frames["t_host_ns"][1]
    link.close()


def test_frames_of_this_computer_are_marked():
    raw = np.frombuffer(b"".join(packed(f) for f in traffic(2)), dtype=np.uint8).reshape(2, 16)
    batch = reader_thread.PacketBatch(raw, [16, 16], [0, socket.MSG_DONTROUTE], [5, 6], None)
    assert frames_of(batch, [5, 6])["dir"].tolist() == [DIR_RX, DIR_TX]


def test_a_socket_that_fails_is_a_lost_connection(pair):
    ours, _ = pair
    link = SocketcanLink(ours, Tally(CLOCK.now_ns))
    link.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        link.read(0)


def test_more_packets_than_fit_one_call(pair):
    ours, theirs = pair
    receive = reader_thread.ReceiveMany(8, 16)
    for number in range(20):
        theirs.send(bytes([number]) * (number % 5))
    sizes, firsts = [], []
    while len(batch := receive.receive(ours.fileno()).sizes):
        sizes += batch
        firsts.append(len(batch))
    assert sizes == [number % 5 for number in range(20)]
    assert firsts == [8, 8, 4]


def test_a_wall_clock_that_is_set_can_not_move_arrivals_beyond_what_is_known():
    elapsed = itertools.count(step=1000)  # of both clocks [ns]
    session_ns, wall_ns, hour = 10**18, 17 * 10**17, 3600 * 10**9

    def now_ns():
        return session_ns + next(elapsed)

    clock = reader_thread.ArrivalClock(now_ns, lambda: wall_ns + next(elapsed))
    now = now_ns()
    stamps = [wall_ns + next(elapsed), wall_ns + hour, wall_ns - hour, 0]
    for stamp in stamps:
        (t_ns,) = clock.times([stamp], now - 1_000_000)
        assert now - 1_000_000 <= t_ns <= now_ns()
    mixed = clock.times(stamps, 0)
    assert mixed == sorted(mixed)


def test_a_kernel_without_can_is_reported(context):
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        with pytest.raises(SourceError, match="this computer's kernel offers no CAN sockets"):
            open_source(parse_address("can:socketcan:can0"))
        return
    source = open_source(parse_address("can:socketcan:nosuchcan0?directions=1"))
    assert source.clock is ClockDomain.HOST
    source.start(context)
    assert "waits for nosuchcan0" in source.poll().events[0].text
    source.stop()
