"""The relay of the live view against frozen, killed, late and noisy processes."""

import os
import signal
import socket

import numpy as np
import pytest

from support.live_stage import EPOCH_NS, WAIT_S, Recorder
from support.processes import freeze, wait_for
from support.simulated_clock import SimulatedClock
from support.written_topics import write_topics
from undulog.capture.common.errors import UsageError
from undulog.capture.recorder import live_feed
from undulog.capture.recorder.live_feed import spawn_relay
from undulog.capture.recorder.live_wire import DatagramHead, DatagramKind, pack_datagram
from undulog.replay.live.relay import SILENCE_S, Inbox, Relay


@pytest.mark.nightly
def test_relay_that_comes_late_understands_what_is_left(stage, truth, read_back):
    recorder = stage.recorder()
    recorder.send(0.0, 1.5, wait=False)
    relay = stage.relay()
    recorder.connect()
    recorder.send(1.5)
    recorder.feed.close()
    assert relay.finish()["dropped"] == 0
    drawn = read_back(relay.output)
    rows = drawn.rows("/joints/measured", "Angle:degrees")
    assert list(rows) == (truth.t_ns - EPOCH_NS)[150:].tolist()
    np.testing.assert_allclose(list(rows.values()), np.degrees(truth.position[150:]), atol=2e-6)
    # The mode was sent before, and still holds.
    assert drawn.rows("/gait/mode", "StateChange:state") == {1_000_000_000: ["avoid"]}


@pytest.mark.nightly
def test_nothing_derived_is_lost_when_much_comes_at_once(stage, truth, read_back):
    recorder, relay = stage.recorder(), stage.relay()
    recorder.connect()
    freeze(relay.process.pid)
    recorder.send(wait=False)  # all three seconds wait
    os.kill(relay.process.pid, signal.SIGCONT)
    wait_for(lambda: recorder.feed.queued == 0, meanwhile=recorder.feed.pump)
    recorder.feed.close()
    assert relay.finish()["dropped"] == 0
    drawn = read_back(relay.output)
    for entity in ("/joints/measured", "/joints/error", "/power/mechanical"):
        assert drawn.times(entity).tolist() == (truth.t_ns - EPOCH_NS).tolist()


@pytest.mark.slow
def test_frozen_relay_holds_nothing_up_and_goes_on(stage, read_back, monkeypatch):
    monkeypatch.setattr(live_feed, "_DATAGRAM", 4096)
    recorder, relay = stage.recorder(), stage.relay()
    recorder.connect()
    recorder.send(0.0, 0.5)
    freeze(relay.process.pid)
    recorder.feed._max_messages = 50
    assert recorder.send(0.5, 2.5, wait=False) == 100
    assert recorder.feed.counts.dropped > 0
    os.kill(relay.process.pid, signal.SIGCONT)
    recorder.send(2.5)
    recorder.feed.close()
    report = relay.finish()
    assert report["dropped"] == recorder.feed.counts.dropped
    assert report["shown"] == recorder.feed.counts.sent
    times = list(read_back(relay.output).rows("/joints/measured", "Angle:degrees"))
    assert times[:50] == [10_000_000 * i for i in range(50)]
    assert times[-50:] == [2_500_000_000 + 10_000_000 * i for i in range(50)]


@pytest.mark.nightly
def test_killed_relay_is_replaced(stage, read_back, monkeypatch):
    monkeypatch.setattr(live_feed, "RETRY_NS", 10_000_000)
    recorder, first = stage.recorder(), stage.relay("first.rrd")
    recorder.connect()
    recorder.send(0.0, 0.5)
    first.process.kill()
    first.process.wait()
    assert recorder.send(0.5, 1.5, wait=False) > 40
    wait_for(lambda: not recorder.feed.connected, meanwhile=recorder.feed.pump)
    second = stage.relay("second.rrd")  # over the socket that the first has left
    recorder.connect()
    recorder.send(1.5)
    recorder.feed.close()
    second.finish()
    times = list(read_back(second.output).rows("/joints/measured", "Angle:degrees"))
    assert times == [1_500_000_000 + 10_000_000 * i for i in range(150)]


@pytest.mark.nightly
def test_joints_sampled_in_turn_are_drawn_at_their_own_times(
    stage, snake25, truth, tmp_path, read_back
):
    names, offset = snake25.joint_names, np.linspace(0.0, 8e-3, 25)
    topics = {
        "/joint_sample_offset": (names, "s", np.tile(offset, (300, 1))),
        "/joint_states": (names, "rad", truth.position),
    }
    path = write_topics(tmp_path / "turns.mcap", truth.t_ns, topics, robot=snake25)
    recorder, relay = stage.recorder(path), stage.relay()
    recorder.send_all()
    relay.finish()
    drawn = read_back(relay.output)
    for j in (0, 12, 24):
        rows = drawn.rows(f"/joints/measured/{snake25.joint_names[j]}", "Angle:degrees")
        expected = truth.t_ns - EPOCH_NS + round(offset[j] * 1e9)
        assert np.abs(np.array(list(rows)) - expected).max() <= 1
        shown = np.ravel(list(rows.values()))
        np.testing.assert_allclose(shown, np.degrees(truth.position[:, j]), atol=2e-6)
    centres = drawn.rows("/world/snake/measured", "Capsules3D:translations")
    assert len(centres) > 100  # at the origin, without odometry


