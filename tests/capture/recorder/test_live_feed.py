"""The live feed against real sockets: bound late, full, gone, replaced."""

import contextlib
import itertools
import os
import signal
import socket
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Attachment, Channel, Metadata, Schema

from support.processes import process, wait_for
from undulog.capture.common.errors import DataError
from undulog.capture.recorder import live_feed, live_wire
from undulog.capture.recorder.live_feed import LiveCounts, LiveFeed

EPOCH_NS = 1_735_689_600_000_000_000
STEP_NS = 10_000_000
SCHEMA = Schema(id=1, name="sensor_msgs/msg/JointState", encoding="ros2msg", data=b"float64 x")
EVENTS = Schema(id=2, name="rcl_interfaces/msg/Log", encoding="ros2msg", data=b"string x")
STATES = Channel(id=1, topic="/joint_states", message_encoding="cdr", metadata={}, schema_id=1)
ROSOUT = Channel(id=2, topic="/rosout", message_encoding="cdr", metadata={}, schema_id=2)
RAW = Channel(id=3, topic="/can/can0", message_encoding="cdr", metadata={}, schema_id=2)
FACTS = Metadata(name="undulog", metadata={"session_id": "s"})
ROBOT = Attachment(
    name="robot.toml", media_type="application/toml", data=b"x" * 200_000, create_time=0, log_time=0
)
DEFINITIONS = [SCHEMA, EVENTS, STATES, ROSOUT, RAW, FACTS, ROBOT]


@given(st.lists(st.integers(1, 300), max_size=40), st.integers(1, 900))
def test_groups_are_as_large_as_a_datagram_may_be(lengths, size):
    definitions = live_wire.LiveDefinitions(0)
    packed = [bytes(length) for length in lengths]
    for number, record in enumerate(packed):
        definitions.keep(Schema(number, "", "", b""), record)
    groups = definitions.groups(size)
    assert [record for group in groups for record in group] == packed
    sizes = [sum(map(len, group)) for group in groups]
    assert all(total <= size or len(group) == 1 for total, group in zip(sizes, groups, strict=True))
    for total, following in zip(sizes, groups[1:], strict=False):
        assert total + len(following[0]) > size


@pytest.fixture
def path(tmp_path):
    return tmp_path / "live.sock"


def bound(path):
    """A socket at the path, as a relay has it."""
    path.unlink(missing_ok=True)
    link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    link.bind(str(path))
    link.setblocking(False)
    return link


@pytest.fixture
def listen(path):
    """Binds the path, as a relay would; closed at the end."""
    with contextlib.ExitStack() as links:
        yield lambda: links.enter_context(bound(path))


@pytest.fixture
def make(path):
    """Makes feeds with all definitions; closed at the end."""
    with contextlib.ExitStack() as feeds:

        def make_feed(**options):
            feed = feeds.enter_context(contextlib.closing(LiveFeed(path, **options)))
            for record in DEFINITIONS:
                feed.define(record)
            return feed

        yield make_feed


def received(link):
    """What lies in the socket: heads, and records in order."""
    heads, records = [], []
    with contextlib.suppress(BlockingIOError):
        while True:
            data = link.recv(live_wire.MAX_DATAGRAM)
            heads.append(live_wire.read_head(data))
            records += live_wire.read_records(data)
    return heads, records


def pump_until(feed, condition):
    wait_for(condition, meanwhile=feed.pump)


@pytest.fixture
def watched(make, listen):
    """Makes a feed and a socket that has its definitions."""

    def connect(**options):
        feed, link = make(**options), listen()
        pump_until(feed, lambda: feed.connected)
        received(link)
        return feed, link

    return connect


def all_sent(feed, link):
    """The records of all that waits, pumped and received in turn."""
    seen = []

    def nothing_waits():
        seen.extend(received(link)[1])
        return feed.queued == 0

    pump_until(feed, nothing_waits)
    return seen + received(link)[1]


def offer(feed, number, channel=1, payload=b"data", step_ns=STEP_NS):
    t_ns = EPOCH_NS + number * step_ns
    feed.offer(channel, t_ns, t_ns - 5, number, payload)


