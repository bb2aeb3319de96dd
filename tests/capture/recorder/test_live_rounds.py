"""The health of a running recording: its rounds of scanning, and what it shows of topics."""

import random
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.records import Channel, Schema

from undulog.capture import SessionWriter, load_robot
from undulog.capture.log.messages.definitions import schema_text
from undulog.capture.log.messages.frames import empty_fd_frames, empty_frames
from undulog.capture.log.write.mcap_sink import McapSink
from undulog.capture.recorder.health import LiveHealth
from undulog.capture.recorder.recording import TappedSink
from undulog.capture.recorder.source_clock import SourceClock
from undulog.capture.sources.contract import SourceCounts

EPOCH_NS, NS, MS = 1_700_000_000_000_000_000, 1_000_000_000, 1_000_000
STRING = "std_msgs/msg/String"
PIECE = 1 << 17


def texts_of(count):
    """A health of some channels of text, numbered from 1."""
    health = LiveHealth(None)
    health.define(Schema(1, schema_text(STRING).encode(), "ros2msg", STRING))
    for key in range(1, count + 1):
        health.define(Channel(key, f"/text{key}", "cdr", {}, 1))
    return health


def text(size=1):
    return b"\0\1\0\0" + struct.pack("<I", size) + bytes(size)


def counts(health):
    return {
        int(channel.topic.removeprefix("/text")): channel.count
        for channel in health.result().channels
    }


# -- rounds ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_channel_is_measured_at_first_and_each_fourth_round_and_when_it_rests(seed):
    """Against a plain list of who was measured when; the end is that of the stalest measure."""
    rng, health = random.Random(seed), texts_of(6)
    written, shown, stale = dict.fromkeys(range(1, 7), 0), {}, {}
    first_ns = last_ns = 0
    for number in range(25):
        begin_ns, busy = last_ns, [key for key in written if rng.random() < 0.7]
        for key in busy:
            for _ in range(rng.randrange(1, 4)):
                at_ns = EPOCH_NS + number * NS + rng.randrange(NS)
                health.offer(key, at_ns, at_ns, written[key], text())
                written[key] += 1
                first_ns, last_ns = min(first_ns or at_ns, at_ns), max(last_ns, at_ns)
        now_ns = EPOCH_NS + (number + 1) * NS
        for _ in range(len(busy) + 2):  # the beginning, one a channel, the end
            health.step(now_ns)
        for key in busy:
            if key not in shown or key % 4 == number % 4:
                shown[key] = written[key]
                stale.pop(key, None)
            else:
                stale.setdefault(key, begin_ns)
        for key in [key for key in stale if key not in busy]:
            shown[key] = written[key]
            del stale[key]
        assert counts(health) == shown
        result = health.result()
        assert (result.start_ns, result.end_ns) == (first_ns, min(stale.values(), default=last_ns))
    health.update()
    assert counts(health) == {key: count for key, count in written.items() if count}
    assert health.result().end_ns == last_ns


def test_without_messages_a_session_has_no_time():
    health = texts_of(1)
    assert (health.result().start_ns, health.result().end_ns, health.topics()) == (0, 0, ())


def test_a_round_begins_a_second_after_the_one_before():
    health = texts_of(1)

    def step(after_ns):
        health.step(EPOCH_NS + after_ns)
        return counts(health).get(1, 0)

    for number in range(2):
        health.offer(1, EPOCH_NS, EPOCH_NS, number, text())
    assert [step(0), step(0), step(0)] == [0, 0, 2]  # begun, taken, told
    health.offer(1, EPOCH_NS + 1, EPOCH_NS + 1, 2, text())
    assert step(NS - 1) == step(NS - 1) == step(NS - 1) == 2
    step(NS)
    step(NS)
    assert health.topics()[0].count == 3


