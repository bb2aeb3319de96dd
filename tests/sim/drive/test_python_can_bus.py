"""A bus of python-can as a drive has it: how it is opened, what is sent when, and what is read."""

import errno
import logging
from types import SimpleNamespace

import can
import numpy as np
import pytest

from support.simulated_clock import SimulatedClock
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, empty_fd_frames, empty_frames
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import parse_address
from undulog.capture.sources.events import Tally
from undulog.sim.drive import links, python_can_bus
from undulog.sim.drive.python_can_bus import PythonCanBus, open_link

LOGGER = logging.getLogger("can.interfaces.socketcand")


class Driver:
    """A driver of somebody else: what it was opened with, what is sent on it."""

    def __init__(self, **options):
        self.options, self.sent, self.fails = options, [], None

    def send(self, message, timeout):
        if self.fails is not None:
            raise self.fails
        self.sent.append((message, timeout))


class Own(Driver):
    """One of python-can's own, which says what options it has."""

    __module__ = "can.interfaces.own"

    def __init__(self, channel, bitrate=1, host="", port=0, tcp_tune=False):
        super().__init__(channel=channel, bitrate=bitrate, host=host, port=port, tcp_tune=tcp_tune)


@pytest.fixture
def opened(monkeypatch):
    """Open a bus with a driver, without a thread that reads it; what it reads is ``read``."""
    clock = SimulatedClock(now_ns=0)
    tally = Tally(lambda: clock.now_ns)
    monkeypatch.setattr(links, "time", SimpleNamespace(sleep=clock.clock.sleep))

    def link(bus, its_tally, *, device_time, detail):
        assert (its_tally, detail) == (tally, "")

        def read(now_ns):
            assert now_ns == clock.now_ns
            if isinstance(opened.read, OSError):
                raise opened.read
            return opened.read

        opened.driver, opened.device_time, opened.closed = bus, device_time, 0
        return SimpleNamespace(read=read, close=lambda: setattr(opened, "closed", 1))

    def start(on, kind=Driver, start=PythonCanBus):
        monkeypatch.setattr(python_can_bus, "bus_class", lambda text, interface: kind)
        monkeypatch.setattr(python_can_bus, "PythonCanLink", link)
        return start(parse_address(on), tally)

    opened = SimpleNamespace(start=start, clock=clock, tally=tally, read=[])
    return opened


def test_its_options_are_those_of_its_interface_as_python_can_casts_them(opened):
    bus = opened.start("can:kvaser:3?bitrate=500000&name=x")
    assert opened.driver.options == {"channel": 3, "bitrate": 500_000, "name": "x"}
    assert (bus.place, bus.clock) == ("can:kvaser:3?bitrate=500000&name=x", ClockDomain.DEVICE)
    assert opened.device_time
    bus = opened.start("can:virtual:a?bitrate=9", Own)
    assert opened.driver.options["bitrate"] == 9
    assert (bus.clock, opened.device_time) == (ClockDomain.HOST, False)
    with pytest.raises(UsageError, match="no option 'speed'"):
        opened.start("can:virtual:a?speed=9", Own)
    with pytest.raises(UsageError, match="no CAN interface 'none'"):
        opened.start("can:none:a")
    assert (LOGGER.propagate, LOGGER.handlers) == (True, [])


def test_of_a_socketcand_server_what_could_not_be_read_is_counted(opened):
    bus = opened.start("can:socketcand:can0?host=far&port=77", Own)
    assert opened.driver.options == {
        "channel": "can0", "bitrate": 1, "host": "far", "port": 77, "tcp_tune": True,
    }  # fmt: skip
    for text in ("Invalid Frame < x >", "Bad data: y", "Incomplete message exceeds 1 MB"):
        LOGGER.warning(text)
        LOGGER.info(text)
    LOGGER.warning("Got incomplete message: Bad data")
    LOGGER.error("Invalid %s", "Frame")
    assert opened.tally.counts.malformed == 4
    assert {event.text for event in opened.tally.events.flush()} == {"malformed message"} | {
        "malformed message (3 times)"
    }
    assert not LOGGER.propagate
    for _ in range(2):
        bus.close()
        assert (LOGGER.propagate, LOGGER.handlers, opened.closed) == (True, [], 1)
    with pytest.raises(UsageError, match="no option 'bitrate'"):
        opened.start("can:socketcand:can0?bitrate=5", Own)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(errno.ENODEV, "No such device"), "ON: can't open it: No such device"),
        (OSError("no driver"), "ON: can't open it: no driver"),
        (can.CanInitializationError("bad cable"), "ON: can't open it: bad cable"),
        (ImportError("no module"), "ON: no module"),
        (ValueError("no rate"), "ON: python-can refuses the options: no rate"),
    ],
)
@pytest.mark.parametrize("on", ["can:kvaser:0", "can:socketcand:can0"])
def test_one_that_can_not_be_opened_says_why_and_listens_no_more(opened, on, error, text):
    class Broken(Driver):
        def __init__(self, **options):
            raise error

    with pytest.raises(SourceError) as refused:
        opened.start(on, Broken)
    assert str(refused.value) == text.replace("ON", on)
    assert (LOGGER.propagate, LOGGER.handlers) == (True, [])


