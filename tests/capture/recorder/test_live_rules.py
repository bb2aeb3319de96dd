"""The live feed's rules to the millisecond and the byte, and the process of its relay."""

import contextlib
import errno
import os
import signal
import socket
import subprocess
import sys
from types import SimpleNamespace

import pytest
from mcap.records import Attachment, Channel, Schema

from support.processes import wait_for
from undulog.capture.common.errors import MissingExtraError, UndulogError
from undulog.capture.recorder import live_feed, live_wire
from undulog.capture.recorder.live_feed import LiveFeed, RelayProcess, spawn_relay

MS, NS = 1_000_000, 1_000_000_000
HEAD = 36  # of a record, before its payload
SCHEMA = Schema(id=1, name="sensor_msgs/msg/JointState", encoding="ros2msg", data=b"float64 x")
STATES = Channel(id=1, topic="/joint_states", message_encoding="cdr", metadata={}, schema_id=1)
EVENTS = Schema(id=2, name="rcl_interfaces/msg/Log", encoding="ros2msg", data=b"string x")
ROSOUT = Channel(id=2, topic="/rosout", message_encoding="cdr", metadata={}, schema_id=2)


class Stage:
    """A feed whose time the test moves, and its relay's socket.

    Attributes:
        now_ns: Time; ``step_ns`` passes with each look at the clock.
    """

    def __init__(self, path, **options):
        self.path, self.now_ns, self.step_ns, self.link = path, 10 * NS, 0, None
        self.feed = LiveFeed(path, clock=self._look, **options)
        for record in (SCHEMA, STATES, EVENTS, ROSOUT):
            self.feed.define(record)

    def _look(self):
        self.now_ns += self.step_ns
        return self.now_ns

    def listen(self):
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.link.bind(str(self.path))

    def offer(self, size=100, channel=2, count=1):
        for _ in range(count):
            self.feed.offer(channel, self.now_ns, 0, 0, bytes(size))

    def pump(self, after_ns=0):
        """Let time pass, and pump; returns the numbers of messages in the datagrams sent."""
        self.now_ns += after_ns
        self.feed.pump()
        return self.received()

    def received(self):
        counts = []
        with contextlib.suppress(BlockingIOError):
            while True:
                data = self.link.recv(live_wire.MAX_DATAGRAM)
                head = live_wire.read_head(data)
                counts.append(
                    "definitions"
                    if head.kind is live_wire.DatagramKind.DEFINITIONS
                    else head.messages
                )
        return counts


@pytest.fixture
def stage_of(tmp_path):
    with contextlib.ExitStack() as stack:

        def make(*, connected=True, **options):
            stage = Stage(tmp_path / "live.sock", **options)
            stack.callback(lambda: stage.link and stage.link.close())
            stack.callback(stage.feed.close)
            if connected:
                stage.listen()
                assert stage.pump() == ["definitions"]
            return stage

        yield make


# -- time ------------------------------------------------------------------------------------------


def test_a_relay_is_looked_for_every_half_second(stage_of):
    stage = stage_of(connected=False)
    stage.feed.pump()
    stage.listen()
    assert stage.pump(500 * MS - 1) == []
    assert not stage.feed.connected
    assert stage.pump(1) == ["definitions"]
    assert (stage.feed.connected, stage.feed.counts.connections) == (True, 1)


def test_definitions_are_sent_again_every_two_seconds(stage_of):
    stage = stage_of()
    assert stage.pump(2000 * MS - 1) == []
    assert stage.pump(1) == ["definitions"]
    assert stage.pump(1999 * MS) == []
    assert stage.pump(1 * MS) == ["definitions"]
    assert stage.feed.counts.connections == 1


def test_a_datagram_fills_for_20_ms_or_to_16_kib(stage_of):
    stage = stage_of()
    stage.offer()
    assert stage.pump(20 * MS - 1) == []
    stage.offer()
    assert stage.pump(1) == [2]
    stage.offer((16 << 10) - HEAD - 1)
    assert stage.pump() == []
    stage.offer(0)
    assert stage.pump() == [2]
    stage.offer((16 << 10) - HEAD)
    assert stage.pump() == [1]
    stage.feed.define(Channel(9, "/odom", "cdr", {}, 1))
    assert stage.pump() == ["definitions"]
    assert stage.pump(20 * MS) == []


