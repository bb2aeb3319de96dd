"""The bus of a virtual robot over a connected pair of sockets: ticks, frames, times and ends."""

import socket
from types import SimpleNamespace

import numpy as np
import pytest

from support.simulated_clock import SimulatedClock
from undulog.capture.common.errors import SourceError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, empty_frames
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.events import Tally
from undulog.sim.drive import links
from undulog.sim.drive.links import VirtualRobotLink, sent_text, wait_until
from undulog.sim.drive.loop import LockstepPace

STREAM = (
    b"< tick 0 >< tick 1 >< frame 201 1.000000 0102 >< frame 202 1.000100 03 >< tick 2 >"
    b"< frame 203 1.010000 0A >< tick 13 >< frame 204 1.020000 0B >"
)


@pytest.fixture
def pair():
    """Both ends of a connection: that of the robot, and the link at the other one."""
    robot, ours = socket.socketpair()
    clock = SimulatedClock(now_ns=7)
    tally = Tally(lambda: clock.now_ns)
    link = VirtualRobotLink("can:test", ours, b"", tally, "snake25", lockstep=True)
    yield robot, link, clock
    link.close()
    robot.close()


def identifiers(arrays):
    return [identifier for frames in arrays for identifier in frames["id_flags"].tolist()]


def test_wherever_the_stream_is_cut_ticks_have_the_frames_before_them():
    for cut in range(1, len(STREAM)):
        robot, ours = socket.socketpair()
        rest = b"< tick 9 >" + STREAM[: cut // 2]  # what came with the answer before
        link = VirtualRobotLink("can:test", ours, rest, Tally(lambda: 0), "snake25", lockstep=True)
        with robot:
            decoded = []
            for piece in (STREAM[cut // 2 : cut], STREAM[cut:]):
                robot.sendall(piece or b" ")
                link._read()
                while link._ticks:
                    tick, frames = link.wait_tick(5.0)
                    decoded.append((tick, identifiers(frames)))
            assert decoded == [(9, []), (0, []), (1, []), (2, [0x201, 0x202]), (13, [0x203])], cut
            assert identifiers(link.receive()) == [0x204]
        link.close()


def test_a_tick_that_does_not_come_in_time_is_none(pair):
    robot, link, _ = pair
    assert link.wait_tick(0.0) is None
    robot.sendall(STREAM[:40])
    assert link.wait_tick(5.0)[0] == 0
    assert link.wait_tick(0.0)[0] == 1  # it has come already
    assert link.wait_tick(0.0) is None


def test_frames_have_the_time_at_which_they_were_read(pair):
    robot, link, clock = pair
    robot.sendall(STREAM)
    clock.now_ns = 12345
    arrays = link.receive()
    assert identifiers(arrays) == [0x201, 0x202, 0x203, 0x204]
    assert {time for frames in arrays for time in frames["t_host_ns"].tolist()} == {12345}
    assert link.receive() == []
    assert (link.place, link.clock, link.lockstep) == ("can:test", ClockDomain.SIMULATED, True)


def test_frames_of_ticks_that_nobody_waits_for_are_received_all_the_same(pair):
    robot, link, _ = pair
    robot.sendall(STREAM)
    assert identifiers(link.receive()) == [0x201, 0x202, 0x203, 0x204]
    assert link.wait_tick(0.0) is None  # its marks went with them


def test_commands_are_sent_together_when_the_last_of_them_may_be(pair, monkeypatch):
    robot, link, clock = pair
    monkeypatch.setattr(links, "time", SimpleNamespace(sleep=clock.clock.sleep))
    frames = empty_frames(2)
    frames["id_flags"], frames["dlc"] = [0x101, 0x1ABCDEF | EXTENDED_FLAG], [2, 3]
    frames["data"][:, :3] = [[0x1F, 0xA0, 0], [1, 2, 3]]
    clock.late_s = [0.0, 0.25]
    assert link.send(frames, np.array([5_000, 3_000])).tolist() == [5_000, 5_000]
    assert robot.recv(4096) == b"< send 101 2 1F A0 >< send 01ABCDEF 3 01 02 03 >"
    assert link.send(frames[:1], np.array([4_000])).tolist() == [5_000]  # it is over
    assert link.send(frames[:1]).tolist() == [5_000]
    assert robot.recv(4096) == b"< send 101 2 1F A0 >" * 2
    assert link.send(frames[:0], np.zeros(0, dtype=np.int64)).tolist() == []
    wait_until(9_000, lambda: clock.now_ns)
    assert clock.now_ns == 9_000 + 250_000_000
    assert sent_text(empty_frames(1)) == b"< send 000 0  >"


def test_a_robot_that_is_gone_is_told_with_its_bus(pair):
    robot, link, _ = pair
    robot.close()
    with pytest.raises(SourceError) as gone:
        link.receive()
    assert str(gone.value) == "can:test: the robot closed the connection"
    with pytest.raises(SourceError) as gone:
        link.send(empty_frames(1))
    assert str(gone.value) == "can:test: the robot is gone: Broken pipe"
    link.close()
    link.close()


class Ticks:
    """What a pace needs of a robot in lockstep."""

    place = "can:test"

    def __init__(self, *ticks):
        self.ticks, self.waited_s = list(ticks), []

    def wait_tick(self, timeout_s):
        self.waited_s.append(timeout_s)
        return self.ticks.pop(0)


def test_in_lockstep_ticks_count_from_the_first_one():
    ticks = Ticks((7, ["a"]), (8, []), (11, ["b", "c"]), None)
    pace = LockstepPace(ticks)
    assert [pace.next() for _ in range(3)] == [(0, ["a"]), (1, []), (4, ["b", "c"])]
    assert (pace.by_the_clock, pace.overruns, pace.late_s) == (False, 0, 0.0)
    with pytest.raises(SourceError, match="can:test: the robot is lost: no control tick for 5 s"):
        pace.next()
    assert ticks.waited_s == [5.0] * 4
