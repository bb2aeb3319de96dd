"""What a live feed takes of a recording: definitions, batches, states, thinned samples."""

import contextlib
import random
import socket

import numpy as np
import pytest
from mcap.records import Channel, Schema

from undulog.capture.log.mcap.batch import MessageBatch
from undulog.capture.log.mcap.chunk import BODY_AT
from undulog.capture.recorder.live_feed import LiveFeed
from undulog.capture.recorder.live_wire import DatagramKind, LiveMessage, read_head, read_records

MS = 1_000_000
SCHEMAS = [
    Schema(1, b"", "ros2msg", "sensor_msgs/msg/Imu"),
    Schema(2, b"", "ros2msg", "rcl_interfaces/msg/Log"),
    Schema(3, b"", "ros2msg", "std_msgs/msg/String"),
]
IMU, EVENTS, MODE, RAW = (
    Channel(1, "/imu", "cdr", {}, 1), Channel(2, "/rosout", "cdr", {}, 2),
    Channel(3, "/gait/mode", "cdr", {}, 3), Channel(4, "/can/a", "cdr", {}, 2),
)  # fmt: skip


class Stage:
    """A feed whose time stands still unless it is moved, and its relay."""

    def __init__(self, path, **options):
        self.path, self.now_ns, self.link = path, 10**10, None
        self.feed = LiveFeed(path, clock=lambda: self.now_ns, **options)
        for record in (*SCHEMAS, IMU, EVENTS, MODE, RAW):
            self.feed.define(record)

    def connect(self):
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.link.bind(str(self.path))
        self.now_ns += 500 * MS
        return self.sent()

    def sent(self):
        """The records that are sent within the next 20 ms."""
        self.feed.pump()
        self.now_ns += 20 * MS
        self.feed.pump()
        return self.received()

    def received(self):
        records = []
        with contextlib.suppress(BlockingIOError):
            while True:
                records += read_records(self.link.recv(1 << 16))
        return records


@pytest.fixture
def stage(tmp_path):
    stage = Stage(tmp_path / "live.sock")
    yield stage
    stage.feed.close()
    if stage.link is not None:
        stage.link.close()


def batch_of(channel, count, first=0):
    times = np.arange(first, first + count) * 10 * MS
    records = np.zeros((count, BODY_AT + 2), np.uint8)
    records[:, BODY_AT] = np.arange(first, first + count)
    return MessageBatch(channel, times, times - 1, first, records)


@pytest.mark.parametrize(("channel", "count"), [(1, 3), (2, 3), (3, 3), (4, 0), (9, 0)])
def test_a_batch_is_queued_as_its_messages_are(stage, channel, count):
    stage.connect()
    stage.feed.offer_batch(batch_of(channel, 3, first=5))
    assert stage.feed.queued == count
    queued = [
        (
            message.channel_id,
            message.sequence,
            message.log_time_ns,
            message.publish_time_ns,
            message.payload,
        )
        for message in stage.sent()
    ]
    assert queued == [
        (channel, k, k * 10 * MS, k * 10 * MS - 1, bytes([k, 0])) for k in (5, 6, 7)
    ][:count]  # fmt: skip


def test_without_a_relay_only_the_last_state_is_kept(stage):
    for channel in (1, 2, 3, 4):
        stage.feed.offer_batch(batch_of(channel, 3))
        stage.feed.offer(channel, 7, 6, 9, b"x")
    assert stage.feed.queued == 0
    *definitions, state = stage.connect()
    assert definitions == [*SCHEMAS, IMU, EVENTS, MODE, RAW]
    assert state == LiveMessage(3, 9, 7, 6, 10**10, b"x")
    assert (stage.feed.queued, stage.feed.counts.sent, stage.feed.counts.dropped) == (0, 0, 0)


def test_definitions_that_come_later_are_sent_at_once_and_change_no_other_channel(stage):
    stage.connect()
    for record in (Schema(4, b"", "ros2msg", "x"), Channel(5, "/can_fd/a", "cdr", {}, 1)):
        stage.feed.define(record)
        stage.feed.pump()
        assert stage.received() == [record]
    stage.feed.offer(1, 100 * MS, 0, 0, b"")
    stage.feed.offer(1, 101 * MS, 0, 0, b"")
    stage.feed.define(Schema(1, b"", "ros2msg", "sensor_msgs/msg/Imu"))
    stage.feed.offer(1, 102 * MS, 0, 1, b"")  # sooner than it may come again
    stage.feed.offer(5, 102 * MS, 0, 0, b"")
    stage.feed.offer(1, 105 * MS, 0, 2, b"")
    assert (stage.feed.queued, stage.feed.counts.thinned) == (3, 1)
    stage.feed.define(Channel(6, "/imu/2", "cdr", {}, 1))
    stage.feed.offer(6, 1, 0, 0, b"")
    stage.feed.offer(6, 2, 0, 1, b"")
    assert (stage.feed.queued, stage.feed.counts.thinned) == (4, 2)


def test_samples_are_thinned_by_their_times_as_by_a_plain_rule(stage):
    """A sample that is late by less than a period doesn't delay the next one."""
    rng, period_ns, due_ns, kept, at_ns = random.Random(6), 5 * MS, 0, [], 0
    stage.connect()
    for number in range(2000):
        at_ns += rng.choice([0, MS, 2 * MS, 5 * MS, 5 * MS - 1, 12 * MS, -3 * MS, 100 * MS])
        stage.feed.offer(1, at_ns, 0, number, b"")
        if at_ns >= due_ns:
            kept.append(number)
            due_ns = max(due_ns + period_ns, at_ns)
    sent = stage.sent()
    assert [message.sequence for message in sent] == kept
    assert stage.feed.counts.thinned == 2000 - len(kept)


def test_a_state_that_is_offered_to_a_relay_is_a_message_and_then_a_definition(stage):
    stage.connect()
    before_ns = stage.now_ns
    stage.feed.offer(3, 7, 6, 9, b"walk")
    assert stage.sent() == [LiveMessage(3, 9, 7, 6, before_ns, b"walk")]
    stage.now_ns += 2000 * MS
    stage.feed.pump()
    data = stage.link.recv(1 << 16)
    assert (read_head(data).kind, read_head(data).messages) == (DatagramKind.DEFINITIONS, 0)
    assert read_records(data)[-1].payload == b"walk"
    assert stage.feed.counts.sent == 1


def test_who_closes_a_feed_sends_what_waits_and_the_end_and_forgets_the_relay(stage):
    stage.connect()
    for number in range(3):
        stage.feed.offer(2, number, 0, number, bytes(20_000))
    stage.feed.define(Channel(6, "/imu/2", "cdr", {}, 1))
    stage.feed.close()
    kinds = []
    with contextlib.suppress(BlockingIOError):
        while True:
            head = read_head(stage.link.recv(1 << 16))
            kinds.append((head.kind.name, head.messages, head.dropped))
    assert kinds == [("DEFINITIONS", 0, 0), *[("MESSAGES", 1, 0)] * 3, ("END", 0, 0)]
    assert (stage.feed.connected, stage.feed.queued, stage.feed.counts.dropped) == (False, 0, 0)