@pytest.mark.nightly
def test_noise_on_the_socket_is_counted_and_borne(stage):
    recorder, relay = stage.recorder(), stage.relay()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.connect(str(stage.path))
        link.send(b"")
        link.send(b"not ours")
        link.send(pack_datagram(DatagramHead(DatagramKind.MESSAGES, 1, 1, 0), [b"\x05\0\0\0cut"]))
    recorder.send_all()
    report = relay.finish()
    assert (report["unread"], report["sessions"]) == (3, ["made-for-tests"])


@pytest.mark.slow
def test_interrupted_relay_leaves_a_whole_file_and_no_socket(stage, read_back):
    recorder, relay = stage.recorder(), stage.relay()
    recorder.connect()
    recorder.send(0.0, 1.0)
    wait_for(lambda: recorder.feed.counts.sent > 0, meanwhile=recorder.feed.pump)
    relay.process.send_signal(signal.SIGINT)
    assert relay.finish()["shown"] == recorder.feed.counts.sent
    assert "/joints/measured" in read_back(relay.output).entities
    assert not stage.path.exists()
    nothing = stage.relay("nothing.rrd")
    nothing.process.terminate()
    _, err = nothing.process.communicate(timeout=WAIT_S)
    assert nothing.process.returncode == 1
    assert "no recording was received" in err
    assert not nothing.output.exists()


def test_socket_is_the_owners_alone_and_only_one_reads_it(tmp_path):
    path = tmp_path / "s"
    with Inbox(path):
        assert path.stat().st_mode & 0o777 == 0o600
        with pytest.raises(UsageError, match="another live view reads there"):
            Inbox(path)
    assert not path.exists()
    path.write_text("mine")
    with pytest.raises(UsageError, match="is no socket"):
        Inbox(path)
    assert path.read_text() == "mine"


def test_inbox_drops_the_oldest_and_keeps_what_explains_the_rest(tmp_path, session_file):
    path = tmp_path / "s"
    with Inbox(path, max_bytes=100_000) as inbox:
        recorder = Recorder(session_file, path)
        recorder.send_all()
        kinds = []

        def end_has_come():
            kinds[:] = [batch.head.kind for batch in inbox._queue]
            return DatagramKind.END in kinds

        wait_for(end_has_come)
        taken = inbox.take()
        assert (
            sum(batch.head.messages for batch in taken) + inbox.dropped == recorder.feed.counts.sent
        )
        assert inbox.dropped > 0
        assert taken[0].head.kind is DatagramKind.DEFINITIONS
        assert sum(len(batch.data) for batch in taken) <= 150_000


def test_a_silent_feed_ends_after_ten_seconds_and_goes_on_when_it_is_heard_again(
    tmp_path, session_file
):
    now = SimulatedClock()
    connect = lambda rec: rec.save(tmp_path / "live.rrd")  # noqa: E731
    with Inbox(tmp_path / "s") as inbox:
        relay = Relay(inbox, connect, clock=now.clock)
        recorder = Recorder(session_file, tmp_path / "s", clock=now.clock.monotonic_ns)

        def send(start_s, stop_s, late_s):
            sent = recorder.feed.counts.sent
            recorder.send(start_s, stop_s, wait=False)
            now.pass_s(0.05)  # a datagram that isn't full waits for less
            wait_for(lambda: recorder.feed.queued == 0, meanwhile=recorder.feed.pump)
            shown = relay.report.shown + recorder.feed.counts.sent - sent
            now.pass_s(late_s)
            wait_for(lambda: relay.report.shown == shown, meanwhile=relay.step)

        relay.step()
        assert not relay.ended
        recorder.connect()
        send(0.0, 0.3, late_s=0.25)
        now.pass_s(SILENCE_S)
        relay.step()
        assert not relay.ended
        now.pass_s(0.1)
        relay.step()
        assert relay.ended
        send(0.3, 0.6, late_s=0.0)
        assert not relay.ended
        report = relay.report
        relay.close()
        recorder.feed.close()
    assert report.sessions == ("made-for-tests",)
    assert report.dropped == 0
    assert 0.25 <= report.lag_s[2] <= 0.31


@pytest.mark.slow
def test_spawned_relay_is_in_a_session_of_its_own_and_ends_on_request(stage, tmp_path):
    output = tmp_path / "spawned.rrd"
    relay = spawn_relay(stage.path, ["--save", str(output)])
    try:
        assert os.getsid(relay.pid) == relay.pid
        wait_for(stage.path.is_socket)
        wait_for(lambda: os.getpriority(os.PRIO_PROCESS, relay.pid) >= 10)
        recorder = stage.recorder()
        recorder.connect()
        recorder.send(0.0, 0.5)
        assert relay.poll() is None
    finally:
        relay.close()
        relay.close()
    assert relay.poll() == 0
    assert output.stat().st_size > 10_000


@pytest.mark.slow
def test_spawned_relay_says_why_it_ended(tmp_path):
    relay = spawn_relay(tmp_path / "there is no such folder" / "s", ["--connect", "x"])
    try:
        wait_for(lambda: relay.poll() is not None)
        assert relay.poll() == 2
        assert "the socket can't be made" in relay.complaint()
    finally:
        relay.close()


@pytest.mark.slow
def test_frozen_relay_that_was_spawned_can_be_ended(stage, monkeypatch):
    monkeypatch.setattr("undulog.capture.recorder.live_feed._GRACE_S", 0.2)
    relay = spawn_relay(stage.path, ["--connect", "rerun+http://127.0.0.1:9/proxy"])
    wait_for(lambda: stage.path.is_socket() or relay.poll() is not None)
    freeze(relay.pid)
    relay.close()
    assert relay.poll() == -signal.SIGKILL
