"""Looking for a virtual robot: what a server is asked, and what its answers mean."""

import dataclasses
import errno
import math
from types import SimpleNamespace

import numpy as np
import pytest

from undulog.capture import load_robot
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.common.errors import DataError, SourceError
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.robot.model import Direction, Quantity
from undulog.capture.sources.contract import parse_address
from undulog.capture.sources.events import Tally
from undulog.sim.drive import links
from undulog.sim.drive.links import BusReadings, VirtualRobotLink, find_virtual_robot

ON = "can:socketcand:can7?host=there&port=9"
NAMED = b"< undulog virtual-robot snake25 %s >"
ASKED = ["< undulog >", "< open can7 >", "< rawmode >"]


class Server:
    """The socket of a server that answers each word as it is told, or fails.

    Attributes:
        asked: What it was sent.
    """

    def __init__(self, *answers, peer="127.0.0.1"):
        self.answers, self.peer, self.asked = list(answers), peer, []
        self.pending, self.closed, self.timeouts = b"", 0, []

    def getpeername(self):
        return self.peer, 9

    def sendall(self, data):
        answer = self.answers.pop(0)
        if isinstance(answer, OSError):
            raise answer
        self.asked.append(data.decode())
        self.pending += answer

    def recv(self, size):
        piece, self.pending = self.pending[:size], self.pending[size:]
        return piece

    def settimeout(self, seconds):
        self.timeouts.append(seconds)

    def shutdown(self, how):
        del how

    def close(self):
        self.closed += 1


@pytest.fixture
def find(monkeypatch):
    """Look for a robot at a server; what came with its greeting is ``rest``."""

    def look(server, rest=b""):
        def connect(*place):
            assert place == ("there", 9)
            if isinstance(server, OSError):
                raise server
            return server, rest

        monkeypatch.setattr(links, "connect", connect)
        return find_virtual_robot(parse_address(ON), Tally(lambda: 5))

    return look


@pytest.mark.parametrize("peer", ["127.0.0.1", "127.9.9.9", "::1"])
@pytest.mark.parametrize("pace", ["lockstep", "paced"])
def test_one_that_says_its_name_is_opened(find, pace, peer):
    early = b"< frame 201 1.000000 0102 >< tick 4 >"  # behind the last answer
    server = Server(NAMED % pace.encode(), b"< ok >", b"< ok >" + early, peer=peer)
    link = find(server)
    assert type(link) is VirtualRobotLink
    assert (link.place, link.robot_name, link.lockstep) == (ON, "snake25", pace == "lockstep")
    assert (server.asked, server.closed) == (ASKED, 0)
    assert server.timeouts == [1.0]  # so long it may take no commands
    server.pending = b"< tick 5 >"
    link._read()
    tick, (frames,) = link.wait_tick(0.0)
    assert (tick, frames["id_flags"].tolist(), frames["t_host_ns"].tolist()) == (4, [0x201], [5])
    assert link.wait_tick(0.0) == (5, [])
    link.close()
    assert server.closed == 1


@pytest.mark.parametrize(
    "answer",
    [
        b"< error unknown command >", b"< undulog virtual-robot snake25 fast >", b"",
        b"< an undulog virtual-robot snake25 paced >",
        b"< undulog virtual-robot snake25 paced or so >",
        OSError(errno.ECONNRESET, "Connection reset by peer"),
    ],
)  # fmt: skip
def test_one_that_does_not_is_no_virtual_robot_and_is_asked_nothing_else(find, answer):
    server = Server(answer)
    assert find(server) is None
    assert (server.closed, server.asked) == (1, [] if isinstance(answer, OSError) else ASKED[:1])


def test_one_on_another_computer_is_not_asked(find):
    server = Server(peer="192.168.7.2")
    assert find(server) is None
    assert (server.closed, server.asked) == (1, [])


@pytest.mark.parametrize(
    ("error", "reason"),
    [(OSError(errno.EHOSTUNREACH, "No route"), "No route"), (OSError("x"), "x")],
)
def test_nobody_there_and_no_such_bus_are_told_with_the_address(find, error, reason):
    with pytest.raises(SourceError) as refused:
        find(error)
    assert str(refused.value) == f"{ON}: can't connect: {reason}"
    server = Server(NAMED % b"paced", error)
    with pytest.raises(SourceError) as refused:
        find(server)
    assert str(refused.value) == f"{ON}: can't open it: {reason}"
    assert server.closed == 1
    server = Server(NAMED % b"paced", b"< error >")
    with pytest.raises(SourceError) as refused:
        find(server)
    assert str(refused.value) == f"{ON}: can't open it: the server answered 'error', not '< ok >'"