def test_a_tick_sends_for_three_tenths_of_a_millisecond(stage_of):
    stage = stage_of()
    stage.offer(20_000, count=6)
    stage.step_ns = 100_000
    assert stage.pump(20 * MS) == [1, 1, 1]
    stage.step_ns = 99_999
    assert stage.pump(20 * MS) == [1, 1, 1]
    assert (stage.feed.queued, stage.feed.counts.sent) == (0, 6)


def test_a_datagram_has_32_kib_at_most_beside_a_longer_message(stage_of):
    stage = stage_of()
    half = (16 << 10) - HEAD
    for size in (half, half, half, half + 1, 40_000, 1):
        stage.offer(size)
    assert stage.pump(20 * MS) == [2, 1, 1, 1, 1]


def test_200_samples_a_second_are_sent_and_all_events(stage_of):
    stage = stage_of()
    for _ in range(11):
        stage.offer(channel=1)
        stage.offer(channel=2)
        stage.now_ns += 5 * MS // 2
    assert stage.feed.counts.thinned == 4  # all but the first are 5 ms apart
    assert stage.pump(20 * MS) == [18]


# -- what may wait ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "most"), [(0, 4096), (HEAD * 49, (2 << 20) // (HEAD * 50))])
def test_4096_messages_or_2_mib_may_wait(stage_of, size, most):
    stage = stage_of()
    stage.offer(size, count=most)
    assert (stage.feed.queued, stage.feed.counts.dropped) == (most, 0)
    stage.offer(size, count=3)
    assert (stage.feed.queued, stage.feed.counts.dropped) == (most, 3)


class Socket:
    """A socket that fails with some errors, one a send, and counts what it takes then."""

    def __init__(self, *codes):
        self.codes, self.taken, self.closed = list(codes), [], 0

    def send(self, data):
        if self.codes:
            raise OSError(self.codes.pop(0), "")
        self.taken.append(live_wire.read_head(data).messages)

    def connect(self, _):
        pass

    def close(self):
        self.closed += 1


def with_socket(stage, *codes):
    stage.feed._socket.close()
    stage.feed._socket = made = Socket(*codes)
    return made


@pytest.mark.parametrize("code", [errno.EAGAIN, errno.ENOBUFS, errno.ENOMEM])
def test_a_full_socket_rests_for_20_ms(stage_of, code):
    stage = stage_of()
    made = with_socket(stage, code)
    stage.offer(20_000, count=2)
    stage.pump(20 * MS)
    assert (made.taken, stage.feed.queued) == ([], 2)
    stage.pump(20 * MS - 1)
    assert made.taken == []
    stage.pump(1)
    assert (made.taken, stage.feed.queued, stage.feed.counts.dropped) == ([1, 1], 0, 0)


def test_a_datagram_that_waits_is_the_first_that_is_dropped(stage_of):
    stage = stage_of(max_messages=3)
    made = with_socket(stage, errno.EAGAIN)
    stage.offer(count=3)
    stage.pump(20 * MS)
    stage.offer(count=3)
    assert (stage.feed.queued, stage.feed.counts.dropped) == (6, 0)
    stage.offer()
    assert (stage.feed.queued, stage.feed.counts.dropped) == (3, 4)
    stage.pump(20 * MS)
    assert made.taken == [3]


def test_a_datagram_that_no_socket_takes_is_left_out(stage_of):
    stage = stage_of()
    made = with_socket(stage, errno.EMSGSIZE)
    stage.offer(20_000, count=2)
    stage.pump(20 * MS)
    assert (made.taken, stage.feed.counts.too_big, stage.feed.counts.sent) == ([1], 1, 1)
    made.codes = [errno.EMSGSIZE]
    stage.feed.define(Channel(9, "/odom", "cdr", {}, 1))
    stage.pump(20 * MS)
    assert (stage.feed.counts.too_big, stage.feed.connected) == (2, True)


def test_a_relay_that_has_ended_is_looked_for_again(stage_of):
    stage = stage_of()
    made = with_socket(stage, errno.ECONNREFUSED)
    stage.offer(20_000, count=3)
    stage.pump(20 * MS)
    assert (made.closed, stage.feed.connected) == (1, False)
    assert (stage.feed.counts.dropped, stage.feed.queued) == (3, 0)
    stage.offer(count=3)
    assert stage.feed.queued == 0
    assert stage.pump(500 * MS - 1) == []
    assert stage.pump(1) == ["definitions"]
    assert stage.feed.counts.connections == 2


