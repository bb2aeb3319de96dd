"""``undulog record`` with faulty sources: impossible times, plug-ins that raise, simulated time.

The senders here know what they sent; joint states are counted with mcap's own reader.
"""

import itertools
import os
import signal
import socket
import sys
import threading

import numpy as np
import pytest

from support import recorders
from support.paths import ROOT
from support.recorders import connected_sender, counts, ended, events, greet, recording, send
from support.written_frames import frames_of
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.log.write.channels import JointStateChannel
from undulog.capture.recorder.bus_recorder import BusRecorder
from undulog.capture.recorder.source_clock import SourceClock

NS = 1_000_000_000
CYCLES, JOINTS = 300, 25


def polling():
    """300 polling cycles of 10 ms: each servo's command, then its answer."""
    assert len(load_robot("snake25").joints) == JOINTS
    return recorders.polling(CYCLES, 1_700_000_000 * NS)[0]


# -- impossible times ---------------------------------------------------------------------------

ODD_NS = (1 << 63, (1 << 63) + 18 * 10**17 - 1, 1 << 62, (1 << 63) - 1, 2**64 - 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", [0, pytest.param(199, marks=pytest.mark.nightly)], ids=["the first", "later"]
)
def test_an_impossible_device_time_ends_no_decoding(first, tmp_path):
    bus, frames = tmp_path / "bus.sock", polling()
    odd = frames[first::200]
    odd["t_device_ns"] = np.resize(np.array(ODD_NS, dtype=np.uint64), len(odd))
    with recording(tmp_path / "run.mcap", f"can0=unix:{bus}", "--robot", "snake25") as process:
        send(bus, frames, pause_s=0.004)
        report, _ = ended(process, signal.SIGTERM)
    assert counts(tmp_path / "run.mcap")["/joint_states"] == CYCLES
    assert report["sources"]["can0"]["malformed"] == len(odd)
    with Session.open(tmp_path / "run.mcap") as session:
        kept = session.frames("/can/can0")["t_device_ns"]
        assert kept.tolist() == frames["t_device_ns"].tolist()  # raw, as they came
        clock = session.metadata["undulog.clock"]
        assert (clock["can0.resets"], clock["can0.out_of_range"]) == ("0", str(len(odd)))
        for t_ns in session.joints("/joint_states").t_ns:
            assert (np.diff(t_ns) > 0).all()
    assert not [text for _, text in events(tmp_path / "run.mcap") if "failed" in text]


TIMES = ("9300000000.0", "99999999999.0", "-1.5", "nan", "inf", "1e300", "9" * 300)
"""What stands where socketcand writes a frame's time."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", [pytest.param(0, marks=pytest.mark.nightly), 199], ids=["the first", "later"]
)
def test_an_impossible_time_of_socketcand_ends_no_decoding(first, tmp_path):
    frames = polling()[1::2]  # a server marks no directions: answers only
    odd = range(first, len(frames), 200)
    lines = []
    for k, frame in enumerate(frames):
        t_ns = int(frame["t_device_ns"])
        sound = f"{t_ns // NS}.{t_ns % NS // 1000:06d}"
        stamp = TIMES[odd.index(k) % len(TIMES)] if k in odd else sound
        lines.append(f"< frame {int(frame['id_flags']):03X} {stamp} {'00' * 8} >".encode())
    listener = socket.create_server(("127.0.0.1", 0))

    def serve():
        client, _ = listener.accept()
        with client:
            greet(client)
            for start in range(0, len(lines), JOINTS):
                client.sendall(b"".join(lines[start : start + JOINTS]))
            client.recv(1)  # until the recorder leaves

    server = threading.Thread(target=serve)
    server.start()
    address = f"can0=can:socketcand:can0?host=127.0.0.1&port={listener.getsockname()[1]}"
    options = ("--robot", "snake25", "--duration", "4")
    with listener, recording(tmp_path / "run.mcap", address, *options) as process:
        report, _ = ended(process)
    server.join()
    assert counts(tmp_path / "run.mcap")["/joint_states"] == CYCLES
    assert report["sources"]["can0"]["frames"] == len(frames)
    assert report["sources"]["can0"]["malformed"] == len(odd)


# -- decoding that fails --------------------------------------------------------------------------


@pytest.mark.parametrize("stage", ["decode", "map", "write"])
def test_a_failure_of_decoding_costs_the_frames_that_cause_it(stage, tmp_path, monkeypatch, opened):
    """Every 200th frame makes one stage raise, as a fault of the program would."""
    owner, method, fails = {
        "decode": (BusDecoder, "decode", lambda _, args: (args[0]["t_device_ns"] % 200 == 1).any()),
        "map": (SourceClock, "add", lambda call, _: call % 3 == 0),
        "write": (JointStateChannel, "write_rows", lambda call, _: call % 11 == 0),
    }[stage]
    original, calls = getattr(owner, method), itertools.count(1)

    def failing(self, *args, **options):
        if fails(next(calls), args):
            raise ZeroDivisionError(stage)
        return original(self, *args, **options)

    monkeypatch.setattr(owner, method, failing)
    frames = polling()
    odd = np.arange(len(frames)) % (20 * 2 * JOINTS) == 77  # in every 20th cycle
    frames["t_device_ns"] += 200 - frames["t_device_ns"] % 200 + odd
    robot, now_ns = load_robot("snake25"), [1_700_000_000 * NS]
    path = tmp_path / "run.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=now_ns[0], robot=robot) as writer:
        bus = BusRecorder("can0", writer, SourceClock(), robot, directions=True)
        for cycle in np.split(frames, CYCLES):
            now_ns[0] += 10_000_000
            cycle["t_host_ns"] = now_ns[0]
            bus.add(cycle)
            bus.write_raw(lambda: now_ns[0])
            bus.decode(lambda: now_ns[0], now_ns[0] + 1)
        bus.finish(lambda: now_ns[0])
        faults = bus.take_faults()
    assert faults
    assert all("decoding failed with ZeroDivisionError" in text for text in faults)
    assert counts(path)["/can/can0"] > 0
    assert len(frames_of(path)) == len(frames)
    samples = sum(np.isfinite(v).sum() for v in opened(path).joints("/joint_states").values)
    if stage == "map":
        assert samples == CYCLES * JOINTS
    elif stage == "decode":
        assert CYCLES * JOINTS - 2 * JOINTS * odd.sum() < samples < CYCLES * JOINTS
    else:
        assert samples > 0.8 * CYCLES * JOINTS


def test_a_decoder_that_always_fails_ends_in_bounded_time(tmp_path, monkeypatch):
    tries = []

    def fail(self, frames):
        tries.append(len(frames))
        raise ZeroDivisionError

    monkeypatch.setattr(BusDecoder, "decode", fail)
    frames, robot = polling(), load_robot("snake25")
    path = tmp_path / "run.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=NS, robot=robot) as writer:
        bus = BusRecorder("can0", writer, SourceClock(), robot, directions=True)
        bus.add(frames)
        bus.finish(lambda: NS)
        (fault,) = bus.take_faults()
    assert f"{len(frames)} frames are kept raw only" in fault
    assert len(tries) < 30 * -(-len(frames) // 256)
    assert len(frames_of(path)) == len(frames)


# -- simulated time and plug-ins ------------------------------------------------------------------


@pytest.mark.slow
def test_a_duration_ends_sources_of_simulated_time(tmp_path):
    bus = tmp_path / "bus.sock"
    words = (f"can0=unix:{bus}?clock=simulated", "--duration", "1.5")
    with recording(tmp_path / "run.mcap", *words) as process, connected_sender(bus):
        report, _ = ended(process)
    assert process.returncode == 0
    assert report["ended"] == "1.5 s are over"
    assert 1.5 <= report["duration_s"] < 10


PLUG_IN = """
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import Polled, SourceCounts

