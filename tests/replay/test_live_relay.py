"""The live view against the replay of the same session, through real sockets and processes."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import undulog
from capture import Session, SessionWriter
from capture.daemon import live_feed
from capture.daemon.live_feed import LiveFeed
from capture.daemon.live_spawn import spawn_relay
from capture.daemon.live_wire import DatagramHead, Kind, pack_datagram
from capture.errors import UsageError
from replay.live_inbox import Inbox
from replay.rrd import write_recording
from replay.viewer import free_ports, viewer_binary

EPOCH_NS = 1_735_689_600_000_000_000
STEP_NS = 20_000_000
WAIT_S = 90


def until(condition, *, each=lambda: None):
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        each()
        time.sleep(0.005)


def freeze(pid):
    """Stop a process, and wait until all its threads stand."""
    os.kill(pid, signal.SIGSTOP)
    threads = Path(f"/proc/{pid}/task")

    def stands():
        states = [
            (one / "stat").read_text().rpartition(")")[2].split()[0] for one in threads.iterdir()
        ]
        return set(states) == {"T"}

    until(stands)


class Recorder:
    """Sends a session's messages, as a recorder would, but as fast as the relay takes them."""

    def __init__(self, session, socket_path):
        with session.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            self.definitions = [
                *reader.iter_metadata(),
                *summary.schemas.values(),
                *summary.channels.values(),
                *reader.iter_attachments(),
            ]
            self.messages = [
                (m.channel_id, m.log_time, m.publish_time, m.sequence, m.data)
                for _, _, m in reader.iter_messages()
            ]
        self.feed = LiveFeed(socket_path)
        for one in self.definitions:
            self.feed.define(one)

    def connect(self):
        until(lambda: self.feed.connected, each=self.feed.pump)

    def send(self, start_s=0.0, stop_s=np.inf, *, wait=True):
        """Messages of a stretch of time; returns how many ticks there were."""
        ticks, at_ns = 0, EPOCH_NS
        for message in self.messages:
            if not start_s <= (message[1] - EPOCH_NS) * 1e-9 < stop_s:
                continue
            if message[1] >= at_ns + STEP_NS:
                at_ns = message[1]
                self.feed.pump()
                ticks += 1
                if wait:
                    until(lambda: self.feed.queued == 0, each=self.feed.pump)
            self.feed.offer(*message)
        if wait:
            until(lambda: self.feed.queued == 0, each=self.feed.pump)
        return ticks