def test_the_end_is_tried_for_a_tenth_of_a_second(stage_of, monkeypatch):
    slept = []
    monkeypatch.setattr(live_feed.time, "sleep", slept.append)
    stage = stage_of()
    made = with_socket(stage, *[errno.EAGAIN] * 1000)
    stage.offer()
    stage.feed.close()
    assert sum(slept) == pytest.approx(0.1)
    assert (made.taken, made.closed, stage.feed.counts.dropped) == ([], 1, 1)
    stage.now_ns += 10**15
    stage.feed.pump()
    assert not stage.feed.connected
    stage.feed.close()
    assert sum(slept) == pytest.approx(0.1)


def test_a_definition_beyond_a_datagram_is_left_out_and_counted(stage_of):
    stage = stage_of()
    long = os.urandom(live_wire.MAX_DATAGRAM)
    stage.feed.define(Attachment(0, 0, "robot.toml", "application/toml", long))
    assert stage.feed.counts.too_big == 1
    assert stage.pump(20 * MS) == []


# -- the relay -------------------------------------------------------------------------------------


def test_what_is_no_socket_is_no_relay(stage_of, tmp_path):
    (tmp_path / "live.sock").write_text("")
    stage = stage_of(connected=False)
    stage.feed.pump()
    assert not stage.feed.connected


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a socket away")
def test_the_socket_of_another_user_is_no_relay_but_root_s_is(stage_of, tmp_path, monkeypatch):
    stage = stage_of(connected=False)
    stage.listen()
    os.chown(stage.path, 12_345, -1)
    stage.feed.pump()
    assert not stage.feed.connected
    monkeypatch.setattr(os, "geteuid", lambda: 12_345)
    assert stage.pump(500 * MS) == ["definitions"]
    os.chown(stage.path, 0, -1)
    assert stage.pump(2000 * MS) == ["definitions"]


WAITS = "import time; print('up', flush=True); time.sleep(1000)"


@pytest.fixture
def relay(tmp_path):
    """A process that leads a session of its own, as a relay."""
    running = subprocess.Popen(
        [sys.executable, "-S", "-c", WAITS], stdout=subprocess.PIPE, start_new_session=True
    )
    running.stdout.readline()
    yield RelayProcess(running, tmp_path / "complaints.txt"), running
    running.kill()
    running.communicate()


def test_a_relay_is_ended_and_its_complaints_are_removed(relay, tmp_path):
    process, running = relay
    assert (process.pid, process.poll(), process.complaint()) == (running.pid, None, "")
    (tmp_path / "complaints.txt").write_bytes(b"first\n  the last \xff \n\n  \n")
    assert process.complaint() == "the last \ufffd"
    process.close(leave_window=True)
    assert process.poll() is None
    assert not (tmp_path / "complaints.txt").exists()
    process.close()
    process.close()
    assert process.poll() == -signal.SIGTERM


def test_a_relay_is_started_with_its_socket_and_options(tmp_path, monkeypatch):
    monkeypatch.setattr(live_feed.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(live_feed, "sys", SimpleNamespace(executable="/bin/echo"))
    monkeypatch.setattr(live_feed.importlib.util, "find_spec", lambda _: True)
    relay = spawn_relay(tmp_path / "s", ["--web"])
    wait_for(lambda: relay.poll() is not None, "its end")
    assert relay.complaint() == f"-m undulog view --live {tmp_path / 's'} --web"
    relay.close()
    assert list(tmp_path.iterdir()) == []


def test_a_relay_leads_a_session_that_no_interrupt_of_the_terminal_reaches(tmp_path, monkeypatch):
    script = tmp_path / "relay"
    script.write_text("#!/bin/sh\necho session $(cut -d' ' -f6 /proc/self/stat)\n")
    script.chmod(0o700)
    monkeypatch.setattr(live_feed, "sys", SimpleNamespace(executable=str(script)))
    monkeypatch.setattr(live_feed.importlib.util, "find_spec", lambda _: True)
    relay = spawn_relay(tmp_path / "s")
    wait_for(lambda: relay.poll() is not None, "its end")
    assert relay.complaint() == f"session {relay.pid}"
    relay.close()


def test_a_relay_that_can_not_be_started_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(live_feed.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(live_feed, "sys", SimpleNamespace(executable=str(tmp_path / "none")))
    monkeypatch.setattr(live_feed.importlib.util, "find_spec", lambda _: True)
    with pytest.raises(UndulogError, match=r"the live view can't be started: .*No such file"):
        spawn_relay(tmp_path / "s")
    monkeypatch.setattr(live_feed.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match="the live view"):
        spawn_relay(tmp_path / "s")
    assert list(tmp_path.iterdir()) == []