def messages(records):
    return [record for record in records if isinstance(record, live_wire.LiveMessage)]


NUMBERS = (st.integers(0, 2**n - 1) for n in (16, 32, 64, 64, 64))
FIELDS = st.lists(st.tuples(*NUMBERS, st.binary(max_size=300)), max_size=20)


@given(FIELDS, st.integers(0, 2**64 - 1))
def test_datagram_comes_back_as_it_was(fields, dropped):
    head = live_wire.DatagramHead(live_wire.DatagramKind.MESSAGES, len(fields), 7, dropped)
    data = live_wire.pack_datagram(head, map(live_wire.pack_message, fields))
    assert live_wire.read_head(data) == head
    assert live_wire.read_records(data) == [live_wire.LiveMessage(*field) for field in fields]


@pytest.mark.parametrize("record", DEFINITIONS)
def test_definition_comes_back_as_it_was(record):
    head = live_wire.DatagramHead(live_wire.DatagramKind.DEFINITIONS, 0, 7, 0)
    data = live_wire.pack_datagram(head, [live_wire.pack_description(record)])
    assert live_wire.read_records(data) == [record]


@given(st.binary(max_size=200))
def test_noise_is_refused_not_believed(noise):
    with pytest.raises(DataError):
        live_wire.read_head(noise)


@given(st.data())
def test_any_cut_or_flipped_datagram_is_read_or_refused(data):
    head = live_wire.DatagramHead(live_wire.DatagramKind.DEFINITIONS, 0, 7, 0)
    whole = live_wire.pack_datagram(head, map(live_wire.pack_description, DEFINITIONS[:4]))
    at = data.draw(st.integers(24, len(whole) - 1))
    damaged = whole[:at]
    if data.draw(st.booleans()):
        damaged += bytes([whole[at] ^ data.draw(st.integers(1, 255))]) + whole[at + 1 :]
    with contextlib.suppress(DataError):
        live_wire.read_records(damaged)


def test_nothing_is_kept_while_nobody_watches(make):
    feed = make()
    for number in range(10_000):
        offer(feed, number)
        feed.pump()
    assert not feed.connected
    assert feed.queued == 0
    assert feed.counts == LiveCounts()


def test_relay_that_comes_late_gets_definitions_first_and_then_every_message(make, listen):
    feed = make()
    for number in range(100):
        offer(feed, number)
        feed.pump()
    link = listen()
    pump_until(feed, lambda: feed.connected)
    heads, records = received(link)
    assert records == DEFINITIONS
    assert {head.kind for head in heads} == {live_wire.DatagramKind.DEFINITIONS}
    for number in range(100, 300):
        offer(feed, number)
    records = all_sent(feed, link)
    assert [message.sequence for message in messages(records)] == list(range(100, 300))
    assert messages(records)[0][2:4] == (EPOCH_NS + 100 * STEP_NS, EPOCH_NS + 100 * STEP_NS - 5)
    assert (feed.counts.sent, feed.counts.dropped) == (200, 0)


def test_offered_time_is_that_of_the_tick_before(watched):
    ticks = itertools.count(5_000_000_000, 20_000_000)
    feed, link = watched(clock=lambda: next(ticks))
    feed.pump()
    now_ns = next(ticks)
    offer(feed, 0)
    (message,) = messages(all_sent(feed, link))
    assert 5_000_000_000 < message.offered_ns < now_ns


def test_definitions_of_later_channels_come_before_their_messages(watched):
    feed, link = watched()
    late = Channel(id=9, topic="/odom", message_encoding="cdr", metadata={}, schema_id=1)
    feed.define(late)
    offer(feed, 0, channel=9)
    records = all_sent(feed, link)
    assert (records[0], records[1].channel_id) == (late, 9)


def test_definitions_are_repeated(make, listen, monkeypatch):
    monkeypatch.setattr(live_feed, "RENEW_NS", 20_000_000)
    feed, link = make(), listen()
    seen = []

    def defined_thrice():
        seen.extend(received(link)[1])
        return seen.count(STATES) >= 3

    pump_until(feed, defined_thrice)
    assert feed.counts.connections == 1


