"""The generic path, over python-can's own in-process bus; what addresses may ask of it."""

import can
import numpy as np
import pytest

from support.can_messages import can_message, fd_traffic, same, traffic
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.log.messages.frames import DIR_RX, ERROR_FLAG, FD_ESI
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources import can as can_source
from undulog.capture.sources.contract import open_source, parse_address


@pytest.fixture
def bus():
    options = {"ignore_config": True, "preserve_timestamps": True}
    with can.Bus(interface="virtual", channel="snake", **options) as bus:
        yield bus


def source_at(query="", interface="virtual:snake"):
    return open_source(parse_address(f"can:{interface}{query}"))


@pytest.fixture
def connect(listen):
    """Starts the source, and waits until it is connected."""

    def start(query=""):
        reader = listen(source_at(query))
        reader.until_event("connected to virtual snake (never transmits)")
        return reader

    return start


def test_twenty_thousand_frames_arrive_as_sent(bus, connect):
    truth = traffic(20_000)
    reader = connect()
    for start in range(0, len(truth), 500):
        for frame in truth[start : start + 500]:
            bus.send(can_message(frame))
        reader.poll()
    received = reader.until_frames(len(truth))
    assert same(received, truth)
    assert reader.source.clock is ClockDomain.HOST
    assert np.array_equal(received["t_device_ns"], received["t_host_ns"])
    assert (np.diff(received["t_host_ns"].astype(np.int64)) >= 0).all()
    assert set(received["dir"].tolist()) == {DIR_RX}
    assert reader.counts.frames == 20_000
    reader.source.stop()
    assert bus.recv(0) is None  # it sent nothing


def test_the_devices_times_to_the_microsecond(bus, connect):
    truth = traffic(2000)
    reader = connect("?device_time=1&preserve_timestamps=1")
    assert reader.source.clock is ClockDomain.DEVICE
    for frame in truth:
        bus.send(can_message(frame))
    assert np.array_equal(reader.until_frames(2000)["t_device_ns"], truth["t_device_ns"])


def test_a_driver_without_times_gets_those_of_arrival():
    messages = [(123, can.Message(timestamp=0.0)), (456, can.Message(timestamp=1.5))]
    frames = can_source.frames_of(messages, device_time=True)
    assert frames["t_device_ns"].tolist() == [123, 1_500_000_000]


def test_impossible_times_are_replaced_by_the_arrivals_and_counted(bus, connect):
    reader = connect("?device_time=1&preserve_timestamps=1")
    times = (float("nan"), float("inf"), -1.5, 1e300, 9.3e9, 4611686018.5)
    for k, time_s in enumerate((*times, 5.25)):
        bus.send(can.Message(arbitration_id=k, timestamp=time_s))
    received = reader.until_frames(len(times) + 1)
    assert np.array_equal(received["t_device_ns"][:-1], received["t_host_ns"][:-1])
    assert received["t_device_ns"][-1] == 5_250_000_000
    assert (reader.counts.malformed, reader.counts.reconnects) == (len(times), 0)


def test_error_frames(bus, connect):
    reader = connect()
    bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=[0] * 8))
    bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=[7]))
    assert reader.until_frames(2)["id_flags"].tolist() == [ERROR_FLAG | 0x40, 0x123]
    assert (reader.counts.error_frames, reader.counts.malformed) == (1, 0)
    reader.until_event("bus-off")
    reader.until_event("back on the bus")


def test_can_fd_frames(bus, connect):
    truth, fd_truth = traffic(500), fd_traffic(500)
    fd_truth["fd_flags"][::3] |= FD_ESI
    reader = connect()
    for frame, fd_frame in zip(truth, fd_truth, strict=True):
        bus.send(can_message(frame))
        bus.send(can_message(fd_frame))
    assert same(reader.until_frames(500), truth)
    reader.until(lambda: len(reader.fd_frames) >= 500)
    assert same(reader.fd_frames, fd_truth)
    assert reader.counts.frames == 1000


def test_a_driver_that_does_not_mark_can_fd():
    """Eight bytes fit a classic frame, more don't, whatever the driver calls it."""
    messages = [(7, can.Message(data=range(12)))]
    link_frames = can_source.frames_of(messages, device_time=False, fd=True)
    assert link_frames["len"].tolist() == [12]
    assert link_frames["data"].tolist() == [[*range(12), *[0] * 52]]


def test_a_bus_that_fails_is_opened_again(connect):
    """The driver is closed under the reading thread: what an unplugged adapter looks like."""
    reader = connect()
    reader.source._link._bus.shutdown()
    reader.until_event("lost virtual snake")
    reader.until_event("is back after")
    assert reader.counts.reconnects == 1
    with can.Bus(interface="virtual", channel="snake", ignore_config=True) as bus:
        bus.send(can.Message(arbitration_id=5, is_extended_id=False))
        assert reader.until_frames(1)["id_flags"].tolist() == [5]


@pytest.mark.parametrize(
    ("address", "match"),
    [
        ("virtual:snake?rx_queue=5", r"no option 'rx_queue'.*did you mean rx_queue_size"),
        ("virtual:snake?listen_only=1", "no listen-only for virtual; it does for cantact, kvaser"),
        ("pcan:PCAN_USBBUS1?state=LOUD", "LOUD is not valid; valid: ACTIVE, PASSIVE, ERROR"),
        ("pcan:PCAN_USBBUS1?fd=maybe", "fd=maybe is neither 1 nor 0"),
        ("socketcam:can0", r"no CAN interface 'socketcam'.*did you mean socketcand?"),
        ("pcan", "no channel"),
        ("socketcan:can0?bitrate=500000", "ip link set can0 up type can bitrate 500000"),
    ],
)
def test_wrong_interfaces_and_options_are_refused(address, match):
    with pytest.raises(UsageError, match=match):
        source_at(interface=address)


def test_options_are_converted(context):
    source = source_at("?receive_own_messages=1", "udp_multicast:239.74.163.2")
    with pytest.raises(SourceError, match=r"can:udp_multicast.*receive"):
        source.start(context)
    assert source.finished


def test_an_interface_that_can_not_be_loaded_is_reported_with_the_cause(context):
    with pytest.raises(SourceError, match="python-can can't load canalystii: No module named"):
        source_at(interface="canalystii:0")
    source = source_at(interface="kvaser:0")
    with pytest.raises(SourceError, match="can:kvaser:0: "):
        source.start(context)


@pytest.mark.parametrize("interface", sorted(can_source.LISTEN_ONLY))
def test_listen_only_options_are_ones_that_the_interface_has(interface):
    try:
        bus = can_source.bus_class("x", interface)
    except SourceError as error:
        pytest.skip(str(error))
    assert can_source.open_can(parse_address(f"can:{interface}:0")).facts["listen_only"] == "yes"
    assert set(can_source.LISTEN_ONLY[interface]) <= can_source.known_options(bus) | {"listen_only"}


def test_the_tables_name_interfaces_that_exist():
    tables = (can_source.LISTEN_ONLY, can_source.NO_CONTROLLER, can_source.DEVICE_TIME)
    assert set().union(*tables) <= set(can.VALID_INTERFACES)


def test_a_drivers_error_is_a_lost_connection():
    error = can_source.failure(can.CanOperationError("the cable", 19))
    assert isinstance(error, OSError)
    assert "the cable" in str(error)
    assert can_source.failure(RuntimeError()).strerror == "RuntimeError"