class Relay:
    """The verb in a process of its own."""

    def __init__(self, socket_path, output, *more):
        self.output = output
        command = [sys.executable, "-m", "undulog", "view", "--live", socket_path]
        if output is not None:
            command += ["--save", output, "--json", "--force"]
        self.process = subprocess.Popen(
            [*command, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        until(lambda: socket_path.is_socket() or self.process.poll() is not None)

    def finish(self):
        out, err = self.process.communicate(timeout=WAIT_S)
        assert self.process.returncode == 0, err
        return json.loads(out)


@pytest.fixture(scope="module", autouse=True)
def small_datagrams():
    """Sent after 2 ms rather than 20, so that sending takes no time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_feed, "_FILL_NS", 2_000_000)
        yield


@pytest.fixture
def stage(tmp_path, session_file):
    """Makes recorders and relays on one socket; none of them is left."""
    socket_path = tmp_path / "live.sock"
    with ExitStack() as stack:

        class Stage:
            path = socket_path

            @staticmethod
            def recorder(session=session_file):
                one = Recorder(session, socket_path)
                stack.callback(one.feed.close)
                return one

            @staticmethod
            def relay(name="live.rrd", *more):
                one = Relay(socket_path, tmp_path / name if name else None, *more)
                stack.callback(one.process.communicate)
                stack.callback(one.process.kill)
                return one

        yield Stage


@pytest.fixture(scope="module")
def live(session_file, tmp_path_factory, read_back):
    """The whole session seen live: (what the relay reports, what it drew)."""
    folder = tmp_path_factory.mktemp("live")
    socket_path = folder / "live.sock"
    relay = Relay(socket_path, folder / "live.rrd")
    try:
        recorder = Recorder(session_file, socket_path)
        recorder.connect()
        recorder.send()
        recorder.feed.close()
        return relay.finish(), read_back(relay.output)
    finally:
        relay.process.kill()
        relay.process.communicate()


@pytest.fixture(scope="module")
def replay(session_file, tmp_path_factory, read_back):
    """The same session as a replay."""
    path = tmp_path_factory.mktemp("replay") / "replay.rrd"
    with Session.open(session_file) as session:
        write_recording(session, path)
    return read_back(path)


def rows(recorded, entity, component):
    """Time to values, in order."""
    found = zip(recorded.times(entity).tolist(), recorded.column(entity, component), strict=True)
    return dict(sorted((t, v) for t, v in found if v is not None))


def same(first, second):
    return np.allclose(
        np.asarray(first, dtype=float), np.asarray(second, dtype=float), atol=1e-12, equal_nan=True
    )


def test_every_message_is_shown(live, session_file):
    report, _ = live
    with Session.open(session_file) as session:
        count = sum(channel.count for channel in session.channels.values())
    assert report["sessions"] == ["made-for-tests"]
    assert (report["shown"], report["dropped"], report["unread"]) == (count, 0, 0)
    assert report["lag_s"]["p50"] > 0


def test_angles_are_those_that_were_measured(live, truth):
    _, drawn = live
    t_ns = truth.t_ns - EPOCH_NS
    for entity, values in (
        ("/joints/measured", truth.position),
        ("/joints/commanded", truth.command),
        ("/joints/error", truth.position - truth.command),
    ):
        found = rows(drawn, entity, "Scalars:scalars")
        assert list(found) == t_ns.tolist()
        np.testing.assert_allclose(list(found.values()), values, atol=1e-12)
    degrees = rows(drawn, "/joints/measured", "Angle:degrees")
    np.testing.assert_allclose(list(degrees.values()), np.degrees(truth.position), rtol=1e-5)


def test_power_is_torque_times_velocity(live, truth):
    _, drawn = live
    found = rows(drawn, "/power/mechanical", "Scalars:scalars")
    assert list(found) == (truth.t_ns - EPOCH_NS).tolist()
    np.testing.assert_allclose(list(found.values()), truth.effort * truth.velocity, atol=1e-12)
    total = rows(drawn, "/power/total/electrical", "Scalars:scalars")
    np.testing.assert_allclose(np.ravel(list(total.values())), 6.0 * truth.effort.sum(axis=1))


@pytest.mark.parametrize(
    ("entity", "component"),
    [
        ("/world/snake/measured", "Capsules3D:translations"),
        ("/world/snake/measured", "Capsules3D:quaternions"),
        ("/world/snake/commanded", "Capsules3D:translations"),
        ("/world/snake/places", "Points3D:positions"),
        ("/joints/places/head/measured", "Scalars:scalars"),
        ("/joints/error", "Scalars:scalars"),
        ("/signals/joint_current", "Scalars:scalars"),
        ("/gait/mode", "StateChange:state"),
        ("/events", "TextLog:text"),
    ],
)
def test_live_and_replay_draw_the_same(live, replay, entity, component):
    _, drawn = live
    seen, expected = rows(drawn, entity, component), rows(replay, entity, component)
    common = [t for t in expected if t in seen]
    assert len(common) >= 0.9 * len(expected)
    for t in common:
        if isinstance(expected[t][0], str):
            assert seen[t] == expected[t]
        else:
            assert same(seen[t], expected[t])


def test_names_and_colours_are_the_replays(live, replay):
    _, drawn = live
    for entity in ("/joints/measured", "/joints/commanded", "/power/total/mechanical"):
        for component in ("SeriesLines:names", "SeriesLines:colors"):
            assert drawn.static(entity, component) == replay.static(entity, component)


def test_whatever_is_drawn_is_in_the_replay_too(live, replay):
    _, drawn = live
    assert {entity for entity in drawn.entities if not entity.startswith("/__")} <= replay.entities


def test_static_things_are_said_once(live):
    _, drawn = live
    chunks = [
        chunk
        for chunk in drawn._chunks
        if chunk.entity_path == "/joints/measured" and chunk.is_static
    ]
    assert len(chunks) == 1


def test_relay_that_comes_late_understands_what_is_left(stage, truth, read_back):
    recorder = stage.recorder()
    recorder.send(0.0, 1.5, wait=False)
    relay = stage.relay()
    recorder.connect()
    recorder.send(1.5)
    recorder.feed.close()
    report = relay.finish()
    assert report["dropped"] == 0
    drawn = read_back(relay.output)
    found = rows(drawn, "/joints/measured", "Scalars:scalars")
    assert list(found) == (truth.t_ns - EPOCH_NS)[150:].tolist()
    np.testing.assert_allclose(list(found.values()), truth.position[150:], atol=1e-12)
    # The mode was said before, and still holds.
    assert rows(drawn, "/gait/mode", "StateChange:state") == {1_000_000_000: ["avoid"]}


def test_nothing_derived_is_lost_when_much_comes_at_once(stage, truth, read_back):
    recorder, relay = stage.recorder(), stage.relay()
    recorder.connect()
    freeze(relay.process.pid)
    recorder.send(wait=False)  # all three seconds wait
    os.kill(relay.process.pid, signal.SIGCONT)
    until(lambda: recorder.feed.queued == 0, each=recorder.feed.pump)
    recorder.feed.close()
    assert relay.finish()["dropped"] == 0
    drawn = read_back(relay.output)
    for entity in ("/joints/measured", "/joints/error", "/power/mechanical"):
        found = rows(drawn, entity, "Scalars:scalars")
        assert list(found) == (truth.t_ns - EPOCH_NS).tolist()


def test_frozen_relay_holds_nothing_up_and_goes_on(stage, read_back, monkeypatch):
    monkeypatch.setattr(live_feed, "_DATAGRAM", 4096)
    recorder, relay = stage.recorder(), stage.relay()
    recorder.connect()
    recorder.send(0.0, 0.5)
    freeze(relay.process.pid)
    recorder.feed._max_messages = 50
    ticks = recorder.send(0.5, 2.5, wait=False)
    assert ticks == 100
    assert recorder.feed.counts.dropped > 0
    os.kill(relay.process.pid, signal.SIGCONT)
    recorder.send(2.5)
    recorder.feed.close()
    report = relay.finish()
    assert report["dropped"] == recorder.feed.counts.dropped
    assert report["shown"] == recorder.feed.counts.sent
    found = list(rows(read_back(relay.output), "/joints/measured", "Scalars:scalars"))
    assert found[:50] == [10_000_000 * i for i in range(50)]
    assert found[-50:] == [2_500_000_000 + 10_000_000 * i for i in range(50)]


def test_killed_relay_is_replaced(stage, read_back, monkeypatch):
    monkeypatch.setattr(live_feed, "RETRY_NS", 10_000_000)
    recorder, first = stage.recorder(), stage.relay("first.rrd")
    recorder.connect()
    recorder.send(0.0, 0.5)
    first.process.kill()
    first.process.wait()
    assert recorder.send(0.5, 1.5, wait=False) > 40
    until(lambda: not recorder.feed.connected, each=recorder.feed.pump)
    second = stage.relay("second.rrd")  # over the socket that the first has left
    recorder.connect()
    recorder.send(1.5)
    recorder.feed.close()
    second.finish()
    found = list(rows(read_back(second.output), "/joints/measured", "Scalars:scalars"))
    assert found == [1_500_000_000 + 10_000_000 * i for i in range(150)]


def test_joints_sampled_in_turn_are_drawn_at_their_own_times(
    stage, snake25, truth, tmp_path, read_back
):
    path = tmp_path / "turns.mcap"
    offset = np.linspace(0.0, 8e-3, 25)
    with SessionWriter(path, session_id="turns", epoch_ns=EPOCH_NS, robot=snake25) as w:
        offsets = w.joint_state("/joint_sample_offset", snake25.joint_names, unit="s")
        states = w.joint_state("/joint_states", snake25.joint_names, unit="rad")
        for i, t_ns in enumerate(truth.t_ns.tolist()):
            offsets.write(t_ns, offset)
            states.write(t_ns, truth.position[i])
    recorder, relay = stage.recorder(path), stage.relay()
    recorder.connect()
    recorder.send()
    recorder.feed.close()
    relay.finish()
    drawn = read_back(relay.output)
    for j in (0, 12, 24):
        found = rows(drawn, f"/joints/measured/{snake25.joint_names[j]}", "Scalars:scalars")
        expected = truth.t_ns - EPOCH_NS + round(offset[j] * 1e9)
        assert np.abs(np.array(list(found)) - expected).max() <= 1
        np.testing.assert_allclose(np.ravel(list(found.values())), truth.position[:, j])
    centres = rows(drawn, "/world/snake/measured", "Capsules3D:translations")
    assert len(centres) > 100  # at the origin, without odometry


def test_noise_on_the_socket_is_counted_and_borne(stage):
    recorder, relay = stage.recorder(), stage.relay()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.connect(str(stage.path))
        link.send(b"")
        link.send(b"not ours")
        link.send(pack_datagram(DatagramHead(Kind.MESSAGES, 1, 1, 0), [b"\x05\0\0\0cut"]))
    recorder.connect()
    recorder.send()
    recorder.feed.close()
    report = relay.finish()
    assert report["unread"] == 3
    assert report["sessions"] == ["made-for-tests"]


def test_interrupted_relay_leaves_a_whole_file_and_no_socket(stage, read_back):
    recorder, relay = stage.recorder(), stage.relay()
    recorder.connect()
    recorder.send(0.0, 1.0)
    until(lambda: recorder.feed.counts.sent > 0, each=recorder.feed.pump)
    relay.process.send_signal(signal.SIGINT)
    report = relay.finish()
    assert report["shown"] == recorder.feed.counts.sent
    assert "/joints/measured" in read_back(relay.output).entities
    assert not stage.path.exists()


def test_without_a_recording_nothing_is_written(stage):
    relay = stage.relay()
    relay.process.terminate()
    _, err = relay.process.communicate(timeout=WAIT_S)
    assert relay.process.returncode == 1
    assert "no recording was heard" in err
    assert not relay.output.exists()


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
        recorder.connect()
        recorder.send()
        recorder.feed.close()
        kinds = []

        def end_has_come():
            kinds[:] = [one.head.kind for one in inbox._queue]
            return Kind.END in kinds

        until(end_has_come)
        taken = inbox.take()
        shown = sum(one.head.messages for one in taken)
        assert shown + inbox.dropped == recorder.feed.counts.sent
        assert inbox.dropped > 0
        assert taken[0].head.kind is Kind.DEFINITIONS
        assert sum(len(one.data) for one in taken) <= 150_000


def test_spawned_relay_is_in_a_session_of_its_own_and_ends_when_told(stage, tmp_path):
    output = tmp_path / "spawned.rrd"
    relay = spawn_relay(stage.path, ["--save", str(output)])
    try:
        assert os.getsid(relay.pid) == relay.pid
        until(stage.path.is_socket)
        until(lambda: os.getpriority(os.PRIO_PROCESS, relay.pid) >= 10)
        recorder = stage.recorder()
        recorder.connect()
        recorder.send(0.0, 0.5)
        assert relay.poll() is None
    finally:
        relay.close()
        relay.close()
    assert relay.poll() == 0
    assert output.stat().st_size > 10_000


def test_spawned_relay_says_why_it_ended(tmp_path):
    relay = spawn_relay(tmp_path / "there is no such folder" / "s", ["--connect", "x"])
    try:
        until(lambda: relay.poll() is not None)
        assert relay.poll() == 2
        assert "the socket can't be made" in relay.complaint()
    finally:
        relay.close()


def test_frozen_relay_that_was_spawned_can_be_ended(stage, monkeypatch):
    monkeypatch.setattr("capture.daemon.live_spawn._GRACE_S", 0.2)
    relay = spawn_relay(stage.path, ["--connect", "rerun+http://127.0.0.1:9/proxy"])
    until(lambda: stage.path.is_socket() or relay.poll() is not None)
    freeze(relay.pid)
    relay.close()
    assert relay.poll() == -signal.SIGKILL


@pytest.fixture
def server(tmp_path):
    """Rerun's own gRPC server without a window, on this machine only: (address, process)."""
    (port,) = free_ports(1)
    process = subprocess.Popen(
        [viewer_binary(), "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    yield f"rerun+http://127.0.0.1:{port}/proxy", process
    process.kill()
    process.wait()


@pytest.mark.slow
def test_frozen_and_killed_viewer_costs_the_feed_nothing(stage, server):
    address, process = server
    recorder, relay = stage.recorder(), stage.relay(None, "--connect", address)
    recorder.connect()
    recorder.send(0.0, 1.0)
    freeze(process.pid)
    assert recorder.send(1.0, 2.0) == 50
    process.kill()
    assert recorder.send(2.0) >= 49
    assert recorder.feed.counts.dropped == 0
    assert relay.process.poll() is None
    relay.process.send_signal(signal.SIGTERM)
    relay.process.communicate(timeout=WAIT_S)
    assert not stage.path.exists()


@pytest.mark.slow
def test_relay_of_a_frozen_viewer_can_be_ended(stage, server):
    address, process = server
    recorder, relay = stage.recorder(), stage.relay(None, "--connect", address)
    recorder.connect()
    recorder.send(0.0, 1.0)
    freeze(process.pid)
    recorder.send(1.0)
    relay.process.send_signal(signal.SIGTERM)
    out, err = relay.process.communicate(timeout=WAIT_S)
    assert relay.process.returncode == 1
    assert "messages shown, 0 dropped" in out
    # Whether it hangs in a send or in the last flush is a matter of when it froze.
    assert re.search("the viewer (did not take the last of it|takes no data)", err)


@pytest.mark.slow
def test_web_serves_this_machine_only_and_leaves_nothing(stage):
    relay = stage.relay(None, "--web")
    page = relay.process.stdout.readline().strip()
    assert page.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page, timeout=WAIT_S) as answer:
        assert answer.status == 200
    recorder = stage.recorder()
    recorder.connect()
    recorder.send(0.0, 1.0)
    (child,) = (
        Path(f"/proc/{relay.process.pid}/task/{relay.process.pid}/children").read_text().split()
    )
    ports = {int(text) for text in re.findall(r"(?:127.0.0.1:|127.0.0.1%3A)(\d+)", page)}
    assert len(ports) == 2
    assert listening(ports) == {(f"{0x0100007F:08X}", port) for port in ports}
    relay.process.send_signal(signal.SIGINT)
    relay.process.communicate(timeout=WAIT_S)
    assert relay.process.returncode == 0
    assert not Path(f"/proc/{child}").exists()
    assert not stage.path.exists()


def listening(ports):
    """Address and port of all listening sockets at some ports."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    lines += Path("/proc/net/tcp6").read_text().splitlines()[1:]
    entries = [line.split() for line in lines]
    local = [entry[1].split(":") for entry in entries if entry[3] == "0A"]
    return {(address, int(port, 16)) for address, port in local if int(port, 16) in ports}


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ([], "give a session to see, or --live"),
        (["a.mcap", "--live", "s"], "give a session to see, or --live"),
        (["a.mcap", "--connect", "x"], "give --live as well"),
        (["--live", "s", "--connect", "x", "--web"], "without --web"),
    ],
)
def test_wrong_usage_is_told(arguments, why, capsys):
    assert undulog.run(["view", *arguments]) == 2
    assert why in capsys.readouterr().err


def test_window_without_a_display_is_refused_at_once(monkeypatch, tmp_path, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    assert undulog.run(["view", "--live", str(tmp_path / "s")]) == 2
    assert "no display" in capsys.readouterr().err