class Connected(Server):
    """One whose commands are not taken."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def sendall(self, data):
        raise self.error

    def recv(self, size):
        raise self.error


@pytest.mark.parametrize(
    ("error", "sent", "received"),
    [
        (TimeoutError(), "takes no commands for 1 s", "the robot is gone: "),
        (OSError(errno.EPIPE, "Broken pipe"), *["the robot is gone: Broken pipe"] * 2),
        (OSError("odd"), *["the robot is gone: odd"] * 2),
    ],
)
def test_a_robot_that_takes_nothing_or_is_gone_is_told(error, sent, received):
    more = {"tally": Tally(lambda: 5), "robot_name": "snake25", "lockstep": False}
    link = VirtualRobotLink("can:here", Connected(error), b"", **more)
    with pytest.raises(SourceError) as gone:
        link.send(empty_frames(1))
    assert str(gone.value) == f"can:here: {sent}"
    with pytest.raises(SourceError) as gone:
        link._read()
    assert str(gone.value) == f"can:here: {received}"


def test_ticks_that_came_before_go_on_counting_their_own_frames(monkeypatch):
    """Three ticks and their frames wait: each takes its own, the rest stay in order."""
    more = {"tally": Tally(lambda: 5), "robot_name": "snake25", "lockstep": True}
    server = Server()
    link = VirtualRobotLink("can:here", server, b"", **more)
    chunks = (b"< frame %d 1.0 0%d >" % (200 + k, k) for k in range(1, 7))
    first, second, third, fourth, fifth, sixth = chunks
    monkeypatch.setattr(links, "select", SimpleNamespace(select=lambda *_: ([], [], [])))
    pieces = [
        first,
        second + b"< tick 1 >" + third,
        b"< tick 2 >< tick 3 >" + fourth + fifth + sixth,
    ]
    monkeypatch.setattr(server, "recv", lambda size: pieces.pop(0))
    for _ in range(3):
        link._read()
    numbers = []
    for expected in (1, 2, 3):
        tick, arrays = link.wait_tick(0.0)
        assert tick == expected
        numbers.append([hex(int(frame)) for frames in arrays for frame in frames["id_flags"]])
    assert numbers == [["0x201", "0x202"], ["0x203"], []]
    assert [int(frame) for frames in link.receive() for frame in frames["id_flags"]] == [
        0x204, 0x205, 0x206,
    ]  # fmt: skip


def test_the_age_of_each_value_is_its_own():
    """At the greatest age a value is known, a moment later it is not; each has its own time."""
    robot = load_robot("snake25")
    encode, bus_readings = BusEncoder(robot, Direction.RX).encode, BusReadings(robot)  # 0.5 s
    values = {("joint01", Quantity.POSITION, ""): 0.1, ("ir01", Quantity.RANGE, ""): 0.25}
    values["joint01", Quantity.VELOCITY, ""] = 0.5
    values |= {("accelerometer", Quantity.ACCELERATION, axis): 1.0 for axis in "xyz"}
    bus_readings.add(encode(values), 1.0)
    bus_readings.add(encode({("joint02", Quantity.POSITION, ""): 0.2}), 1.25)
    for now_s, first, second in ((1.5, True, True), (1.5001, False, True), (1.7501, False, False)):
        readings, status = bus_readings.readings(now_s), bus_readings.status(now_s)
        for angle in (readings.angle, status.angle):
            assert (~np.isnan(angle[:3])).tolist() == [first, second, False]
        assert np.isfinite(readings.velocity[0]) == first
        assert set(readings.ranges) == ({"ir01"} if first else set())
        assert set(readings.acceleration) == ({"accelerometer"} if first else set())
        assert readings.magnetic_field == {}
        np.testing.assert_allclose(status.silence_s[:2], [now_s - 1.0, now_s - 1.25])
    bus_readings.add(encode({("joint02", Quantity.POSITION, ""): 0.2}), 1.8)
    assert bus_readings.angles[:3].tolist() == [1, 2, 0]


def test_beyond_its_greatest_range_a_sensor_sees_nothing():
    robot = load_robot("snake25")
    (sensor,) = (sensor for sensor in robot.sensors if sensor.name == "ir01")
    farther = dataclasses.replace(sensor, range_max=0.5)
    endless = dataclasses.replace(sensor, range_max=None)
    encode = BusEncoder(robot, Direction.RX).encode
    for modified, seen in ((farther, (0.3, 0.5, math.inf)), (endless, (0.3, 0.5, 0.7))):
        others = tuple(modified if other is sensor else other for other in robot.sensors)
        bus_readings, distances = BusReadings(dataclasses.replace(robot, sensors=others)), []
        for distance in (0.3, 0.5, 0.7):
            bus_readings.add(encode({("ir01", Quantity.RANGE, ""): distance}), 1.0)
            distances.append(bus_readings.readings(1.0).ranges["ir01"])
        assert distances == pytest.approx(seen)


def test_a_robot_without_a_bus_map_tells_nothing():
    with pytest.raises(DataError):
        BusReadings(dataclasses.replace(load_robot("snake25"), bus=None))
