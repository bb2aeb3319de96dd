"""A drive's session and its teller in detail: room, faults of decoding, and what is queued."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from undulog.capture import Session
from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.common.errors import ControlError, LogWriteError
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX, empty_frames
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import DEVICE_TIMES_END_NS
from undulog.sim.drive import session as module
from undulog.sim.drive.loop import BusTick
from undulog.sim.drive.motion import find_motion
from undulog.sim.drive.outcome import GatePhase, GateStep
from undulog.sim.drive.over_bus import bus_plan
from undulog.sim.drive.session import BusSession, GaitPublisher
from undulog.sim.gait.contract import GaitTick

EPOCH_NS, MS = 1_735_689_600_000_000_000, 1_000_000
QUIET = GateStep(GatePhase.RUN, None, None, None, ())


def frames(identifier, host_ms, device_ns=None, way=DIR_RX):
    block = empty_frames(1)
    block["id_flags"], block["dlc"], block["dir"] = identifier, 8, way
    block["t_host_ns"] = EPOCH_NS + host_ms * MS
    block["t_device_ns"] = host_ms * MS if device_ns is None else device_ns
    return block


def opened(path, **more):
    plan = bus_plan(find_motion("flat"), "can:virtual:one", path, **more)
    return BusSession(plan, ClockDomain.DEVICE, EPOCH_NS, ("a",))


def write(session, number, received=(), sent=None):
    tick = BusTick(number, QUIET, received, empty_frames(0) if sent is None else sent)
    session.write(tick, EPOCH_NS + 10 * MS * number)


def test_it_takes_the_room_of_the_write_ahead_log_and_keeps_some_for_an_ending(
    tmp_path, monkeypatch
):
    asked, path = [], tmp_path / "a.mcap"

    class Noted(DurableSink):
        def __init__(self, path, **options):
            asked.append(options)
            super().__init__(path, **options)

    monkeypatch.setattr(module, "require_space", lambda *room: asked.append(room))
    monkeypatch.setattr(module, "DurableSink", Noted)
    opened(path, force=True).close()
    assert asked == [
        (path, 48 * 2**20), {"force": True, "last_words": 4 * 2**20},
    ]  # fmt: skip


def test_a_full_disk_is_a_shortage_and_what_is_elsewhere_the_end(tmp_path, monkeypatch):
    state = {"shortage": None, "misplaced": "", "rescued": ()}

    class Sink(DurableSink):
        shortage, misplaced, rescued = (property(lambda _, key=key: state[key]) for key in state)

    monkeypatch.setattr(module, "DurableSink", Sink)
    session = opened(tmp_path / "a.mcap")
    assert session.shortage is None
    state["misplaced"] = "the folder was moved"
    assert session.shortage == "the folder was moved"
    error = LogWriteError("/proc/none/a.mcap", "no space left")
    state["shortage"] = error
    assert session.shortage == f"the disk at /proc is full or fails: {error}"
    state["rescued"] = (Path("/b/1.mcap"), Path("/b/2.mcap"))
    with pytest.raises(LogWriteError) as moved:
        session.close()
    assert str(moved.value) == (
        f"{tmp_path / 'a.mcap'}: the folder was moved; the session is in /b/1.mcap, /b/2.mcap"
    )
    session.close()  # nothing more


@pytest.mark.parametrize(("odd", "at_ms"), [(10, 100), (11, 200)])
def test_each_tenth_tick_decodes_and_tells_what_failed(tmp_path, monkeypatch, odd, at_ms):
    path, session = tmp_path / "a.mcap", opened(tmp_path / "a.mcap")
    decode = BusDecoder.decode

    def fails(self, received):
        if odd in received["data"][:, 0]:
            raise ValueError("odd")
        return decode(self, received)

    monkeypatch.setattr(BusDecoder, "decode", fails)
    for number in range(1, 23):
        block = frames(0x201, 10 * number)
        block["data"][0, 0] = number
        write(session, number, [block])
    session.close()
    with Session.open(path) as log:
        t_ns, event = next(log.messages("/rosout"))
        assert len(log.frames("/can/one")) == 22
    assert (t_ns - EPOCH_NS, event.level) == (at_ms * MS, 40)
    assert event.msg.startswith("decoding failed with ValueError('odd') and goes on; ")


def test_what_failed_at_the_end_is_told_too(tmp_path, monkeypatch):
    def fails(self, received):
        raise ValueError("odd")

    monkeypatch.setattr(BusDecoder, "decode", fails)
    session = opened(tmp_path / "a.mcap")
    write(session, 3, [frames(0x201, 30)])
    session.close()
    with Session.open(tmp_path / "a.mcap") as log:
        ((t_ns, event),) = log.messages("/rosout")
        assert (t_ns - EPOCH_NS, event.level, event.name) == (30 * MS, 40, "drive")
        assert event.msg.startswith("decoding failed with ValueError('odd') and goes on; 1 frames")


def test_an_echo_that_is_received_is_no_reading(tmp_path):
    session = opened(tmp_path / "a.mcap")
    write(session, 1, [frames(0x201, 10), frames(0x202, 10)])
    write(session, 2, [frames(0x201, 20, way=DIR_TX)])
    session.close()
    with Session.open(tmp_path / "a.mcap") as log:
        states = log.joints("/joint_states")
        assert [states.signal(name).t_ns.size for name in ("joint01", "joint02")] == [1, 1]


@pytest.mark.parametrize(("beyond_ns", "is_known"), [(0, False), (-1, True)])
def test_a_device_time_that_can_not_be_says_nothing_of_the_clock(tmp_path, beyond_ns, is_known):
    session = opened(tmp_path / "a.mcap")
    device_ns = DEVICE_TIMES_END_NS + beyond_ns
    write(session, 1, [frames(0x201, 10, 4 * MS), frames(0x202, 10, device_ns)])
    write(session, 2, sent=frames(0x101, 20, way=DIR_TX))
    session.close()
    with Session.open(tmp_path / "a.mcap") as log:
        recorded = log.frames("/can/one")
        (ours,) = recorded[recorded["dir"] == DIR_TX]["t_device_ns"].astype(np.int64)
    assert ours == (device_ns if is_known else 4 * MS) + 10 * MS


# -- telling a recorder -------------------------------------------------------------------------


class Thread:
    """A thread that runs when it is joined."""

    joined_s = None

    def __init__(self, target, name, daemon):
        self.target, self.name, self.daemon, self.started = target, name, daemon, False

    def start(self):
        self.started = True

    def join(self, timeout_s):
        self.joined_s = timeout_s
        self.target()


class Event:
    """An end that comes in the third wait."""

    def __init__(self):
        self.waited, self.was_set = [], False

    def wait(self, timeout_s):
        self.waited.append(timeout_s)
        return self.was_set and len(self.waited) >= 3

    def set(self):
        self.was_set = True


class Client:
    """A recorder that takes so many requests, and then no more."""

    takes = 10**6

    def __init__(self, path):
        self.path, self.batches, self.closed = path, [], False

    def ask_all(self, batch):
        if sum(map(len, self.batches)) + len(batch) > self.takes:
            raise ControlError("it is full")
        self.batches.append(list(batch))

    def close(self):
        self.closed = True


@pytest.fixture
def publisher(monkeypatch):
    monkeypatch.setattr(module, "threading", SimpleNamespace(Thread=Thread, Event=Event))
    monkeypatch.setattr(module, "ControlClient", Client)
    return GaitPublisher(Path("a.sock"), ["a"])


def publish(publisher, count):
    for k in range(count):
        publisher.publish(GaitTick(np.zeros(1), np.array([float(k)]), "walk", ()), k)


def test_a_thousand_requests_are_held_and_what_is_more_is_counted(publisher):
    thread, client = publisher._thread, publisher._client
    assert (thread.started, thread.daemon, client.path) == (True, True, Path("a.sock"))
    publish(publisher, 1005)  # and the mode
    publisher.note("a", "warn")  # whatever is held
    assert (publisher.dropped, publisher.taken, client.batches) == (6, 0, [])
    publisher.close()
    # 64 at once: neither side's buffer is full before the other one reads.
    assert [len(batch) for batch in client.batches] == [*[64] * 15, 41]
    assert (publisher.dropped, publisher.taken, publisher.error) == (6, 999, None)
    assert client.batches[0][:2] == [
        {"do": "mode", "text": "walk"}, {"do": "gait", "values": {"a": 0.0}, "t_ns": 0},
    ]  # fmt: skip
    assert client.batches[-1][-1] == {"do": "note", "text": "a", "level": "warn"}
    assert (thread.joined_s, client.closed) == (5.0, True)
    assert publisher._ended.waited == [0.02] * 3  # it is looked at until the end


def test_a_recorder_that_takes_no_more_is_asked_no_more(publisher):
    publish(publisher, 300)
    publisher._client.takes = 130
    publisher.close()
    assert (publisher.taken, publisher.error) == (127, "it is full")
    assert [len(batch) for batch in publisher._client.batches] == [64, 64]
    publish(publisher, 5)
    assert publisher.dropped == 0
    assert len(publisher._held) == 301 - 3 * 64