def test_messages_are_taken_in_pieces_of_128_kib_of_equal_numbers():
    for sizes in ([PIECE - 9] * 3, [5] * 4, [PIECE // 3] * 7, [2 * PIECE, 0, 0, 0], [0, 0]):
        payloads = [text(size) for size in sizes]
        total = sum(map(len, payloads))
        pieces = max(1, (total + PIECE - 1) // PIECE)
        piece_size = (len(sizes) + pieces - 1) // pieces
        health, seen = texts_of(1), []
        for number, payload in enumerate(payloads):
            health.offer(1, EPOCH_NS + number, EPOCH_NS, number, payload)
        for _ in range(20):
            health.step(EPOCH_NS)
            taken = [topic.count for topic in health.topics()]
            if taken and taken[0] not in seen:
                seen += taken
        assert seen == [*range(piece_size, len(sizes), piece_size), len(sizes)]
        assert health.final().channels[0].sequence.dropped in (0, None)


def test_a_channel_that_is_defined_again_keeps_its_count():
    health = texts_of(2)
    health.offer(2, EPOCH_NS, EPOCH_NS, 0, text())
    health.update()
    health.define(Channel(2, "/text2", "cdr", {}, 1))
    health.offer(2, EPOCH_NS + 1, EPOCH_NS, 1, text())
    health.update()
    assert counts(health) == {2: 2}
    assert [topic.count for topic in health.topics()] == [2]


@pytest.mark.parametrize(
    ("schema_id", "encoding", "message_encoding", "read"),
    [(1, "ros2msg", "cdr", True), (1, "ros2msg", "json", False), (1, "jsonschema", "cdr", False),
     (2, "ros2msg", "cdr", False)],
)  # fmt: skip
def test_messages_of_other_encodings_are_counted_and_not_read(
    schema_id, encoding, message_encoding, read
):
    health = LiveHealth(None)
    health.define(Schema(1, schema_text(STRING).encode(), encoding, STRING))
    health.define(Channel(1, "/text1", message_encoding, {}, schema_id))
    health.offer(1, EPOCH_NS, EPOCH_NS, 0, b"\0\1\0\0")  # ends before its text
    (channel,) = health.final().channels
    assert (channel.count, channel.type_name) == (1, STRING if schema_id == 1 else "")
    assert channel.unread == int(read)


# -- topics ----------------------------------------------------------------------------------------


@pytest.fixture
def judged(tmp_path):
    """A health of snake25, and a session that it judges."""
    health = LiveHealth(load_robot("snake25"))
    sink = TappedSink(McapSink(tmp_path / "run.mcap"), [health])
    with SessionWriter(tmp_path / "run.mcap", session_id="s", epoch_ns=0, sink=sink) as writer:
        yield health, writer


def topic_of(health, name, now_ns=None):
    health.update(now_ns)
    return {topic.topic: topic for topic in health.topics()}[name]


def test_joints_at_their_limits_frozen_ones_and_lost_values_are_named(judged):
    health, writer = judged
    robot = load_robot("snake25")
    names, upper = robot.joint_names, robot.joints[0].upper
    commands = writer.joint_state("/joint_commands", names, unit="rad")
    states = writer.joint_state("/joint_states", names, unit="rad")
    for tick in range(500):
        angles = 0.3 * np.sin(0.05 * tick + np.arange(25))
        t_ns = EPOCH_NS + tick * 10 * MS
        commands.write(t_ns, angles)
        angles[3] = upper if tick < 50 else 0.0  # a tenth of the time is not too long
        angles[4] = upper if tick < 51 else 0.0
        angles[5] = 0.1 if tick >= 300 else angles[5]  # in two whole seconds
        angles[6] = 0.1 if 320 <= tick < 480 else angles[6]  # in no two
        angles[7] = np.nan if tick < 9 else angles[7]
        states.write(t_ns, angles)
    topic = topic_of(health, "/joint_states")
    # Of joints 3 and 4 the rest stands for more than two seconds as well.
    assert topic.at_limit == (names[4],)
    assert topic.frozen == (names[3], names[4], names[5])
    assert (topic.nan, topic.count, topic.dropped) == (9, 500, 0)
    assert (topic_of(health, "/joint_commands").at_limit, topic.gaps, topic.missing) == ((), 0, 0)


def test_the_rhythm_of_a_topic_is_that_of_all_its_series(judged):
    """Two sets of names on one topic are two series: the larger jitter, the sum of the gaps."""
    health, writer = judged
    whole = writer.joint_state("/joint_current", ["a", "b", "c"], unit="A")
    some, other = whole.part(["a"]), whole.part(["b"])
    even = [tick for tick in range(400) if tick not in {50, 51, 120}]
    for tick in even:
        some.write(EPOCH_NS + tick * 10 * MS + (tick % 2) * MS, [0.0], log_time_ns=EPOCH_NS + tick)
    first = topic_of(health, "/joint_current")
    assert (first.gaps, first.missing) == (2, 3)
    assert first.jitter == pytest.approx(0.1, rel=0.12)  # 1 ms of 9 or 11 ms, in turn
    for tick in range(400):
        if tick != 77:
            t_ns = EPOCH_NS + tick * 20 * MS + (tick % 2) * 4 * MS
            other.write(t_ns, [0.0], log_time_ns=EPOCH_NS + 1000 + tick)
    both = topic_of(health, "/joint_current")
    assert (both.gaps, both.missing) == (3, 4)
    assert both.jitter == pytest.approx(0.2, rel=0.25)  # 4 ms of 16 or 24 ms
    rng = random.Random(1)
    for tick in range(200):  # a third one has no rhythm
        t_ns = EPOCH_NS + tick * 100 * MS + rng.randrange(95 * MS)
        whole.write(t_ns, [0.0] * 3, log_time_ns=EPOCH_NS + 2000 + tick)
    topic = topic_of(health, "/joint_current")
    assert (topic.gaps, topic.missing, topic.jitter) == (None, None, None)
    assert topic.count == len(even) + 399 + 200


@pytest.mark.parametrize("prefix", ["/can/", "/can_fd/", "/serial/", "/other/"])
def test_messages_of_frames_have_no_rhythm_of_their_own(judged, prefix):
    health, writer = judged
    bus = (writer.frames if prefix == "/can/" else writer.fd_frames)(f"{prefix}x")
    frames = (empty_frames if prefix == "/can/" else empty_fd_frames)(1)
    for tick in range(60):
        frames["t_host_ns"] = EPOCH_NS + tick * 20 * MS
        bus.write(EPOCH_NS + tick * 20 * MS, frames)
    topic = topic_of(health, f"{prefix}x", EPOCH_NS + 5 * NS)
    rhythm = (topic.gaps, topic.missing, topic.jitter)
    assert rhythm == ((0, 0, 0.0) if prefix == "/other/" else (None, None, None))
    assert topic.age_s == pytest.approx(5.0 - 59 * 0.02)


def test_ages_are_never_negative_and_rates_need_two_times():
    health = texts_of(2)
    health.offer(1, EPOCH_NS + 5 * NS, 0, 0, text())
    health.offer(2, EPOCH_NS + 3 * NS, 0, 0, text())
    health.offer(2, EPOCH_NS + 2 * NS, 0, 1, text())
    health.update(EPOCH_NS)
    first, second = health.topics()
    assert (first.age_s, second.age_s, first.rate_hz) == (0.0, 0.0, None)
    health.update(EPOCH_NS)  # time stands
    assert [topic.rate_hz for topic in health.topics()] == [None, None]
    health.update()  # until the latest message
    first, second = health.topics()
    assert (first.age_s, second.age_s, first.rate_hz) == (0.0, 2.0, 0.0)
    health.update(EPOCH_NS + NS)  # time never goes back
    assert [topic.age_s for topic in health.topics()] == [0.0, 2.0]
    for second in range(6, 12):
        for _ in range(second):
            health.offer(1, EPOCH_NS + second * NS, 0, 0, text())
        health.update(EPOCH_NS + second * NS)
    assert health.topics()[0].rate_hz == (7 + 8 + 9 + 10 + 11) / 5  # six looks: five seconds
    again = texts_of(1)
    for second in range(2):
        again.offer(1, EPOCH_NS, 0, second, text())
        again.update(EPOCH_NS + second * NS)
    assert again.topics()[0].rate_hz == 1.0


# -- sources ---------------------------------------------------------------------------------------


def source(name="x", *, frames=0, robot=None, connected=True, **counted):
    counts = SourceCounts(frames=frames, **counted)
    return SimpleNamespace(
        name=name, robot=robot, counts=counts, connected=connected, finished=False
    )


def test_a_source_has_its_counts_its_load_and_its_age(judged):
    health, writer = judged
    state = source(frames=7, dropped=3, malformed=4, error_frames=5, reconnects=6)
    snapshot = health.source(state, "can:x", SourceClock())
    assert (snapshot.name, snapshot.address, snapshot.connected, snapshot.finished) == (
        "x",
        "can:x",
        True,
        False,
    )
    counted = (
        snapshot.frames,
        snapshot.dropped,
        snapshot.malformed,
        snapshot.error_frames,
        snapshot.reconnects,
    )
    assert counted == (7, 3, 4, 5, 6)
    assert (snapshot.age_s, snapshot.load, snapshot.rate_hz, snapshot.clock) == (
        None,
        None,
        None,
        None,
    )
    bus, later = writer.frames("/can/x"), writer.string("/mode")
    frames = empty_frames(100)
    frames["dlc"] = 8
    for second in range(4):
        t_ns = EPOCH_NS + second * NS
        frames["t_host_ns"] = t_ns + np.arange(100) * 10 * MS
        bus.write(t_ns, frames)
        later.write(t_ns + NS // 2, "walk")
    health.update(EPOCH_NS + 5 * NS)
    clock = SourceClock()
    clock.add(np.array([5]), np.array([EPOCH_NS]))
    snapshot = health.source(state, "can:x", clock)
    assert snapshot.age_s == 2.0
    assert snapshot.clock == clock.result()
    low, high = snapshot.load
    bitrate = load_robot("snake25").bus.bitrate
    # A classic frame of 8 bytes: 44 bits, 64 of data, 3 in between; at most a quarter is stuffed.
    assert 108 * 100 / bitrate <= low < high <= 1.25 * 112 * 100 / bitrate
    other = health.source(source("y", robot=object()), "twin:flat", None)
    assert (other.frames, other.age_s, other.load) == (None, None, None)
    assert health.source(source("y", robot=object(), frames=2), "twin:flat", None).frames == 2


@pytest.mark.parametrize("prefix", ["/can/", "/can_fd/", "/serial/"])
def test_the_age_of_a_source_is_that_of_its_latest_frames_of_any_kind(judged, prefix):
    health, writer = judged
    for name, after_s in (("/can/x", 1), ("/can_fd/x", 1), ("/serial/x", 1), ("/can/y", 9)):
        classic = name.startswith("/can/")
        frames = (empty_frames if classic else empty_fd_frames)(1)
        frames["t_host_ns"] = EPOCH_NS + after_s * NS
        channel = (writer.frames if classic else writer.fd_frames)(name)
        channel.write(EPOCH_NS + (4 if name == f"{prefix}x" else after_s) * NS, frames)
    health.update(EPOCH_NS + 10 * NS)
    assert health.source(source(), "x", None).age_s == 6.0


def test_a_robot_whose_servos_only_answer_waits_while_every_line_is_silent():
    silent, off, busy = source(), source(connected=False), source(frames=1)
    arm = LiveHealth(load_robot("so101"))
    waiting = ("waiting for commands", "good", ())
    assert arm.standing([silent]) == arm.standing([silent, silent]) == waiting
    for sources in ([silent, off], [silent, busy], [off], [busy]):
        state, verdict, reasons = arm.standing(sources)
        assert (state, verdict, bool(reasons)) == ("recording", "bad", True)
        assert (verdict, reasons) == (arm.result().verdict, arm.result().reasons)
    for robot in (None, load_robot("snake25")):
        health = LiveHealth(robot)
        commanded = robot is not None and health._scan.commanded
        assert health.standing([silent])[0] == (waiting[0] if commanded else "recording")