class Source:
    clock, robot, directions, facts = ClockDomain.HOST, None, False, {}
    connected, finished = True, False
    def __init__(self, address):
        self.name, self.fails, self.counts = address.name, address.rest.split(","), SourceCounts()
        self.fail("open")
    def fail(self, where):
        if where in self.fails:
            raise ZeroDivisionError(f"in {where}")
    def start(self, context):
        self.now_ns = context.now_ns
        self.fail("start")
    def poll(self):
        self.fail("poll")
        if "rubbish" in self.fails:
            return None
        frames = empty_frames(1) if "dtype" not in self.fails else [1, 2]
        if "dtype" not in self.fails:
            frames["t_host_ns"] = frames["t_device_ns"] = self.now_ns()
        return Polled((frames,))
    def stop(self):
        self.fail("stop")
"""


@pytest.fixture
def plugged(tmp_path):
    """The environment of a command that finds a plug-in with the scheme ``faulty``."""
    folder = tmp_path / "plug-in"
    info = folder / "faulty-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "faulty_source.py").write_text(PLUG_IN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[undulog.sources]\nfaulty = faulty_source:Source\n")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])}


@pytest.mark.parametrize("where", ["open", "start,stop"])
def test_a_plug_in_that_fails_to_start_is_an_error_with_its_name(
    where, plugged, tmp_path, command, monkeypatch
):
    monkeypatch.syspath_prepend(tmp_path / "plug-in")
    monkeypatch.delitem(sys.modules, "faulty_source", raising=False)
    good = f"can0=unix:{tmp_path / 'bus.sock'}"
    words = (good, f"bad=faulty:{where}", "-o", tmp_path / "run.mcap", "--floor", "0", "--json")
    out, trouble = command("record", *words, "--socket", tmp_path / "control.sock", code=1)
    assert out == ""
    assert "Traceback" not in trouble
    assert trouble.startswith(("error: bad=faulty:open: ", "error: bad: "))
    assert "ZeroDivisionError" in trouble
    assert [path.name for path in tmp_path.iterdir()] == ["plug-in"]


def test_plug_ins_that_fail_later_are_given_up_alone(plugged, tmp_path):
    bus, frames = tmp_path / "bus.sock", polling()[: 50 * 2 * JOINTS]
    faulty = {"bad1": "poll,stop", "bad2": "rubbish", "bad3": "dtype"}
    sources = [f"can0=unix:{bus}", *(f"{name}=faulty:{how}" for name, how in faulty.items())]
    with recording(tmp_path / "run.mcap", *sources, env=plugged) as process:
        send(bus, frames, pause_s=0.004)
        report, _ = ended(process, signal.SIGTERM)
    assert process.returncode == 1
    assert "given up before, see /rosout: bad1, bad2, bad3" in report["ended"]
    assert report["sources"]["can0"]["frames"] == len(frames)
    given_up = {
        name
        for name, text in events(tmp_path / "run.mcap")
        if text.startswith("this source is given up: it failed with")
    }
    assert given_up == set(faulty)
    assert len(frames_of(tmp_path / "run.mcap")) == len(frames)