def test_a_state_that_holds_is_sent_to_a_relay_that_comes_later(make, listen):
    feed = make()
    schema = Schema(id=7, name="std_msgs/msg/String", encoding="ros2msg", data=b"string data")
    mode = Channel(id=7, topic="/gait/mode", message_encoding="cdr", metadata={}, schema_id=7)
    feed.define(schema)
    feed.define(mode)
    for number in range(3):
        offer(feed, number, channel=7, payload=f"mode {number}".encode())
    link = listen()
    pump_until(feed, lambda: feed.connected)
    _, records = received(link)
    assert records[:-1] == [*DEFINITIONS, schema, mode]
    assert records[-1].payload == b"mode 2"
    assert feed.counts.sent == 0  # as a message: it was sent like the definitions


def test_raw_frames_are_not_sent(watched):
    feed, link = watched()
    offer(feed, 0, channel=3)
    feed.pump()
    assert messages(all_sent(feed, link)) == []
    assert feed.queued == 0


def test_samples_are_thinned_and_events_are_not(watched):
    feed, link = watched(max_rate_hz=100.0)
    for number in range(1000):  # one second at 1 kHz
        offer(feed, number, channel=1, step_ns=1_000_000)
        offer(feed, number, channel=2, step_ns=1_000_000)
    seen = messages(all_sent(feed, link))
    by_channel = {n: [m for m in seen if m.channel_id == n] for n in (1, 2)}
    assert len(by_channel[2]) == 1000
    assert 100 <= len(by_channel[1]) <= 102
    assert feed.counts.thinned == 1000 - len(by_channel[1])


def test_a_jittering_channel_at_the_highest_rate_is_not_thinned(watched):
    feed, _ = watched(max_rate_hz=100.0)
    for number in range(1000):
        jitter = 3_000_000 if number % 2 else -3_000_000
        feed.offer(1, EPOCH_NS + number * STEP_NS + jitter, 0, number, b"")
    assert feed.counts.thinned <= 1


def test_a_message_beyond_a_datagram_is_left_out_and_counted(watched):
    feed, link = watched()
    offer(feed, 0, payload=bytes(live_wire.MAX_MESSAGE + 1))
    offer(feed, 1, payload=bytes(live_wire.MAX_MESSAGE))
    offer(feed, 2)
    assert [message.sequence for message in messages(all_sent(feed, link))] == [1, 2]
    assert feed.counts.too_big == 1


@settings(deadline=None, max_examples=20)
@given(
    count=st.integers(1, 400),
    max_messages=st.integers(1, 50),
    sizes=st.lists(st.integers(0, 3000), min_size=1, max_size=10),
)
def test_what_is_dropped_is_always_the_oldest(tmp_path_factory, count, max_messages, sizes):
    path = tmp_path_factory.mktemp("drop") / "s"
    feed = LiveFeed(path, max_messages=max_messages, max_bytes=20_000)
    with contextlib.closing(feed), bound(path) as link:
        for record in DEFINITIONS:
            feed.define(record)
        pump_until(feed, lambda: feed.connected)
        for number in range(count):
            offer(feed, number, payload=bytes(sizes[number % len(sizes)]))
        assert feed.queued <= max_messages
        numbers = [message.sequence for message in messages(all_sent(feed, link))]
    assert numbers == list(range(count - len(numbers), count))
    assert len(numbers) + feed.counts.dropped == count
    assert numbers


def test_a_message_counts_with_its_record_head_in_what_may_wait(make, listen):
    """The head of a record: kind, pad, channel, sequence, length, three times."""
    feed = make(max_bytes=10 * (100 + 1 + 1 + 2 + 4 + 4 + 3 * 8))
    listen()
    pump_until(feed, lambda: feed.connected)
    for number in range(10):
        offer(feed, number, payload=bytes(100))
    assert (feed.queued, feed.counts.dropped) == (10, 0)
    offer(feed, 10, payload=b"")
    assert (feed.queued, feed.counts.dropped) == (10, 1)