def test_frames_are_sent_in_order_each_not_before_its_time(opened):
    bus = opened.start("can:kvaser:0")
    frames = empty_frames(3)
    frames["id_flags"], frames["dlc"] = [0x101, 0x1ABCDEF | EXTENDED_FLAG, 0x7FF], [2, 8, 0]
    frames["data"] = np.arange(1, 9)
    assert bus.send(frames[:1]).tolist() == [0]  # at once
    opened.clock.now_ns, opened.clock.late_s = 1000, [3e-6]
    times = bus.send(frames, np.array([500, 2000, 4000]))
    assert times.tolist() == [1000, 5000, 5000]  # the second one woke late
    assert times.dtype == np.int64
    assert bus.send(frames[:2]).tolist() == [5000, 5000]
    assert bus.send(frames[:0]).tolist() == []
    sent = [
        (message.arbitration_id, message.is_extended_id, bytes(message.data), timeout)
        for message, timeout in opened.driver.sent
    ]
    # A frame waits 20 ms at most for a full queue.
    expected = [
        (0x101, False, b"\1\2", 0.02),
        (0x1ABCDEF, True, bytes(range(1, 9)), 0.02),
        (0x7FF, False, b"", 0.02),
    ]
    assert sent == [expected[0], *expected, *expected[:2]]
    assert not any(message.is_remote_frame or message.is_fd for message, _ in opened.driver.sent)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (can.CanOperationError("queue full\nsince long"), "queue full"),
        (OSError(errno.ENETDOWN, "Network is down"), "Network is down"),
        (OSError("  it went \n away"), "it went"),
    ],
)
def test_a_bus_that_is_lost_is_named_with_the_first_line_of_the_reason(opened, error, reason):
    bus = opened.start("can:kvaser:0")
    opened.driver.fails = error
    with pytest.raises(SourceError) as lost:
        bus.send(empty_frames(1))
    assert str(lost.value) == f"can:kvaser:0: the bus is lost: {reason}"
    if isinstance(error, OSError):
        opened.read = error
        with pytest.raises(SourceError) as lost:
            bus.receive()
        assert str(lost.value) == f"can:kvaser:0: the bus is lost: {reason}"


def test_what_is_read_is_classic_frames_and_nothing_empty(opened):
    bus = opened.start("can:kvaser:0")
    classic = empty_frames(2)
    opened.read = [classic, empty_frames(0), empty_fd_frames(1), empty_fd_frames(0)]
    (frame,) = bus.receive()
    assert frame is classic
    opened.read = ()
    assert list(bus.receive()) == []


def test_a_virtual_robot_is_looked_for_where_it_may_be(opened, monkeypatch):
    asked, robot = [], object()

    def find(address, tally):
        assert tally is opened.tally
        asked.append((address.rest, dict(address.options)))
        return robot if address.options.get("port") == "1" else None

    monkeypatch.setattr(python_can_bus, "find_virtual_robot", find)

    def link(on):
        return opened.start(on, Own, open_link)

    assert link("can:socketcand:can0?port=1") is robot
    assert asked == [("socketcand:can0", {"port": "1"})]
    for on in ("can:socketcand:can0?port=2", "can:socketcand:can0?port=2&plain=no"):
        bus = link(on)
        assert (type(bus), opened.driver.options["port"]) == (PythonCanBus, 2)
        bus.close()
        assert asked.pop() == ("socketcand:can0", {"port": "2"})
    for on in ("can:socketcand:can0?port=1&plain=yes", "can:virtual:can0"):
        bus = link(on)
        assert type(bus) is PythonCanBus
        bus.close()
        assert len(asked) == 1
    with pytest.raises(UsageError) as refused:
        link("can:socketcand")
    assert str(refused.value) == "'can:socketcand': no channel; expected can:socketcand:CHANNEL"