def test_a_full_socket_drops_the_oldest_and_every_tick_completes(watched):
    feed, link = watched(max_messages=100)
    ticks = 0
    for number in range(20_000):  # nobody reads
        offer(feed, number, payload=bytes(500))
        if number % 10 == 0:
            feed.pump()
            ticks += 1
    assert ticks == 2000
    assert feed.queued <= 100 + (32 << 10) // 500  # and one datagram
    numbers = [message.sequence for message in messages(all_sent(feed, link))]
    assert numbers == sorted(numbers)
    assert numbers[-1] == 19_999
    assert len(numbers) + feed.counts.dropped == 20_000
    assert (
        live_wire.read_head(feed._pack(live_wire.DatagramKind.END).data).dropped
        == feed.counts.dropped
    )


def test_a_relay_that_is_replaced_is_found_and_gets_everything(watched, listen, monkeypatch):
    monkeypatch.setattr(live_feed, "RENEW_NS", 50_000_000)
    feed, first = watched()
    second = listen()  # the first is still there, bound to nothing any more
    seen = []

    def has_everything():
        offer(feed, feed.counts.sent)
        seen.extend(received(second)[1])
        return ROBOT in seen and bool(messages(seen))

    pump_until(feed, has_everything)
    first.close()


def test_a_relay_that_goes_and_comes_again_is_found(watched, listen, monkeypatch):
    monkeypatch.setattr(live_feed, "RETRY_NS", 10_000_000)
    feed, link = watched()
    link.close()

    def lost():
        offer(feed, 0)
        return not feed.connected

    pump_until(feed, lost)
    assert feed.queued == 0
    link = listen()
    pump_until(feed, lambda: feed.connected)
    assert received(link)[1] == DEFINITIONS
    assert feed.counts.connections == 2


def test_the_end_is_sent(watched):
    feed, link = watched()
    offer(feed, 0)
    feed.close()
    feed.close()
    feed.pump()
    assert not feed.connected
    heads, records = received(link)
    assert [message.sequence for message in messages(records)] == [0]
    assert heads[-1].kind is live_wire.DatagramKind.END
    offer(feed, 1)
    feed.pump()
    assert not feed.connected


def test_closing_does_not_wait_for_a_relay_that_takes_nothing(watched):
    feed, _ = watched()
    for number in range(3000):
        offer(feed, number, payload=bytes(1000))
        feed.pump()
    feed.close()
    assert not feed.connected


_READER = """
import socket, sys
link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
link.bind(sys.argv[1])
print("bound", flush=True)
count = 0
while True:
    count += len(link.recv(65536)) > 0
"""


@pytest.fixture
def reader(path):
    """Starts a process that reads the socket; ended at the end."""
    with contextlib.ExitStack() as started:

        def start():
            path.unlink(missing_ok=True)
            running = started.enter_context(process(sys.executable, "-c", _READER, path))
            assert running.stdout.readline() == "bound\n"
            return running

        yield start


def test_reader_frozen_killed_and_started_again_never_holds_a_tick(make, reader, monkeypatch):
    monkeypatch.setattr(live_feed, "RETRY_NS", 10_000_000)
    feed = make()
    number = ticks = 0

    def run(count):
        nonlocal number, ticks
        for _ in range(count):
            for _ in range(20):
                offer(feed, number, payload=bytes(500))
                number += 1
            feed.pump()
            ticks += 1

    first = reader()
    pump_until(feed, lambda: feed.connected)
    run(50)
    pump_until(feed, lambda: feed.queued == 0)
    sent = feed.counts.sent
    assert sent > 0
    os.kill(first.pid, signal.SIGSTOP)
    run(2000)
    frozen = feed.counts.sent
    run(2000)
    assert feed.counts.sent == frozen  # nothing more goes in
    assert feed.counts.dropped > 0
    os.kill(first.pid, signal.SIGCONT)
    pump_until(feed, lambda: feed.queued == 0)
    assert feed.counts.sent > frozen
    first.kill()
    first.wait()
    run(2000)
    assert not feed.connected
    reader()
    pump_until(feed, lambda: feed.connected)
    run(50)
    pump_until(feed, lambda: feed.queued == 0)
    assert feed.counts.connections == 2
    assert ticks == 6100
